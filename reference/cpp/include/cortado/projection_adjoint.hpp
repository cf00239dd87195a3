// The adjoint of the part that the projection has in a step: the transpose of `projection_tangent`, every sum a gather.
#pragma once

#include "coarse_derivative.hpp"
#include "density_derivative.hpp"
#include "surroundings_derivative.hpp"

namespace cortado {

template <class Real, int D>
class ProjectionAdjoint {
public:
    ProjectionAdjoint(const Model<Real, D>& model, const Step<Real, D>& step, const State<Real, D>& state)
        : model_(model),
          step_(step),
          state_(state),
          at_(step.projection),
          count_(state.x.size()),
          moments_bar_(count_),
          effects_bar_(count_),
          pushes_bar_(at_.corrections.empty() ? 0 : count_),
          x_bar_(zero_vectors<Real, D>(count_)),
          v_star_bar_(zero_vectors<Real, D>(count_)),
          flow_bar_(zero_vectors<Real, D>(count_)),
          f_(count_) {}

    // From the adjoint of a step's result to that of its state but for what predicted velocities depend on; adds to
    // that of densities n, and returns that of predicted velocities.
    Vectors<Real, D> find(State<Real, D>& bar, Values<Real>& n_bar) {
        const Vectors<Real, D> moved_bar = repairs(bar.x);
        shift(moved_bar, bar.v, bar.k);
        Values<Real> y_bar(count_, Real(0));
        project(bar, y_bar, n_bar);
        each([&](std::size_t i) {
            const Real first_bar = bar.k[i] + y_bar[i], full = at_.taken(model_, state_, i);
            bar.k[i] = full * first_bar;
            bar.kick[i] = full * bar.v[i];
            if (full > 0) effects_bar_[i].full += state_.k[i] * first_bar + state_.kick[i].dot(bar.v[i]);
            v_star_bar_[i] += bar.v[i];
        });
        surroundings(n_bar);
        bar.x = x_bar_;
        return v_star_bar_;
    }

private:
    template <class Body>
    void each(const Body& body) const {
        each_particle(count_, model_.threads, body);
    }
    // `body(j, pair, g, x_bar)` for all pairs of fluid, where `body` adds to what multiplies H in the adjoint of x.
    template <class Body>
    void each_pair(std::size_t i, const Body& body) {
        for (auto pair = step_.fluid.begin_of(i); pair != step_.fluid.end_of(i); ++pair) {
            Vector<Real, D> bent = Vector<Real, D>::Zero();
            body(pair->other, *pair, Vector<Real, D>(model_.volume * pair->gradient()), bent);
            x_bar_[i] += model_.volume * pair->hessian_product(bent);
        }
    }

    // Of what walls and images add to D^T y, from its adjoint f to that of y, which is returned.
    Real walled(std::size_t i, const Values<Real>& y) {
        const Effects<Real, D>& of = at_.effects[i];
        Real wide = 0;
        each_image(model_, step_.fluid, state_.x, i, [&](const Image<Real, D>& image) {
            const int j = image.other;
            const Vector<Real, D> f_ij = f_[i] - image.of(f_[j]);
            wide += model_.volume * image.gradient().dot(f_ij);
            x_bar_[i] += model_.volume * (of.image * y[i] + at_.effects[j].image * y[j]) * image.hessian_product(f_ij);
        });
        effects_bar_[i].push += y[i] * f_[i];
        effects_bar_[i].image += y[i] * wide;
        return of.push.dot(f_[i]) + of.image * wide;
    }

