"""The files of a data set: one file for each run at first, and three assembled files with metadata at the end."""

import io
import json
import os
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from cortado.errors import ComputationError
from cortado.files.disk import parsed_json, reason, sentences, unfinished, write_atomically
from cortado.optimisation.datasets import DatasetTable, OneRun, bounds_of
from cortado.scene.scene import Scene
from cortado.version import __version__

METADATA, PARTS, PURPOSES = "metadata.json", "runs", ("train", "valid", "test")
REACH = 1.6
"""Radius within which a learned simulator connects particles [spacings]."""
SPARE = 1.02
"""Free disk space needed to assemble the runs, relative to the size of the runs."""


@dataclass(frozen=True)
class FinishedRun:
    file: Path
    group: str
    statistics: Mapping[str, Any]


class DatasetFolder:
    def __init__(self, out: Path):
        self.out, self.parts = out, out / PARTS

    def save(self, number: int, run: OneRun) -> None:
        """HDF5 may crash on a full disk. The run is therefore first written to memory."""
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
                found = f"{self.out} needs {needed / 1e9:.3g} GB to put its runs together"
                left = f"the disk has {free / 1e9:.3g} GB left"
                raise ComputationError(f"{found}, but {left}; free some space, and give the same command again.")
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
            said = f"{path} cannot be written, as the disk refuses"
            raise ComputationError(f"{said}; free some space, and give the same command again.") from problem

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
