"""One run of a data set: its arrays, and what is known of it for the whole."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from cortado.discretise.pairs import wrapped
from cortado.losses import FinalPositions
from cortado.optimisation.datasets.sample import Sample
from cortado.particles.state import State
from cortado.problem import Problem
from cortado.scene.parameters import BY_NAME
from cortado.simulation import Simulation

WALL, FLUID, MORE_FLUID = 1, 0, 4
"""Types of particles in LagrangeBench: what does not move, fluid, and the first number that it leaves free, which
further phases have."""


@dataclass(frozen=True)
class OneRun:
    """What is kept of a run."""

    arrays: dict[str, np.ndarray]
    """By their names in the file."""
    statistics: dict[str, Any]
    """Of the fluid: how many, the sum and the sum of squares of each component, of velocities and accelerations in
    metres a frame; the lower and the upper end of all positions; and how many particles there are, with walls."""


def one_run(simulation: Simulation, sample: Sample) -> OneRun:
    """Run it, and differentiate it along random directions; raises `DivergedError` or `InputError`."""
    table, scene = sample.table, simulation.scene
    spacing, d = scene.discretisation.spacing, simulation.dimension
    start = sample.start(simulation.positions, simulation.velocities, spacing)
    trajectory = simulation.run(table.steps, start, record_every=table.write_every)
    origin, periods = (np.asarray(one, dtype=np.float64) for one in periods_of(scene))
    positions = np.asarray(trajectory.positions, dtype=np.float64)
    walls = np.asarray(simulation.walls, dtype=np.float64) if table.walls else np.zeros((0, d))
    every = np.concatenate([positions, np.broadcast_to(walls, (len(positions), *walls.shape))], axis=1)
    phases = simulation.mass_fractions.argmax(axis=1)
    kinds = np.where(phases == 0, FLUID, MORE_FLUID - 1 + phases)
    real = simulation.precision.numpy
    arrays = {
        "position": wrapped(every - origin, periods).astype(real),
        "particle_type": np.concatenate([kinds, np.full(len(walls), WALL)]).astype(np.int64),
        "velocity": np.asarray(trajectory.velocities, dtype=real),
        **{f"vary/{key}": np.array(value) for key, value in sample.values.items()},
    }
    for name, motion in trajectory.solids.items():
        arrays |= {f"solids/{name}/position": motion.positions, f"solids/{name}/rotation": motion.rotations}
    statistics = {**_statistics(positions, periods), "particles": every.shape[1]}
    return OneRun(arrays | _tangents(simulation, sample, start), statistics)


def periods_of(scene: Any) -> tuple[np.ndarray, np.ndarray]:
    """The lower ends and the lengths (d,) [m] of the axes that are periodic, both 0 along others."""
    ends, (_, lengths) = scene.container.extent(), scene.container.periods(scene.dimension)
    lower = np.zeros(scene.dimension) if ends is None else np.asarray(ends[0], dtype=np.float64)
    return np.where(lengths > 0.0, lower, 0.0), np.asarray(lengths, dtype=np.float64)


def _statistics(positions: np.ndarray, periods: np.ndarray) -> dict[str, Any]:
    """Of differences of positions (frames, n, d), the shorter way around, as LagrangeBench takes them."""
    moved = np.diff(positions, axis=0)
    moved -= periods * np.round(moved / np.where(periods > 0.0, periods, 1.0))
    found: dict[str, Any] = {}
    for name, values in (("vel", moved), ("acc", np.diff(moved, axis=0))):
        rows = values.reshape(-1, positions.shape[2])
        found[name] = [len(rows), rows.sum(axis=0).tolist(), (rows**2).sum(axis=0).tolist()]
    ends = positions.reshape(-1, positions.shape[2])
    return {**found, "lower": ends.min(axis=0).tolist(), "upper": ends.max(axis=0).tolist()}


def _tangents(simulation: Simulation, sample: Sample, start: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Jacobian-vector products: how positions and velocities change along random directions of the first state."""
    table, d, real = sample.table, simulation.dimension, simulation.precision.numpy
    if not table.tangents:
        return {}
    first = {"initial_positions": simulation.positions, "initial_velocities": simulation.velocities} | start
    names = ("initial_positions", "initial_velocities")
    sizes = tuple(float(np.max(BY_NAME[name].change(simulation, first[name]))) for name in names)
    problem = Problem(simulation, table.steps, FinalPositions(simulation.positions))
    frames = range(0, table.steps + 1, table.write_every) if table.tangent_frames == "all" else [table.steps]
    found: dict[str, list[Any]] = {name: [] for name in ("position", "velocity", *names)}
    for which in range(table.tangents):
        direction = sample.direction(which, simulation.positions.shape, (sizes[0], sizes[1]))
        dots: dict[int, Any] = {}

        def observe(step: int, dot: State, kept: dict[int, Any] = dots) -> None:
            if step in frames:
                kept[step] = dot.numpy(d)

        problem.tangents(first, direction, observe)
        for key, field in (("position", "positions"), ("velocity", "velocities")):
            found[key].append([dots[step][field] for step in frames])
        for name in names:
            found[name].append(direction[name])
    to = {"initial_positions": "position_direction", "initial_velocities": "velocity_direction"}
    return {f"tangent/{to.get(name, name)}": np.array(values, dtype=real) for name, values in found.items()}
