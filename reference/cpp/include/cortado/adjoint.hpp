// The adjoint of a step: the transpose of `step_tangent`, every sum a gather.
#pragma once

#include "projection_adjoint.hpp"
#include "stress_derivative.hpp"
#include "viscosity_derivative.hpp"

namespace cortado {

// Of PCISPH's pressures: adds to the adjoints of the state, of accelerations (at first dt times that of velocities), of
// densities and of yields.
template <class Real, int D>
void pressure_adjoint(const Model<Real, D>& model, const Step<Real, D>& step, State<Real, D>& bar, const Terms& terms,
                      Vectors<Real, D>& a_bar, Values<Real>& n_bar, Values<Real>& y_bar) {
    const std::size_t count = a_bar.size();
    const Real m = model.rest_density, dt = model.time_step, push_factor = model.volume / m;
    const Pairs<Real, D>&fluid = step.fluid, &walls = step.walls;
    Vectors<Real, D> push_bar = a_bar;
    Values<Real> p_bar(count, Real(0)), r(count);
    for (int k = step.iterations() - 1; k >= 0; --k) {
        // The pressure force, to the adjoints of x, n, p and (r) the predicted sum of W.
        each_particle(count, model.threads, [&](std::size_t i) {
            const Real n = step.n[i], c_i = step.p[k][i] / (n * n);
            Real stretch = 0;
            Vector<Real, D> bend = Vector<Real, D>::Constant(Real(0));
            for (auto pair = fluid.begin_of(i); pair != fluid.end_of(i); ++pair) {
                const int j = pair->other;
                const Vector<Real, D> u_ij = push_bar[i] - push_bar[j];
                stretch += pair->a * pair->x.dot(u_ij);
                bend += (c_i + step.p[k][j] / (step.n[j] * step.n[j])) * pair->hessian_product(u_ij);
            }
            for (auto pair = walls.begin_of(i); pair != walls.end_of(i); ++pair) {
                const Real weight = model.wall_weights[pair->other];
                stretch += weight * (pair->a * pair->x.dot(push_bar[i]));
                bend += (weight * c_i) * pair->hessian_product(push_bar[i]);
            }
            if (terms.hessian) bar.x[i] -= push_factor * bend;
            r[i] = Real(0);
            if (!terms.density) return;
            const Real c_bar = -push_factor * stretch;
            n_bar[i] -= 2 * c_i / n * c_bar;
            p_bar[i] = step.p[k][i] > Real(0) ? Real(p_bar[i] + c_bar / (n * n)) : Real(0);
            const Real excess_bar = step.delta(model, i) * p_bar[i];
            y_bar[i] += excess_bar * step.excess[k][i] / step.y[i];
            r[i] = m * model.volume * excess_bar;
        });
        // The predicted sum of W, to the adjoints of what was predicted.
        each_particle(count, model.threads, [&](std::size_t i) {
            const Vector<Real, D> total = weights_adjoint(model, i, step, step.x_star[k], r);
            bar.x[i] += total;
            bar.v[i] += dt * total;
            push_bar[i] = (dt * dt) * total;
            a_bar[i] += push_bar[i];
        });
    }
}

// From `bar`, the adjoint of a step's result, to that of its state, in place; adds to those of its parameters.
template <class Real, int D>
void step_adjoint(const Model<Real, D>& model, Step<Real, D>& step, const State<Real, D>& state, State<Real, D>& bar,
                  Real viscosity, const Terms& terms, Vector<Real, D>& gravity_bar, Real& viscosity_bar) {
    const std::size_t count = state.x.size();
    const Real m = model.rest_density;
    const Pairs<Real, D>&fluid = step.fluid, &walls = step.walls;
    step.fluid.bend(model.smoothing, model.threads);
    step.walls.bend(model.smoothing, model.threads);

    Vectors<Real, D> a_bar(count);
    Values<Real> n_bar(count, Real(0)), y_bar(count, Real(0));
    if (model.projection) {
        bar.v = ProjectionAdjoint<Real, D>(model, step, state).find(bar, n_bar);
        for (std::size_t i = 0; i < count; ++i) a_bar[i] = model.time_step * bar.v[i];
    } else {
        for (std::size_t i = 0; i < count; ++i) {
            bar.v[i] += model.time_step * bar.x[i];
            a_bar[i] = model.time_step * bar.v[i];
        }
        if (terms.pressure) pressure_adjoint(model, step, bar, terms, a_bar, n_bar, y_bar);
    }
    for (const auto& one : a_bar) gravity_bar += one;

    if (model.viscosity == Viscosity::stress && terms.viscosity) {
        Vectors<Real, D> force_bar(count);
        for (std::size_t i = 0; i < count; ++i) {
            force_bar[i] = viscosity / m * a_bar[i];
            viscosity_bar += step.friction_sum[i].dot(a_bar[i]) / m;
        }
        stress_adjoint(model, step, state, force_bar, bar);
    } else if (model.viscosity != Viscosity::none && terms.viscosity) {
        Values<Real> work(count);
        each_particle(count, model.threads, [&](std::size_t i) {
            const Real factor = model.kappa * viscosity * model.volume / (m * step.n[i]);
            work[i] = step.friction_sum[i].dot(a_bar[i]) / (m * step.n[i]);
            for (auto pair = fluid.begin_of(i); pair != fluid.end_of(i); ++pair) {
                const int j = pair->other;
                const Vector<Real, D> v_ij = state.v[i] - state.v[j], w_ij = a_bar[i] - a_bar[j];
                const auto [x_part, v_part] = phi_adjoint(model, *pair, v_ij, w_ij);
                bar.x[i] += factor / step.n[j] * x_part;
                bar.v[i] += factor / step.n[j] * v_part;
                n_bar[i] -= factor / (step.n[i] * step.n[j]) * model.phi(*pair, v_ij).dot(w_ij);
            }
            if (model.friction == Real(0)) return;
            for (auto pair = walls.begin_of(i); pair != walls.end_of(i); ++pair) {
                const Real weight = factor * model.friction * model.wall_weights[pair->other];
                const auto [x_part, v_part] = phi_adjoint(model, *pair, state.v[i], a_bar[i]);
                bar.x[i] += weight * x_part;
                bar.v[i] += weight * v_part;
                n_bar[i] -= weight / step.n[i] * model.phi(*pair, state.v[i]).dot(a_bar[i]);
            }
        });
        for (const Real& one : work) viscosity_bar += model.kappa * one;
    }

    each_particle(count, model.threads, [&](std::size_t i) {
        for (auto pair = fluid.begin_of(i); pair != fluid.end_of(i); ++pair)
            bar.x[i] += (model.volume * (n_bar[i] + n_bar[pair->other]) * pair->a) * pair->x;
        const Vector<Real, D> wall_bar =
            (-2 * y_bar[i] * step.y[i] * step.y[i] / model.response) * step.wall_gradient[i];
        for (auto pair = walls.begin_of(i); pair != walls.end_of(i); ++pair) {
            const Real weight = model.wall_weights[pair->other];
            bar.x[i] += (model.volume * weight * n_bar[i] * pair->a) * pair->x;
            bar.x[i] += weight * pair->hessian_product(wall_bar);
        }
    });
}

}  // namespace cortado
