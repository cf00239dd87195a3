// Neighbours of x(t), kept for a step: lists, and what a step needs of each pair.
#pragma once

#include "cells.hpp"
#include "fields.hpp"
#include "smoothing.hpp"

namespace cortado {

// The nearest image of a separation, where an axis is periodic.
template <class Scalar, int D>
class Period {
public:
    using Real = typename RealOf<Scalar>::type;

    explicit Period(const std::array<double, 3>& lengths) : lengths_(lengths) {
        for (int axis = 0; axis < D; ++axis) any_ = any_ || lengths[axis] > 0;
    }
    Vector<Scalar, D> nearest(Vector<Scalar, D> x) const {
        if (!any_) return x;
        for (int axis = 0; axis < D; ++axis) {
            if (!(lengths_[axis] > 0)) continue;
            const Real length = Real(lengths_[axis]);
            x[axis] -= Scalar(length * nearest_integer(Real(real_part(x[axis]) / length)));
        }
        return x;
    }

private:
    std::array<double, 3> lengths_;
    bool any_ = false;
};

template <class Scalar, int D>
typename Cells<D>::Point place_of(const Vector<Scalar, D>& x) {
    typename Cells<D>::Point place;
    for (int axis = 0; axis < D; ++axis) place[axis] = double(real_part(x[axis]));
    return place;
}

template <class Scalar, int D>
Cells<D> cells_of(const Vectors<Scalar, D>& x, double size, const std::array<double, 3>& periods) {
    std::vector<typename Cells<D>::Point> places(x.size());
    for (std::size_t i = 0; i < x.size(); ++i) places[i] = place_of<Scalar, D>(x[i]);
    return Cells<D>(places, size, periods);
}

template <class Scalar, int D>
struct Pair {
    int other;            // j, or b of a wall particle
    Vector<Scalar, D> x;  // x_i - x_other
    Scalar w, a, b;       // W = w, grad W = a x, H u = a u + b (x . u) x; b is 0 before `Pairs::bend`

    Vector<Scalar, D> gradient() const { return a * x; }
    Vector<Scalar, D> hessian_product(const Vector<Scalar, D>& u) const { return a * u + (b * x.dot(u)) * x; }
};

// A list for each particle, over the others in a fixed order. Memory is kept from one `find` to the next.
template <class Scalar, int D>
class Pairs {
public:
    // All pairs of x with `others`, sorted into `cells`, that are nearer than `reach`; `same`: the others are x, and a
    // particle is not its own.
    template <class Other>
    void find(const Vectors<Scalar, D>& x, const Vectors<Other, D>& others, const Cells<D>& cells, bool same,
              double reach, const Period<Scalar, D>& period, const Smoothing<Scalar>& smoothing, int threads) {
        using Real = typename RealOf<Scalar>::type;
        const Real reach_squared = Real(reach) * Real(reach);
        start_ = x;
        begin_.resize(x.size());
        end_.resize(x.size());
        parts_.resize(threads);
        each_particle(parts_.size(), threads, [&](std::size_t part) {
            std::vector<Pair<Scalar, D>>& pairs = parts_[part];
            const std::size_t first = part * x.size() / parts_.size(), last = (part + 1) * x.size() / parts_.size();
            std::vector<std::size_t> ends;
            pairs.clear();
            for (std::size_t i = first; i < last; ++i) {
                cells.around(place_of<Scalar, D>(x[i]), [&](int j) {
                    if (same && std::size_t(j) == i) return;
                    const Vector<Scalar, D> x_ij = period.nearest(x[i] - others[j].template cast<Scalar>());
                    const Scalar r_squared = x_ij.dot(x_ij);
                    if (!(real_part(r_squared) < reach_squared)) return;
                    Pair<Scalar, D> pair{j, x_ij, Scalar(0), Scalar(0), Scalar(0)};
                    if (smoothing.near(r_squared)) {
                        const Scalar q = smoothing.q_of(r_squared);
                        pair.w = smoothing.weight(q);
                        pair.a = smoothing.slope(q);
                    }
                    pairs.push_back(pair);
                });
                ends.push_back(pairs.size());
            }
            for (std::size_t i = first; i < last; ++i) {
                begin_[i] = pairs.data() + (i == first ? 0 : ends[i - first - 1]);
                end_[i] = pairs.data() + ends[i - first];
            }
        });
    }
    const Pair<Scalar, D>* begin_of(std::size_t i) const { return begin_[i]; }
    const Pair<Scalar, D>* end_of(std::size_t i) const { return end_[i]; }
    // The x that they were found for.
    const Vectors<Scalar, D>& start() const { return start_; }

    // What second derivatives of W need.
    void bend(const Smoothing<Scalar>& smoothing, int threads) {
        each_particle(begin_.size(), threads, [&](std::size_t i) {
            for (Pair<Scalar, D>* pair = begin_[i]; pair != end_[i]; ++pair) {
                const Scalar r_squared = pair->x.dot(pair->x);
                if (smoothing.near(r_squared)) pair->b = smoothing.bend(smoothing.q_of(r_squared));
            }
        });
    }

private:
    Vectors<Scalar, D> start_;
    std::vector<Pair<Scalar, D>*> begin_, end_;
    std::vector<std::vector<Pair<Scalar, D>>> parts_;  // each thread's
};

}  // namespace cortado
