// The nodes of a coarse grid and their hat functions phi_I, and the symmetric matrices of sums over particles.
#pragma once

#include "fields.hpp"

namespace cortado {

// A function at a place: its value, its gradient and its second derivatives.
template <class Scalar, int D>
struct Smooth {
    Scalar value{0};
    Vector<Scalar, D> slope = Vector<Scalar, D>::Constant(Scalar(0));
    Matrix<Scalar, D> bent = Matrix<Scalar, D>::Constant(Scalar(0));
};

// phi_I: linear along each axis, 1 at its node and 0 at all others.
template <class Scalar, int D>
struct Hat : Smooth<Scalar, D> {
    int node = 0;
};

// Those of the nodes at the corners of a cell.
template <class Scalar, int D>
using Hats = std::array<Hat<Scalar, D>, 1 << D>;

// The grid goes round in every direction: what is beyond it shares nodes with what is in it.
template <class Scalar, int D>
class Nodes {
public:
    using Real = typename RealOf<Scalar>::type;

    explicit Nodes(const Scene& s) {
        for (int axis = 0; axis < D; ++axis) {
            counts_[axis] = s.nodes[axis];
            first_[axis] = Scalar(Real(s.first_node[axis]));
            frequency_[axis] = Scalar(Real(s.node_frequency[axis]));
        }
    }

    // 0 where there is no grid.
    int count() const {
        int all = 1;
        for (const int one : counts_) all *= one;
        return all;
    }

    Hats<Scalar, D> around(const Vector<Scalar, D>& x) const {
        std::array<int, D> cell;
        Vector<Scalar, D> t;
        for (int axis = 0; axis < D; ++axis) {
            const Scalar place = (x[axis] - first_[axis]) * frequency_[axis];
            const Real below = whole_below(Real(real_part(place)));
            cell[axis] = int(below);
            t[axis] = place - Scalar(below);
        }
        Hats<Scalar, D> found;
        for (int corner = 0; corner < (1 << D); ++corner) found[corner] = hat(cell, t, corner);
        return found;
    }

private:
    Hat<Scalar, D> hat(const std::array<int, D>& cell, const Vector<Scalar, D>& t, int corner) const {
        Hat<Scalar, D> found;
        Vector<Scalar, D> sides, slopes;
        for (int axis = D - 1; axis >= 0; --axis) {
            const int upper = corner >> axis & 1, count = counts_[axis];
            sides[axis] = upper ? t[axis] : Scalar(Scalar(1) - t[axis]);
            slopes[axis] = upper ? frequency_[axis] : Scalar(-frequency_[axis]);
            found.node = found.node * count + ((cell[axis] + upper) % count + count) % count;
        }
        found.value = sides.prod();
        for (int a = 0; a < D; ++a) {
            Vector<Scalar, D> along = sides;
            along[a] = slopes[a];
            found.slope[a] = along.prod();
            for (int b = 0; b < D; ++b) {
                if (b == a) continue;
                Vector<Scalar, D> both = along;
                both[b] = slopes[b];
                found.bent(a, b) = both.prod();
            }
        }
        return found;
    }

    std::array<int, D> counts_;
    Vector<Scalar, D> first_, frequency_;
};

// A symmetric matrix and its factors L D L^T in the same place: each row from its first entry to the diagonal. There are
// neither roots nor pivots, which sums of squares do not need: any kind of number will do.
template <class Scalar>
class Skyline {
public:
    // `first`: the column that each row begins with.
    void begin(const std::vector<int>& first) {
        first_ = first;
        rows_.resize(first.size());
        for (std::size_t i = 0; i < rows_.size(); ++i) rows_[i].assign(i + 1 - first[i], Scalar(0));
    }

    Scalar& at(int row, int column) { return rows_[row][column - first_[row]]; }
    const Scalar& at(int row, int column) const { return rows_[row][column - first_[row]]; }

    void factorise() {
        for (int i = 0; i < int(rows_.size()); ++i) {
            for (int j = first_[i]; j < i; ++j)
                for (int k = std::max(first_[i], first_[j]); k < j; ++k) at(i, j) -= at(i, k) * at(j, k);
            for (int j = first_[i]; j < i; ++j) {
                const Scalar whole = at(i, j);
                at(i, j) = whole / at(j, j);
                at(i, i) -= whole * at(i, j);
            }
        }
    }

    // In place, after the factors were found.
    void solve(Values<Scalar>& b) const {
        const int count = int(rows_.size());
        for (int i = 0; i < count; ++i)
            for (int j = first_[i]; j < i; ++j) b[i] -= at(i, j) * b[j];
        for (int i = 0; i < count; ++i) b[i] /= at(i, i);
        for (int i = count - 1; i >= 0; --i)
            for (int j = first_[i]; j < i; ++j) b[j] -= at(i, j) * b[i];
    }

private:
    std::vector<int> first_;
    std::vector<std::vector<Scalar>> rows_;
};

}  // namespace cortado
