// The binding to Python, and the only file that knows of it. What it gives is for cortado.reference, not for users.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/array.h>
#include <nanobind/stl/function.h>
#include <nanobind/stl/pair.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/unique_ptr.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <map>

#include "cortado/engine.hpp"

namespace nb = nanobind;
using namespace nb::literals;

namespace {

using Array = nb::ndarray<const double, nb::ndim<1>, nb::c_contig, nb::device::cpu>;

template <class Value>
auto to_numpy(const std::vector<Value>& values) {
    auto* copy = new std::vector<Value>(values);
    nb::capsule owner(copy, [](void* p) noexcept { delete static_cast<std::vector<Value>*>(p); });
    return nb::ndarray<nb::numpy, Value, nb::ndim<1>>(copy->data(), {copy->size()}, owner);
}

std::vector<double> from_numpy(const Array& array) { return {array.data(), array.data() + array.shape(0)}; }

using Make = std::unique_ptr<cortado::Engine> (*)(const cortado::Scene&, int);
const std::map<std::string, Make> precisions = {
#ifdef CORTADO_HAS_FLOAT32
    {"float32", cortado::make_engine<float>},
#endif
#ifdef CORTADO_HAS_FLOAT64
    {"float64", cortado::make_engine<double>},
#endif
#ifdef CORTADO_HAS_FLOAT80
    {"float80", cortado::make_engine<long double>},
#endif
#ifdef CORTADO_HAS_FLOAT128
    {"float128", cortado::make_engine<__float128>},
#endif
};

// A function of Python, called without its lock being held by the engine.
template <class Result, class... Arguments>
std::function<Result(Arguments...)> locked(std::function<Result(Arguments...)> function) {
    if (!function) return function;
    return [function](Arguments... arguments) {
        nb::gil_scoped_acquire lock;
        return function(arguments...);
    };
}

// What the observer of Python sees, and where Ctrl+C is noticed.
cortado::Observer watched(cortado::Observer observe) {
    return [observe](int step) {
        nb::gil_scoped_acquire lock;
        if (PyErr_CheckSignals() != 0) throw nb::python_error();
        if (observe) observe(step);
    };
}

}  // namespace

