"""Tasks that search how a solid moves."""

import numpy as np
import pytest

from cortado import SceneError, optimise
from cortado.optimisation.inverse.knots import knot_values
from cortado.optimisation.inverse.setup import setup
from cortado.optimisation.inverse.task import load_task

TASK = """
dimension = 2
discretisation.spacing = 0.05
container = {shape = "box", lower = [0.0, 0.0], upper = [1.0, 1.0], slip = "no"}
solver = {kind = "projection", time_step = 0.001}

[[phase]]
name = "water"
rest_density = 1000.0
viscosity = 1.0

[[fluid]]
shape = "box"
lower = [0.0, 0.0]
upper = [0.6, 0.4]
phase = "water"

[[solid]]
name = "rotor"
shape = "box"
lower = [0.2, 0.15]
upper = [0.4, 0.25]
motion = "path"
velocity = [0.0, 0.0]
slip = "no"

[problem]
steps = 10
target.rotor.displacement = [[0.0, 0.0], [0.004, 0.001], [0.002, 0.0]]
target.rotor.turn = [0.0, 0.05]
target.rotor.scale = 1.05

[optimise]
start.rotor.displacement = [[0.0, 0.0], [0.0, 0.0]]
start.rotor.turn = [0.0, 0.0]
start.rotor.scale = 1.0
bounds.rotor.turn = [-0.1, 0.1]
knots = 3
optimiser = "lbfgs"
learning_rate = 0.001
iterations = 20
"""


def test_a_task_searches_a_path_by_its_knots(tmp_path):
    """Also one of numbers, and a knot is where the solid is at the end of its step; and how large the solid is."""
    file = tmp_path / "task.toml"
    file.write_text(TASK)
    made = setup(load_task(file), "cpu", "float64")
    assert made.start["rotor.displacement"].shape == (3, 2) and made.start["rotor.turn"].shape == (3,)
    assert made.start["rotor.scale"] == 1.0
    found = optimise(made.search, made.start, optimiser="lbfgs", iterations=8, bounds=made.bounds)
    assert found.loss < 0.5 * made.search.value(made.start)
    knots = knot_values(made, found.parameters, made.search.parameters(found.parameters))
    np.testing.assert_allclose(knots["rotor.turn"].times, [0.001, 0.0055, 0.01], rtol=1e-12)
    np.testing.assert_allclose(knots["rotor.turn"].true, [0.0, 0.025, 0.05], atol=1e-12)


def test_a_task_offers_what_its_solids_have(tmp_path):
    file = tmp_path / "task.toml"
    file.write_text(TASK.replace("rotor.turn", "rotor.turning"))
    with pytest.raises(SceneError, match=r"'rotor\.turning' is unknown, but must be one of .*, rotor\.turn, "):
        load_task(file)
