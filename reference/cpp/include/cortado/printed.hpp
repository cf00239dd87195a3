// The derivative of a step by the report's eqs. 12 to 14 as they are printed, to reproduce what it measured.
//
// What is wrong in them: (12) takes the density at x(t), forgets that the pressure is added up over the iterations, and
// has no clamp; (13) uses that one density for the pressure too; and gamma before (14) is 2 (d + 2 mu).
#pragma once

#include "tangent.hpp"

namespace cortado {

struct Reading {
    bool predicted_density = false;  // (12) with the predicted density, as the text of Algorithm 2 has it
    bool printed_gamma = true;       // 2 (d + 2 mu), else 2 (d + 2) mu
};

template <class Real, int D>
State<Real, D> printed_tangent(const Model<Real, D>& model, Step<Real, D>& step, const State<Real, D>& state,
                               const State<Real, D>& dot, const Vector<Real, D>& gravity_dot, Real viscosity,
                               const Reading& reading) {
    const std::size_t count = state.x.size();
    const Real m = model.rest_density;
    step.fluid.bend(model.smoothing, model.threads);
    step.walls.bend(model.smoothing, model.threads);
    const Values<Real> dn = density_tangent(model, step, state.x, dot.x);
    const Real gamma = reading.printed_gamma ? 2 * (D + 2 * viscosity) : model.kappa * viscosity;
    const Vectors<Real, D> da = acceleration_tangent(model, step, state, dot, dn, gravity_dot, gamma, Real(0));
    State<Real, D> new_dot{Vectors<Real, D>(count), Vectors<Real, D>(count), {}, {}};
    const auto predict = [&](std::size_t i, const Vector<Real, D>& push_dot) {
        predict_tangent(i, model.time_step, dot, da, push_dot, new_dot);
    };
    each_particle(count, model.threads, [&](std::size_t i) { predict(i, Vector<Real, D>::Constant(Real(0))); });
    Values<Real> dc(count);
    for (int k = 0; k < step.iterations(); ++k) {
        const Values<Real> c = pressure_coefficients(step, k);
        each_particle(count, model.threads, [&](std::size_t i) {
            const Real n = step.n[i];
            const Real change = reading.predicted_density
                                    ? Real(model.volume * weights_tangent(model, i, step, step.x_star[k], new_dot.x))
                                    : dn[i];
            dc[i] = (step.delta(model, i) * m * n - 2 * step.p[k][i]) / (n * n * n) * change;
        });
        each_particle(count, model.threads, [&](std::size_t i) {
            predict(i, pressure_force_tangent(model, i, step, dot.x, c, dc, true));
        });
    }
    return new_dot;
}

}  // namespace cortado
