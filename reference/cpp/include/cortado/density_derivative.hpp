// Derivatives of densities at any positions over the lists of a step.
#pragma once

#include "step.hpp"

namespace cortado {

// sum_j G(x_ij) . dx_ij + sum_b w_b G(x_ib) . dx_i at positions x over lists (eq. 11, over V).
template <class Real, int D>
Real weights_tangent(const Model<Real, D>& model, std::size_t i, const Step<Real, D>& step, const Vectors<Real, D>& x,
                     const Vectors<Real, D>& dx) {
    Real total = 0;
    const auto slope = [&](const Vector<Real, D>& separation, const Vector<Real, D>& by) {
        const Real r_squared = separation.dot(separation);
        if (!model.smoothing.near(r_squared)) return Real(0);
        return Real(model.smoothing.slope(model.smoothing.q_of(r_squared)) * separation.dot(by));
    };
    for (auto pair = step.fluid.begin_of(i); pair != step.fluid.end_of(i); ++pair)
        total += slope(model.period.nearest(x[i] - x[pair->other]), dx[i] - dx[pair->other]);
    for (auto pair = step.walls.begin_of(i); pair != step.walls.end_of(i); ++pair)
        total += model.wall_weights[pair->other] *
                 slope(model.period.nearest(x[i] - model.wall_positions[pair->other]), dx[i]);
    return total;
}

// dn at x(t)
template <class Real, int D>
Values<Real> density_tangent(const Model<Real, D>& model, const Step<Real, D>& step, const Vectors<Real, D>& x,
                             const Vectors<Real, D>& dx) {
    Values<Real> dn(x.size());
    each_particle(x.size(), model.threads,
                  [&](std::size_t i) { dn[i] = model.volume * weights_tangent(model, i, step, x, dx); });
    return dn;
}

// What the adjoints r of the sums of W at positions x over lists give to those of the position of particle i.
template <class Real, int D>
Vector<Real, D> weights_adjoint(const Model<Real, D>& model, std::size_t i, const Step<Real, D>& step,
                                const Vectors<Real, D>& x, const Values<Real>& r) {
    Vector<Real, D> total = Vector<Real, D>::Constant(Real(0));
    const auto add = [&](const Vector<Real, D>& separation, Real weight) {
        const Real r_squared = separation.dot(separation);
        if (model.smoothing.near(r_squared))
            total += (weight * model.smoothing.slope(model.smoothing.q_of(r_squared))) * separation;
    };
    for (auto pair = step.fluid.begin_of(i); pair != step.fluid.end_of(i); ++pair)
        add(model.period.nearest(x[i] - x[pair->other]), r[i] + r[pair->other]);
    for (auto pair = step.walls.begin_of(i); pair != step.walls.end_of(i); ++pair)
        add(model.period.nearest(x[i] - model.wall_positions[pair->other]), model.wall_weights[pair->other] * r[i]);
    return total;
}

}  // namespace cortado
