"""Forces that a user gives as classes, also with a field that is kept: what they do, what is refused, what is seen."""

import numpy as np
import pytest

import cortado
from cortado import InputError, Problem, Simulation
from cortado.errors import MissingDerivativeError
from cortado.particles.state import Entry, StateField
from cortado.scene.parameters import Axis, Parameter
from cortado.sph.gravity import Gravity
from cortado.sph.parts import Part
from finite_differences import both_modes, central_difference
from own_forces import Breeze
from remembering_force import TAU, Memory, MemoryForce, U
from scenes import Squares, aimed, plane, splash

STEPS = 8


def problem(forces, made=None, steps=STEPS, **options):
    return aimed(Simulation(made or splash(), **{"precision": "float64", **options}, forces=forces), steps)


def test_what_the_force_does_is_what_it_says():
    """Without pressure and viscosity one step is exact: v + dt (g + k sin(t) (wind - v)), with t = 0 at the first."""
    free = plane(forces={"gravity": [0.0, -9.81], "viscosity": "none", "pressure": False})
    simulation = Simulation(free, precision="float64", forces=[Breeze(4.0)])
    dt, v, gravity, wind = 0.0021, np.zeros(2), np.array([0.0, -9.81]), np.array([1.0, 0.5])
    for step in range(5):
        v = v + dt * (gravity + 4.0 * np.sin(step * dt) * (wind - v))
    np.testing.assert_allclose(simulation.run(5).velocities[-1], np.tile(v, (64, 1)), rtol=1e-12)


def test_one_that_has_no_batches_is_refused():
    class Alone(Breeze):
        def force(self, setting):
            made = super().force(setting)
            made.batches = False
            return made

    with pytest.raises(InputError, match="batch is 2, but must be left out, as the force BreezeForce has no"):
        problem([Alone()], batch=2)


class Gusts(Breeze):
    """With a setting that is no parameter."""

    def __init__(self, gusts):
        super().__init__()
        self.gusts = gusts


def test_another_force_is_another_problem():
    of_functions = [Gusts(lambda t: 1.0 * t)], [Gusts(lambda t: 2.0 * t)]
    different = ([], [Breeze()], [Breeze(2.0)], [Gusts(1)], [Gusts(2)], *of_functions)
    texts = {problem(forces).fingerprint for forces in different}
    assert len(texts) == len(different)


class Named(Breeze):
    def __init__(self, *parameters):
        self._parameters = parameters

    @property
    def parameters(self):
        return self._parameters


def number(name, value=1.0):
    return Parameter(name, "", "", Axis.SCALAR, lambda source: value)


@pytest.mark.parametrize(
    ("forces", "said"),
    [
        (Breeze(), "forces is <.*>, but must be a list of forces, such as"),
        ([Breeze], r"forces has <class .*> at place 0, but each force must be an object with a method force"),
        ([Named("k")], r"has parameters \['k'\], but must have a list of"),
        ([Breeze(), Breeze()], "parameter breeze.k of a force has the name of another one, breeze.k, but must have"),
        ([Named(number("a.b")), Named(number("a_b"))], "parameter a_b of a force has the name of another one, a.b"),
        ([Breeze(np.nan)], "parameter breeze.k has a value that is not finite"),
    ],
)
def test_a_force_that_does_not_fit_is_a_sentence(forces, said):
    with pytest.raises(InputError, match=said):
        problem(forces)


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"breeze": 1.0}, "parameter 'breeze' is unknown, but must be one of gravity, .*breeze.k, breeze.wind"),
        ({"breeze.wind": [1.0, 2.0]}, r"parameter breeze.wind has shape \(2,\), but must be \(3,\) in m/s"),
    ],
)
def test_a_value_that_does_not_fit_is_a_sentence(values, said):
    with pytest.raises(InputError, match=said):
        problem([Breeze()]).value(values)


def test_what_it_does_is_what_it_says():
    free = plane(forces={"gravity": [0.0, -9.81], "viscosity": "none", "pressure": False})
    simulation = Simulation(free, precision="float64", forces=[Memory()])
    dt, gravity = free.solver.time_step, np.array([0.0, -9.81])
    v = u = np.zeros(2)
    for _ in range(6):
        v, u = v + dt * (gravity + 30.0 * (u - v)), u + dt * (v - u) / TAU
    run = simulation.run(6)
    np.testing.assert_allclose(run.velocities[-1], np.tile(v, (simulation.particles, 1)), rtol=1e-12)
    np.testing.assert_allclose(run.last_state[U.name], np.tile(u, (simulation.particles, 1)), rtol=1e-12)
    assert np.abs(u).max() > 0.0


class Made:
    parameters = Memory.parameters

    def __init__(self, kind):
        self.force = kind


def test_a_part_without_derivatives_says_so():
    class Forward(MemoryForce):
        new_tangent, new_adjoint = Part.new_tangent, Part.new_adjoint

    simulation = Simulation(plane(), forces=[Made(Forward)])
    simulation.run(2)
    judged = Problem(simulation, 2, cortado.losses.FinalPositions(simulation.positions))
    with pytest.raises(MissingDerivativeError, match="Forward has no reverse mode: define the method new_adjoint"):
        judged.value_and_gradient({"memory.k": 1.0})
    with pytest.raises(MissingDerivativeError, match="Forward has no forward mode: define the method new_tangent"):
        judged.tangent({"memory.k": 1.0}, {"memory.k": 1.0})


class Duck(Gravity):
    def __init__(self, setting):
        super().__init__(setting.layout, False)

    def settle(self, step):
        """Never called."""


def of_fields(*fields):
    return type("Odd", (MemoryForce,), {"fields": fields})


def field(entry, first, *axis):
    return StateField("u", "", entry, *axis, first=first)


@pytest.mark.parametrize(
    ("force", "error", "message"),
    [
        (of_fields(U, U), TypeError, "several fields called 'remembered_velocities'"),
        (of_fields(field(Entry.NUMBER, "weight")), TypeError, "'u' begins as 'weight', but must begin as a parameter"),
        (of_fields(field(Entry.NUMBER, "initial_velocities")), TypeError, "which is not a number for each particle"),
        (of_fields(field(Entry.VECTOR, "viscosity", Axis.SCALAR)), TypeError, "which is not a vector for the scene"),
        (lambda setting: object(), InputError, r"object, which .*Made.* made, has no shares, but must have"),
        (Duck, InputError, "the force Duck has the methods settle of a part, but is no Part"),
        (type("Idle", (MemoryForce,), {"end": Part.end}), InputError, "Idle has fields, but no method `end` that"),
    ],
)
def test_a_force_that_cannot_be_is_refused(force, error, message):
    with pytest.raises(error, match=message):
        Simulation(plane(), forces=[Made(force)])


def test_its_field_is_in_losses_and_derivatives_go_through_it():
    judged = Problem(Simulation(plane(), precision="float64", forces=[Memory()]), 12, Squares({U.name: 0.01}))
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
    end = Problem(simulation, 6, Squares({U.name: 1.0})).end({})
    np.testing.assert_array_equal(end[U.name], field[-1])
