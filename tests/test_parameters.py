"""The list of parameters, and what follows from it."""

from pathlib import Path

import numpy as np
import pytest

from cortado import InputError, Problem, Simulation, losses
from cortado.gradients import Exact
from cortado.scene.parameter_values import scene_values
from cortado.scene.parameters import BY_NAME, PARAMETERS, Role, markdown, names
from scenes import plane, plane_of_three, scene

DOCUMENT = Path(__file__).parents[1] / "docs" / "parameters.md"


def test_the_document_has_the_table_of_the_registry():
    assert markdown() in DOCUMENT.read_text(encoding="utf-8")


def test_the_docstring_of_a_problem_names_every_parameter():
    assert [parameter.name for parameter in PARAMETERS if f"``{parameter.name}``" not in Problem.__doc__] == []


def test_every_parameter_of_steps_is_on_the_device():
    found = Simulation(plane_of_three()).solver.new_parameters(7)
    assert found.names == names(Role.RUN)
    shapes = {"gravity": (1, 7), "nozzle_path": (1, 7), "rest_density": (1, 3), "viscosity": (1, 3)}
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


def test_a_rollout_does_not_go_back_through_states_of_other_parameters():
    simulation = Simulation(plane())
    rollout = simulation.rollout(3)
    rollout.forward(keep=False)
    with pytest.raises(InputError, match="run forward first, with keep=True"):
        rollout.backward(Exact().derivative(rollout), {})


def test_a_rollout_takes_derivatives_of_its_own_alone():
    simulation = Simulation(plane())
    rollout, other = simulation.rollout(3), simulation.rollout(3)
    with pytest.raises(InputError, match="was made for another rollout"):
        rollout.backward(Exact().derivative(other), {})
    with pytest.raises(InputError, match="cannot go along a tangent"):
        rollout.tangent(simulation.solver.new_state(), simulation.solver.new_parameters(3), lambda step, dot: None)
    rollout.forward()
    with pytest.raises(InputError, match="bars has the state 7, but must have states from 0 to 3"):
        rollout.backward(Exact().derivative(rollout), {7: simulation.initial})


@pytest.mark.parametrize("given", [None, [1.0], 3, "gravity"])
def test_parameters_are_a_table(given):
    simulation = Simulation(plane())
    problem = Problem(simulation, 3, losses.FinalPositions(simulation.positions))
    with pytest.raises(InputError, match=r"parameters are .*, but must be given by name, as \{'gravity': value\}"):
        problem.value(given)


def test_a_part_that_forgets_its_shares_is_an_error():
    """Its kernel would write (n,) numbers into the one of the parameter."""
    solver = Simulation(plane_of_three()).solver
    bar = solver.adjoint(2).bar
    known = {name for group in bar.named for name in group}
    assert {"x_bar", "gravity_bar", "viscosity_bar", "time_step_bar"} <= known and "flow_rate_bar" not in known


@pytest.mark.parametrize("budget", ["8GB", -1, 1.5, None])
def test_a_memory_budget_is_a_number_of_bytes(budget):
    simulation = Simulation(plane())
    with pytest.raises(InputError, match=r"memory_budget is .* must be a whole number of at least 0"):
        Problem(simulation, 3, losses.FinalPositions(simulation.positions), memory_budget=budget)
