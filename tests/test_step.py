"""Whole steps of the engine against the slow twins, and their tangents and adjoints against complex steps."""

import numpy as np
import pytest

import reference
import reference_terms
from cortado import Simulation
from cortado.gradients import Exact
from cortado.losses.loss import ADJOINT_FIELDS
from cortado.rollout.parameter_space import ParameterSpace
from scenes import MIXING, jet, plane, plane_of_three, pour, scatter, scene, two_layers
from twins import emitter_twin, nozzle_of, tension_twin, twin

BY_CURVATURE = {"kind": "projection", "time_step": 0.0021}
"""The solver whose surface tension is by curvature; without pressure it takes the step of the twin."""
GRAVITY, STEPS, ITERATIONS = np.array([0.3, -9.81, 0.1]), 3, 5
ONE = {"rest_density": 1000.0, "viscosity": 5.0, "time_step": 0.0021}
"""Parameters of the fluids."""
SEVERAL = {"rest_density": [1000.0, 1800.0, 1300.0], "viscosity": [5.0, 0.4, 20.0], "time_step": 0.0021}
RATES = {"rest_density": 10.0, "viscosity": 0.3, "time_step": 1e-4, "mobility": 0.01, "interface_width": 0.003}
RATES |= {"nozzle.path": 0.01, "nozzle.flow_rate": 0.01}
"""Sizes of directions; 1 for the others."""


def tense(**changes):
    forces, phase = {"gravity": [0.0, -9.81], "surface_tension": 20.0}, {"name": "water", "rest_density": 1000.0}
    return plane(**{"phase": [{**phase, "viscosity": 5.0}], "forces": forces, **changes})


def tense_cube(**changes):
    forces = {"gravity": [0.0, -9.81, 0.0], "surface_tension": 15.0}
    phases = [{**phase.model_dump(), "viscosity": 5.0} for phase in two_layers().phase]
    return two_layers(**{"phase": phases, "forces": forces, **changes})


def curved(make=tense, **changes):
    forces = {**changes.pop("forces", make().forces.model_dump()), "pressure": False}
    return make(**changes, forces=forces, solver=BY_CURVATURE)


def curved_cube(**changes):
    return curved(tense_cube, **changes)


def miscible(make=two_layers, **changes):
    return make(**changes, mixture={**make().mixture.model_dump(), "free_energy": "miscible"})


def three_miscible(**changes):
    mixture = {**MIXING, "mobility": 0.03, "free_energy": "miscible"}
    return plane_of_three(**changes, mixture=mixture)


def point_of(simulation, seed=0):
    """Values of all parameters: a random state near the scene's own, so that no symmetry hides a mistake."""
    random = np.random.default_rng(seed)
    spacing, phases = simulation.scene.discretisation.spacing, len(simulation.scene.phase)
    shape = simulation.positions.shape
    point = {
        "gravity": GRAVITY[: simulation.dimension],
        "initial_positions": simulation.positions + 0.05 * spacing * random.standard_normal(shape),
        "initial_velocities": 0.3 * random.standard_normal(shape),
        **(ONE if phases == 1 else SEVERAL),
    }
    if simulation.scene.forces.viscosity == "stress":
        scatter(point["initial_positions"], spacing)
    if phases > 1:
        point |= {name: simulation.parameters()[name] for name in ("mobility", "interface_width")}
        point |= {name: point[name][:phases] for name in ("rest_density", "viscosity")}
        point["mass_fractions"] = random.dirichlet(np.full(phases, 0.5), len(simulation.positions))
    if simulation.scene.forces.viscosity == "none":
        point = {name: value for name, value in point.items() if name != "viscosity"}
    if simulation.scene.forces.surface_tension:
        point["surface_tension"] = simulation.scene.forces.surface_tension
    if nozzle := nozzle_of(simulation):
        outlet = simulation.parameters()["nozzle.path"]
        point["nozzle.path"] = outlet + 0.01 * random.standard_normal((STEPS, len(outlet)))
        point["nozzle.flow_rate"] = 0.6 * nozzle.area * simulation.scene.discretisation.spacing / point["time_step"]
    return {name: np.asarray(value, dtype=np.float64) for name, value in point.items()}


def twins_steps(simulation, substeps):
    """The function of parameters, by their names, to the twin's last (x, v, c)."""
    slow, lattice, mixture = twin(simulation), simulation.solver.lattice, simulation.scene.mixture
    phases, iterations = len(simulation.scene.phase), ITERATIONS if simulation.scene.forces.pressure else 0

    def mix(x, c, mass, time_step, mobility, width):
        slow_mixture = reference_terms.Mixture(
            *(simulation.smoothing, simulation.dimension, lattice.support, lattice.volume),
            alpha=mixture.strength,
            mobility=mobility,
            eps=width,
            laplacian_correction=lattice.laplacian_correction,
            form=mixture.mobility_form,
            energy=mixture.free_energy,
        )
        walls = lattice.volume * slow.wall_density(x, slow.near(x)[1])
        return slow_mixture.step(x, c, mass, time_step / substeps, substeps, walls)

    def steps(gravity, initial_positions, initial_velocities, rest_density, time_step, viscosity=1.0, **others):
        x, v = initial_positions, initial_velocities
        tension, emitter = tension_twin(simulation), emitter_twin(simulation, others.get("nozzle.path"))
        c = others.get("mass_fractions", np.ones((len(x), 1)))
        mass = reference.blend(c, rest_density, viscosity)[0]
        for n in range(STEPS):
            if phases > 1:
                c = mix(x, c, mass, time_step, others["mobility"], others["interface_width"])
            rho_0, mu = reference.blend(c, rest_density, viscosity)
            pull = gravity + (tension.acceleration(x, mass, others["surface_tension"]) if tension else 0.0)
            x, v = slow.step(x, v, pull, lattice.volume * mass, rho_0, mu, time_step, iterations)
            if emitter:
                x, v = emitter.lead(n, x, v, others["nozzle.flow_rate"], time_step)
        return np.concatenate([x, v, c], axis=1)

    return steps


