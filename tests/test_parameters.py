"""The list of parameters, and what follows from it."""

from pathlib import Path

import numpy as np
import pytest

from cortado import InputError, Problem, Simulation, losses
from cortado.device.state import Parameters
from cortado.gradients import Exact
from cortado.parameters.registry import BY_NAME, PARAMETERS, Role, names
from cortado.parameters.table import markdown
from cortado.parameters.values import scene_values
from scenes import plane, plane_of_three, scene

DOCUMENT = Path(__file__).parents[1] / "docs" / "parameters.md"


def test_the_document_has_the_table_of_the_registry():
    assert markdown() in DOCUMENT.read_text(encoding="utf-8")


def test_every_parameter_of_steps_is_on_the_device():
    simulation = Simulation(plane_of_three())
    found = Parameters.zeros(7, 64, 3, simulation.precision, simulation.device)
    assert found.names == (*names(Role.RUN), "reference_density")
    sizes = {"gravity": 7, "nozzle_path": 7, "rest_density": 3, "viscosity": 3, "reference_density": 64}
    assert {name: len(found[name]) for name in found.names} == {name: sizes.get(name, 1) for name in found.names}


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
    made = plane(forces={"gravity": [0.0, 0.0]})
    simulation = Simulation(made)
    problem = Problem(simulation, 2, losses.FinalPositions(simulation.positions))
    with pytest.raises(InputError, match=f"parameter {name} is given, but must be left out, as the scene has no"):
        problem.value({name: np.zeros(1)})


def test_a_rollout_does_not_go_back_through_states_of_other_parameters():
    simulation = Simulation(plane())
    problem = Problem(simulation, 3, losses.FinalPositions(simulation.positions))
    first = problem.forward_pass({"gravity": [0.0, -9.0]})
    derivative = first.derivative(Exact())
    problem.value({"gravity": [0.0, -8.0]})
    with pytest.raises(InputError, match="was evaluated again"):
        first.back(derivative)
    rollout = simulation.rollout(3)
    rollout.forward(keep=False)
    with pytest.raises(InputError, match="run forward first, with keep=True"):
        rollout.backward(derivative, {})
