// The tangent of the part that the projection has in a step, derived by hand.
#pragma once

#include "coarse_derivative.hpp"
#include "density_derivative.hpp"
#include "surroundings_derivative.hpp"

namespace cortado {

template <class Real, int D>
using ManyMoments = std::vector<Moments<Real, D>>;
template <class Real, int D>
using ManyEffects = std::vector<Effects<Real, D>>;

template <class Real, int D>
ManyMoments<Real, D> moments_tangent(const Model<Real, D>& model, const Step<Real, D>& step, const Vectors<Real, D>& x,
                                     const Vectors<Real, D>& dx) {
    const Real m = model.rest_density;
    ManyMoments<Real, D> change(dx.size());
    each_particle(dx.size(), model.threads, [&](std::size_t i) {
        Moments<Real, D>& dot = change[i];
        for (auto pair = step.fluid.begin_of(i); pair != step.fluid.end_of(i); ++pair) {
            const Vector<Real, D> dx_ij = dx[i] - dx[pair->other], g = model.volume * pair->gradient();
            const Vector<Real, D> dg = model.volume * pair->hessian_product(dx_ij);
            dot.M -= dg * pair->x.transpose() + g * dx_ij.transpose();
            dot.Q += (dg * g.transpose() + g * dg.transpose()) / m;
            dot.g += dg;
        }
        for (auto pair = step.walls.begin_of(i); pair != step.walls.end_of(i); ++pair) {
            const Vector<Real, D>& normal = model.wall_normals[pair->other];
            const Real volume = model.volume * model.wall_weights[pair->other];
            const Vector<Real, D> dg = volume * pair->hessian_product(dx[i]);
            const Real dw = volume * pair->gradient().dot(dx[i]);
            dot.normal += normal.dot(dg) * normal;
            dot.whole += dg;
            dot.nu += dw;
            if (!model.wall_mirrors[pair->other]) continue;
            dot.mirror += normal.dot(dg) * normal;
            dot.behind += dw;
        }
        each_image(model, step.fluid, x, i, [&](const Image<Real, D>& image) {
            dot.images += model.volume * image.gradient().dot(dx[i] - image.of(dx[image.other]));
        });
        dot.gamma = Edge<Real, D>(model, step.projection.moments[i]).tangent(dot.normal, dot.whole);
        dot.M = even<Real, D>(dot.M);  // which it is over all pairs, but for round-off
    });
    return change;
}

// Of what walls and images add to D^T y.
template <class Real, int D>
Vector<Real, D> walled_tangent(const Model<Real, D>& model, const Step<Real, D>& step, const Vectors<Real, D>& x,
                               const Vectors<Real, D>& dx, const ManyEffects<Real, D>& effects_dot,
                               const Values<Real>& y, const Values<Real>& dy, std::size_t i) {
    const ManyEffects<Real, D>& effects = step.projection.effects;
    const auto pushed_dot = [&](std::size_t j) { return effects_dot[j].image * y[j] + effects[j].image * dy[j]; };
    Vector<Real, D> total = Vector<Real, D>::Zero();
    each_image(model, step.fluid, x, i, [&](const Image<Real, D>& image) {
        const int j = image.other;
        const Vector<Real, D> dg = image.hessian_product(Vector<Real, D>(dx[i] - image.of(dx[j])));
        total += (pushed_dot(i) + pushed_dot(j)) * image.gradient();
        total += (effects[i].image * y[i] + effects[j].image * y[j]) * dg;
    });
    return dy[i] * effects[i].push + y[i] * effects_dot[i].push + model.volume * total;
}

// Of D^T y, but for that.
template <class Real, int D>
Vectors<Real, D> pull_tangent(const Model<Real, D>& model, const Step<Real, D>& step, const Vectors<Real, D>& dx,
                              const ManyEffects<Real, D>& effects_dot, const Values<Real>& y, const Values<Real>& dy) {
    const Projection<Real, D>& at = step.projection;
    Vectors<Real, D> dpull(y.size());
    each_particle(y.size(), model.threads, [&](std::size_t i) {
        const auto pull = [&](std::size_t j) { return Matrix<Real, D>(y[j] * at.effects[j].L); };
        const auto change = [&](std::size_t j) {
            return Matrix<Real, D>(dy[j] * at.effects[j].L + y[j] * effects_dot[j].L);
        };
        Vector<Real, D> total = Vector<Real, D>::Zero();
        const Matrix<Real, D> T = pull(i), dT = change(i);
        for (auto pair = step.fluid.begin_of(i); pair != step.fluid.end_of(i); ++pair) {
            const int j = pair->other;
            const Vector<Real, D> dx_ij = dx[i] - dx[j];
            const Vector<Real, D> dg = pair->hessian_product(dx_ij);
            total += model.volume * ((dT + change(j)) * pair->gradient() + (T + pull(j)) * dg);
        }
        dpull[i] = total;
    });
    return dpull;
}

// Of h and N of the coarse grid.
template <class Real, int D>
Pushes<Real, D> pushes_tangent(const Model<Real, D>& model, const Step<Real, D>& step, const Vectors<Real, D>& x,
                               const Vectors<Real, D>& dx, const ManyEffects<Real, D>& effects_dot) {
    const Projection<Real, D>& at = step.projection;
    Values<Real> c(dx.size()), dc(dx.size());
    for (std::size_t i = 0; i < dx.size(); ++i) {
        c[i] = at.effects[i].shared;
        dc[i] = effects_dot[i].shared;
    }
    Pushes<Real, D> dot(dx.size());
    dot.h = pull_tangent(model, step, dx, effects_dot, c, dc);
    each_particle(dx.size(), model.threads, [&](std::size_t i) {
        dot.h[i] += walled_tangent(model, step, x, dx, effects_dot, c, dc, i);
        each_image(model, step.fluid, x, i, [&](const Image<Real, D>& image) {
            const int j = image.other;
            const Real pushed = model.volume * at.effects[j].image * c[j];
            const Real pushed_dot = model.volume * (effects_dot[j].image * c[j] + at.effects[j].image * dc[j]);
            const Vector<Real, D> dg = image.hessian_product(Vector<Real, D>(dx[i] - image.of(dx[j])));
            const Vector<Real, D> dpush = pushed_dot * image.gradient() + pushed * dg, direct_dot = dx[i] - dx[j];
            dot.N[i] -= dpush * image.direct.transpose() + pushed * image.gradient() * direct_dot.transpose();
        });
        for (auto pair = step.fluid.begin_of(i); pair != step.fluid.end_of(i); ++pair) {
            const int j = pair->other;
            const Matrix<Real, D> T = c[j] * at.effects[j].L, dT = dc[j] * at.effects[j].L + c[j] * effects_dot[j].L;
            const Vector<Real, D> dx_ij = dx[i] - dx[j], g = model.volume * pair->gradient();
            const Vector<Real, D> dg = model.volume * pair->hessian_product(dx_ij);
            dot.N[i] -= (dT * g + T * dg) * pair->x.transpose() + T * g * dx_ij.transpose();
        }
    });
    return dot;
}

// From the tangents of a state, of its densities without images and of predicted velocities to that of the step's result.
template <class Real, int D>
State<Real, D> projection_tangent(const Model<Real, D>& model, const Step<Real, D>& step, const State<Real, D>& state,
                                  const State<Real, D>& dot, const Values<Real>& without_dot,
                                  const Vectors<Real, D>& dv_star) {
    const Projection<Real, D>& at = step.projection;
    const std::size_t count = state.x.size();
    const Real dt = model.time_step, m = model.rest_density;
    const ManyMoments<Real, D> moments_dot = moments_tangent(model, step, state.x, dot.x);
    ManyEffects<Real, D> effects_dot(count);
    Values<Real> dk(count), dy(count), dn(count);
    Vectors<Real, D> dv(count), du(count), dkick;  // du: before the last iteration
    each_particle(count, model.threads, [&](std::size_t i) {
        effects_dot[i] = SurroundingsSlope<Real, D>(model, at.moments[i]).tangent(moments_dot[i]);
        if (at.shut) effects_dot[i].tension = Real(0);
        const Moments<Real, D>&of = at.moments[i], &change = moments_dot[i];
        dn[i] = without_dot[i] + effects_dot[i].image * (of.images - of.behind) +
                at.effects[i].image * (change.images - change.behind);
        const Real full = at.taken(model, state, i), dfull = full > 0 ? effects_dot[i].full : Real(0);
        dk[i] = dy[i] = dfull * state.k[i] + full * dot.k[i];
        dv[i] = dv_star[i] + dfull * state.kick[i] + full * dot.kick[i];
    });
    const auto divergence = [&](std::size_t i, const Vectors<Real, D>& u, const Vectors<Real, D>& change) {
        const Matrix<Real, D>&L = at.effects[i].L, &dL = effects_dot[i].L;
        Real found = at.effects[i].push.dot(change[i]) + effects_dot[i].push.dot(u[i]);
        Real wide = 0, wide_dot = 0;
        each_image(model, step.fluid, state.x, i, [&](const Image<Real, D>& image) {
            const int j = image.other;
            const Vector<Real, D> u_ij = u[i] - image.of(u[j]), dx_ij = dot.x[i] - image.of(dot.x[j]);
            wide += image.gradient().dot(u_ij);
            wide_dot += image.gradient().dot(change[i] - image.of(change[j])) + image.hessian_product(dx_ij).dot(u_ij);
        });
        found += model.volume * (at.effects[i].image * wide_dot + effects_dot[i].image * wide);
        for (auto pair = step.fluid.begin_of(i); pair != step.fluid.end_of(i); ++pair) {
            const int j = pair->other;
            const Vector<Real, D> g = pair->gradient(), dg = pair->hessian_product(dot.x[i] - dot.x[j]);
            const Vector<Real, D> by_u = L * g, by_x = L * dg + dL * g;
            found += model.volume * (by_u.dot(change[i] - change[j]) + by_x.dot(u[i] - u[j]));
        }
        return found;
    };
    const auto wanted = [&](std::size_t i) {
        const Real less = (at.effects[i].full - 1) * dn[i] - effects_dot[i].full * (1 - at.n[i]);
        return at.n[i] < 1 ? Real(less / dt) : Real(0);
    };
    const auto press = [&](const Values<Real>& y) {
        dkick = pull_tangent(model, step, dot.x, effects_dot, y, dy);
        for (std::size_t i = 0; i < count; ++i) {
            dkick[i] = -(dkick[i] + walled_tangent(model, step, state.x, dot.x, effects_dot, y, dy, i)) / m;
            dv[i] = dv_star[i] + dkick[i];
        }
    };
    Pushes<Real, D> pushes_dot;
    if (!at.corrections.empty()) pushes_dot = pushes_tangent(model, step, state.x, dot.x, effects_dot);
    const auto correct = [&](std::size_t k) {
        const Correction<Real, D>& before = at.corrections[k];
        std::vector<CorrectionChange<Real>> change(count);
        each_particle(count, model.threads, [&](std::size_t i) {
            const Real dr = before.counted[i] * (divergence(i, before.u, dv) - wanted(i));
            change[i] = {dy[i], dr, effects_dot[i].shared, effects_dot[i].tension};
        });
        const Values<Real> dd = correction_tangent(model, at, before, dot.x, pushes_dot, change);
        Vectors<Real, D> df = pull_tangent(model, step, dot.x, effects_dot, before.d, dd);
        Real climb = 0;
        for (std::size_t i = 0; i < count; ++i) {
            df[i] = -(df[i] + walled_tangent(model, step, state.x, dot.x, effects_dot, before.d, dd, i)) / m;
            climb += change[i].r * before.d[i] + before.r[i] * dd[i] - 2 * before.alpha * m * before.f[i].dot(df[i]);
        }
        const Real dalpha = before.bends() ? Real(climb / before.energy) : Real(0);
        for (std::size_t i = 0; i < count; ++i) {
            dk[i] = dy[i] += dalpha * before.d[i] + before.alpha * dd[i];
            dv[i] += dalpha * before.f[i] + before.alpha * df[i];
        }
    };
    for (std::size_t k = 0; k < at.divergences.size(); ++k) {
        if (at.corrects(k)) correct(k);
        du = dv;
        each_particle(count, model.threads, [&](std::size_t i) {
            const Effects<Real, D>&of = at.effects[i], &change = effects_dot[i];
            const Real b = at.wanted(model, i, at.n[i]), D_i = at.divergences[k][i], per = at.step_of(model, i);
            const Real dD = divergence(i, at.u[k], du), db = wanted(i);
            const Real down = at.y[k][i] + per * D_i, dper = -per * change.a / of.a;
            const Clamp<Real> clamp(Real(at.y[k][i] + per * (D_i - b)), down);
            const Real moved = dy[i] + dper * D_i + per * dD;
            const Real dk_new = clamp.rise * (moved - dper * b - per * db) +
                                clamp.fall * (change.tension * down + of.tension * moved);
            dy[i] = dk_new + model.momenta[k] * (dk_new - dk[i]);
            dk[i] = dk_new;
        });
        press(at.uncorrected(k + 1));
    }
    const Vectors<Real, D>& u = at.flow();
    Vectors<Real, D> dx_moved(count);
    each_particle(count, model.threads, [&](std::size_t i) {
        const Real pull_dot = effects_dot[i].repaired * at.k.back()[i] + at.effects[i].repaired * dk[i];
        const Vector<Real, D> zero = Vector<Real, D>::Zero();
        Crowding<Real, D> change{Matrix<Real, D>::Zero(), zero, effects_dot[i].shifted, pull_dot, zero};
        for (auto pair = step.fluid.begin_of(i); pair != step.fluid.end_of(i); ++pair) {
            const int j = pair->other;
            const Vector<Real, D> dx_ij = dot.x[i] - dot.x[j], g = model.volume * pair->gradient();
            const Vector<Real, D> dg = model.volume * pair->hessian_product(dx_ij);
            const Closeness<Real> near(Real(model.volume * pair->w), model.nearest_weight);
            change.A += (du[i] - du[j]) * g.transpose() + (u[i] - u[j]) * dg.transpose();
            change.crowd += near.value * dg + near.slope * g.dot(dx_ij) * g;
            change.apart += Apart<Real, D>(model, pair->x).along(dx_ij);
        }
        const Crowding<Real, D> crowding{at.A[i], at.crowd[i], at.effects[i].shifted, at.pulled(i), at.apart[i]};
        const ShiftSlope<Real, D> shift(model, at.moments[i], crowding);
        dx_moved[i] = dot.x[i] + dt * dv[i] + shift.tangent(moments_dot[i], change);
    });
    Vectors<Real, D> dx_now = dx_moved;
    Values<Real> dc(count, Real(0));
    for (std::size_t k = 0; k < at.excess.size(); ++k) {
        each_particle(count, model.threads, [&](std::size_t i) {
            const Effects<Real, D>&of = at.effects[i], &change = effects_dot[i];
            const Real per = at.repair_step_of(model, k, i), excess = at.excess[k][i];
            Real dn_now = model.volume * weights_tangent(model, i, step, at.x_now[k], dx_now);
            dn_now += of.image * surplus_tangent(model, step.fluid, step.walls, at.x_now[k], dx_now, i);
            dn_now += change.image * surplus(model, step.fluid, step.walls, at.x_now[k], i);
            const Real z = at.c[k][i] + per * excess, dz = dc[i] + per * (dn_now - change.a / of.a * excess);
            dc[i] = z < 0 ? Real(of.repaired * dz + change.repaired * z) : dz;
        });
        each_particle(count, model.threads, [&](std::size_t i) {
            const Values<Real>& c = at.c[k + 1];
            Vector<Real, D> total = walled_tangent(model, step, state.x, dot.x, effects_dot, c, dc, i);
            for (auto pair = step.fluid.begin_of(i); pair != step.fluid.end_of(i); ++pair) {
                const int j = pair->other;
                const Vector<Real, D> dg = pair->hessian_product(dot.x[i] - dot.x[j]);
                total += model.volume * ((dc[i] + dc[j]) * pair->gradient() + (c[i] + c[j]) * dg);
            }
            dx_now[i] = dx_moved[i] - at.along(k, i, total / m);
        });
    }
    return {dx_now, dv, dk, dkick};
}

}  // namespace cortado
