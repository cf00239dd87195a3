"""The projection in the reference engine: its steps are those of the slow twin and of the Warp engine, so are its
derivatives, and in float128 differences confirm them far below what float64 can resolve."""

from fractions import Fraction

import numpy as np
import pytest

from cortado import InputError, Simulation, reference
from cortado.reference import Terms
from cortado.scene.discrete_scene import discretise, mirrors_of
from cortado.solvers.projection.lattice import coarse_grid
from reference_projection import Projection
from scenes import C2, CUBIC, box, plane, scene
from test_projection import CASES, HURLED, PERIODIC, SOLVER, begun, thrown
from test_reference import C4, distance, gradients_agree, target_of


def space(**tables):
    """3 x 4 x 2 particles between walls, as the twin and float128 are slow."""
    fluid, room = box([0.0] * 3, [0.15, 0.2, 0.1], phase="water"), box([0.0] * 3, [0.25, 0.3, 0.2])
    return scene(fluid=[fluid], container=room, **tables)


SCENES = {
    "plane": plane(solver=SOLVER),
    "space": space(solver=SOLVER),
    "periodic": plane(solver=SOLVER, container=PERIODIC, forces={"gravity": [1.0, -9.81]}),
    "stress, no slip": plane(solver=SOLVER, container=box([0.0, 0.0], [0.7, 0.8], slip="no")),
    "wendland_c4": plane(solver={**SOLVER, "iterations": 7, "repairs": 1}, discretisation=C4),
    "free space": plane(solver=SOLVER, container={"shape": "none"}, forces={"gravity": [0.0, 0.0]}),
}
scenes = pytest.mark.parametrize("made", SCENES.values(), ids=SCENES)


def point_and_direction(simulation, steps, at_rest=False):
    """All parameters at once: fluid that is thrown, or, ``at_rest``, the lattice of a scene that moves as a whole."""
    random = np.random.default_rng(1)
    point = thrown(simulation) | {
        "gravity": np.tile(simulation.scene.forces.gravity, (steps, 1)),
        "viscosity": np.array(0.05),
    }
    if at_rest:
        shape = simulation.positions.shape
        point |= {"initial_positions": simulation.positions, "initial_velocities": np.full(shape, 0.5)}
    return point, {name: 0.1 * random.standard_normal(np.shape(value)) for name, value in point.items()}


@pytest.mark.parametrize(
    "make, smoothing",
    [
        pytest.param(make, smoothing, id=f"{make.__name__}-{smoothing['kernel']}")
        for make in (plane, space)
        for smoothing in (CUBIC, C2, C4)
    ],
)
def test_steps_are_those_of_the_twin(make, smoothing):
    """Five steps without viscosity, all but the first from pressures of the one before."""
    made = make(solver=SOLVER, discretisation=smoothing).replaced("phase[0].viscosity=0")
    simulation, discrete = reference.Simulation(made), discretise(made)
    lattice, walls, dt = discrete.lattice, discrete.walls, 0.002
    grid = coarse_grid(made, discrete, len(simulation.positions))
    nodes = tuple(np.array(part)[: made.dimension] for part in (grid.origin, 1.0 / grid.cell, grid.shape))
    twin = Projection(
        *(discrete.kernel, lattice.support, lattice.volume, made.discretisation.spacing),
        *(walls.positions, walls.weights, walls.feet),
        mirrors=tuple(end[: made.dimension] for end in mirrors_of(made)),
        container=walls.solid == -1,
        periods=np.zeros(made.dimension),
        iterations=made.solver.iterations,
        repairs=made.solver.repairs,
        follow=False,
        nodes=nodes,
    )
    given = thrown(simulation)
    run = simulation.run(5, given)
    x, v = given["initial_positions"], given["initial_velocities"]
    ends = np.zeros(len(x)), np.zeros_like(x)
    for step in range(1, 6):
        x, v, ends, _ = twin.step(x, v + dt * np.array(made.forces.gravity), ends, np.full(len(x), 1000.0), dt)
        np.testing.assert_allclose(run.positions.high[step], x, rtol=0.0, atol=1e-13)
        np.testing.assert_allclose(run.velocities.high[step], v, rtol=0.0, atol=1e-11)
    assert (ends[0] > 0.0).any() and (ends[0] < 0.0).any()


