// Derivatives of a coarse correction, given those of h and N: tangents, and their transposes.
#pragma once

#include "projection.hpp"

namespace cortado {

// How a function on the grid pushes particle i, as it moves and as h and N change; the function stays.
template <class Real, int D>
Vector<Real, D> push_tangent(const Pushes<Real, D>& at, const Pushes<Real, D>& dot, std::size_t i,
                             const Smooth<Real, D>& f, const Vector<Real, D>& dx) {
    return dot.of(i, f) + at.N[i] * (f.bent * dx) + f.slope.dot(dx) * at.h[i];
}

// Adds to the adjoints of h, N and x for that of the push.
template <class Real, int D>
void push_adjoint(const Pushes<Real, D>& at, Pushes<Real, D>& bar, std::size_t i, const Smooth<Real, D>& f,
                  const Vector<Real, D>& push_bar, Vector<Real, D>& x_bar) {
    bar.h[i] += f.value * push_bar;
    bar.N[i] += push_bar * f.slope.transpose();
    x_bar += f.bent * (at.N[i].transpose() * push_bar) + at.h[i].dot(push_bar) * f.slope;
}

// What changes of a correction beside h and N: its y, the residual where it counts, c and sigma.
template <class Real>
struct CorrectionChange {
    Real y{0}, r{0}, shared{0}, tension{0};
};

// The tangent of d; `change` has those of what it depends on.
template <class Real, int D>
Values<Real> correction_tangent(const Model<Real, D>& model, const Projection<Real, D>& at,
                                const Correction<Real, D>& before, const Vectors<Real, D>& dx,
                                const Pushes<Real, D>& dpushes, const std::vector<CorrectionChange<Real>>& change) {
    const std::size_t count = dx.size();
    const Coarse<Real, D>& coarse = at.coarse;
    Vectors<Real, D> w(count), dw(count);  // how e moves a particle
    each_particle(count, model.threads, [&](std::size_t i) {
        const Smooth<Real, D> f = coarse.at(i, before.e);
        w[i] = coarse.pushes.of(i, f) / model.rest_density;
        dw[i] = push_tangent<Real, D>(coarse.pushes, dpushes, i, f, dx[i]) / model.rest_density;
    });
    const Values<Real> de = coarse.solve([&](std::size_t i, const Hat<Real, D>& hat) {
        const Real c = at.effects[i].shared, wanted = c * before.r[i];
        const Real wanted_dot = change[i].shared * before.r[i] + c * change[i].r;
        const Real held_dot = Real(2) / Real(100) * coarse.pushes.h[i].dot(dpushes.h[i]) / model.rest_density;
        return Real(hat.value * wanted_dot + hat.slope.dot(dx[i]) * wanted - coarse.pushes.of(i, hat).dot(dw[i]) -
                    push_tangent<Real, D>(coarse.pushes, dpushes, i, hat, dx[i]).dot(w[i]) -
                    held_dot * before.e[hat.node]);
    });
    Values<Real> dd(count);
    each_particle(count, model.threads, [&](std::size_t i) {
        const Real c = at.effects[i].shared, sigma = at.effects[i].tension;
        const Smooth<Real, D> f = coarse.at(i, before.e);
        const Real moved = f.slope.dot(dx[i]) + coarse.at(i, de).value, z = before.y[i] + c * f.value;
        const Real dz = change[i].y + change[i].shared * f.value + c * moved;
        const bool pulls = before.y[i] < 0;
        const Real below = z - (pulls ? before.y[i] : Real(0)), dleast = pulls ? change[i].y : Real(0);
        const Clamp<Real> clamp(below, below);
        const Real dbelow = dz - dleast;
        dd[i] = clamp.rise * dz + clamp.fall * (dleast + change[i].tension * below + sigma * dbelow) - change[i].y;
    });
    return dd;
}

// The transpose: from the adjoint of d to what `change` is of; adds to those of h, N and x.
template <class Real, int D>
std::vector<CorrectionChange<Real>> correction_adjoint(const Model<Real, D>& model, const Projection<Real, D>& at,
                                                       const Correction<Real, D>& before, const Values<Real>& d_bar,
                                                       Pushes<Real, D>& pushes_bar, Vectors<Real, D>& x_bar) {
    const std::size_t count = d_bar.size();
    const Coarse<Real, D>& coarse = at.coarse;
    std::vector<CorrectionChange<Real>> bar(count);
    Values<Real> z_bar(count);
    each_particle(count, model.threads, [&](std::size_t i) {
        const Real c = at.effects[i].shared, sigma = at.effects[i].tension;
        const Smooth<Real, D> f = coarse.at(i, before.e);
        const Real z = before.y[i] + c * f.value;
        const bool pulls = before.y[i] < 0;
        const Real below = z - (pulls ? before.y[i] : Real(0));
        const Clamp<Real> clamp(below, below);
        z_bar[i] = (clamp.rise + clamp.fall * sigma) * d_bar[i];
        bar[i].tension = clamp.fall * below * d_bar[i];
        bar[i].y = z_bar[i] - d_bar[i];
        if (pulls) bar[i].y += clamp.fall * (1 - sigma) * d_bar[i];
        bar[i].shared = f.value * z_bar[i];
        x_bar[i] += c * z_bar[i] * f.slope;
    });
    const Values<Real> multiplier = coarse.solve([&](std::size_t i, const Hat<Real, D>& hat) {
        return Real(hat.value * at.effects[i].shared * z_bar[i]);
    });
    each_particle(count, model.threads, [&](std::size_t i) {
        const Real c = at.effects[i].shared, m = model.rest_density;
        const Smooth<Real, D> f = coarse.at(i, before.e), g = coarse.at(i, multiplier);
        bar[i].r = c * g.value;
        bar[i].shared += g.value * before.r[i];
        x_bar[i] += c * before.r[i] * g.slope;
        const Vector<Real, D> by_f = -coarse.pushes.of(i, g) / m, by_g = -coarse.pushes.of(i, f) / m;
        push_adjoint<Real, D>(coarse.pushes, pushes_bar, i, f, by_f, x_bar[i]);
        push_adjoint<Real, D>(coarse.pushes, pushes_bar, i, g, by_g, x_bar[i]);
        Real both = 0;
        for (const auto& hat : coarse.hats[i]) both += before.e[hat.node] * multiplier[hat.node];
        pushes_bar.h[i] -= Real(2) / Real(100) * both / m * coarse.pushes.h[i];
    });
    return bar;
}

}  // namespace cortado
