// Viscosity as a stress of one fluid, over its viscosity. Neighbours of particle i are arms (s, y):
//
//     M = sum s y y^T,   A = sum s v_ij y^T,   G = A M^-1,   T = S ((G + G^T) M^-1 - C G),
//     force on i = -sum s ((T_i + T_j) y + C (S_i + S_j) v_ij)
//
// S is the fullness of M: 1 where neighbours lie on all sides or on one side, 0 where they lie on a line.
#pragma once

#include <Eigen/LU>

#include "model.hpp"

namespace cortado {


// How a neighbour counts: with a weight s, as a particle at a separation y.
template <class Scalar, int D>
struct Arm {
    Scalar s;
    Vector<Scalar, D> y;
};

template <class Scalar, int D>
Arm<Scalar, D> fluid_arm(const Model<Scalar, D>& model, const Pair<Scalar, D>& pair) {
    return {-model.volume * pair.a, pair.x};
}

// A wall without slip counts as the point of its surface below the particle.
template <class Scalar, int D>
Arm<Scalar, D> wall_arm(const Model<Scalar, D>& model, const Pair<Scalar, D>& pair) {
    const Vector<Scalar, D> normal = model.wall_normals[pair.other].template cast<Scalar>();
    const Scalar across = normal.dot(pair.x), height = across - Scalar(model.wall_depths[pair.other]);
    const Scalar held = height > model.closest ? height : model.closest;
    const Scalar above = height > Scalar(0) ? height : Scalar(0);
    return {-model.wall_weights[pair.other] * model.volume * pair.a * across / held, above * normal};
}

// `body(pair, arm, j)` for all that particle i rubs against; j is -1 for a wall.
template <class Scalar, int D, class Body>
void each_arm(const Model<Scalar, D>& model, std::size_t i, const Pairs<Scalar, D>& fluid,
              const Pairs<Scalar, D>& walls, const Body& body) {
    for (auto pair = fluid.begin_of(i); pair != fluid.end_of(i); ++pair)
        body(*pair, fluid_arm(model, *pair), pair->other);
    if (real_part(model.friction) == 0) return;
    for (auto pair = walls.begin_of(i); pair != walls.end_of(i); ++pair) body(*pair, wall_arm(model, *pair), -1);
}

// Of values of i and of j, all 0 for a wall.
template <class Value>
Value sum_of(const std::vector<Value>& values, std::size_t i, int j) {
    return j < 0 ? values[i] : Value(values[i] + values[j]);
}
template <class Value>
Value difference_of(const std::vector<Value>& values, std::size_t i, int j) {
    return j < 0 ? values[i] : Value(values[i] - values[j]);
}

// The invariant of order D - 1 of a symmetric matrix, and its gradient.
template <class Scalar, int D>
struct Second {
    Scalar value;
    Matrix<Scalar, D> slope = Matrix<Scalar, D>::Identity();

    explicit Second(const Matrix<Scalar, D>& M) : value(M.trace()) {
        if constexpr (D == 2) return;
        slope = value * slope - M;
        value = (value * value - (M * M).trace()) / Scalar(2);
    }
};

// The fullness S of M, and its gradient where that is asked for: both 0 where neighbours lie on a line.
template <class Scalar, int D>
struct Fullness {
    Scalar S{0};
    Matrix<Scalar, D> slope = Matrix<Scalar, D>::Constant(Scalar(0));

    explicit Fullness(const Matrix<Scalar, D>& M) {
        const Scalar one(1);
        const Second<Scalar, D> second(M);
        if (!(second.value > Scalar(0))) return;
        const Scalar H = Scalar(D) * M.determinant() / second.value;
        const Scalar empty = one / Scalar(5), width = Scalar(3) / Scalar(10);
        if (!(H > empty)) return;
        const Scalar t = (H - empty) / width;
        if (!(t < one)) {
            S = one;
            return;
        }
        S = t * t * (Scalar(3) - Scalar(2) * t);
        const Matrix<Scalar, D> H_slope = H * (M.inverse() - second.slope / second.value);
        slope = (Scalar(6) * t * (one - t) / width) * H_slope;
    }
};

template <class Scalar, int D>
struct Stress {
    Matrices<Scalar, D> M, A;  // sums of s y y^T and of s v_ij y^T
    Matrices<Scalar, D> T;     // S (2 D M^-1 - C G)
    Values<Scalar> S;

    // What follows from positions, by way of lists, and from velocities.
    void find(const Model<Scalar, D>& model, const Pairs<Scalar, D>& fluid, const Pairs<Scalar, D>& walls,
              const Vectors<Scalar, D>& v) {
        for (Matrices<Scalar, D>* each : {&M, &A, &T}) each->resize(v.size());
        S.resize(v.size());
        each_particle(v.size(), model.threads, [&](std::size_t i) {
            M[i] = A[i] = T[i] = Matrix<Scalar, D>::Constant(Scalar(0));
            each_arm(model, i, fluid, walls, [&](const auto&, const Arm<Scalar, D>& arm, int j) {
                const Vector<Scalar, D> pull = arm.s * arm.y;
                M[i] += pull * arm.y.transpose();
                A[i] += difference_of(v, i, j) * pull.transpose();
            });
            S[i] = Fullness<Scalar, D>(M[i]).S;
            if (real_part(S[i]) == 0) return;
            const Matrix<Scalar, D> K = M[i].inverse(), G = A[i] * K, twice_D = G + G.transpose();
            T[i] = S[i] * (twice_D * K - model.control * G);
        });
    }

    // The force on particle i per volume, over the viscosity.
    Vector<Scalar, D> force(const Model<Scalar, D>& model, std::size_t i, const Pairs<Scalar, D>& fluid,
                            const Pairs<Scalar, D>& walls, const Vectors<Scalar, D>& v) const {
        Vector<Scalar, D> total = Vector<Scalar, D>::Constant(Scalar(0));
        each_arm(model, i, fluid, walls, [&](const auto&, const Arm<Scalar, D>& arm, int j) {
            total -= arm.s * pull(model, i, j, arm, v);
        });
        return total;
    }

    // (T_i + T_j) y + C (S_i + S_j) v_ij
    Vector<Scalar, D> pull(const Model<Scalar, D>& model, std::size_t i, int j, const Arm<Scalar, D>& arm,
                           const Vectors<Scalar, D>& v) const {
        return sum_of(T, i, j) * arm.y + (model.control * sum_of(S, i, j)) * difference_of(v, i, j);
    }
};

}  // namespace cortado
