"""Data sets of runs with varied scenes, for learned simulators: the table [dataset], one run, and the files of all."""

import io
import json
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import BeforeValidator, Field, WithJsonSchema, model_validator

from cortado.discretise.shapes import wrapped
from cortado.errors import ComputationError
from cortado.files.disk import sentences, unfinished, write_atomically
from cortado.losses import FinalPositions
from cortado.particles.state import State
from cortado.problem import Problem
from cortado.scene.parameters import BY_NAME
from cortado.scene.scene import Scene
from cortado.scene.tables import Flag, Table, Text, count, field_error, quantity
from cortado.simulation import Simulation
from cortado.version import __version__

PAIR = "a lower and an upper end of the same shape, each a number or a list of numbers"


def _ranges(given: Any) -> Any:
    """Check ranges by the names of values, and return the lower and upper ends of each as lists of floats."""
    if not isinstance(given, Mapping):
        raise field_error((), given, "a table of ranges by the keys of values")
    found = {}
    for key, pair in given.items():
        if isinstance(pair, Mapping):
            raise field_error((key,), pair, f'{PAIR}; a key with dots stands in quotes, as in vary."{key}.…"')
        try:
            lower, upper = np.asarray(pair, dtype=np.float64)
        except (ValueError, TypeError):
            raise field_error((key,), pair, PAIR) from None
        if not np.isfinite([lower, upper]).all() or np.any(lower > upper):
            raise field_error((key,), pair, f"{PAIR}, finite, the lower one nowhere above the upper one")
        found[key] = (lower.tolist(), upper.tolist())
    return found


Ranges = Annotated[
    dict[str, Any],
    BeforeValidator(_ranges),
    WithJsonSchema({"type": "object", "additionalProperties": {"type": "array", "minItems": 2, "maxItems": 2}}),
]


class DatasetTable(Table):
    """[dataset]: how long the runs of a data set are, how they are varied, and what is kept of each."""

    steps: Annotated[int, count(1, 10_000_000)]
    """Time steps of each run."""
    write_every: Annotated[int, count(1, 10_000_000)] = 1
    """Time steps from one frame to the next; steps is a multiple of it."""
    vary: Ranges = Field(default_factory=dict)
    """By the key of a value of the scene, in quotes, the ends of its range, as vary."phase.0.viscosity" = [0.1, 1.0]:
    each run has a value from it, each component for itself."""
    logarithmic: tuple[Text, ...] = ()
    """Keys of vary that are drawn evenly by their logarithm."""
    position_noise: Annotated[float, quantity("spacings", ge=0.0, le=0.5)] = 0.0
    """Standard deviation of noise in every coordinate of the first positions [spacings]"""
    velocity_noise: Annotated[float, quantity("m/s", ge=0.0)] = 0.0
    """Standard deviation of noise in every component of the first velocities [m/s]"""
    valid: Annotated[float, quantity(ge=0.0, le=0.9)] = 0.1
    """The part of the runs that is for validation."""
    test: Annotated[float, quantity(ge=0.0, le=0.9)] = 0.1
    """The part of the runs that is for tests."""
    walls: Flag = True
    """Whether the particles of walls come behind those of fluid."""
    tangents: Annotated[int, count(0, 1_000)] = 0
    """Random directions of the first state along which each run is differentiated."""
    tangent_frames: Literal["last", "all"] = "last"
    """Frames whose derivatives are kept."""
    seed: Annotated[int, count(0, 2**31)] = 0
    """Seed of all random numbers."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.steps % self.write_every:
            raise field_error(("write_every",), self.write_every, f"a divisor of steps, which is {self.steps}")
        if self.valid + self.test >= 1.0:
            raise field_error(("test",), self.test, f"less than {1.0 - self.valid:g}, so that runs to train are left")
        if not self.vary and not self.position_noise and not self.velocity_noise:
            raise field_error(("vary",), "nothing", "given, or position_noise or velocity_noise, so that runs differ")
        if not self.tangents and self.tangent_frames != "last":
            raise field_error(("tangent_frames",), self.tangent_frames, "left out, as there are no tangents")
        for key in self.logarithmic:
            if key not in self.vary:
                raise field_error(("logarithmic",), key, "one of the keys of vary")
            if np.min(self.vary[key][0]) <= 0.0:
                raise field_error(("vary", key), self.vary[key][0], "above 0, as its logarithm is drawn")
        return self

    def split(self, runs: int) -> dict[str, range]:
        """The numbers of the runs for each purpose: the first ones train."""
        valid, test = (max(round(part * runs), 1) if part else 0 for part in (self.valid, self.test))
        train = runs - valid - test
        return {"train": range(train), "valid": range(train, train + valid), "test": range(train + valid, runs)}


class DatasetTables(Table):
    """The table [dataset] that a file of a data set has besides those of its scene."""

    dataset: DatasetTable


@dataclass(frozen=True)
class Sample:
    """Random values for one run of a data set, drawn from the seed of its table and the number of the run alone."""

    table: DatasetTable
    number: int

    @cached_property
    def values(self) -> dict[str, Any]:
        """Return random values of the scene's keys that are varied, in the order of the table."""
        random = self._random(0)
        found = {}
        for key, (lower, upper) in self.table.vary.items():
            ends, part = np.array([lower, upper]), random.random(np.shape(lower))
            if key in self.table.logarithmic:
                drawn = np.exp((1.0 - part) * np.log(ends[0]) + part * np.log(ends[1]))
            else:
                drawn = (1.0 - part) * ends[0] + part * ends[1]
            found[key] = drawn.tolist()
        return found

    @property
    def overrides(self) -> list[str]:
        """Return the random values as overrides of a scene."""
        return [f"{key}={json.dumps(value)}" for key, value in self.values.items()]

    def start(self, positions: np.ndarray, velocities: np.ndarray, spacing: float) -> dict[str, np.ndarray]:
        """Return noisy first positions [m] and velocities [m/s] (n, d) by name; one without noise is left out."""
        random, found = self._random(1), {}
        for name, array, size in (
            ("initial_positions", positions, self.table.position_noise * spacing),
            ("initial_velocities", velocities, self.table.velocity_noise),
        ):
            noise = random.standard_normal(array.shape)
            if size:
                found[name] = array + size * noise
        return found

    def direction(self, which: int, shape: tuple[int, ...], sizes: tuple[float, float]) -> dict[str, np.ndarray]:
        """Return a random direction of the first state by name: normal numbers times a size of positions [m] and of
        velocities [m/s]."""
        random = self._random(2, which)
        names = ("initial_positions", "initial_velocities")
        return {name: size * random.standard_normal(shape) for name, size in zip(names, sizes, strict=True)}

    def _random(self, *purpose: int) -> np.random.Generator:
        return np.random.default_rng([self.table.seed, self.number, *purpose])


