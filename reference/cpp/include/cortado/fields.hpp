// Arrays of particles, and the loop over them.
#pragma once

#include <Eigen/Core>
#include <vector>

#include "engine.hpp"
#include "scalar.hpp"

namespace cortado {

template <class Scalar, int D>
using Vector = Eigen::Matrix<Scalar, D, 1>;
template <class Scalar, int D>
using Vectors = std::vector<Vector<Scalar, D>>;
template <class Scalar, int D>
using Matrix = Eigen::Matrix<Scalar, D, D>;
template <class Scalar, int D>
using Matrices = std::vector<Matrix<Scalar, D>>;
template <class Scalar>
using Values = std::vector<Scalar>;

template <class Scalar, int D>
Vectors<Scalar, D> zero_vectors(std::size_t count) {
    return Vectors<Scalar, D>(count, Vector<Scalar, D>::Constant(Scalar(0)));
}

template <class Scalar, int D>
struct State {
    Vectors<Scalar, D> x;  // [m]
    Vectors<Scalar, D> v;  // [m / s]
    Values<Scalar> k;      // dt p of the projection [Pa s]
    Vectors<Scalar, D> kick;  // -D^T k / m of its step [m / s]
};

// Every particle writes its own values only: the same bits for any number of threads.
template <class Body>
void each_particle(std::size_t count, int threads, const Body& body) {
#pragma omp parallel for schedule(static) num_threads(threads)
    for (std::ptrdiff_t i = 0; i < std::ptrdiff_t(count); ++i) body(std::size_t(i));
}

// ---- to and from pairs of doubles ------------------------------------------------------------------------------

template <class Real>
Real joined(const Numbers& numbers, std::size_t k) {
    return Real(numbers.high[k]) + Real(numbers.low[k]);
}

template <class Real>
void append(Numbers& numbers, const Real& value) {
    const double high = double(value);
    numbers.high.push_back(high);
    numbers.low.push_back(double(value - Real(high)));
}

template <class Real, int D>
Vectors<Real, D> joined_vectors(const Numbers& numbers) {
    Vectors<Real, D> vectors(numbers.size() / D);
    for (std::size_t i = 0; i < vectors.size(); ++i)
        for (int axis = 0; axis < D; ++axis) vectors[i][axis] = joined<Real>(numbers, i * D + axis);
    return vectors;
}

template <class Real, int D>
void append(Numbers& numbers, const Vectors<Real, D>& vectors) {
    for (const auto& vector : vectors)
        for (int axis = 0; axis < D; ++axis) append(numbers, vector[axis]);
}

template <class Real, int D>
double norm(const Vectors<Real, D>& vectors) {
    double sum = 0;
    for (const auto& vector : vectors)
        for (int axis = 0; axis < D; ++axis) sum += double(vector[axis]) * double(vector[axis]);
    return std::sqrt(sum);
}

}  // namespace cortado
