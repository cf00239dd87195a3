// The coarse correction of the projection's pressure: a pressure c_i E(x_i) with E = sum_I e_I phi_I on a grid of nodes,
// which takes away what a residual r has that is smooth:
//
//     A e = sum_i phi_I c_i r_i,   A_IJ = sum_i (q_iI . q_iJ + (eps + h_i^2 / 100) delta_IJ) / m,
//     q_iI = N_i grad phi_I + phi_I h_i.
//
// q_iI is how the pressure phi_I c pushes particle i: h_i is the push of the share c alone, and N_i the moment of that,
// -sum_j (T_j g_ij) x_ij^T with T = c L. eps and h^2 are for nodes that few particles touch.
#pragma once

#include "surroundings.hpp"

namespace cortado {

// h and N, and also a change of them and an adjoint.
template <class Scalar, int D>
struct Pushes {
    Vectors<Scalar, D> h;
    Matrices<Scalar, D> N;

    explicit Pushes(std::size_t count = 0)
        : h(zero_vectors<Scalar, D>(count)), N(count, Matrix<Scalar, D>::Constant(Scalar(0))) {}

    // What a function on the grid pushes particle i with.
    Vector<Scalar, D> of(std::size_t i, const Smooth<Scalar, D>& f) const { return N[i] * f.slope + f.value * h[i]; }
    // h^2 / 100
    Scalar holds(std::size_t i) const { return hundredths<Scalar>(1) * h[i].dot(h[i]); }
};

// The y and u that a correction begins with, and what it finds: y + alpha d and u + alpha f, with the alpha from 0 to 1
// after which the kinetic energy is least, but for a small part of it: where there is next to none, it makes alpha 1, and
// 0 before the first iteration.
template <class Scalar, int D>
struct Correction {
    Values<Scalar> y;
    Vectors<Scalar, D> u;
    Values<Scalar> counted;  // dr / d(D u): 1, or 0 where iterations leave a tension a part of its divergence
    Values<Scalar> r;        // D u - b where it counts
    Values<Scalar> e;        // of each node
    Values<Scalar> d;        // z - y where z = y + c E is above y- = min(y, 0), else y- + sigma (z - y-) - y
    Vectors<Scalar, D> f;    // -D^T d / m
    Scalar energy{0}, alpha{0};  // sum m (f^2 + small^2); sum r d, and but for the first m small^2, over it

    // Whether alpha is between its ends, and follows the sums.
    bool bends() const { return alpha > Scalar(0) && alpha < Scalar(1); }

    void stride(const Scalar& m, const Scalar& small, bool first) {
        using Real = typename RealOf<Scalar>::type;
        energy = m * small * small * Scalar(Real(double(d.size())));
        Scalar work = first ? Scalar(0) : energy;
        for (std::size_t i = 0; i < d.size(); ++i) {
            work += r[i] * d[i];
            energy += m * f[i].dot(f[i]);
        }
        alpha = work / energy;
        if (real_part(alpha) < Real(0)) alpha = Scalar(0);  // NaN must stay
        if (real_part(alpha) > Real(1)) alpha = Scalar(1);
    }
};

// The grid and the matrix of a step.
template <class Scalar, int D>
struct Coarse {
    Pushes<Scalar, D> pushes;
    std::vector<Hats<Scalar, D>> hats;  // of each particle

    // From positions, and h and N.
    void find(const Model<Scalar, D>& model, const Vectors<Scalar, D>& x) {
        const Scalar m = model.rest_density;
        hats.resize(x.size());
        each_particle(x.size(), model.threads, [&](std::size_t i) { hats[i] = model.nodes.around(x[i]); });
        number(model.nodes.count());
        for (std::size_t i = 0; i < x.size(); ++i)
            for (const auto& one : hats[i]) {
                const Vector<Scalar, D> q = pushes.of(i, one);
                const int row = rows_[one.node];
                A_.at(row, row) += (model.least_energy + pushes.holds(i)) / m;
                for (const auto& other : hats[i])
                    if (rows_[other.node] <= row) A_.at(row, rows_[other.node]) += q.dot(pushes.of(i, other)) / m;
            }
        A_.factorise();
    }

    // E at a particle.
    Smooth<Scalar, D> at(std::size_t i, const Values<Scalar>& e) const {
        Smooth<Scalar, D> found;
        for (const auto& hat : hats[i]) {
            found.value += e[hat.node] * hat.value;
            found.slope += e[hat.node] * hat.slope;
            found.bent += e[hat.node] * hat.bent;
        }
        return found;
    }

    // e where A e is the sum over particles i of term(i, phi_I); 0 at nodes that no particle touches.
    template <class Term>
    Values<Scalar> solve(const Term& term) const {
        Values<Scalar> b(touched_, Scalar(0)), e(rows_.size(), Scalar(0));
        for (std::size_t i = 0; i < hats.size(); ++i)
            for (const auto& hat : hats[i]) b[rows_[hat.node]] += term(i, hat);
        A_.solve(b);
        for (std::size_t node = 0; node < e.size(); ++node)
            if (rows_[node] >= 0) e[node] = b[rows_[node]];
        return e;
    }

private:
    // The rows of the matrix: those nodes that particles touch, in their order.
    void number(int nodes) {
        rows_.assign(nodes, -1);
        for (const auto& around : hats)
            for (const auto& hat : around) rows_[hat.node] = 0;
        touched_ = 0;
        for (int& row : rows_)
            if (row == 0) row = touched_++;
        std::vector<int> first(touched_);
        for (int row = 0; row < touched_; ++row) first[row] = row;
        for (const auto& around : hats)
            for (const auto& one : around)
                for (const auto& other : around) {
                    int& begin = first[rows_[one.node]];
                    begin = std::min(begin, rows_[other.node]);
                }
        A_.begin(first);
    }

    Skyline<Scalar> A_;
    std::vector<int> rows_;  // of each node, -1 where no particle touches it
    int touched_ = 0;
};

}  // namespace cortado