WALL, FLUID, MORE_FLUID = 1, 0, 4
"""Types of particles in LagrangeBench: walls, fluid, and the first number that it leaves free, for further phases."""


@dataclass(frozen=True)
class OneRun:
    """The arrays and statistics of a run that a data set keeps."""

    arrays: dict[str, np.ndarray]
    """Arrays by their names in the file."""
    statistics: dict[str, Any]
    """Statistics of the fluid: count, sum and sum of squares of each component of velocities and accelerations, in
    metres a frame; the ends of all positions; and the number of particles with walls."""


def one_run(simulation: Simulation, sample: Sample) -> OneRun:
    """Run a simulation from a sample's start, and differentiate it along random directions; raises `DivergedError` or
    `InputError`."""
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
    """Return the lower ends and the lengths (d,) [m] of the axes that are periodic, both 0 along others."""
    ends, (_, lengths) = scene.container.extent(), scene.container.periods(scene.dimension)
    lower = np.zeros(scene.dimension) if ends is None else np.asarray(ends[0], dtype=np.float64)
    return np.where(lengths > 0.0, lower, 0.0), np.asarray(lengths, dtype=np.float64)


def _statistics(positions: np.ndarray, periods: np.ndarray) -> dict[str, Any]:
    """Return statistics of differences of positions (frames, n, d), the shorter way around, for LagrangeBench."""
    moved = np.diff(positions, axis=0)
    moved -= periods * np.round(moved / np.where(periods > 0.0, periods, 1.0))
    found: dict[str, Any] = {}
    for name, values in (("vel", moved), ("acc", np.diff(moved, axis=0))):
        rows = values.reshape(-1, positions.shape[2])
        found[name] = [len(rows), rows.sum(axis=0).tolist(), (rows**2).sum(axis=0).tolist()]
    ends = positions.reshape(-1, positions.shape[2])
    return {**found, "lower": ends.min(axis=0).tolist(), "upper": ends.max(axis=0).tolist()}


