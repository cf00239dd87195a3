"""A force that keeps a field from step to step is a part like all others, though nothing in Cortado knows of it."""

import numpy as np
import pytest

import cortado
from cortado import Problem, Simulation
from cortado.errors import InputError, MissingDerivativeError
from cortado.particles.fields import Entry, StateField
from cortado.scene.parameters import Axis
from cortado.sph.gravity import Gravity
from cortado.sph.parts import Carried, Part
from finite_differences import all_ways_agree, both_modes, central_difference
from remembering_force import TAU, Memory, MemoryForce, U
from scenes import jet, plane, two_layers

STEPS = 6
SCENES = {"plane": plane, "two layers": two_layers, "jet": jet}


def problem(make, **options):
    simulation = Simulation(make(), **{"precision": "float64", **options}, forces=[Memory()])
    target = simulation.positions + 0.02 * np.sin(7.0 * simulation.positions)
    return Problem(simulation, STEPS, cortado.losses.FinalPositions(target))


def point_of(simulation):
    velocities = 0.3 * np.random.default_rng(4).standard_normal(simulation.positions.shape)
    return {"memory.k": 40.0, "time_step": 0.002, "initial_velocities": velocities}


def test_what_it_does_is_what_it_says():
    """Without pressure and viscosity a step is exact."""
    free = plane(forces={"gravity": [0.0, -9.81], "viscosity": "none", "pressure": False})
    simulation = Simulation(free, precision="float64", forces=[Memory()])
    dt, gravity = free.solver.time_step, np.array([0.0, -9.81])
    v = u = np.zeros(2)
    for _ in range(STEPS):
        v, u = v + dt * (gravity + 30.0 * (u - v)), u + dt * (v - u) / TAU
    run = simulation.run(STEPS)
    np.testing.assert_allclose(run.velocities[-1], np.tile(v, (simulation.particles, 1)), rtol=1e-12)
    np.testing.assert_allclose(run.last_state[U.name], np.tile(u, (simulation.particles, 1)), rtol=1e-12)
    assert np.abs(u).max() > 0.0


@pytest.mark.parametrize("make", SCENES)
def test_reverse_forward_tape_and_differences_agree(make):
    judged = problem(SCENES[make])
    all_ways_agree(judged, point_of(judged.simulation), 5, lambda name: 1e-6, rtol=1e-4)


def test_a_run_that_is_cut_has_the_same_bits():
    simulation = Simulation(two_layers(), forces=[Memory()])
    state = simulation.state({"initial_velocities": simulation.velocities + 0.1})
    whole, halves = (
        simulation.step(state, steps=STEPS),
        simulation.step(simulation.step(state, steps=2), steps=STEPS - 2),
    )
    for name in (U.name, "positions", "velocities"):
        np.testing.assert_array_equal(halves[name], whole[name])
    assert np.abs(np.asarray(whole[U.name]) - whole["velocities"]).max() > 0.0


def test_it_is_certified_and_runs_in_a_batch():
    judged = problem(plane)
    point = point_of(judged.simulation)
    assert cortado.certify(judged, point).right
    many = problem(plane, batch=2)
    values, found = many.value_and_gradient({**point, "memory.k": [40.0, 10.0]})
    value, gradient = judged.value_and_gradient({**point, "memory.k": 10.0})
    assert values[1] == value and found["memory.k"][1] == gradient["memory.k"]


class Made:
    """Makes a force that is a class."""

    parameters = Memory.parameters

    def __init__(self, kind):
        self.force = kind


def test_a_part_without_derivatives_says_so():
    class Forward(MemoryForce):
        new_tangent, new_adjoint = Part.new_tangent, Part.new_adjoint

    simulation = Simulation(plane(), forces=[Made(Forward)])
    simulation.run(2)
    judged = Problem(simulation, 2, cortado.losses.FinalPositions(simulation.positions))
    with pytest.raises(MissingDerivativeError, match="Forward has no reverse mode: let it have a method new_adjoint"):
        judged.value_and_gradient({"memory.k": 1.0})
    with pytest.raises(MissingDerivativeError, match="Forward has no forward mode: let it have a method new_tangent"):
        judged.tangent({"memory.k": 1.0}, {"memory.k": 1.0})


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ((U, U), "several fields called 'remembered_velocities'"),
        ((StateField("positions", "m", Entry.VECTOR),), "several fields called 'positions'"),
        (
            (StateField("u", "", Entry.NUMBER, first="weight"),),
            "field 'u' begins as 'weight', but must begin as one of",
        ),
        (
            (StateField("u", "", Entry.NUMBER, first="initial_velocities"),),
            "begins as 'initial_velocities', which is not a number of each particle",
        ),
        (
            (StateField("u", "", Entry.VECTOR, Axis.SCALAR, first="viscosity"),),
            "begins as 'viscosity', which is not a vector of the scene",
        ),
    ],
)
def test_fields_that_cannot_be_are_refused(fields, message):
    with pytest.raises(TypeError, match=message):
        Simulation(plane(), forces=[Made(type("Odd", (MemoryForce,), {"fields": fields}))])


