"""Data sets of varied runs for learned simulators: the table [dataset], random values, arrays and files.

Each run is first written to a separate file. At the end, three files contain all runs, and a fourth the metadata.
"""

import io
import json
import os
import shutil
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import BeforeValidator, Field, WithJsonSchema, model_validator

from cortado.discretise.shapes import wrapped
from cortado.discretise.solid import rotation_matrix
from cortado.errors import ComputationError, InputError
from cortado.files.disk import parsed_json, reason, sentences, unfinished, write_atomically
from cortado.losses import FinalPositions
from cortado.particles.state import State
from cortado.problem import Problem
from cortado.runs.frames import SolidMotion
from cortado.scene.motions import wall_numbers
from cortado.scene.parameters import BY_NAME
from cortado.scene.scene import Scene
from cortado.scene.tables import Flag, Table, Text, count, field_error, quantity
from cortado.simulation import Simulation
from cortado.version import __version__

PAIR = "a lower and an upper end of the same shape, each a number or a list of numbers"


def _ranges(given: Any) -> Any:
    if not isinstance(given, Mapping):
        raise field_error((), given, "a table with a range of values for each key")
    found = {}
    for key, pair in given.items():
        if isinstance(pair, Mapping):
            raise field_error((key,), pair, f'{PAIR}; put a key with dots in quotes, as in vary."{key}.…"')
        try:
            lower, upper = np.asarray(pair, dtype=np.float64)
        except (ValueError, TypeError):
            raise field_error((key,), pair, PAIR) from None
        if not np.isfinite([lower, upper]).all() or np.any(lower > upper):
            raise field_error((key,), pair, f"{PAIR}, finite, and no lower end above its upper end")
        found[key] = (lower.tolist(), upper.tolist())
    return found


Ranges = Annotated[
    dict[str, Any],
    BeforeValidator(_ranges),
    WithJsonSchema({"type": "object", "additionalProperties": {"type": "array", "minItems": 2, "maxItems": 2}}),
]


