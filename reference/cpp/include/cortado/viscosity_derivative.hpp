// Derivatives of phi, the viscous force of a pair, in its separation and its velocity.
#pragma once

#include "model.hpp"

namespace cortado {

// In its separation by dx and in its velocity v by dv.
template <class Real, int D>
Vector<Real, D> phi_tangent(const Model<Real, D>& model, const Pair<Real, D>& pair,
                            const Vector<Real, D>& v, const Vector<Real, D>& dx, const Vector<Real, D>& dv) {
    const Vector<Real, D>& x = pair.x;
    const Real r_squared = x.dot(x), size = r_squared + model.size_floor;
    if (model.viscosity == Viscosity::pairwise) {
        const Real B = v.dot(x) / size;
        const Real dB = (dv.dot(x) + v.dot(dx) - 2 * B * x.dot(dx)) / size;
        return dB * pair.gradient() + B * pair.hessian_product(dx);
    }
    const Real F = model.laplacian_correction * pair.a * r_squared / size;
    return F * dv + (factor_slope(model, pair) * x.dot(dx)) * v;
}

// The transposed derivatives, applied to w: (of the separation, of the velocity).
template <class Real, int D>
std::pair<Vector<Real, D>, Vector<Real, D>> phi_adjoint(const Model<Real, D>& model,
                                                        const Pair<Real, D>& pair, const Vector<Real, D>& v,
                                                        const Vector<Real, D>& w) {
    const Vector<Real, D>& x = pair.x;
    const Real r_squared = x.dot(x), size = r_squared + model.size_floor;
    if (model.viscosity == Viscosity::pairwise) {
        const Real B = v.dot(x) / size, work = pair.a * x.dot(w) / size;
        return {B * pair.hessian_product(w) + work * (v - (2 * B) * x), work * x};
    }
    const Real F = model.laplacian_correction * pair.a * r_squared / size;
    return {(factor_slope(model, pair) * v.dot(w)) * x, F * w};
}

// s in grad F = s x, with F = laplacian_correction x . G / (|x|^2 + 0.01 h^2) of the laminar form.
template <class Real, int D>
Real factor_slope(const Model<Real, D>& model, const Pair<Real, D>& pair) {
    const Real r_squared = pair.x.dot(pair.x), size = r_squared + model.size_floor;
    return model.laplacian_correction * (pair.b * r_squared + 2 * pair.a * (1 - r_squared / size)) / size;
}

}  // namespace cortado
