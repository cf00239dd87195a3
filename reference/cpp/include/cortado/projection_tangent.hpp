// The tangent of the part that the projection has in a step, derived by hand.
#pragma once

#include "density_derivative.hpp"
#include "surroundings_derivative.hpp"

namespace cortado {

template <class Real, int D>
using ManyMoments = std::vector<Moments<Real, D>>;
template <class Real, int D>
using ManyEffects = std::vector<Effects<Real, D>>;

template <class Real, int D>
ManyMoments<Real, D> moments_tangent(const Model<Real, D>& model, const Step<Real, D>& step,
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
            dot.normal += normal.dot(dg) * normal;
            dot.whole += dg;
            dot.nu += volume * pair->gradient().dot(dx[i]);
        }
        dot.gamma = Edge<Real, D>(model, step.projection.moments[i]).tangent(dot.normal, dot.whole);
        dot.M = even<Real, D>(dot.M);  // which it is over all pairs, but for round-off
    });
    return change;
}

// Of what pressures y add to velocities.
template <class Real, int D>
Vectors<Real, D> kick_tangent(const Model<Real, D>& model, const Step<Real, D>& step, const Vectors<Real, D>& dx,
                              const ManyMoments<Real, D>& moments_dot, const ManyEffects<Real, D>& effects_dot,
                              const Values<Real>& y, const Values<Real>& dy) {
    const Projection<Real, D>& at = step.projection;
    Vectors<Real, D> dkick(y.size());
    each_particle(y.size(), model.threads, [&](std::size_t i) {
        const auto pull = [&](std::size_t j) { return Matrix<Real, D>(y[j] * at.effects[j].L); };
        const auto change = [&](std::size_t j) {
            return Matrix<Real, D>(dy[j] * at.effects[j].L + y[j] * effects_dot[j].L);
        };
        Vector<Real, D> total = dy[i] * at.moments[i].gamma + y[i] * moments_dot[i].gamma;
        const Matrix<Real, D> T = pull(i), dT = change(i);
        for (auto pair = step.fluid.begin_of(i); pair != step.fluid.end_of(i); ++pair) {
            const int j = pair->other;
            const Vector<Real, D> dx_ij = dx[i] - dx[j];
            const Vector<Real, D> dg = pair->hessian_product(dx_ij);
            total += model.volume * ((dT + change(j)) * pair->gradient() + (T + pull(j)) * dg);
        }
        dkick[i] = -total / model.rest_density;
    });
    return dkick;
}