class DatasetTable(Table):
    """[dataset]: the number of steps, the variations and the stored arrays of the runs of a data set."""

    steps: Annotated[int, count(1, 10_000_000)]
    """Number of time steps of each run."""
    write_every: Annotated[int, count(1, 10_000_000)] = 1
    """Number of time steps between two frames. The number `steps` must be a multiple of `write_every`."""
    vary: Ranges = Field(default_factory=dict)
    """Range of values for each varied key of the scene, as in vary."phase.0.viscosity" = [0.1, 1.0]. For each run,
    every component of a value is drawn independently."""
    logarithmic: tuple[Text, ...] = ()
    """Keys of vary whose values have a log-uniform distribution."""
    position_noise: Annotated[float, quantity("spacings", ge=0.0, le=0.5)] = 0.0
    """Standard deviation of the noise in every coordinate of the initial positions [spacings]"""
    velocity_noise: Annotated[float, quantity("m/s", ge=0.0)] = 0.0
    """Standard deviation of the noise in every component of the initial velocities [m/s]"""
    valid: Annotated[float, quantity(ge=0.0, le=0.9)] = 0.1
    """Fraction of the runs that are validation data. A fraction above 0 gives at least one run."""
    test: Annotated[float, quantity(ge=0.0, le=0.9)] = 0.1
    """Fraction of the runs that are test data. A fraction above 0 gives at least one run."""
    walls: Flag = True
    """Append wall particles to the fluid particles."""
    tangents: Annotated[int, count(0, 1_000)] = 0
    """Number of random directions of the initial state along which each run is differentiated."""
    tangent_frames: Literal["last", "all"] = "last"
    """Frames with stored derivatives: only the last frame, or all frames."""
    seed: Annotated[int, count(0, 2**31)] = 0
    """Seed of all random numbers."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.steps % self.write_every:
            raise field_error(("write_every",), self.write_every, f"a divisor of steps, which is {self.steps}")
        if self.valid + self.test >= 1.0:
            raise field_error(("test",), self.test, f"less than {1.0 - self.valid:g}, to leave runs for training")
        if not self.vary and not self.position_noise and not self.velocity_noise:
            raise field_error(("vary",), "nothing", "given, unless position_noise or velocity_noise is set")
        if not self.tangents and self.tangent_frames != "last":
            raise field_error(("tangent_frames",), self.tangent_frames, "left out, as dataset.tangents is 0")
        for key in self.logarithmic:
            if key not in self.vary:
                raise field_error(("logarithmic",), key, "one of the keys in dataset.vary")
            if np.min(self.vary[key][0]) <= 0.0:
                raise field_error(("vary", key), self.vary[key][0], "above 0, as the key is in dataset.logarithmic")
        return self

    def split(self, runs: int) -> dict[str, list[int]]:
        """Return run numbers by purpose. Additional runs do not change the purpose of earlier runs."""
        parts = {"train": 1.0 - self.valid - self.test, "valid": self.valid, "test": self.test}
        found: dict[str, list[int]] = {purpose: [] for purpose in parts}
        for number in range(runs):
            lacks = {p: (part > 0.0 and not found[p], part * (number + 1) - len(found[p])) for p, part in parts.items()}
            found[max(parts, key=lacks.__getitem__)].append(number)
        return found


class DatasetTables(Table):
    dataset: DatasetTable


@dataclass(frozen=True)
class Sample:
    """Random values for a run of a data set. The values depend only on the seed and the number of the run."""

    table: DatasetTable
    number: int

    @cached_property
    def values(self) -> dict[str, Any]:
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
        return [f"{key}={json.dumps(value)}" for key, value in self.values.items()]

    def start(self, positions: np.ndarray, velocities: np.ndarray, spacing: float) -> dict[str, np.ndarray]:
        """Return noisy initial positions [m] and velocities [m/s] (n, d) by name. Arrays without noise are left out."""
        random, found = self._random(1), {}
        sizes = self.table.position_noise * spacing, self.table.velocity_noise
        for name, array, size in zip(FIRST, (positions, velocities), sizes, strict=True):
            noise = random.standard_normal(array.shape)
            if size:
                found[name] = array + size * noise
        return found

    def direction(self, which: int, shape: tuple[int, ...], sizes: tuple[float, float]) -> dict[str, np.ndarray]:
        """Return a random direction by name. ``sizes`` are the standard deviations [m, m/s]."""
        random = self._random(2, which)
        return {name: size * random.standard_normal(shape) for name, size in zip(FIRST, sizes, strict=True)}

    def _random(self, *purpose: int) -> np.random.Generator:
        return np.random.default_rng([self.table.seed, self.number, *purpose])


FIRST = ("initial_positions", "initial_velocities")
FLUID, WALL, MOVING_WALL, BODY, MORE_FLUID, KINDS = 0, 1, 2, 3, 4, 9
"""Particle types of LagrangeBench. ``MORE_FLUID`` is the type of the second phase. ``KINDS`` is the number of types."""
MARGIN = 3
"""Distance from the container to the bounds of the data set [spacings]. If one axis is periodic, LagrangeBench treats
all axes as periodic, so that opposite walls must be far apart."""


@dataclass(frozen=True)
class OneRun:
    arrays: dict[str, np.ndarray]
    statistics: dict[str, Any]
    """Counts, sums and sums of squares of first and second differences of positions [m], for `metadata`."""


def one_run(simulation: Simulation, sample: Sample) -> OneRun:
    table, scene = sample.table, simulation.scene
    start = sample.start(simulation.positions, simulation.velocities, scene.discretisation.spacing)
    trajectory = simulation.run(table.steps, start, record_every=table.write_every)
    origin, _, periods = bounds_of(scene)
    positions, real = np.asarray(trajectory.positions, dtype=np.float64), simulation.precision.numpy
    phases = simulation.mass_fractions.argmax(axis=1)
    kinds, every = np.where(phases == 0, FLUID, MORE_FLUID - 1 + phases), positions
    if table.walls:
        walls, wall_kinds = _walls(simulation, trajectory.solids, len(positions))
        kinds, every = np.concatenate([kinds, wall_kinds]), np.concatenate([positions, walls], axis=1)
    places = wrapped(every - origin, periods)
    arrays = {
        "position": wrapped(places.astype(real), periods.astype(real)),  # as rounding may reach the period
        "particle_type": kinds.astype(np.int64),
        "velocity": np.asarray(trajectory.velocities, dtype=real),
        **{f"vary/{key}": np.array(value) for key, value in sample.values.items()},
    }
    for name, motion in trajectory.solids.items():
        arrays |= {f"solids/{name}/position": motion.positions - origin, f"solids/{name}/rotation": motion.rotations}
    statistics = {**_statistics(positions, places, periods), "particles": every.shape[1]}
    return OneRun(arrays | _tangents(simulation, sample, start), statistics)


def bounds_of(scene: Scene) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return lower corner, lengths and periods of the bounds, each (d,) [m]. Non-periodic axes have period 0."""
    ends, (_, periods) = scene.container.extent(), scene.periods
    if ends is None:
        raise InputError("container.shape is 'none', but must be 'box' or 'cylinder', as a data set has bounds.")
    if scene.drain:
        raise InputError("[[drain]] is given, but must be left out, as a data set keeps every particle to the end.")
    spacing = scene.discretisation.spacing
    for index, emitter in enumerate(scene.emitter):
        if (layers := emitter.supply(spacing)) > emitter.layers(spacing):
            found = f"emitter[{index}] has particles in reserve, but a data set has every particle from the start"
            longer = f"a length of {layers * spacing:.4g} m has room for all of them"
            raise InputError(f"{found}: {longer}, or take fewer steps.")
    room = np.where(periods > 0.0, 0.0, MARGIN * scene.discretisation.spacing)
    return ends[0] - room, ends[1] - ends[0] + 2.0 * room, np.asarray(periods, dtype=np.float64)