@scenes
def test_it_is_the_projection_of_the_warp_engine(made):
    """Steps, what is recorded of them, and derivatives with respect to all parameters."""
    simulation, warp, steps = reference.Simulation(made), Simulation(made, precision="float64"), 20
    point, directions = point_and_direction(simulation, steps)
    wanted, found = warp.run(steps, point), simulation.run(steps, point)
    np.testing.assert_allclose(found.positions.high[-1], wanted.positions[-1], rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(found.velocities.high[-1], wanted.velocities[-1], rtol=0.0, atol=1e-10)
    np.testing.assert_allclose(found.density_errors, wanted.density_errors, rtol=0.0, atol=1e-13)
    assert np.array_equal(found.iterations, wanted.iterations) and (wanted.density_errors > 0.0).any()
    problem = gradients_agree(simulation, point, steps, 1e-10)
    tangent = simulation.tangent(point, directions, steps)
    bar, _ = reference.FinalPositions(problem.loss.target).adjoint(tangent.positions[-1], tangent.velocities[-1])
    forward = (bar * tangent.position_tangents.high[-1]).sum()
    size = np.linalg.norm(bar) * tangent.position_norms[-1]
    assert abs(forward - problem.tangent(point, directions)) < 1e-10 * size


@pytest.mark.parametrize("case", HURLED)
def test_fluid_that_is_hurled_at_walls_is_that_of_the_warp_engine(case):
    """With the bounds of what walls press together, and their derivatives."""
    made, steps = CASES[case](), 6
    simulation, warp = reference.Simulation(made), Simulation(made, precision="float64")
    point, directions = point_and_direction(simulation, steps)
    point |= begun(case, simulation)
    wanted, found = warp.run(steps, point), simulation.run(steps, point)
    np.testing.assert_allclose(found.positions.high, wanted.positions, rtol=0.0, atol=1e-12)
    gradients_agree(simulation, point, steps, 1e-10)
    analytic, dual = (simulation.tangent(point, directions, steps, method) for method in ("analytic", "dual"))
    assert distance(dual.position_tangents[-1], analytic.position_tangents[-1]) < 1e-12


@pytest.mark.parametrize("name", ["plane", "free space"])
def test_on_corners_of_the_clamp_it_takes_the_mean_slope_too(name):
    """The lattice as a scene has it, moving as a whole: there is no divergence, and so the clamp is on its corner."""
    simulation, steps = reference.Simulation(SCENES[name]), 2
    point, directions = point_and_direction(simulation, steps, at_rest=True)
    gradients_agree(simulation, point, steps, 1e-9)
    analytic, dual = (simulation.tangent(point, directions, steps, method) for method in ("analytic", "dual"))
    assert distance(dual.velocity_tangents[-1], analytic.velocity_tangents[-1]) < 1e-12


@pytest.mark.parametrize("name", ["plane", "space"])
def test_derivatives_are_right_far_below_round_off_of_float64(name):
    """In which the best step of central differences leaves an error of about 1e-9; the adjoint is the transpose."""
    if "float128" not in reference.precisions():
        pytest.skip("the compiler has no float128")
    simulation, steps = reference.Simulation(SCENES[name], "float128"), 3
    point, directions = point_and_direction(simulation, steps)
    exact = simulation.tangent(point, directions, steps, record_every=steps)
    methods = {"dual": (1e-28, {}), "complex_step": (1e-28, {}), "finite_difference": (1e-18, {"difference": 1e-12})}
    for method, (most, options) in methods.items():
        other = simulation.tangent(point, directions, steps, method=method, record_every=steps, **options)
        assert distance(other.position_tangents[-1], exact.position_tangents[-1]) < most
        assert distance(other.velocity_tangents[-1], exact.velocity_tangents[-1]) < most
    bar = np.random.default_rng(2).standard_normal(simulation.positions.shape)
    back = simulation.gradient(point, steps, Along(bar))
    forward = product(bar, exact.position_tangents[-1])
    reverse = sum(product(along, back.parameters[name]) for name, along in directions.items())
    assert abs(float(forward - reverse)) < 1e-29 * np.linalg.norm(bar) * exact.position_norms[-1]


class Along:
    """The product of last positions and ``bar``."""

    def __init__(self, bar):
        self.bar = bar

    def value(self, positions, velocities):
        return float((self.bar * positions).sum())

    def adjoint(self, positions, velocities):
        return self.bar, np.zeros_like(self.bar)


def product(numbers, digits):
    """Without any round-off."""
    columns = (np.ravel(column).tolist() for column in (numbers, digits.high, digits.low))
    return sum(Fraction(a) * (Fraction(high) + Fraction(low)) for a, high, low in zip(*columns, strict=True))


@pytest.mark.parametrize("name", ["plane"])
def test_same_bits_with_any_number_of_threads(name):
    found = []
    for threads in (1, 3):
        simulation = reference.Simulation(SCENES[name], threads=threads)
        point, directions = point_and_direction(simulation, 10)
        tangent = simulation.tangent(point, directions, 10)
        gradient = simulation.gradient(point, 10, reference.FinalPositions(target_of(simulation)))
        arrays = [tangent.velocity_tangents.high, *(digits.high for digits in gradient.parameters.values())]
        found.append(b"".join(array.tobytes() for array in arrays))
    assert found[0] == found[1]


def test_without_pressure_nothing_is_projected():
    forces = {"gravity": [0.0, -9.81], "pressure": False}
    solvers = {"time_step": 0.002}, SOLVER
    one, other = (reference.Simulation(plane(forces=forces, solver=solver, discretisation=C2)) for solver in solvers)
    wanted, found = (simulation.run(10, thrown(simulation)) for simulation in (one, other))
    assert np.array_equal(found.positions.high, wanted.positions.high)
    assert found.iterations.tolist() == [0] * 10


LAW = "{kind='power_law', flow_index=0.6}"


def at(simulation):
    return reference.FinalPositions(simulation.positions)


def other(simulation, change):
    return reference.Simulation(simulation.scene.replaced(change))


def test_a_mistake_gives_a_sentence():
    for call, sentence in [
        (lambda s: s.tangent({}, {}, 5, method="as_printed"), "must not be used with the projection"),
        (lambda s: s.tangent({}, {}, 5, terms=Terms(hessian=False)), "must not with the projection"),
        (lambda s: s.gradient({}, 5, at(s), terms=Terms(pressure=False)), "must not with the projection"),
        (lambda s: other(s, "forces.viscous_solve='implicit'"), 'must have viscous_solve = "explicit"'),
        (lambda s: other(s, f"phase[0].rheology={LAW}"), r"scene has phase\[0\].rheology, but must leave it out"),
    ]:
        with pytest.raises(InputError, match=sentence):
            call(reference.Simulation(SCENES["plane"]))
