// The tangent of a step, derived by hand: the report's Algorithm 2 and eqs. 11 to 14, put right.
#pragma once

#include "projection_tangent.hpp"
#include "stress_derivative.hpp"
#include "viscosity_derivative.hpp"

namespace cortado {

// The derivative of the acceleration without pressure (eq. 14, put right); `kappa` is that of the derivative.
template <class Real, int D>
Vectors<Real, D> acceleration_tangent(const Model<Real, D>& model, const Step<Real, D>& step,
                                      const State<Real, D>& state, const State<Real, D>& dot, const Values<Real>& dn,
                                      const Vector<Real, D>& gravity_dot, Real coefficient, Real coefficient_dot) {
    Vectors<Real, D> da(state.x.size(), gravity_dot);
    if (model.viscosity == Viscosity::none) return da;
    const Real m = model.rest_density;
    if (model.viscosity == Viscosity::stress) {
        const Vectors<Real, D> change = stress_tangent(model, step, state, dot);
        for (std::size_t i = 0; i < da.size(); ++i)
            da[i] += (coefficient * change[i] + coefficient_dot * step.friction_sum[i]) / m;
        return da;
    }
    each_particle(state.x.size(), model.threads, [&](std::size_t i) {
        Vector<Real, D> total = -dn[i] / step.n[i] * step.friction_sum[i];
        for (auto pair = step.fluid.begin_of(i); pair != step.fluid.end_of(i); ++pair) {
            const int j = pair->other;
            const Vector<Real, D> v_ij = state.v[i] - state.v[j];
            const Vector<Real, D> dx_ij = dot.x[i] - dot.x[j], dv_ij = dot.v[i] - dot.v[j];
            total += model.volume / step.n[j] *
                     (phi_tangent(model, *pair, v_ij, dx_ij, dv_ij) -
                      dn[j] / step.n[j] * model.phi(*pair, v_ij));
        }
        if (model.friction != Real(0))
            for (auto pair = step.walls.begin_of(i); pair != step.walls.end_of(i); ++pair)
                total += model.friction * model.volume * model.wall_weights[pair->other] *
                         phi_tangent(model, *pair, state.v[i], dot.x[i], dot.v[i]);
        da[i] += (coefficient * total + coefficient_dot * step.friction_sum[i]) / (m * step.n[i]);
    });
    return da;
}

// The derivative of the pressure acceleration (eq. 13, put right) for c = p / n^2 and dc.
template <class Real, int D>
Vector<Real, D> pressure_force_tangent(const Model<Real, D>& model, std::size_t i, const Step<Real, D>& step,
                                       const Vectors<Real, D>& dx, const Values<Real>& c, const Values<Real>& dc,
                                       bool hessian) {
    Vector<Real, D> total = Vector<Real, D>::Constant(Real(0));
    for (auto pair = step.fluid.begin_of(i); pair != step.fluid.end_of(i); ++pair) {
        const int j = pair->other;
        total += (dc[i] + dc[j]) * pair->gradient();
        if (hessian) total += (c[i] + c[j]) * pair->hessian_product(dx[i] - dx[j]);
    }
    for (auto pair = step.walls.begin_of(i); pair != step.walls.end_of(i); ++pair) {
        const Real weight = model.wall_weights[pair->other];
        total += (weight * dc[i]) * pair->gradient();
        if (hessian) total += (weight * c[i]) * pair->hessian_product(dx[i]);
    }
    return -model.volume / model.rest_density * total;
}

// That of the prediction of particle i: dv* = dv + dt (da + dpush), dx* = dx + dt dv*.
template <class Real, int D>
void predict_tangent(std::size_t i, const Real& dt, const State<Real, D>& dot, const Vectors<Real, D>& da,
                     const Vector<Real, D>& push_dot, State<Real, D>& star_dot) {
    star_dot.v[i] = dot.v[i] + dt * (da[i] + push_dot);
    star_dot.x[i] = dot.x[i] + dt * star_dot.v[i];
}

template <class Real, int D>
Values<Real> pressure_coefficients(const Step<Real, D>& step, int k) {
    Values<Real> c(step.n.size());
    for (std::size_t i = 0; i < c.size(); ++i) c[i] = step.p[k][i] / (step.n[i] * step.n[i]);
    return c;
}

// From the tangent of a step's state to that of its result.
template <class Real, int D>
State<Real, D> step_tangent(const Model<Real, D>& model, Step<Real, D>& step, const State<Real, D>& state,
                            const State<Real, D>& dot, const Vector<Real, D>& gravity_dot, Real viscosity,
                            Real viscosity_dot, const Terms& terms) {
    const std::size_t count = state.x.size();
    const Real m = model.rest_density;
    step.fluid.bend(model.smoothing, model.threads);
    step.walls.bend(model.smoothing, model.threads);
    const Values<Real> dn = density_tangent(model, step, state.x, dot.x);
    const Vectors<Real, D> da =
        terms.viscosity ? acceleration_tangent(model, step, state, dot, dn, gravity_dot, Real(model.kappa * viscosity),
                                               Real(model.kappa * viscosity_dot))
                        : Vectors<Real, D>(count, gravity_dot);
    if (model.projection) {
        Vectors<Real, D> dv_star(count);
        for (std::size_t i = 0; i < count; ++i) dv_star[i] = dot.v[i] + model.time_step * da[i];
        return projection_tangent(model, step, state, dot, dn, dv_star);
    }
    Values<Real> dy(count);
    each_particle(count, model.threads, [&](std::size_t i) {
        Vector<Real, D> change = Vector<Real, D>::Constant(Real(0));
        for (auto pair = step.walls.begin_of(i); pair != step.walls.end_of(i); ++pair)
            change += model.wall_weights[pair->other] * pair->hessian_product(dot.x[i]);
        dy[i] = -2 * step.y[i] * step.y[i] * step.wall_gradient[i].dot(change) / model.response;
    });
    State<Real, D> new_dot{Vectors<Real, D>(count), Vectors<Real, D>(count), {}, {}};
    const auto predict = [&](std::size_t i, const Vector<Real, D>& push_dot) {
        predict_tangent(i, model.time_step, dot, da, push_dot, new_dot);
    };
    each_particle(count, model.threads, [&](std::size_t i) { predict(i, Vector<Real, D>::Constant(Real(0))); });
    Values<Real> dp(count, Real(0)), dc(count, Real(0));
    for (int k = 0; terms.pressure && k < step.iterations(); ++k) {
        const Values<Real> c = pressure_coefficients(step, k);
        if (terms.density)
            each_particle(count, model.threads, [&](std::size_t i) {
                if (step.p[k][i] > Real(0)) {
                    const Real change = m * model.volume * weights_tangent(model, i, step, step.x_star[k], new_dot.x);
                    dp[i] += step.delta(model, i) * (change + dy[i] / step.y[i] * step.excess[k][i]);
                } else {
                    dp[i] = Real(0);
                }
                dc[i] = (dp[i] - 2 * step.p[k][i] / step.n[i] * dn[i]) / (step.n[i] * step.n[i]);
            });
        each_particle(count, model.threads, [&](std::size_t i) {
            predict(i, pressure_force_tangent(model, i, step, dot.x, c, dc, terms.hessian));
        });
    }
    return new_dot;
}

}  // namespace cortado