// From the tangents of a state, of its densities and of predicted velocities to that of the step's result.
template <class Real, int D>
State<Real, D> projection_tangent(const Model<Real, D>& model, const Step<Real, D>& step, const State<Real, D>& state,
                                  const State<Real, D>& dot, const Values<Real>& dn, const Vectors<Real, D>& dv_star) {
    const Projection<Real, D>& at = step.projection;
    const std::size_t count = state.x.size();
    const Real dt = model.time_step, m = model.rest_density;
    const ManyMoments<Real, D> moments_dot = moments_tangent(model, step, dot.x);
    ManyEffects<Real, D> effects_dot(count);
    Values<Real> dk(count), dy(count);
    Vectors<Real, D> dv(count), du(count), dkick;  // du: before the last iteration
    each_particle(count, model.threads, [&](std::size_t i) {
        effects_dot[i] = SurroundingsSlope<Real, D>(model, at.moments[i]).tangent(moments_dot[i]);
        const Real full = at.effects[i].full, dfull = effects_dot[i].full;
        dk[i] = dy[i] = dfull * state.k[i] + full * dot.k[i];
        dv[i] = dv_star[i] + dfull * state.kick[i] + full * dot.kick[i];
    });
    for (std::size_t k = 0; k < at.divergences.size(); ++k) {
        const Vectors<Real, D>& u = at.u[k];
        du = dv;
        each_particle(count, model.threads, [&](std::size_t i) {
            const Effects<Real, D>&of = at.effects[i], &change = effects_dot[i];
            Real dD = at.moments[i].gamma.dot(du[i]) + moments_dot[i].gamma.dot(u[i]);
            for (auto pair = step.fluid.begin_of(i); pair != step.fluid.end_of(i); ++pair) {
                const int j = pair->other;
                const Vector<Real, D> g = pair->gradient(), dg = pair->hessian_product(dot.x[i] - dot.x[j]);
                const Vector<Real, D> by_u = of.L * g, by_x = of.L * dg + change.L * g;
                dD += model.volume * (by_u.dot(du[i] - du[j]) + by_x.dot(u[i] - u[j]));
            }
            const Real b = at.wanted(model, i, step.n[i]), D_i = at.divergences[k][i], per = at.step_of(model, i);
            const Real less = (of.full - 1) * dn[i] - change.full * (1 - step.n[i]);
            const Real db = step.n[i] < 1 ? Real(less / dt) : Real(0);
            const Real down = at.y[k][i] + per * D_i, dper = -per * change.a / of.a;
            const Clamp<Real> clamp(Real(at.y[k][i] + per * (D_i - b)), down);
            const Real moved = dy[i] + dper * D_i + per * dD;
            const Real dk_new = clamp.rise * (moved - dper * b - per * db) +
                                clamp.fall * (change.tension * down + of.tension * moved);
            dy[i] = dk_new + model.momenta[k] * (dk_new - dk[i]);
            dk[i] = dk_new;
        });
        dkick = kick_tangent(model, step, dot.x, moments_dot, effects_dot, at.y[k + 1], dy);
        for (std::size_t i = 0; i < count; ++i) dv[i] = dv_star[i] + dkick[i];
    }
    const Vectors<Real, D>& u = at.flow();
    Vectors<Real, D> dx_moved(count);
    each_particle(count, model.threads, [&](std::size_t i) {
        const Real pull_dot = effects_dot[i].repaired * at.k.back()[i] + at.effects[i].repaired * dk[i];
        Crowding<Real, D> change{Matrix<Real, D>::Zero(), Vector<Real, D>::Zero(), effects_dot[i].shifted, pull_dot};
        for (auto pair = step.fluid.begin_of(i); pair != step.fluid.end_of(i); ++pair) {
            const int j = pair->other;
            const Vector<Real, D> dx_ij = dot.x[i] - dot.x[j], g = model.volume * pair->gradient();
            const Vector<Real, D> dg = model.volume * pair->hessian_product(dx_ij);
            const Closeness<Real> near(Real(model.volume * pair->w), model.nearest_weight);
            change.A += (du[i] - du[j]) * g.transpose() + (u[i] - u[j]) * dg.transpose();
            change.crowd += near.value * dg + near.slope * g.dot(dx_ij) * g;
        }
        const Crowding<Real, D> crowding{at.A[i], at.crowd[i], at.effects[i].shifted, at.pulled(i)};
        const ShiftSlope<Real, D> shift(model, at.moments[i], crowding);
        dx_moved[i] = dot.x[i] + dt * dv[i] + shift.tangent(moments_dot[i], change);
    });
    Vectors<Real, D> dx_now = dx_moved;
    Values<Real> dc(count, Real(0));
    for (std::size_t k = 0; k < at.excess.size(); ++k) {
        each_particle(count, model.threads, [&](std::size_t i) {
            const Effects<Real, D>&of = at.effects[i], &change = effects_dot[i];
            const Real per = at.repair_step_of(model, k, i), excess = at.excess[k][i];
            const Real dn_now = model.volume * weights_tangent(model, i, step, at.x_now[k], dx_now);
            const Real z = at.c[k][i] + per * excess, dz = dc[i] + per * (dn_now - change.a / of.a * excess);
            dc[i] = z < 0 ? Real(of.repaired * dz + change.repaired * z) : dz;
        });
        each_particle(count, model.threads, [&](std::size_t i) {
            const Values<Real>& c = at.c[k + 1];
            Vector<Real, D> total = dc[i] * at.moments[i].gamma + c[i] * moments_dot[i].gamma;
            for (auto pair = step.fluid.begin_of(i); pair != step.fluid.end_of(i); ++pair) {
                const int j = pair->other;
                const Vector<Real, D> dg = pair->hessian_product(dot.x[i] - dot.x[j]);
                total += model.volume * ((dc[i] + dc[j]) * pair->gradient() + (c[i] + c[j]) * dg);
            }
            dx_now[i] = dx_moved[i] - total / m;
        });
    }
    return {dx_now, dv, dk, dkick};
}

}  // namespace cortado