def _walls(simulation: Simulation, motions: Mapping[str, SolidMotion], frames: int) -> tuple[np.ndarray, np.ndarray]:
    places = np.repeat(np.asarray(simulation.walls, dtype=np.float64)[None], frames, axis=0)
    kinds, numbers = np.full(len(simulation.walls), WALL), wall_numbers(simulation.scene.solid)
    for name, motion in motions.items():
        own = simulation.wall_solids == numbers[name]
        turns = [rotation_matrix(tuple(np.atleast_1d(turn))) for turn in motion.rotations]
        beside = places[0, own] - motion.positions[0]
        for frame, (middle, turn) in enumerate(zip(motion.positions, turns, strict=True)):
            places[frame, own] = middle + beside @ (turn @ turns[0].T).T
        kinds[own] = MOVING_WALL if motion.velocities is None else BODY
    return places, kinds


def _statistics(positions: np.ndarray, places: np.ndarray, periods: np.ndarray) -> dict[str, Any]:
    if places.min() < 0.0:
        frame, particle, axis = np.unravel_index(places.argmin(), places.shape)
        found = f"Particle {particle} is {-places.min():.3g} m below the bounds of the data set along axis {axis}"
        within = f"must be within the bounds, which begin {MARGIN} spacings outside of the container"
        raise InputError(f"{found} in frame {frame}, but {within}.")
    moved = np.diff(positions, axis=0)
    moved -= periods * np.round(moved / np.where(periods > 0.0, periods, 1.0))  # to the nearest periodic image
    statistics: dict[str, Any] = {}
    for name, values in (("vel", moved), ("acc", np.diff(moved, axis=0))):
        rows = values.reshape(-1, positions.shape[2])
        statistics[name] = [len(rows), rows.sum(axis=0).tolist(), (rows**2).sum(axis=0).tolist()]
    return {**statistics, "upper": places.max(axis=(0, 1)).tolist()}


