// Derivatives of phi, the pairwise viscous force, in its separation and its velocity.
#pragma once

#include "model.hpp"

namespace cortado {

// In its separation by dx and in its velocity v by dv.
template <class Real, int D>
Vector<Real, D> phi_tangent(const Model<Real, D>& model, const Pair<Real, D>& pair,
                            const Vector<Real, D>& v, const Vector<Real, D>& dx, const Vector<Real, D>& dv) {
    const Vector<Real, D>& x = pair.x;
    const Real size = x.dot(x) + model.size_floor, B = v.dot(x) / size;
    const Real dB = (dv.dot(x) + v.dot(dx) - 2 * B * x.dot(dx)) / size;
    return dB * pair.gradient() + B * pair.hessian_product(dx);
}

// The transposed derivatives, applied to w: (of the separation, of the velocity).
template <class Real, int D>
std::pair<Vector<Real, D>, Vector<Real, D>> phi_adjoint(const Model<Real, D>& model,
                                                        const Pair<Real, D>& pair, const Vector<Real, D>& v,
                                                        const Vector<Real, D>& w) {
    const Vector<Real, D>& x = pair.x;
    const Real size = x.dot(x) + model.size_floor;
    const Real B = v.dot(x) / size, work = pair.a * x.dot(w) / size;
    return {B * pair.hessian_product(w) + work * (v - (2 * B) * x), work * x};
}

}  // namespace cortado