CASES = [
    (scene, "cubic_spline", "pairwise", "free"),
    (scene, "wendland_c2", "pairwise", "no"),
    (scene, "wendland_c4", "stress", "no"),
    (scene, "wendland_c4", "none", "free"),
    (plane, "wendland_c2", "pairwise", "no"),
    (plane, "cubic_spline", "stress", "free"),
    (plane_of_three, "cubic_spline", "stress", "no"),
    (two_layers, "cubic_spline", "pairwise", "free"),
    (two_layers, "wendland_c2", "stress", "no"),
    (plane_of_three, "cubic_spline", "pairwise", "no"),
    (miscible, "wendland_c2", "stress", "no"),
    (three_miscible, "cubic_spline", "stress", "free"),
    (tense, "cubic_spline", "pairwise", "free"),
    (tense_cube, "wendland_c2", "pairwise", "no"),
    (curved, "wendland_c4", "stress", "free"),
    (curved_cube, "wendland_c2", "stress", "no"),
    (curved_cube, "cubic_spline", "none", "free"),
    (jet, "cubic_spline", "pairwise", "free"),
    (pour, "wendland_c2", "pairwise", "no"),
]
cases = pytest.mark.parametrize(("make", "kernel", "viscosity", "slip"), CASES)


@cases
@pytest.mark.parametrize("precision", ["float64", "float32"])
def test_steps_equal_those_of_the_twin(make, kernel, viscosity, slip, precision):
    simulation = prepared(make, kernel, viscosity, slip, precision)
    point, d = point_of(simulation), simulation.dimension
    rollout = simulation.rollout(STEPS, point)
    last = rollout.forward().numpy(d)
    found = np.concatenate([last[name] for name in ADJOINT_FIELDS], axis=1)
    wanted = twins_steps(simulation, rollout.solver.substeps)(**point)
    tolerance = 1e-13 if precision == "float64" else 2e-5
    assert np.abs(wanted[:, :d] - point["initial_positions"]).max() > 1e-3
    if "mass_fractions" in point:
        assert np.abs(wanted[:, 2 * d :] - point["mass_fractions"]).max() > 1e-2
    for part, factor in ((slice(d), 1), (slice(d, 2 * d), 100), (slice(2 * d, None), 1)):
        np.testing.assert_allclose(found[:, part], wanted[:, part], rtol=0, atol=factor * tolerance)


@cases
def test_tangents_and_adjoints_equal_complex_steps_of_the_twin(make, kernel, viscosity, slip):
    simulation = prepared(make, kernel, viscosity, slip, "float64")
    values, d = point_of(simulation), simulation.dimension
    random = np.random.default_rng(1)
    along = {name: RATES.get(name, 1.0) * random.standard_normal(value.shape) for name, value in values.items()}
    rollout, controls = simulation.rollout(STEPS, values), ParameterSpace(simulation, STEPS)
    rollout.forward()
    states = {}
    rollout.tangent(*controls.direction(rollout, values, along), lambda step, dot: states.update({step: dot.numpy(d)}))
    slow = twins_steps(simulation, rollout.solver.substeps)
    exact = reference.complex_step(
        lambda *given: slow(**dict(zip(values, given, strict=True))), list(values.values()), list(along.values())
    )
    wanted = np.split(exact, [d, 2 * d], axis=1)
    for name, one in zip(ADJOINT_FIELDS, wanted, strict=True):
        found = states[STEPS][name]
        assert np.linalg.norm(found - one) <= 1e-12 * np.linalg.norm(one)
    bars = [random.standard_normal(one.shape) for one in wanted]
    bar = rollout.solver.new_state()
    bar.set(dict(zip(ADJOINT_FIELDS, bars, strict=True)))
    derivative = Exact().derivative(rollout)
    first = rollout.backward(derivative, {STEPS: bar})
    gradient = controls.gradient(rollout, values, first, derivative.parameters())
    adjoint = sum((gradient[name] * along[name]).sum() for name in values)
    size = sum(np.linalg.norm(one) * np.linalg.norm(w) for one, w in zip(wanted, bars, strict=True))
    assert abs(adjoint - sum((one * w).sum() for one, w in zip(wanted, bars, strict=True))) <= 1e-12 * size


def prepared(make, kernel, viscosity, slip, precision):
    original = make()
    made = make(
        discretisation={"spacing": 0.05, "support": 2.0 if kernel == "cubic_spline" else 2.6, "kernel": kernel},
        forces={**original.forces.model_dump(), "viscosity": viscosity},
        container={**original.container.model_dump(), "slip": slip},
    )
    return Simulation(made, precision=precision)
