"""The list of parameters and what follows from it; numbers as users give them, taken or refused in a sentence."""

from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
import warp as wp
from parameter_table import markdown

from cortado import InputError, Problem, Simulation, losses
from cortado.arrays import as_numbers, as_one_number
from cortado.device.precision import FLOAT64
from cortado.gradients import Exact
from cortado.particles.state import Fields, Layout
from cortado.particles.wall_terms import SolidShares
from cortado.scene.parameter_values import scene_values
from cortado.scene.parameters import BY_NAME, PARAMETERS, Role, names
from cortado.solvers.pcisph.solver import PcisphAdjoint
from cortado.sph.gravity import Gravity
from cortado.sph.parts import Adjoints, Shares
from scenes import plane, plane_of_three, scene, splash

DOCUMENT = Path(__file__).parents[1] / "docs" / "parameters.md"


def test_the_document_has_the_table_of_the_registry():
    written = DOCUMENT.read_text(encoding="utf-8")
    assert markdown() in written, "put the table there that this prints: python docs/site/parameter_table.py"


def test_the_docstring_of_a_problem_names_every_parameter():
    missing = [parameter.name for parameter in PARAMETERS if f"``{parameter.name}``" not in Problem.__doc__]
    assert missing == [], "name them in the docstring of Problem, src/cortado/problem.py"


def test_every_parameter_of_steps_is_on_the_device():
    found = Simulation(plane_of_three()).solver.new_parameters(7)
    assert found.names == names(Role.RUN)
    shapes = {"gravity": (1, 7), "rest_density": (1, 3), "viscosity": (1, 3)}
    assert {name: found[name].shape for name in found.names} == {name: shapes.get(name, (1,)) for name in found.names}


@pytest.mark.parametrize("made", [scene, plane_of_three])
def test_values_of_a_scene_have_the_shapes_of_the_registry(made):
    simulation = Simulation(made())
    values, positions = scene_values(simulation), simulation.positions.shape
    wanted = {p.name for p in PARAMETERS if p.present(simulation.scene)} - set(names(Role.VIEW))
    assert values.keys() == wanted
    for name, value in values.items():
        assert value.shape == BY_NAME[name].shapes(0, len(simulation.scene.phase), positions)[0]


@pytest.mark.parametrize("name", [p.name for p in PARAMETERS if p.absent])
def test_a_parameter_that_a_scene_lacks_is_refused(name):
    chosen = {"kind": "pcisph", "time_step": "auto", "greatest_time_step": 0.01}
    made = plane(forces={"gravity": [0.0, 0.0], "viscosity": "none"}, solver=chosen)
    simulation = Simulation(made)
    problem = Problem(simulation, 2, losses.FinalPositions(simulation.positions))
    with pytest.raises(InputError) as error:
        problem.value({name: np.zeros(1)})
    absent = BY_NAME[name].absent
    assert str(error.value) == f"parameter {name} is given, but must be left out, as the scene {absent}."


def test_a_rollout_takes_derivatives_of_its_own_alone():
    """Through states that it keeps."""
    simulation = Simulation(plane())
    rollout, other = simulation.rollout(3), simulation.rollout(3)
    rollout.forward(keep=False)
    with pytest.raises(InputError, match="run forward first, with keep=True"):
        rollout.backward(Exact().derivative(rollout), {})
    with pytest.raises(InputError, match="was made for another rollout"):
        rollout.backward(Exact().derivative(other), {})
    with pytest.raises(InputError, match="cannot go along a tangent"):
        other.tangent(simulation.solver.new_state(), simulation.solver.new_parameters(3), lambda step, dot: None)
    rollout.forward()
    with pytest.raises(InputError, match="bars has the state 7, but must have states from 0 to 3"):
        rollout.backward(Exact().derivative(rollout), {7: simulation.initial})


@pytest.fixture(scope="module")
def simulation():
    return Simulation(plane())


@pytest.mark.parametrize("given", [None, [1.0], 3, "gravity"])
def test_parameters_are_a_table(simulation, given):
    problem = Problem(simulation, 3, losses.FinalPositions(simulation.positions))
    with pytest.raises(InputError, match=r"parameters are .*, but must be a table by name, such as \{'gravity'"):
        problem.value(given)


@pytest.mark.parametrize("budget", ["8GB", -1, 1.5, None])
def test_a_memory_budget_is_a_number_of_bytes(simulation, budget):
    with pytest.raises(InputError, match=r"memory_budget is .* must be a whole number of at least 0"):
        Problem(simulation, 3, losses.FinalPositions(simulation.positions), memory_budget=budget)


def test_a_part_that_forgets_its_shares_is_an_error():
    """Its kernel would write (n,) numbers into the one of the parameter."""
    solver = Simulation(plane_of_three()).solver
    bar = solver.adjoint(2).bar
    known = {name for group in bar.named for name in group}
    assert {"x_bar", "gravity_bar", "viscosity_bar", "time_step_bar"} <= known and "surface_tension_bar" not in known


