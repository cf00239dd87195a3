// A scene's constants in the precision of a run, and the sums over neighbours that a step and its derivatives share.
#pragma once

#include <memory>

#include "nodes.hpp"
#include "pairs.hpp"

namespace cortado {

enum class Viscosity { none, pairwise, stress };

template <class Scalar, int D>
struct Model {
    using Real = typename RealOf<Scalar>::type;

    Smoothing<Scalar> smoothing;
    Period<Scalar, D> period;
    std::array<double, 3> periods;
    double reach;
    Scalar volume, self_weight, stiffness, response, size_floor;
    Scalar rest_density, time_step, friction, control, closest, kappa;
    Viscosity viscosity;
    bool pressure;
    int minimum_iterations, maximum_iterations;
    Real density_tolerance, maximum_density_tolerance;
    bool projection;
    Scalar spacing, relaxation, least_diagonal, nearest_weight;
    Nodes<Scalar, D> nodes;  // of the coarse correction
    Scalar least_energy;     // eps: 1e-5 of that of a hat's gradient on the lattice, for each particle around a node
    Values<Scalar> momenta;  // beta of the projection's iterations: of the first as Nesterov's (1983), else 0
    Values<Scalar> repair_relaxations;
    Vectors<Real, D> wall_positions, wall_normals;
    Values<Real> wall_depths;  // behind the surface
    Values<Scalar> wall_weights;
    std::array<double, 3> mirror_lower, mirror_upper;  // flat walls that mirror the fluid
    std::vector<int> wall_mirrors;                     // whether a wall particle is one of theirs
    Cells<D> wall_cells;
    int threads;

    Model(const Scene& s, int threads)
        : smoothing(s.kernel, s.support, s.normalisation),
          period(s.periods),
          periods(s.periods),
          reach(s.reach),
          volume(Real(s.volume)),
          self_weight(smoothing.weight(Scalar(0))),
          stiffness(Real(s.stiffness)),
          response(Real(s.response)),
          size_floor(Real(1) / Real(100) * smoothing.h_squared),
          rest_density(Real(s.rest_density)),
          time_step(Real(s.time_step)),
          friction(Real(s.friction)),
          control(Real(s.control)),
          closest(Real(s.closest)),
          kappa(Real(s.viscosity == "pairwise" ? 2 * (D + 2) : 1)),
          viscosity(s.viscosity == "pairwise" ? Viscosity::pairwise
                    : s.viscosity == "stress" ? Viscosity::stress
                                              : Viscosity::none),
          pressure(s.pressure),
          minimum_iterations(s.minimum_iterations),
          maximum_iterations(s.maximum_iterations),
          density_tolerance(Real(s.density_tolerance)),
          maximum_density_tolerance(Real(s.maximum_density_tolerance)),
          projection(s.projection),
          spacing(Real(s.spacing)),
          relaxation(Real(s.relaxation)),
          least_diagonal(Real(s.least_diagonal)),
          nearest_weight(Real(s.nearest_weight)),
          nodes(s),
          least_energy(Real(D == 2 ? 8 : 16) / (Real(3e5) * Real(1 << 2 * D)) / (spacing * spacing)),
          momenta(s.maximum_iterations, Scalar(0)),
          repair_relaxations(s.repair_relaxations.begin(), s.repair_relaxations.end()),
          wall_positions(joined_vectors<Real, D>(high_only(s.wall_positions))),
          wall_normals(joined_vectors<Real, D>(high_only(s.wall_feet))),
          wall_depths(wall_normals.size()),
          wall_weights(s.wall_weights.begin(), s.wall_weights.end()),
          mirror_lower(s.mirror_lower),
          mirror_upper(s.mirror_upper),
          wall_mirrors(s.wall_mirrors),
          wall_cells(cells_of<Real, D>(wall_positions, s.reach, s.periods)),
          threads(threads) {
        for (std::size_t b = 0; b < wall_normals.size(); ++b) {
            wall_depths[b] = square_root(Real(wall_normals[b].dot(wall_normals[b])));
            wall_normals[b] /= wall_depths[b];
        }
        const Real t(5);  // not 1, as the first pressure is that of the step before
        const Real later = (Real(1) + square_root(Real(Real(1) + Real(4) * t * t))) / Real(2);
        if (momenta.size() > 1) momenta[0] = Scalar((t - Real(1)) / later);
    }

    // phi of the pairwise viscosity, of a pair at rest and its gradient: see docs/discretisation.md.
    Vector<Scalar, D> phi(const Pair<Scalar, D>& pair, const Vector<Scalar, D>& v) const {
        return (v.dot(pair.x) / (pair.x.dot(pair.x) + size_floor) * pair.a) * pair.x;
    }

    // sum_j W(x_j) + sum_b w_b W(x_b) over lists, at other positions than those that the lists are of.
    Scalar weights(std::size_t i, const Pairs<Scalar, D>& fluid, const Pairs<Scalar, D>& walls,
                   const Vectors<Scalar, D>& x) const {
        Scalar total(0);
        for (auto pair = fluid.begin_of(i); pair != fluid.end_of(i); ++pair) {
            const Vector<Scalar, D> x_ij = period.nearest(x[i] - x[pair->other]);
            const Scalar r_squared = x_ij.dot(x_ij);
            if (smoothing.near(r_squared)) total += smoothing.weight(smoothing.q_of(r_squared));
        }
        for (auto pair = walls.begin_of(i); pair != walls.end_of(i); ++pair) {
            const Vector<Scalar, D> x_ib = period.nearest(x[i] - wall_positions[pair->other].template cast<Scalar>());
            const Scalar r_squared = x_ib.dot(x_ib);
            if (smoothing.near(r_squared))
                total += wall_weights[pair->other] * smoothing.weight(smoothing.q_of(r_squared));
        }
        return total;
    }

private:
    static Numbers high_only(const std::vector<double>& values) {
        Numbers numbers(values.size());
        numbers.high = values;
        return numbers;
    }
};

}  // namespace cortado
