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
from cortado.rollout.parameter_space import ParameterSpace
from cortado.scene.parameter_values import scene_values
from cortado.scene.parameters import BY_NAME, PARAMETERS, Role, names
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
    with pytest.raises(InputError, match="call forward with keep=True first"):
        rollout.backward(Exact().derivative(rollout), {})
    with pytest.raises(InputError, match="was made for another rollout"):
        rollout.backward(Exact().derivative(other), {})
    with pytest.raises(InputError, match="cannot run along a tangent"):
        other.tangent(simulation.solver.new_state(), simulation.solver.new_parameters(3), lambda step, dot: None)
    rollout.forward()
    with pytest.raises(InputError, match="bars has the state 7, but must have states from 0 to 3"):
        rollout.backward(Exact().derivative(rollout), {7: simulation.initial})


@pytest.mark.parametrize("given", [None, [1.0], "gravity"])
def test_parameters_are_a_table(given):
    simulation = Simulation(plane())
    loss = losses.FinalPositions(simulation.positions)
    with pytest.raises(InputError, match=r"parameters are .*, but must be a dictionary, such as \{'gravity'"):
        Problem(simulation, 3, loss).value(given)
    with pytest.raises(InputError, match=r"memory_budget is .* must be a whole number of at least 0"):
        Problem(simulation, 3, loss, memory_budget=given)


class Tensor:
    """An array of another library."""

    def __init__(self, values, problem=None):
        self.values, self.problem = values, problem

    def __array__(self, dtype=None, copy=None):
        if self.problem is not None:
            raise self.problem
        return np.array(self.values, dtype=dtype)


def test_numbers_are_taken():
    """Arrays of Warp too, and those in float64 without a copy."""
    values = np.zeros(3)
    assert as_numbers("gravity", values) is values and as_one_number("the loss", np.array(2)) == 2.0
    for given, wanted in (
        (3, 3.0),
        (np.array([1, 2], np.uint8), [1.0, 2.0]),
        ([10**30, Fraction(1, 2)], [1e30, 0.5]),
        (range(3), [0.0, 1.0, 2.0]),
        (np.ma.array([1.0, 2.0]), [1.0, 2.0]),
        (Tensor([1.0, 2.0]), [1.0, 2.0]),
        (wp.array(np.ones((2, 3)), dtype=wp.vec3f, device="cpu"), np.ones((2, 3))),
    ):
        found = as_numbers("gravity", given)
        assert type(found) is np.ndarray and found.dtype == np.float64
        np.testing.assert_array_equal(found, wanted)


@pytest.mark.filterwarnings("error")
def test_what_is_not_made_of_real_numbers_is_a_sentence():
    endless = []
    endless.append(endless)
    for value, found in (
        (1j, "1j"),
        (np.array([1 + 0j, 2]), "made of complex numbers"),
        (["1", "2"], "made of text"),
        (True, "True"),
        (np.array([True, False]), "made of True and False"),
        (np.array(["2020-01-01"], "M8[D]"), "made of dates"),
        ([np.ma.array([1.0, 2.0], mask=[0, 1]), [1.0, 2.0]], "partly masked"),
        (np.array([None, 1.0]), "None"),
        ([[1.0], [1.0, 2.0]], "[[1.0], [1.0, 2.0]]"),
        (10**400, "1000"),
        ({"x": 1.0}, "a table"),
        (Tensor([1.0], RuntimeError("it requires grad")), "Tensor"),
        (endless, "[[...]]"),
    ):
        with pytest.raises(InputError) as caught:
            as_numbers("gravity", value)
        sentence = str(caught.value)
        assert sentence.startswith("gravity is ") and found in sentence and "must be a number or an array" in sentence
        assert "\n" not in sentence and len(sentence) < 200
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
    with pytest.raises(TypeError, match=f"shares has '{shares}', but must be a tuple of names among rest_density, "):
        Shares([shares], Layout(3, 1, FLOAT64, "cpu"))


def test_a_gravity_is_judged_with_the_other_values_of_its_run(monkeypatch):
    """A weaker gravity needs no new look, but one that was looked at beside another viscosity does."""
    looks, space = [], ParameterSpace(Simulation(plane()), 2)
    monkeypatch.setattr(space, "_check", lambda values, number: looks.append(values))
    strong, weak = [0.0, -20.0], [0.0, -5.0]
    for gravity, viscosity, wanted in (
        (strong, 0.1, 1),
        (weak, 0.1, 1),
        (weak, 0.2, 2),
        (strong, 0.2, 3),
        (weak, 0.2, 3),
    ):
        space.checked({"gravity": gravity, "viscosity": viscosity})
        assert len(looks) == wanted