    // From the adjoint of the last positions to that of those before all repairs.
    Vectors<Real, D> repairs(const Vectors<Real, D>& last_bar) {
        Vectors<Real, D> now_bar = last_bar, moved_bar = zero_vectors<Real, D>(count_);
        Values<Real> c_bar(count_, Real(0)), r(count_);
        for (int k = int(at_.excess.size()) - 1; k >= 0; --k) {
            const Values<Real>& c = at_.c[k + 1];
            each([&](std::size_t i) {
                moved_bar[i] += now_bar[i];
                f_[i] = -at_.along(k, i, now_bar[i]) / model_.rest_density;
            });
            each([&](std::size_t i) {
                const Effects<Real, D>& of = at_.effects[i];
                Real z_bar = c_bar[i] + walled(i, c);
                each_pair(i, [&](int j, const auto&, const Vector<Real, D>& g, Vector<Real, D>& bent) {
                    const Vector<Real, D> f_ij = f_[i] - f_[j];
                    z_bar += g.dot(f_ij);
                    bent = (c[i] + c[j]) * f_ij;
                });
                const Real per = at_.repair_step_of(model_, k, i), excess = at_.excess[k][i];
                const Real z = at_.c[k][i] + per * excess;
                if (z < 0) {
                    effects_bar_[i].repaired += z * z_bar;
                    z_bar *= of.repaired;
                }
                effects_bar_[i].a -= per * excess / of.a * z_bar;
                r[i] = model_.volume * per * z_bar;
                c_bar[i] = z_bar;
            });
            Values<Real> imaged(count_);
            for (std::size_t i = 0; i < count_; ++i) imaged[i] = at_.effects[i].image * r[i] / model_.volume;
            each([&](std::size_t i) {
                const Vectors<Real, D>& x = at_.x_now[k];
                now_bar[i] = weights_adjoint(model_, i, step_, x, r) + lift(model_, step_.fluid, x, imaged, i);
                each_mirror(model_, step_.walls, x, i, [&](const Pair<Real, D>& wall) {
                    now_bar[i] -= model_.volume * imaged[i] * model_.wall_weights[wall.other] * wall.gradient();
                });
                effects_bar_[i].image +=
                    r[i] / model_.volume * surplus(model_, step_.fluid, step_.walls, x, i);
            });
        }
        for (std::size_t i = 0; i < count_; ++i) moved_bar[i] += now_bar[i];
        return moved_bar;
    }

    // From the adjoint of x' to those of the new velocities and of k, to which it adds, and of the flow.
    void shift(const Vectors<Real, D>& moved_bar, Vectors<Real, D>& v_bar, Values<Real>& k_bar) {
        std::vector<Crowding<Real, D>> bar(count_);
        each([&](std::size_t i) {
            const Real shifted = at_.effects[i].shifted;
            const Crowding<Real, D> crowding{at_.A[i], at_.crowd[i], shifted, at_.pulled(i), at_.apart[i]};
            const ShiftSlope<Real, D> shift(model_, at_.moments[i], crowding);
            bar[i] = shift.adjoint(moved_bar[i], moments_bar_[i]);
            effects_bar_[i].shifted += bar[i].shifted;
            effects_bar_[i].repaired += at_.k.back()[i] * bar[i].pull;
            k_bar[i] += at_.effects[i].repaired * bar[i].pull;
            x_bar_[i] += moved_bar[i];
            v_bar[i] += model_.time_step * moved_bar[i];
        });
        const Vectors<Real, D>& u = at_.flow();
        each([&](std::size_t i) {
            each_pair(i, [&](int j, const auto& pair, const Vector<Real, D>& g, Vector<Real, D>& bent) {
                const Matrix<Real, D> A_bar = bar[i].A + bar[j].A;
                const Vector<Real, D> crowd_bar = bar[i].crowd - bar[j].crowd, u_ij = u[i] - u[j];
                const Closeness<Real> near(Real(model_.volume * pair.w), model_.nearest_weight);
                flow_bar_[i] += A_bar * g;
                x_bar_[i] += near.slope * g.dot(crowd_bar) * g;
                x_bar_[i] += Apart<Real, D>(model_, pair.x).along(bar[i].apart - bar[j].apart);
                bent = A_bar.transpose() * u_ij + near.value * crowd_bar;
            });
        });
    }

