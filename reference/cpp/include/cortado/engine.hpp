// What the engine can do, without how: the only header that the binding to Python sees.
#pragma once

#include <array>
#include <functional>
#include <memory>
#include <string>
#include <vector>

namespace cortado {

// Numbers that may have more digits than a double: each is high + low.
struct Numbers {
    std::vector<double> high, low;

    explicit Numbers(std::size_t count = 0) : high(count), low(count) {}
    std::size_t size() const { return high.size(); }
};

// A scene made ready: docs/discretisation.md gives every constant. Vectors lie one after the other, d numbers each.
struct Scene {
    int dimension;
    std::string kernel;     // "cubic_spline", "wendland_c2", "wendland_c4"
    double support;         // h [m]
    double reach;           // to which pairs are listed [m]
    double normalisation;   // sigma [1 / m^d]
    double volume;          // V [m^d]
    double stiffness;       // k
    double response;        // of the yield beside walls
    std::vector<double> wall_positions;  // (b, d) [m]
    std::vector<double> wall_weights;    // (b,) w_b, a fluid particle being 1
    std::vector<double> wall_feet;       // (b, d) from wall particles to the surface [m]
    std::array<double, 3> mirror_lower, mirror_upper;  // of flat walls that mirror the fluid [m]; infinite: none
    std::vector<int> wall_mirrors;       // (b,) 1 of particles of these walls, else 0
    std::array<double, 3> periods;       // [m], 0 along an axis that is not periodic
    double rest_density;                 // [kg / m3]
    double time_step;                    // [s]
    std::string viscosity;               // "stress", "pairwise", "none"
    double friction;                     // of walls; 0 for free slip
    double control;                      // C of the stress
    double closest;                      // from where on a wall pulls no harder, by the stress [m]
    bool pressure;
    int minimum_iterations, maximum_iterations;
    double density_tolerance, maximum_density_tolerance;
    bool projection;                     // in the place of PCISPH: `maximum_iterations` of its pressures, and
    double spacing;                      // [m]
    double relaxation;                   // omega
    std::vector<double> repair_relaxations;  // that of each repair of the density
    double least_diagonal;               // 0.05 a_0 [1 / m2]
    double nearest_weight;               // V W(s)
    std::array<int, 3> nodes;            // of its coarse grid along each axis; 0 where nothing is corrected
    std::array<double, 3> first_node;    // [m]
    std::array<double, 3> node_frequency;  // nodes to the metre
};

// What a run depends on, and also the type of a direction and of a gradient.
struct Parameters {
    Numbers positions;   // (n, d) [m]
    Numbers velocities;  // (n, d) [m / s]
    Numbers gravity;     // (steps, d) [m / s2]
    Numbers viscosity;   // (1,) dynamic [Pa s]
};

// Which parts of the step's derivative count; all of them make the exact one. The step itself is never changed.
struct Terms {
    bool viscosity = true;
    bool pressure = true;
    bool hessian = true;  // of the pressure force: (c_i + c_j) H_ij dx_ij, the report's term 1
    bool density = true;  // of the pressure force: (dc_i + dc_j) G_ij, the report's term 2
};

struct History {
    std::vector<int> frames;         // numbers of steps after which a state was recorded
    Numbers positions, velocities;   // (frames, n, d)
    Numbers position_dots, velocity_dots;            // (frames, n, d), of a tangent
    std::vector<double> position_norms, velocity_norms;  // (steps + 1,) of the tangent or adjoint of each state
    std::vector<int> iterations;     // (steps,)
    std::vector<double> errors;      // (steps,) average compression before the last correction
    int bad_step = -1, bad_particle = -1;  // where a particle was lost, which ends the run
};

struct Gradient {
    Parameters bar;
    History history;  // of the states; norms are those of the adjoints
};

// Called after each step, and before the first: may throw to stop.
using Observer = std::function<void(int step)>;

// From the last positions and velocities (n, d) to a loss's derivatives with respect to them.
using LossAdjoint = std::function<std::pair<Numbers, Numbers>(const Numbers& positions, const Numbers& velocities)>;

class Engine {
public:
    virtual ~Engine() = default;

    virtual History run(const Parameters& at, int steps, int record_every, const Observer& observe) const = 0;

    // `method`: "analytic" (with `terms`), "dual", "complex_step", "finite_difference" (central, of step
    // `difference`), "as_printed", "as_printed_right_viscosity", "as_printed_predicted_density".
    virtual History tangent(const Parameters& at, const Parameters& along, int steps, int record_every,
                            const std::string& method, const Terms& terms, double difference,
                            const Observer& observe) const = 0;

    virtual Gradient gradient(const Parameters& at, int steps, int record_every, const Terms& terms,
                              const LossAdjoint& loss, const Observer& observe) const = 0;
};

// In D dimensions, with numbers of a type. Which of these there are is for the build to say.
template <class Real, int D>
std::unique_ptr<Engine> engine_of(const Scene& scene, int threads);

// `threads` >= 1. Results do not depend on it.
template <class Real>
std::unique_ptr<Engine> make_engine(const Scene& scene, int threads) {
    return scene.dimension == 2 ? engine_of<Real, 2>(scene, threads) : engine_of<Real, 3>(scene, threads);
}

}  // namespace cortado
