"""Wave gauges above, below and beside solids: the level of still water, and its derivatives."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import pytest

import cortado
from cortado.discretise.room import WITHOUT_PERIODS
from cortado.discretise.smoothing import KERNELS
from cortado.losses import Series
from cortado.runs.sensor import value_of
from cortado.scene.discrete_scene import Lattice
from cortado.sensors import WaveGauge
from finite_differences import both_modes, distance
from scenes import plane, pool

LEVEL = 0.5


@dataclass(frozen=True)
class Basin:
    """Water that stands half a metre high around solids, 2 m long and in space 2 m wide, as gauges see it."""

    dimension: int
    solid: tuple[dict[str, Any], ...] = ()
    level: float = LEVEL
    spacing: float = 0.05
    kernel: str = "cubic_spline"
    support: float = 2.0

    @cached_property
    def scene(self):
        d = self.dimension
        solid = [{"name": f"solid {k}", **each} for k, each in enumerate(self.solid)]
        return pool([2.0, LEVEL, 2.0][:d], [2.0, 1.2, 2.0][:d], self.spacing, 0.1, solid=solid)

    @cached_property
    def lattice(self):
        radius = self.support * self.spacing
        return Lattice.of(KERNELS[self.kernel], self.spacing, radius, self.dimension, WITHOUT_PERIODS)

    @property
    def container(self):
        return self.scene.container

    @property
    def solids(self):
        return self.scene.solid

    def __getitem__(self, name):
        counts = np.rint(np.array([2.0, self.level, 2.0][: self.dimension]) / self.spacing).astype(int)
        x = self.spacing * (np.stack(np.meshgrid(*map(np.arange, counts), indexing="ij"), -1) + 0.5)
        x = x.reshape(-1, self.dimension)
        away = [each.solid().distance(x) > 0.0 for each in self.solids]
        return {"positions": x[np.all(away, axis=0)] if away else x}[name]


def box(dimension, lower, upper):
    """As deep as the basin, or from 0.5 to 1.5 m across it if it is no sheet."""
    return {"shape": "box", "lower": [*lower, 0.5][:dimension], "upper": [*upper, 1.5][:dimension]}


def standing(dimension):
    return {
        "a block on the floor": [box(dimension, [0.6, 0.0], [1.4, 0.2])],
        "its edge": [box(dimension, [0.4, 0.0], [1.0, 0.2])],
        "a plate in the water": [box(dimension, [0.6, 0.2], [1.4, 0.3])],
        "a bridge above": [box(dimension, [0.6, 0.7], [1.4, 0.9])],
        "a wall out of the water": [box(dimension, [0.4, 0.0], [1.0, 0.9])],
        "two steps": [box(dimension, [0.6, 0.0], [1.4, 0.1]), box(dimension, [0.8, 0.1], [1.4, 0.3])],
    }


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("name", standing(2))
def test_a_gauge_reads_the_level_of_still_water_around_solids(name, dimension):
    basin = Basin(dimension, tuple(standing(dimension)[name]))
    for radius in (None, 0.12):
        for place in (1.0, 1.013):
            gauge = WaveGauge([place, 0.2, 0.987][:dimension], radius=radius)
            assert value_of(gauge, basin)[0] == pytest.approx(LEVEL, rel=1e-3)


@pytest.mark.parametrize("dimension", [2, 3])
def test_a_gauge_reads_the_level_beside_the_walls_of_a_container(dimension):
    for basin in (Basin(dimension), Basin(dimension, (box(dimension, [0.0, 0.0], [0.3, 0.2]),))):
        for place in (0.0, 0.013, 0.1, 1.93, 2.0):
            for radius in (None, 0.12):
                gauge = WaveGauge([place, 0.2, 0.0][:dimension], radius=radius)
                assert value_of(gauge, basin)[0] == pytest.approx(LEVEL, rel=1.5e-3)


def test_a_gauge_above_a_dry_step_reads_where_it_ends_and_below_a_deck_where_the_water_ends():
    dry = Basin(2, tuple(standing(2)["a block on the floor"]), level=0.2)
    assert value_of(WaveGauge([1.0, 0.0]), dry)[0] == pytest.approx(0.2)
    for pressed in (1.0, 1.003):  # water that is pressed against a deck a little is not on it
        deck = Basin(2, (box(2, [0.5, 0.5 / pressed], [1.5, 0.8]),))
        assert value_of(WaveGauge([1.0, 0.0]), deck)[0] == pytest.approx(LEVEL, rel=0.04)


def test_a_gauge_above_a_round_or_slanted_solid_reads_the_level():
    """A cylinder that lies on the floor, a slope that comes out of the water, a block in a turned frame."""
    for solid in (
        {"shape": "sphere", "centre": [1.0, 0.2], "radius": 0.15},
        {"shape": "polygon", "corners": [[0.6, 0.0], [1.6, 0.0], [1.6, 0.9]]},
        {**box(2, [0.7, 0.1], [1.3, 0.3]), "rotation": 0.3},
    ):
        basin = Basin(2, (solid,), spacing=0.0125)
        assert value_of(WaveGauge([1.013, 0.0], radius=0.25), basin)[0] == pytest.approx(LEVEL, rel=0.01)


def turned(dimension):
    angle, flat = (0.2, 0.4) if dimension == 2 else ([0.2, 0.1, -0.3], [0.1, 0.4, 0.2])
    spin = 0.5 if dimension == 2 else [0.0, 0.0, 0.5]
    plate = {**box(dimension, [0.95, 0.1], [1.3, 0.24]), "rotation": angle, "motion": "path", "angular_velocity": spin}
    boat = {**box(dimension, [0.75, 0.4], [0.95, 0.62]), "rotation": flat, "motion": "free", "density": 400.0}
    return plate, boat


def test_the_gradient_of_a_gauge_above_a_solid_that_moves():
    solid = [{"name": "sill", "shape": "box", "lower": [0.1, 0.02], "upper": [0.3, 0.1], "motion": "path"}]
    simulation = cortado.Simulation(plane(solid=[{**solid[0], "velocity": [0.2, 0.1]}]), precision="float64")
    dt, random = simulation.scene.solver.time_step, np.random.default_rng(3)
    loss = Series(WaveGauge([0.19, 0.0], radius=0.15), np.linspace(0.0, 4 * dt, 3), [0.3, 0.1, 0.4], dt)
    problem = cortado.Problem(simulation, 4, loss)
    velocities = 0.5 * random.normal(size=simulation.velocities.shape)
    point = {"sill.position": np.array([0.203, 0.0611]), "initial_velocities": velocities}
    along = {"sill.position": np.array([1.0, 0.6]), "initial_velocities": random.normal(size=velocities.shape)}
    _, derivative = both_modes(problem, point, along)
    steps = [1e-4, 3e-5, 1e-5, 3e-6, 1e-6, 3e-7, 1e-7]
    assert distance(problem.value, point, along, derivative, steps, enough=1e-5) < 1e-5