    // Of the velocity that y leaves, from its adjoint and that of the kick, which is 0 then, to that of y.
    void pull(const Values<Real>& y, const Vectors<Real, D>& u_bar, Vectors<Real, D>& kick_bar, Values<Real>& y_bar) {
        each([&](std::size_t i) {
            v_star_bar_[i] += u_bar[i];
            f_[i] = -(u_bar[i] + kick_bar[i]) / model_.rest_density;
            kick_bar[i] = Vector<Real, D>::Zero();
        });
        pulled(y, y_bar);
        each([&](std::size_t i) { y_bar[i] += walled(i, y); });
    }

    // Of D^T y, but for that, from its adjoint f to that of y.
    void pulled(const Values<Real>& y, Values<Real>& y_bar) {
        each([&](std::size_t i) {
            const Matrix<Real, D>& L = at_.effects[i].L;
            Matrix<Real, D> T_bar = Matrix<Real, D>::Zero();
            each_pair(i, [&](int j, const auto&, const Vector<Real, D>& g, Vector<Real, D>& bent) {
                const Vector<Real, D> f_ij = f_[i] - f_[j];
                T_bar += f_ij * g.transpose();
                bent = (y[i] * L + y[j] * at_.effects[j].L) * f_ij;
            });
            T_bar = even<Real, D>(T_bar);
            y_bar[i] += L.cwiseProduct(T_bar).sum();
            effects_bar_[i].L += y[i] * T_bar;
        });
    }

    // Of a divergence D u, from its adjoint: adds to that of u.
    void diverge(const Values<Real>& d_bar, const Vectors<Real, D>& u, Vectors<Real, D>& u_bar) {
        each([&](std::size_t i) {
            const Matrix<Real, D>& L = at_.effects[i].L;
            Matrix<Real, D> L_bar = Matrix<Real, D>::Zero();
            u_bar[i] += d_bar[i] * at_.effects[i].push;
            Real wide = 0;
            each_image(model_, step_.fluid, state_.x, i, [&](const Image<Real, D>& image) {
                const int j = image.other;
                const Real both = at_.effects[i].image * d_bar[i] + at_.effects[j].image * d_bar[j];
                const Vector<Real, D> u_ij = u[i] - image.of(u[j]);
                u_bar[i] += model_.volume * both * image.gradient();
                x_bar_[i] += model_.volume * both * image.hessian_product(u_ij);
                wide += model_.volume * image.gradient().dot(u_ij);
            });
            effects_bar_[i].image += d_bar[i] * wide;
            each_pair(i, [&](int j, const auto&, const Vector<Real, D>& g, Vector<Real, D>& bent) {
                const Vector<Real, D> u_ij = u[i] - u[j];
                const Matrix<Real, D> S = d_bar[i] * L + d_bar[j] * at_.effects[j].L;
                u_bar[i] += S * g;
                L_bar += u_ij * g.transpose();
                bent = S * u_ij;
            });
            effects_bar_[i].L += d_bar[i] * even<Real, D>(L_bar);
            effects_bar_[i].push += d_bar[i] * u[i];
        });
    }

    // Of b, from its adjoint.
    void want(std::size_t i, const Real& b_bar, Values<Real>& n_bar) {
        const Real n = at_.n[i], dt = model_.time_step;
        if (!(n < 1)) return;
        n_bar[i] -= (1 - at_.effects[i].full) / dt * b_bar;
        effects_bar_[i].full -= (1 - n) / dt * b_bar;
    }