def _tangents(simulation: Simulation, sample: Sample, start: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return Jacobian-vector products of positions and velocities along random directions of the first state."""
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


METADATA, PARTS = "metadata.json", "runs"
"""Names of the file that is written last, and of the folder that has the runs until then."""
REACH = 1.45
"""In spacings: the connectivity radius of a learned simulator, as in LagrangeBench's data sets."""
SPARE = 1.02
"""Free space on the disk that is asked for, relative to the size of all runs."""


class Parts:
    """The finished runs of a data set that is not complete."""

    def __init__(self, out: Path):
        self.folder = out / PARTS

    def save(self, number: int, run: OneRun) -> None:
        """Write a run to its file, whole or not at all; HDF5 does it in memory, as a full disk may kill it."""
        import h5py

        content = io.BytesIO()
        with h5py.File(content, "w") as file:
            for name, array in run.arrays.items():
                file[f"run/{name}"] = array
        self._mark(number, {"statistics": run.statistics}, content.getvalue())

    def save_failure(self, number: int, why: str) -> None:
        """Note that a run failed, and why."""
        self._mark(number, {"failure": why})

    def note(self, number: int) -> dict[str, Any] | None:
        """Return the statistics of a run, or its failure; None while it is not finished."""
        path = self.path(number, "json")
        return json.loads(path.read_text()) if path.exists() else None

    def path(self, number: int, ending: str = "h5") -> Path:
        """Return the path of a run's file, or with another ``ending`` that of its note."""
        return self.folder / f"{number:05d}.{ending}"

    def _mark(self, number: int, note: Mapping[str, Any], content: bytes | None = None) -> None:
        with sentences(self.folder):
            self.folder.mkdir(exist_ok=True)
        if content is not None:
            write_atomically(self.path(number), content)
        write_atomically(self.path(number, "json"), json.dumps(note))


def assemble(out: Path, split: Mapping[str, Sequence[int]]) -> None:
    """Write one file for each purpose of ``split`` with the runs of its numbers, counted from 0 in each; raises
    `ComputationError` where the disk has no room, and leaves the runs as they are."""
    import h5py

    parts = Parts(out)
    with sentences(out):
        needed = SPARE * sum(parts.path(number).stat().st_size for own in split.values() for number in own)
        free = shutil.disk_usage(out).free
        if free < needed:
            raise ComputationError(
                f"{out} needs {needed / 1e9:.3g} GB to put its runs together, but the disk has {free / 1e9:.3g} GB "
                "left; free some space, and give the same command again."
            )
        for purpose, numbers in split.items():
            path = out / f"{purpose}.h5"
            temporary = unfinished(path)
            try:
                with h5py.File(temporary, "w") as whole:
                    for k, number in enumerate(numbers):
                        with h5py.File(parts.path(number), "r") as part:
                            whole.copy(part["run"], f"{k:05d}")
                temporary.replace(path)
            except RuntimeError as problem:  # so HDF5 says that the disk refused
                raise ComputationError(
                    f"{path} cannot be written, as the disk refuses; free some space, and give the same command again."
                ) from problem
            finally:
                temporary.unlink(missing_ok=True)


def remove_parts(out: Path) -> None:
    """Remove the single runs, once they are in the files of the data set."""
    shutil.rmtree(out / PARTS, ignore_errors=True)


def metadata(
    scene: Scene, table: DatasetTable, split: Mapping[str, Sequence[int]], notes: Mapping[int, Any], most: int
) -> dict[str, Any]:
    """Return the metadata that LagrangeBench reads of a data set, and its origin; ``notes`` by the number of each run,
    ``most`` the particles of the largest one."""
    frames, (origin, periods) = table.steps // table.write_every + 1, periods_of(scene)
    train = [notes[number]["statistics"] for number in split["train"]]
    ends = scene.container.extent()
    if ends is None:
        every = [note["statistics"] for note in notes.values()]
        ends = tuple(pick([one[key] for one in every], axis=0) for key, pick in (("lower", np.min), ("upper", np.max)))
    time_step = scene.solver.fixed_time_step("a data set")
    moments = {f"{name}_{what}": value for name in ("vel", "acc") for what, value in _moments(train, name).items()}
    gravity = {} if "forces.gravity" in table.vary else {"g_ext": list(scene.forces.gravity)}
    return {
        "case": scene.name,
        "solver": f"Cortado {__version__}, {scene.solver.kind}",
        "dim": scene.dimension,
        "dx": scene.discretisation.spacing,
        "dt": time_step,
        "t_end": table.steps * time_step,
        "write_every": table.write_every,
        "num_particles_max": most,
        "periodic_boundary_conditions": (periods > 0.0).tolist(),
        "bounds": np.transpose([ends[0] - origin, ends[1] - origin]).tolist(),
        "origin": origin.tolist(),
        "default_connectivity_radius": REACH * scene.discretisation.spacing,
        **gravity,
        "seed": table.seed,
        "vary": dict(table.vary),
        **{f"sequence_length_{purpose}": frames for purpose in split},
        **{f"num_trajs_{purpose}": len(numbers) for purpose, numbers in split.items()},
        **moments,
    }


def _moments(train: Sequence[Mapping[str, Any]], name: str) -> dict[str, list[float]]:
    """Return the mean and the standard deviation (d,) of a statistic over all training runs."""
    counts, sums, squares = (np.sum([np.asarray(one[name][k]) for one in train], axis=0) for k in range(3))
    mean = sums / np.maximum(counts, 1)
    return {"mean": mean.tolist(), "std": np.sqrt(np.maximum(squares / np.maximum(counts, 1) - mean**2, 0.0)).tolist()}


def write_metadata(out: Path, content: Mapping[str, Any]) -> None:
    """Write the metadata, which mark a data set as complete."""
    write_atomically(out / METADATA, json.dumps(content, indent=2) + "\n")
