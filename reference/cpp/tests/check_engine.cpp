// Every path of the engine on small scenes, for the sanitizers, with the checks that need no other engine: reverse mode
// against forward mode, the methods against each other, and the same bits with two threads.
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <limits>

#include "cortado/engine.hpp"

using namespace cortado;

namespace {

int failures = 0;

void expect(bool right, const std::string& what, double found) {
    if (right) return;
    ++failures;
    std::printf("WRONG %s: %g\n", what.c_str(), found);
}

Scene box(int d, const std::string& kernel, const std::string& viscosity, bool periodic, bool projection = false) {
    Scene s{};
    const double pi = 3.14159265358979323846, h = 0.1;
    s.dimension = d;
    s.kernel = kernel;
    s.support = h;
    s.reach = 1.03 * h;
    s.normalisation = d == 2 ? 40 / (7 * pi * h * h) : 8 / (pi * h * h * h);
    s.volume = std::pow(0.05, d);
    s.stiffness = 0.1 * h * h * (d == 2 ? 1 : 0.5);
    s.response = std::pow(h, -2.0 * (d + 1));
    for (double x = -0.1; x < 0.4; x += 0.05)
        for (double z = -0.1; z < (d == 3 ? 0.3 : -0.09); z += 0.05) {
            s.wall_positions.insert(s.wall_positions.end(), {x, -0.02});
            if (d == 3) s.wall_positions.push_back(z);
            s.wall_weights.push_back(1.1);
            s.wall_feet.insert(s.wall_feet.end(), {0, 0.02});
            if (d == 3) s.wall_feet.push_back(0);
        }
    s.wall_mirrors.assign(s.wall_weights.size(), 1);
    s.mirror_lower.fill(-std::numeric_limits<double>::infinity());
    s.mirror_upper.fill(std::numeric_limits<double>::infinity());
    s.mirror_lower[1] = 0;
    if (periodic) s.periods = {0.3, 0, 0};
    s.rest_density = 1000;
    s.time_step = 0.002;
    s.viscosity = viscosity;
    s.friction = 0.8;
    s.control = 1.4;
    s.closest = 0.0125;
    s.pressure = true;
    s.minimum_iterations = 2;
    s.maximum_iterations = 5;
    s.density_tolerance = 1e-3;
    s.maximum_density_tolerance = 1e-2;
    s.projection = projection;
    s.spacing = 0.05;
    s.relaxation = 0.4;
    s.repair_relaxations = {0.9, 0.4};
    s.least_diagonal = d == 2 ? 60 : 40;
    s.nearest_weight = 0.1;
    if (projection) {
        s.nodes = {periodic ? 3 : 6, 5, d == 3 ? 5 : 1};
        s.first_node = {periodic ? 0 : -0.2, -0.2, -0.2};
        s.node_frequency = {10, 10, 10};
    }
    return s;
}

double noise() { return double(std::rand()) / RAND_MAX - 0.5; }

Parameters block(int d, int steps, double size, bool lattice) {
    Parameters at;
    const auto add = [](Numbers& to, double value) {
        to.high.push_back(value);
        to.low.push_back(0);
    };
    for (int i = 0; i < 4; ++i)
        for (int j = 0; j < 4; ++j)
            for (int k = 0; k < (d == 3 ? 4 : 1); ++k) {
                const int place[] = {i, j, k};
                for (int axis = 0; axis < d; ++axis) {
                    add(at.positions, lattice ? 0.048 * (place[axis] + 0.5) + size * noise() : size * noise());
                    add(at.velocities, size * noise());
                }
            }
    for (int n = 0; n < steps; ++n)
        for (int axis = 0; axis < d; ++axis) add(at.gravity, (lattice && axis == 1 ? -9.81 : 0) + size * noise());
    add(at.viscosity, 0.5);
    return at;
}

double dot(const Numbers& a, const Numbers& b) {
    double sum = 0;
    for (std::size_t k = 0; k < a.size(); ++k) sum += (a.high[k] + a.low[k]) * (b.high[k] + b.low[k]);
    return sum;
}

double dot(const Parameters& a, const Parameters& b) {
    return dot(a.positions, b.positions) + dot(a.velocities, b.velocities) + dot(a.gravity, b.gravity) +
           dot(a.viscosity, b.viscosity);
}

void check(const std::string& name, std::unique_ptr<Engine> (*make)(const Scene&, int), double round_off) {
    const int steps = 6;
    struct Case {
        int d;
        const char *kernel, *viscosity;
        bool periodic, projection = false;
    };
    for (const auto& [d, kernel, viscosity, periodic, projection] : {Case{2, "cubic_spline", "pairwise", false},
                                                         Case{2, "wendland_c2", "pairwise", true},
                                                         Case{2, "wendland_c4", "none", true},
                                                         Case{2, "cubic_spline", "stress", true},
                                                         Case{3, "cubic_spline", "pairwise", true},
                                                         Case{3, "wendland_c2", "stress", false},
                                                         Case{3, "wendland_c2", "pairwise", false},
                                                         Case{3, "wendland_c4", "pairwise", false},
                                                         Case{2, "wendland_c2", "stress", true, true},
                                                         Case{2, "cubic_spline", "none", false, true},
                                                         Case{3, "wendland_c4", "stress", false, true}}) {
        const std::string what = name + " " + std::to_string(d) + "-D " + kernel +
                                 (projection ? " projection" : "");
        const Scene scene = box(d, kernel, viscosity, periodic, projection);
        const Parameters at = block(d, steps, 0.004, true), along = block(d, steps, 0.01, false);
        const auto engine = make(scene, 1), parallel = make(scene, 2);
        const auto tangent = [&](const char* method, const Terms& terms = {}) {
            return engine->tangent(at, along, steps, 1, method, terms, 1e-3, nullptr);
        };
        const History exact = tangent("analytic");
        const double size = exact.position_norms.back();
        for (const char* method : {"dual", "complex_step"}) {
            const double other = tangent(method).position_norms.back();
            expect(std::abs(other - size) < round_off * size, what + " " + method, other / size - 1);
        }
        tangent("finite_difference");
        for (const char* reading :
             {"as_printed", "as_printed_right_viscosity", "as_printed_predicted_density"})
            if (!projection) tangent(reading);
        for (const Terms& terms : {Terms{}, Terms{false, true, true, true}, Terms{true, false, true, true},
                                   Terms{true, true, false, true}, Terms{true, true, true, false}}) {
            if (projection && !(terms.viscosity && terms.pressure && terms.hessian && terms.density)) continue;
            const Gradient back = engine->gradient(
                at, steps, 1, terms,
                [](const Numbers& x, const Numbers& v) { return std::pair<Numbers, Numbers>(x, v); },
                nullptr);
            const History forth = tangent("analytic", terms);
            const std::size_t n = at.positions.size(), last = steps * n;
            double forward = 0;
            for (std::size_t k = 0; k < n; ++k)
                forward += forth.positions.high[last + k] * forth.position_dots.high[last + k] +
                           forth.velocities.high[last + k] * forth.velocity_dots.high[last + k];
            const double reverse = dot(back.bar, along);
            // Of terms that cancel, and low digits left out above.
            const double scale = std::abs(forward) + 1e-3;
            expect(std::abs(reverse - forward) < 1e3 * round_off * scale, what + " reverse", reverse - forward);
        }
        const History again = parallel->run(at, steps, 1, nullptr);
        expect(again.positions.high == exact.positions.high, what + " threads", 0);
    }
    Scene wild = box(2, "cubic_spline", "none", false);
    wild.time_step = 1e6;
    expect(make(wild, 1)->run(block(2, 3, 0.004, true), 3, 1, nullptr).bad_step == 0, name + " lost particle", 0);
}

}  // namespace

int main() {
#ifdef CORTADO_HAS_FLOAT32
    check("float32", make_engine<float>, 1e-2);
#endif
#ifdef CORTADO_HAS_FLOAT64
    check("float64", make_engine<double>, 1e-11);
#endif
#ifdef CORTADO_HAS_FLOAT80
    check("float80", make_engine<long double>, 1e-13);
#endif
#ifdef CORTADO_HAS_FLOAT128
    check("float128", make_engine<__float128>, 1e-13);
#endif
    if (failures == 0) std::puts("every check of the engine passed");
    return failures > 0;
}