    // Of the coarse correction before an iteration, from the adjoints of its k, y and u to those of y and u before.
    void correct(int k, State<Real, D>& bar, Values<Real>& y_bar, Values<Real>& n_bar) {
        const Correction<Real, D>& before = at_.corrections[k];
        const Real m = model_.rest_density, alpha = before.alpha;
        Real alpha_bar = 0;
        for (std::size_t i = 0; i < count_; ++i) {
            y_bar[i] += bar.k[i];
            bar.k[i] = 0;
            alpha_bar += y_bar[i] * before.d[i] + bar.v[i].dot(before.f[i]);
        }
        const Real work_bar = before.bends() ? Real(alpha_bar / before.energy) : Real(0);
        Values<Real> d_bar(count_), left_bar(count_);
        for (std::size_t i = 0; i < count_; ++i) {
            d_bar[i] = alpha * y_bar[i] + work_bar * before.r[i];
            f_[i] = 2 * alpha * work_bar * before.f[i] - alpha / m * bar.v[i];
        }
        pulled(before.d, d_bar);
        each([&](std::size_t i) { d_bar[i] += walled(i, before.d); });
        const auto change = correction_adjoint(model_, at_, before, d_bar, pushes_bar_, x_bar_);
        each([&](std::size_t i) {
            effects_bar_[i].shared += change[i].shared;
            effects_bar_[i].tension += change[i].tension;
            y_bar[i] += change[i].y;
            left_bar[i] = before.counted[i] * (change[i].r + work_bar * before.d[i]);
            want(i, -left_bar[i], n_bar);
        });
        diverge(left_bar, before.u, bar.v);
    }

    // Of h and N of the coarse grid, from their adjoints.
    void pushes() {
        Values<Real> c(count_), c_bar(count_, Real(0));
        for (std::size_t i = 0; i < count_; ++i) c[i] = at_.effects[i].shared;
        f_ = pushes_bar_.h;
        pulled(c, c_bar);
        each([&](std::size_t i) {
            c_bar[i] += walled(i, c);
            Real pushed_bar = 0;
            const Matrix<Real, D> &N_bar = pushes_bar_.N[i], T = c[i] * at_.effects[i].L;
            Matrix<Real, D> T_bar = Matrix<Real, D>::Zero();
            each_pair(i, [&](int j, const auto& pair, const Vector<Real, D>& g, Vector<Real, D>& bent) {
                const Matrix<Real, D> &other = pushes_bar_.N[j], T_j = c[j] * at_.effects[j].L;
                T_bar -= other * pair.x * g.transpose();
                bent = -T_j * (N_bar * pair.x) - T * (other * pair.x);
                x_bar_[i] -= N_bar.transpose() * (T_j * g) + other.transpose() * (T * g);
            });
            each_image(model_, step_.fluid, state_.x, i, [&](const Image<Real, D>& image) {
                const int j = image.other;
                const Real own = at_.effects[i].image * c[i], pushed = at_.effects[j].image * c[j];
                const Vector<Real, D> g = model_.volume * image.gradient();
                const Matrix<Real, D> other = image.flip.asDiagonal() * pushes_bar_.N[j];
                const Vector<Real, D> back = own * (other * image.direct) + pushed * (N_bar * image.direct);
                x_bar_[i] -= model_.volume * image.hessian_product(back);
                x_bar_[i] -= pushed * (N_bar.transpose() * g) + own * (other.transpose() * g);
                pushed_bar -= g.dot(other * image.direct);
            });
            effects_bar_[i].image += c[i] * pushed_bar;
            c_bar[i] += at_.effects[i].image * pushed_bar;
            T_bar = even<Real, D>(T_bar);
            effects_bar_[i].L += c[i] * T_bar;
            effects_bar_[i].shared += c_bar[i] + at_.effects[i].L.cwiseProduct(T_bar).sum();
        });
    }