def _tangents(simulation: Simulation, sample: Sample, start: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    table, d, real = sample.table, simulation.dimension, simulation.precision.numpy
    if not table.tangents:
        return {}
    first = {"initial_positions": simulation.positions, "initial_velocities": simulation.velocities} | start
    sizes = tuple(float(np.max(BY_NAME[name].change(simulation, first[name]))) for name in FIRST)
    problem = Problem(simulation, table.steps, FinalPositions(simulation.positions))
    frames = range(0, table.steps + 1, table.write_every) if table.tangent_frames == "all" else [table.steps]
    found = defaultdict[str, list[Any]](list)
    for which in range(table.tangents):
        direction = sample.direction(which, simulation.positions.shape, (sizes[0], sizes[1]))
        dots: dict[int, Any] = {}

        def observe(step: int, dot: State, kept: dict[int, Any] = dots) -> None:
            if step in frames:
                kept[step] = dot.numpy(d)

        problem.tangents(first, direction, observe)
        for key, field, first_field in zip(("position", "velocity"), ("positions", "velocities"), FIRST, strict=True):
            found[key].append([dots[step][field] for step in frames])
            found[f"{key}_direction"].append(direction[first_field])
    return {f"tangent/{name}": np.array(values, dtype=real) for name, values in found.items()}


METADATA, PARTS, PURPOSES = "metadata.json", "runs", ("train", "valid", "test")
REACH = 1.6
"""Radius within which a learned simulator connects particles [spacings]."""
SPARE = 1.02
"""Free disk space for joining the runs in the final files, relative to the size of the runs."""


@dataclass(frozen=True)
class FinishedRun:
    file: Path
    group: str
    statistics: Mapping[str, Any]


class DatasetFolder:
    def __init__(self, out: Path):
        self.out, self.parts = out, out / PARTS

    def save(self, number: int, run: OneRun) -> None:
        """Write a run to memory first, because HDF5 may crash on a full disk."""
        import h5py

        content = io.BytesIO()
        with h5py.File(content, "w") as file:
            for name, array in run.arrays.items():
                file[f"run/{name}"] = array
            file["run"].attrs.update(number=number, statistics=json.dumps(run.statistics))
        self._write(f"{number:05d}.h5", content.getvalue())

    def save_failure(self, number: int, why: str) -> None:
        self._write(f"{number:05d}.json", json.dumps({"failure": why}))

    def _write(self, name: str, content: str | bytes) -> None:
        with sentences(self.parts):
            self.parts.mkdir(exist_ok=True)
        write_atomically(self.parts / name, content)

    def path(self, purpose: str) -> Path:
        return self.out / f"{purpose}.h5"

    @cached_property
    def metadata(self) -> dict[str, Any]:
        try:
            return dict(parsed_json((self.out / METADATA).read_bytes()))
        except (OSError, ValueError, TypeError):
            return {}

    @property
    def runs(self) -> dict[int, FinishedRun]:
        return self._read[0]

    @property
    def damaged(self) -> dict[Path, str]:
        return self._read[1]

    @cached_property
    def _read(self) -> tuple[dict[int, FinishedRun], dict[Path, str]]:
        import h5py

        found: dict[int, FinishedRun] = {}
        damaged = {self.out / METADATA: "no JSON"} if not self.metadata and (self.out / METADATA).exists() else {}
        own = [path for purpose in PURPOSES if (path := self.path(purpose)).exists()]
        for path in [*sorted(self.parts.glob("*.h5")), *own]:
            try:
                with h5py.File(path, "r") as file:
                    groups = {int(one.attrs["number"]): (name, one.attrs["statistics"]) for name, one in file.items()}
            except (OSError, RuntimeError, KeyError) as problem:
                damaged[path] = reason(problem)
                continue
            found |= {n: FinishedRun(path, name, json.loads(text)) for n, (name, text) in groups.items()}
        return found, damaged

    @cached_property
    def failures(self) -> dict[int, str]:
        old = {int(number): why for number, why in self.metadata.get("failed", {}).items()}
        notes = sorted(self.parts.glob("*.json"))
        return old | {int(path.stem): json.loads(path.read_text())["failure"] for path in notes}

    @property
    def size(self) -> int:
        numbers = [number for number, run in self.runs.items() if run.file.parent == self.out]
        return max([int(self.metadata.get("runs", 0)), *(number + 1 for number in numbers)])

    def assemble(self, split: Mapping[str, Sequence[int]]) -> None:
        """Write the files whose runs differ from ``split``. If writing fails, no file is changed."""
        stale = {}
        for purpose, numbers in split.items():
            path = self.path(purpose)
            there = {number: run.group for number, run in self.runs.items() if run.file == path}
            known = {number: f"{k:05d}" for k, number in enumerate(numbers)}
            if not path.exists() or path in self.damaged or there != known:
                stale[purpose] = numbers
        sources = {self.runs[number].file for numbers in stale.values() for number in numbers}
        temporaries = {self.path(purpose): unfinished(self.path(purpose)) for purpose in stale}
        with sentences(self.out):
            needed = SPARE * sum(path.stat().st_size for path in sources)
            if (free := shutil.disk_usage(self.out).free) < needed:
                found = f"{self.out} needs {needed / 1e9:.3g} GB to join its runs"
                left = f"the disk has {free / 1e9:.3g} GB left"
                raise ComputationError(f"{found}, but {left}; free some space, and repeat the command.")
            try:
                for (path, temporary), numbers in zip(temporaries.items(), stale.values(), strict=True):
                    self._copy([self.runs[number] for number in numbers], path, temporary)
                for path, temporary in temporaries.items():
                    temporary.replace(path)
            finally:
                for temporary in temporaries.values():
                    temporary.unlink(missing_ok=True)

    def _copy(self, runs: Sequence[FinishedRun], path: Path, temporary: Path) -> None:
        import h5py

        try:
            with h5py.File(temporary, "w") as whole:
                for k, run in enumerate(runs):
                    with h5py.File(run.file, "r") as source:
                        whole.copy(source[run.group], f"{k:05d}")
            with open(temporary, "rb+") as file:
                os.fsync(file.fileno())
        except RuntimeError as problem:  # so HDF5 says that the disk refused
            said = f"{path} cannot be written to the disk"
            raise ComputationError(f"{said}; free some space, and repeat the command.") from problem

    def write_metadata(self, content: Mapping[str, Any]) -> None:
        write_atomically(self.out / METADATA, json.dumps(content, indent=2) + "\n")
        shutil.rmtree(self.parts, ignore_errors=True)


def metadata(
    scene: Scene, table: DatasetTable, split: Mapping[str, Sequence[int]], folder: DatasetFolder, runs: int
) -> dict[str, Any]:
    """Return the metadata of a data set in the format of LagrangeBench."""
    frames, (origin, size, periods) = table.steps // table.write_every + 1, bounds_of(scene)
    every = [folder.runs[number].statistics for own in split.values() for number in own]
    train = [folder.runs[number].statistics for number in split["train"]]
    beyond = np.max([one["upper"] for one in every], axis=0)
    upper = np.where((beyond < size) | (periods > 0.0), size, beyond + scene.discretisation.spacing)
    time_step = scene.solver.fixed_time_step("a data set")
    moments = dict[str, list[float]]()
    for name in ("vel", "acc"):
        counts, sums, squares = (np.sum([np.asarray(one[name][k]) for one in train], axis=0) for k in range(3))
        mean = sums / np.maximum(counts, 1)
        std = np.sqrt(np.maximum(squares / np.maximum(counts, 1) - mean**2, 0.0))
        # below the threshold [m] of LagrangeBench it is 1, as it becomes a divisor
        moments |= {f"{name}_mean": mean.tolist(), f"{name}_std": np.where(std < 1e-7, 1.0, std).tolist()}
    return {
        "case": scene.name,
        "solver": f"Cortado {__version__}, {scene.solver.kind}",
        "dim": scene.dimension,
        "dx": scene.discretisation.spacing,
        "dt": time_step,
        "t_end": table.steps * time_step,
        "write_every": table.write_every,
        "num_particles_max": max(one["particles"] for one in every),
        "periodic_boundary_conditions": (periods > 0.0).tolist(),
        "bounds": [[0.0, float(end)] for end in upper],
        "origin": origin.tolist(),
        "default_connectivity_radius": REACH * scene.discretisation.spacing,
        **({} if "forces.gravity" in table.vary else {"g_ext": list(scene.forces.gravity)}),
        "seed": table.seed,
        "vary": dict(table.vary),
        "runs": runs,
        "failed": {str(number): why for number, why in sorted(folder.failures.items()) if number < runs},
        **{f"sequence_length_{purpose}": frames for purpose in split},
        **{f"num_trajs_{purpose}": len(numbers) for purpose, numbers in split.items()},
        **moments,
    }