NB_MODULE(_engine, m) {
    using namespace cortado;

    nb::class_<Numbers>(m, "Numbers")
        .def("__init__",
             [](Numbers* numbers, const Array& high, const Array& low) {
                 new (numbers) Numbers();
                 numbers->high = from_numpy(high);
                 numbers->low = from_numpy(low);
             })
        .def_prop_ro("high", [](const Numbers& numbers) { return to_numpy(numbers.high); }, nb::rv_policy::move)
        .def_prop_ro("low", [](const Numbers& numbers) { return to_numpy(numbers.low); }, nb::rv_policy::move);

    nb::class_<Scene>(m, "Scene")
        .def(nb::init<>())
        .def_rw("dimension", &Scene::dimension)
        .def_rw("kernel", &Scene::kernel)
        .def_rw("support", &Scene::support)
        .def_rw("reach", &Scene::reach)
        .def_rw("normalisation", &Scene::normalisation)
        .def_rw("volume", &Scene::volume)
        .def_rw("stiffness", &Scene::stiffness)
        .def_rw("response", &Scene::response)
        .def_rw("wall_positions", &Scene::wall_positions)
        .def_rw("wall_weights", &Scene::wall_weights)
        .def_rw("wall_feet", &Scene::wall_feet)
        .def_rw("mirror_lower", &Scene::mirror_lower)
        .def_rw("mirror_upper", &Scene::mirror_upper)
        .def_rw("wall_mirrors", &Scene::wall_mirrors)
        .def_rw("periods", &Scene::periods)
        .def_rw("rest_density", &Scene::rest_density)
        .def_rw("time_step", &Scene::time_step)
        .def_rw("viscosity", &Scene::viscosity)
        .def_rw("friction", &Scene::friction)
        .def_rw("control", &Scene::control)
        .def_rw("closest", &Scene::closest)
        .def_rw("pressure", &Scene::pressure)
        .def_rw("minimum_iterations", &Scene::minimum_iterations)
        .def_rw("maximum_iterations", &Scene::maximum_iterations)
        .def_rw("density_tolerance", &Scene::density_tolerance)
        .def_rw("maximum_density_tolerance", &Scene::maximum_density_tolerance)
        .def_rw("projection", &Scene::projection)
        .def_rw("spacing", &Scene::spacing)
        .def_rw("relaxation", &Scene::relaxation)
        .def_rw("repair_relaxations", &Scene::repair_relaxations)
        .def_rw("least_diagonal", &Scene::least_diagonal)
        .def_rw("nearest_weight", &Scene::nearest_weight)
        .def_rw("nodes", &Scene::nodes)
        .def_rw("first_node", &Scene::first_node)
        .def_rw("node_frequency", &Scene::node_frequency);

    nb::class_<Parameters>(m, "Parameters")
        .def("__init__",
             [](Parameters* parameters, const Numbers& positions, const Numbers& velocities, const Numbers& gravity,
                const Numbers& viscosity) {
                 new (parameters) Parameters{positions, velocities, gravity, viscosity};
             })
        .def_ro("positions", &Parameters::positions)
        .def_ro("velocities", &Parameters::velocities)
        .def_ro("gravity", &Parameters::gravity)
        .def_ro("viscosity", &Parameters::viscosity);

    nb::class_<Terms>(m, "Terms").def("__init__",
                                      [](Terms* terms, bool viscosity, bool pressure, bool hessian, bool density) {
                                          new (terms) Terms{viscosity, pressure, hessian, density};
                                      });

    nb::class_<History>(m, "History")
        .def_prop_ro("frames", [](const History& h) { return to_numpy(h.frames); }, nb::rv_policy::move)
        .def_ro("positions", &History::positions)
        .def_ro("velocities", &History::velocities)
        .def_ro("position_dots", &History::position_dots)
        .def_ro("velocity_dots", &History::velocity_dots)
        .def_prop_ro("position_norms", [](const History& h) { return to_numpy(h.position_norms); }, nb::rv_policy::move)
        .def_prop_ro("velocity_norms", [](const History& h) { return to_numpy(h.velocity_norms); }, nb::rv_policy::move)
        .def_prop_ro("iterations", [](const History& h) { return to_numpy(h.iterations); }, nb::rv_policy::move)
        .def_prop_ro("errors", [](const History& h) { return to_numpy(h.errors); }, nb::rv_policy::move)
        .def_ro("bad_step", &History::bad_step)
        .def_ro("bad_particle", &History::bad_particle);

    nb::class_<Gradient>(m, "Gradient").def_ro("bar", &Gradient::bar).def_ro("history", &Gradient::history);

    nb::class_<Engine>(m, "Engine")
        .def(
            "run",
            [](const Engine& engine, const Parameters& at, int steps, int record_every, Observer observe) {
                nb::gil_scoped_release unlocked;
                return engine.run(at, steps, record_every, watched(observe));
            },
            "at"_a, "steps"_a, "record_every"_a, "observe"_a.none())
        .def(
            "tangent",
            [](const Engine& engine, const Parameters& at, const Parameters& along, int steps, int record_every,
               const std::string& method, const Terms& terms, double difference, Observer observe) {
                nb::gil_scoped_release unlocked;
                return engine.tangent(at, along, steps, record_every, method, terms, difference, watched(observe));
            },
            "at"_a, "along"_a, "steps"_a, "record_every"_a, "method"_a, "terms"_a, "difference"_a,
            "observe"_a.none())
        .def(
            "gradient",
            [](const Engine& engine, const Parameters& at, int steps, int record_every, const Terms& terms,
               LossAdjoint loss, Observer observe) {
                nb::gil_scoped_release unlocked;
                return engine.gradient(at, steps, record_every, terms, locked(loss), watched(observe));
            },
            "at"_a, "steps"_a, "record_every"_a, "terms"_a, "loss"_a, "observe"_a.none());

    m.def("precisions", [] {
        std::vector<std::string> names;
        for (const auto& [name, make] : precisions) names.push_back(name);
        return names;
    });
    m.def("make_engine", [](const std::string& precision, const Scene& scene, int threads) {
        return precisions.at(precision)(scene, threads);
    });
}