    // From the adjoints of the last k, of the new velocities and of the kick to those of the first k, y and u.
    void project(State<Real, D>& bar, Values<Real>& y_bar, Values<Real>& n_bar) {
        Values<Real>& k_bar = bar.k;
        Vectors<Real, D>& u_bar = bar.v;
        Values<Real> d_bar(count_);
        const int last = int(at_.divergences.size()) - 1;
        for (int k = last; k >= 0; --k) {
            const Real beta = model_.momenta[k];
            pull(at_.uncorrected(k + 1), u_bar, bar.kick, y_bar);
            each([&](std::size_t i) {
                const Effects<Real, D>& of = at_.effects[i];
                Effects<Real, D>& of_bar = effects_bar_[i];
                const Real n = at_.n[i], b = at_.wanted(model_, i, n), D_i = at_.divergences[k][i];
                const Real per = at_.step_of(model_, i), down = at_.y[k][i] + per * D_i;
                const Clamp<Real> clamp(Real(at_.y[k][i] + per * (D_i - b)), down);
                const Real new_bar = k_bar[i] + (1 + beta) * y_bar[i], up_bar = clamp.rise * new_bar;
                const Real z_bar = up_bar + clamp.fall * of.tension * new_bar, b_bar = -per * up_bar;
                of_bar.tension += clamp.fall * down * new_bar;
                of_bar.a -= per / of.a * (D_i * z_bar - b * up_bar);
                want(i, b_bar, n_bar);
                k_bar[i] = -beta * y_bar[i];
                y_bar[i] = z_bar;
                d_bar[i] = per * z_bar;
            });
            u_bar = k == last ? flow_bar_ : zero_vectors<Real, D>(count_);
            diverge(d_bar, at_.u[k], u_bar);
            if (at_.corrects(k)) correct(k, bar, y_bar, n_bar);
        }
        if (!at_.corrections.empty()) pushes();
    }

    // From the adjoints of effects and moments to that of positions.
    void surroundings(const Values<Real>& n_bar) {
        Values<Real> images_bar(count_);
        each([&](std::size_t i) {
            const Real with = at_.effects[i].image * n_bar[i];
            effects_bar_[i].image += n_bar[i] * (at_.moments[i].images - at_.moments[i].behind);
            if (at_.shut) effects_bar_[i].tension = Real(0);
            const Moments<Real, D> more =
                SurroundingsSlope<Real, D>(model_, at_.moments[i]).adjoint(effects_bar_[i]);
            Moments<Real, D>& bar = moments_bar_[i];
            bar.M += more.M;
            bar.Q += more.Q;
            bar.g += more.g;
            bar.gamma += more.gamma;
            bar.nu += more.nu;
            bar.mirror += more.mirror;
            bar.behind += more.behind - with;
            images_bar[i] = more.images + with;
            Edge<Real, D>(model_, at_.moments[i]).adjoint(bar);
        });
        each([&](std::size_t i) {
            const Moments<Real, D>& own = moments_bar_[i];
            each_pair(i, [&](int j, const auto& pair, const Vector<Real, D>& g, Vector<Real, D>& bent) {
                const Moments<Real, D>& other = moments_bar_[j];
                const Vector<Real, D> stretch = (own.M + other.M) * pair.x;
                const Vector<Real, D> square = (own.Q + other.Q) * g;
                bent = 2 / model_.rest_density * square + own.g - other.g - stretch;
                x_bar_[i] -= (model_.volume * pair.a) * stretch;
            });
            for (auto pair = step_.walls.begin_of(i); pair != step_.walls.end_of(i); ++pair) {
                const Vector<Real, D>& normal = model_.wall_normals[pair->other];
                const Real volume = model_.volume * model_.wall_weights[pair->other];
                const bool mirrors = model_.wall_mirrors[pair->other];
                const Vector<Real, D> of_normal = own.normal + Real(mirrors ? 1 : 0) * own.mirror;
                const Vector<Real, D> along = normal.dot(of_normal) * normal + own.whole;
                const Real nu = own.nu + (mirrors ? own.behind : Real(0));
                x_bar_[i] += volume * (pair->hessian_product(along) + nu * pair->gradient());
            }
            x_bar_[i] += lift(model_, step_.fluid, state_.x, images_bar, i);
        });
    }

    const Model<Real, D>& model_;
    const Step<Real, D>& step_;
    const State<Real, D>& state_;
    const Projection<Real, D>& at_;
    std::size_t count_;
    std::vector<Moments<Real, D>> moments_bar_;
    std::vector<Effects<Real, D>> effects_bar_;
    Pushes<Real, D> pushes_bar_;
    Vectors<Real, D> x_bar_, v_star_bar_, flow_bar_;
    Vectors<Real, D> f_;  // -u_bar / m of a velocity, or that of a position: the adjoint of D^T y
};

}  // namespace cortado