class Tensor:
    """An array of another library."""

    def __init__(self, values, problem=None):
        self.values, self.problem = values, problem

    def __array__(self, dtype=None, copy=None):
        if self.problem is not None:
            raise self.problem
        return np.array(self.values, dtype=dtype)


@pytest.mark.parametrize(
    "value, wanted",
    [
        (3, 3.0),
        ([1, 2.5], [1.0, 2.5]),
        (np.array([1, 2], np.uint8), [1.0, 2.0]),
        (np.array([1.5], np.float16), [1.5]),
        ([10**30, Fraction(1, 2)], [1e30, 0.5]),
        (range(3), [0.0, 1.0, 2.0]),
        (np.ma.array([1.0, 2.0]), [1.0, 2.0]),
        (Tensor([1.0, 2.0]), [1.0, 2.0]),
    ],
)
def test_numbers_are_taken(value, wanted):
    found = as_numbers("gravity", value)
    assert type(found) is np.ndarray and found.dtype == np.float64
    np.testing.assert_array_equal(found, wanted)


def test_arrays_are_taken():
    """Those of Warp, and in float64 without a copy."""
    vectors, values = wp.array(np.ones((2, 3)), dtype=wp.vec3f, device="cpu"), np.zeros(3)
    np.testing.assert_array_equal(as_numbers("positions", vectors), np.ones((2, 3)))
    assert as_numbers("gravity", values) is values


ENDLESS: list = []
ENDLESS.append(ENDLESS)


@pytest.mark.parametrize(
    "value, found",
    [
        (1j, "1j"),
        (np.array([1 + 0j, 2]), "made of complex numbers"),
        ("1.5", "'1.5'"),
        (["1", "2"], "made of text"),
        (np.array([b"1"]), "made of text"),
        (True, "True"),
        (np.array([True, False]), "made of True and False"),
        (np.array(["2020-01-01"], "M8[D]"), "made of dates"),
        (np.ma.array([1.0, 2.0, 3.0], mask=[1, 0, 1]), "partly masked"),
        ([np.ma.array([1.0, 2.0], mask=[0, 1]), [1.0, 2.0]], "partly masked"),
        (np.ma.masked, "partly masked"),
        (np.array([None, 1.0]), "None"),
        (np.array([True, 1.0], object), "True"),
        ([[1.0], [1.0, 2.0]], "[[1.0], [1.0, 2.0]]"),
        (10**400, "1000"),
        (None, "None"),
        ({"x": 1.0}, "a table"),
        (Tensor([1.0], RuntimeError("it requires grad")), "Tensor"),
        (ENDLESS, "[[...]]"),
    ],
)
@pytest.mark.filterwarnings("error")
def test_what_is_not_made_of_real_numbers_is_a_sentence(value, found):
    with pytest.raises(InputError) as caught:
        as_numbers("gravity", value)
    sentence = str(caught.value)
    assert sentence.startswith("gravity is ") and found in sentence and "must be a number or an array" in sentence
    assert "\n" not in sentence and len(sentence) < 200


def test_one_number_is_no_array():
    assert as_one_number("the loss", np.array(2)) == 2.0
    with pytest.raises(InputError, match=r"the loss has shape \(1,\), but must be one number"):
        as_one_number("the loss", [2.0])


def test_gravity_adds_to_its_adjoint():
    simulation = Simulation(splash(), precision="float64")
    solver, n = simulation.solver, simulation.particles
    bar = solver.new_parameters(2)
    bar["gravity"].assign(np.full((1, 2, 3), 0.5))
    fields = Fields.zeros(n, simulation.precision, simulation.device)
    shares = Shares(["time_step"], solver.layout)
    ones = wp.array(np.ones((n, 3)), dtype=wp.vec3d, device=simulation.device)
    solver.step_number.fill_(1)
    gravity, solids = Gravity(solver.layout, taped=False), SolidShares(None, solver.layout)
    bars = Adjoints(fields, solver.new_fractions(), bar, shares, solids)
    for _ in range(2):
        gravity.adjoint(solver.context(solver.new_parameters(2)), ones, bars)
    np.testing.assert_array_equal(bar["gravity"].numpy(), [[[0.5] * 3, [0.5 + 2 * n] * 3]])


@pytest.mark.parametrize("shares", ["drag", "gravity", "mass_fractions"])
def test_what_cannot_be_shared_is_said(shares):
    with pytest.raises(TypeError, match=f"shares has '{shares}', but must be a tuple of some of rest_density, "):
        Shares([shares], Layout(3, 1, FLOAT64, "cpu"))


def test_what_parts_added_to_parameters_is_kept_to_the_end():
    solver = Simulation(plane_of_three(), precision="float64").solver
    adjoint = PcisphAdjoint(solver, steps=2)
    for array in adjoint.bar.parameters.arrays():
        array.fill_(0.5)
    for array in adjoint.collect().arrays():
        np.testing.assert_array_equal(array.numpy(), 0.5)