def test_fields_of_a_scene_are_not_sorted():
    layout = Simulation(plane()).solver.layout
    with pytest.raises(TypeError, match="field 'u' has one entry, but must have one for each particle to be sorted"):
        Carried([StateField("u", "", Entry.NUMBER, Axis.SCALAR)], layout)


def test_what_lacks_something_of_a_force_is_refused():
    with pytest.raises(InputError, match=r"the force object, which .*Made.* made, has no shares, but must have"):
        Simulation(plane(), forces=[Made(lambda setting: object())])


def test_what_works_as_a_part_must_be_one():
    class Duck(Gravity):
        def __init__(self, setting):
            super().__init__(setting.layout, False)

        def settle(self, step):
            """Never called."""

    with pytest.raises(InputError, match="the force Duck has the methods settle of a part, but is none"):
        Simulation(plane(), forces=[Made(Duck)])


def test_a_part_writes_its_fields():
    with pytest.raises(InputError, match="the force Idle has fields, but no method `end` that writes them"):
        Simulation(plane(), forces=[Made(type("Idle", (MemoryForce,), {"end": Part.end}))])


class Memories:
    """The mean square of the velocities that particles had."""

    def value(self, end):
        return float((end[U.name] ** 2).mean())

    def adjoint(self, end):
        return {U.name: 2.0 * end[U.name] / end[U.name].size}


def test_its_field_is_in_losses_and_derivatives_go_through_it():
    judged = Problem(Simulation(plane(), precision="float64", forces=[Memory()]), 12, Memories())
    point = {"memory.k": 30.0, "gravity": np.array([1.0, -9.81])}
    along = {"memory.k": 2.0, "gravity": np.array([0.3, 0.7])}
    gradient, derivative = both_modes(judged, point, along, 1e-12)
    assert gradient["memory.k"] != 0.0
    assert central_difference(judged.value, point, along, 1e-5) == pytest.approx(derivative, rel=1e-6)
    assert cortado.certify(judged, ["memory.k", "gravity"]).right


def test_its_field_is_read_by_name(tmp_path):
    simulation = Simulation(plane(), forces=[Memory()])
    trajectory = simulation.run(6, record_every=2)
    field = trajectory.others[U.name]
    assert np.abs(field[-1]).max() > 1e-3
    trajectory.save(tmp_path / "run.vtkhdf")
    for read in (trajectory, cortado.Trajectory.load(tmp_path / "run.vtkhdf")):
        assert read.quantity(U.name).tobytes() == field.tobytes() and read[1][U.name].tobytes() == field[1].tobytes()
    np.testing.assert_array_equal(simulation.quantity(U.name, trajectory.last_state), field[-1])
    np.testing.assert_array_equal(simulation.quantity(U.name, trajectory), field)
    with pytest.raises(InputError, match=f"quantity is 'memories', but must be one of .*, {U.name}, density"):
        trajectory.quantity("memories")
    end = Problem(simulation, 6, Memories()).end({})
    np.testing.assert_array_equal(end[U.name], field[-1])


def test_its_field_colours_pictures():
    simulation = Simulation(plane(picture={"width": 160, "height": 120}), forces=[Memory()])
    frame = simulation.run(6)[-1]
    found = simulation.picture(frame, colour=U.name)
    assert found.shape == (120, 160, 3)
    assert np.abs(found - simulation.picture(frame)).max() > 0.1
    assert np.abs(found - simulation.picture(frame, colour="speed")).max() > 0.1
    with pytest.raises(cortado.SceneError, match="colour"):
        simulation.picture(frame, colour="mass_fractions")
