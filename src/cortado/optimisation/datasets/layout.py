"""The files of a data set, in the layout of LagrangeBench (Toshev et al., NeurIPS 2023): ``train.h5``, ``valid.h5`` and
``test.h5`` with a group for each run, and ``metadata.json``."""

import io
import json
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cortado.errors import ComputationError
from cortado.files.output_files import sentences, unfinished, write_atomically
from cortado.optimisation.datasets.one_run import OneRun, periods_of
from cortado.optimisation.datasets.table import DatasetTable
from cortado.scene.scene import Scene
from cortado.version import __version__

METADATA, PARTS = "metadata.json", "runs"
"""Names of the file that is written last, and of the folder that has the runs until then."""
REACH = 1.45
"""In spacings: how far particles are connected that a learned simulator looks at, as in LagrangeBench's data sets."""
SPARE = 1.02
"""Of the size of runs, what the disk must have."""


class Parts:
    """The finished runs of a data set that is not complete."""

    def __init__(self, out: Path):
        self.folder = out / PARTS

    def save(self, number: int, run: OneRun) -> None:
        """Write a run, whole or not at all; HDF5 does it in memory, as a full disk may kill it."""
        import h5py

        content = io.BytesIO()
        with h5py.File(content, "w") as file:
            for name, array in run.arrays.items():
                file[f"run/{name}"] = array
        self._mark(number, content.getvalue(), {"statistics": run.statistics})

    def save_failure(self, number: int, why: str) -> None:
        """Note that there is no run, and why."""
        self._mark(number, None, {"failure": why})

    def note(self, number: int) -> dict[str, Any] | None:
        """The statistics of a run, or its failure; None while it is not finished."""
        path = self._path(number, "json")
        found: dict[str, Any] | None = json.loads(path.read_text()) if path.exists() else None
        return found

    def path(self, number: int) -> Path:
        """The file of a run."""
        return self._path(number, "h5")

    def _mark(self, number: int, content: bytes | None, note: Mapping[str, Any]) -> None:
        with sentences(self.folder):
            self.folder.mkdir(exist_ok=True)
        if content is not None:
            write_atomically(self.path(number), content)
        write_atomically(self._path(number, "json"), json.dumps(note))

    def _path(self, number: int, ending: str) -> Path:
        return self.folder / f"{number:05d}.{ending}"


def assemble(out: Path, split: Mapping[str, Sequence[int]]) -> None:
    """One file for each purpose, of the runs of these numbers, which are numbered from 0 in each; raises
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
    """The runs, once they are in the files of the data set."""
    shutil.rmtree(out / PARTS, ignore_errors=True)


def metadata(
    scene: Scene, table: DatasetTable, split: Mapping[str, Sequence[int]], notes: Mapping[int, Any], most: int
) -> dict[str, Any]:
    """What LagrangeBench reads of a data set, and where it comes from; ``notes`` by the number of each run, ``most``
    the particles of the largest one."""
    frames, origin = table.steps // table.write_every + 1, periods_of(scene)[0]
    train = [notes[number]["statistics"] for number in split["train"]]
    ends = scene.container.extent()
    if ends is None:
        every = [note["statistics"] for note in notes.values()]
        ends = tuple(pick([one[key] for one in every], axis=0) for key, pick in (("lower", np.min), ("upper", np.max)))
    time_step = scene.solver.fixed_time_step("a data set")
    moments = {f"{name}_{what}": value for name in ("vel", "acc") for what, value in _moments(train, name).items()}
    lengths = {f"sequence_length_{purpose}": frames for purpose in split}
    gravity = {} if "forces.gravity" in table.vary else {"g_ext": list(scene.forces.gravity)}
    counts = {f"num_trajs_{purpose}": len(numbers) for purpose, numbers in split.items()}
    return {
        "case": scene.name,
        "solver": f"Cortado {__version__}, {scene.solver.kind}",
        "dim": scene.dimension,
        "dx": scene.discretisation.spacing,
        "dt": time_step,
        "t_end": table.steps * time_step,
        "write_every": table.write_every,
        "num_particles_max": most,
        "periodic_boundary_conditions": (periods_of(scene)[1] > 0.0).tolist(),
        "bounds": np.transpose([ends[0] - origin, ends[1] - origin]).tolist(),
        "origin": origin.tolist(),
        "default_connectivity_radius": REACH * scene.discretisation.spacing,
        **gravity,
        "seed": table.seed,
        "vary": dict(table.vary),
        **lengths,
        **counts,
        **moments,
    }


def _moments(train: Sequence[Mapping[str, Any]], name: str) -> dict[str, list[float]]:
    """The mean and the standard deviation (d,) over all runs to train."""
    counts, sums, squares = (np.sum([np.asarray(one[name][k]) for one in train], axis=0) for k in range(3))
    mean = sums / np.maximum(counts, 1)
    return {"mean": mean.tolist(), "std": np.sqrt(np.maximum(squares / np.maximum(counts, 1) - mean**2, 0.0)).tolist()}


def write_metadata(out: Path, content: Mapping[str, Any]) -> None:
    """The mark of a data set that is complete."""
    write_atomically(out / METADATA, json.dumps(content, indent=2) + "\n")
