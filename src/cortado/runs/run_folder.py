"""The folder of one run: its scene, where and how it ran, its metrics, its trajectory and its pictures.

Files are checked on reading: they may be damaged, from an earlier Cortado, or depend on a file that has changed.
"""

from __future__ import annotations

import json
import math
import os
import platform
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from hashlib import sha256
from importlib import metadata
from pathlib import Path
from typing import Any, Self

from cortado.errors import LONGEST, InputError, SceneError, shown, unwarned
from cortado.files.disk import UNFINISHED, content, parsed_json, reason, sentences, write_atomically
from cortado.runs.sensor import Readings, as_csv, from_csv
from cortado.scene.parameter_values import NAMES
from cortado.scene.scene import Scene, files_named
from cortado.version import __version__

LARGEST = 2**31
"""Greatest size [bytes] of a file that is read when a run is resumed."""
_PACKAGES = ("warp-lang", "numpy", "scipy", "pydantic", "h5py", "matplotlib")


_RESUMABLE = ("run", "optimise")
"""The commands that have --resume."""
_FILES = ("scene.json", "metrics.jsonl", "trajectory.vtkhdf", "report.html", "result.json", "sensors.csv")
REPLAY_LOG = "replay.log"
"""The file in which a search logs its evaluations."""
_FOLDERS = ("checkpoint", "figures")
_PICTURES = (
    "particles",
    "measured",
    "rendered",
    "density_errors",
    "loss",
    "images",
    "progress",
    "residuals",
    "profiles",
    *NAMES,
)
_SHADED = ("first", "last", "picture", "found", "search")
_FILMS = ("run", "estimate", "film", "found", "search")
FIGURES = (
    *(f"{name}.png" for name in (*_PICTURES, *_SHADED, *(f"measured_{k}" for k in range(100)))),
    *(f"{name}.mp4" for name in _FILMS),
)
"""Every file that a run may write into its figures folder; other files there belong to the user."""
TO_RESUME = "; choose another --out, or begin one without --resume"
"""End of the error message about a missing run to resume."""


class _Entry:
    """A descriptor that returns the path of a file or folder inside a run folder."""

    def __init__(self, name: str):
        self._name = name

    def __get__(self, folder: RunFolder, owner: type[RunFolder]) -> Path:
        return folder.path / self._name


@dataclass(frozen=True)
class RunFolder:
    """Paths and files of one run: `create` makes a new folder, `open` opens an existing one, `resume` continues its
    run.

    The file environment.json marks a run folder. It is written first and removed last: a process killed in between
    leaves a folder that can be overwritten or resumed.
    """

    path: Path
    scene = _Entry("scene.json")
    """The resolved scene."""
    environment = _Entry("environment.json")
    """Versions, device, command line and starting time of the run."""
    metrics = _Entry("metrics.jsonl")
    """One JSON object a line."""
    trajectory = _Entry("trajectory.vtkhdf")
    """The recorded frames (VTKHDF)."""
    sensors = _Entry("sensors.csv")
    """sensors.csv: readings of sensors in every step; only where the scene has some."""
    checkpoint = _Entry("checkpoint")
    """The folder with the optimiser's state, from which a search is resumed."""
    figures = _Entry("figures")
    """The folder of the pictures."""
    report = _Entry("report.html")
    """report.html, a page with the run's results and pictures."""
    result = _Entry("result.json")
    """result.json with the results; it is written when the run ends."""

    @classmethod
    def create(
        cls,
        path: str | Path,
        scene_json: str,
        command: Sequence[str],
        *,
        kind: str = "run",
        settings: Mapping[str, Any] | None = None,
        device: str = "",
        overwrite: bool = False,
    ) -> Self:
        """Make the folder of a new run.

        Args:
            path: the folder, made with its parents when missing.
            scene_json: the resolved scene.
            command: the command line, word by word.
            kind: the command that writes the run; only this command can resume it.
            settings: tables of further settings that must be unchanged when the run is resumed.
            device: where the run computes, in words.
            overwrite: removes an earlier run in this folder (its files only).

        Raises:
            InputError: the folder holds a run already, or files that a run would replace, or is not writable.
            ComputationError: the disk is full.
        """
        folder = cls(Path(path).absolute())
        noted = {**session(command, device), "kind": kind, "settings": as_json(settings or {}), "resumed": []}
        noted["files"] = file_marks(scene_json)
        with sentences(folder.path):
            folder._make_room(kind, overwrite)
            folder.path.mkdir(parents=True, exist_ok=True)
            folder._complete(noted, scene_json)
        return folder

    @classmethod
    def open(cls, path: str | Path, otherwise: str = ", but RUN must be the folder of one") -> Self:
        """Open the folder of an existing run; ``otherwise``: end of the error message if there is no run.

        Raises:
            InputError: there is no run in it.
        """
        folder = cls(Path(path).absolute())
        if not folder._holds_run():
            raise InputError(f"There is no run in {folder.path}{otherwise}.")
        return folder

    @classmethod
    def resume(
        cls,
        path: str | Path,
        scene_json: str,
        command: Sequence[str],
        *,
        kind: str = "run",
        settings: Mapping[str, Any] | None = None,
        device: str = "",
    ) -> Self:
        """Open the folder of a run to resume it, and add versions and command of this process to environment.json.

        Raises:
            InputError: the folder contains no run, or one of another kind, scene or settings; the message says which.
            ComputationError: the disk is full.
        """
        folder = cls.open(path, TO_RESUME)
        folder.require(scene_json, kind, settings)
        noted = read_json(folder.environment)
        noted.setdefault("resumed", []).append(session(command, device))
        with sentences(folder.path):
            folder.result.unlink(missing_ok=True)
            folder._remove_unfinished()
            folder._complete(noted, scene_json)
            cut_torn_line(folder.metrics)
        return folder

    def require(self, scene_json: str, kind: str, settings: Mapping[str, Any] | None = None) -> None:
        """Raise `InputError` unless the run in the folder is of this kind, scene and settings; the message says what
        differs."""
        noted = read_json(self.environment)
        former = noted.get("kind", kind)
        if former != kind:
            raise InputError(
                f"{self.path} holds what `cortado {former}` wrote, with which `cortado {kind}` cannot go on; choose "
                f"another --out, or replace it with --overwrite."
            )
        if self.scene.exists():
            require_same(computed(read_json(self.scene)), computed(json.loads(scene_json)), self.path)
        if "settings" in noted:
            require_same(noted["settings"], as_json(settings or {}), self.path)
        self.require_files()

    def require_files(self) -> None:
        """Raise `InputError` for a file of the scene, such as a mesh, that has changed since the run began, or is
        missing."""
        require_files(read_json(self.environment).get("files", {}), self.path)

    def write_sensors(self, readings: Mapping[str, Readings]) -> None:
        """Write sensors.csv, whole or not at all; without sensors write no file."""
        if readings:
            write_atomically(self.sensors, as_csv(readings))

    def read_sensors(self) -> dict[str, Readings]:
        """Read sensors.csv with exactly the numbers written; empty if there is no file. Raise `InputError` for a
        damaged file."""
        return from_csv(self.sensors) if self.sensors.exists() else {}

    def read_scene(self, overrides: Sequence[str] = ()) -> Scene:
        """Read the scene, with overrides as in `load_scene`. Its warnings are left out, as the run has printed them.

        Raises:
            InputError: the file is damaged; `SceneError`: a value in the file or an override is wrong.
        """
        text = bytes_of(self.scene).decode(errors="replace")
        with unwarned():
            try:
                return Scene.from_json(text, overrides)
            except SceneError as error:
                raise error.in_file(str(self.scene)) from None

    def write_result(self, **values: Any) -> None:
        """Write result.json, which marks a run as ended. Values may be NumPy's; numbers that are not finite become
        null."""
        write_atomically(self.result, json.dumps(finite(as_json(values)), indent=2) + "\n")

    def read_result(self) -> dict[str, Any] | None:
        """Read result.json; None for a run that has not ended. Raise `InputError` for a damaged file."""
        return read_json(self.result) if self.result.exists() else None

    def append_metrics(self, **values: Any) -> None:
        """Append one line to metrics.jsonl; it survives if the process is killed right after. Values may be NumPy's."""
        line = json.dumps(values, default=plain) + "\n"
        with sentences(self.metrics), open(self.metrics, "a", encoding="utf-8") as file:
            file.write(line)

    def write_metrics(self, columns: Mapping[str, Any]) -> None:
        """Write metrics.jsonl, whole or not at all: one line per step, from columns (steps,) by name."""
        rows = (dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True))
        lines = [json.dumps({"step": step, **row}, default=plain) + "\n" for step, row in enumerate(rows, 1)]
        write_atomically(self.metrics, "".join(lines))

    def read_metrics(self) -> list[dict[str, Any]]:
        """Read all lines of metrics.jsonl; an unfinished last line of a killed run is ignored.

        Raises:
            InputError: an earlier line is damaged.
        """
        if not self.metrics.exists():
            return []
        try:
            return [parsed_json(line) for line in bytes_of(self.metrics).split(b"\n")[:-1]]
        except ValueError as problem:
            raise InputError(f"{self.metrics} holds a line that is not JSON: {problem}.") from problem

    def _holds_run(self) -> bool:
        try:
            return "cortado" in dict(parsed_json(bytes_of(self.environment)))
        except (InputError, ValueError, TypeError):
            return False

    def _complete(self, noted: Mapping[str, Any], scene_json: str) -> None:
        """Write the initial files of a run folder; the first is environment.json, which marks it."""
        write_atomically(self.environment, json.dumps(noted, indent=2) + "\n")
        write_atomically(self.scene, scene_json)
        self.figures.mkdir(exist_ok=True)

    def _make_room(self, kind: str, overwrite: bool) -> None:
        present = [name for name in (self.environment.name, *_FILES, *_FOLDERS) if (self.path / name).exists()]
        if not present:
            self._require_own()
        elif not self._holds_run():
            raise InputError(f"{self.path} holds {', '.join(present)}, but no run of Cortado; choose another --out.")
        elif not overwrite:
            resumable = kind in _RESUMABLE and kind == read_json(self.environment).get("kind")
            advice = ", or go on with it by --resume" if resumable else ""
            raise InputError(
                f"{self.path} already holds a run; choose another --out, or replace it with --overwrite{advice}."
            )
        self._remove_unfinished()
        if present:
            self._remove_run()

    def _require_own(self) -> None:
        """Raise `InputError` for a folder that belongs to something else than one run."""
        if Path.cwd().is_relative_to(self.path.resolve()):
            raise InputError(f"{self.path} is the current folder, or one that it is in; choose another --out.")
        runs = sorted(one.parent.name for one in self.path.glob(f"*/{self.environment.name}"))
        if runs:
            raise InputError(f"{self.path} holds other runs, such as {runs[0]}; choose another --out.")

    def _remove_run(self) -> None:
        """Remove the run's files, environment.json last; files that the run did not write are kept."""
        written = (*map(self.figures.joinpath, FIGURES), *map(self.path.joinpath, _FILES))
        for path in (*(folder / REPLAY_LOG for folder in self._checkpoints()), *written):
            path.unlink(missing_ok=True)
        for folder in (*self._checkpoints(), self.figures):
            with suppress(OSError):  # it is not there, or something of the user's is in it
                folder.rmdir()
        self.environment.unlink()

    def _remove_unfinished(self) -> None:
        """Remove unfinished files of killed processes."""
        for folder in (self.path, self.figures, *self._checkpoints()):
            for path in folder.glob(UNFINISHED):
                path.unlink(missing_ok=True)

    def _checkpoints(self) -> list[Path]:
        """Return the log folders of all searches. The first search's comes last, because it contains the others."""
        return [*self.checkpoint.glob("[0-9]*/"), self.checkpoint]


def computed(scene: Any) -> Any:
    """Return a scene without the tables that affect only pictures and readings, not the computation."""
    shown = ("picture", "sensor")
    return {name: table for name, table in scene.items() if name not in shown} if isinstance(scene, dict) else scene


def finite(value: Any) -> Any:
    """Return a value in which numbers that JSON lacks (NaN, infinities) are null."""
    if isinstance(value, dict):
        return {name: finite(entry) for name, entry in value.items()}
    if isinstance(value, list):
        return [finite(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def bytes_of(path: Path) -> bytes:
    """Read all of a file; raise `InputError` if it is no regular file or too large."""
    try:
        return content(path, LARGEST)
    except OSError as problem:
        raise InputError(f"{path} cannot be read: {reason(problem)}.") from problem


def read_json(path: Path) -> Any:
    try:
        return parsed_json(bytes_of(path))
    except ValueError as problem:
        raise InputError(f"{path} cannot be read: {reason(problem)}.") from problem


def cut_torn_line(path: Path) -> None:
    """Remove an unfinished last line of a killed run, so that text appended next starts a new line."""
    if path.exists():
        os.truncate(path, bytes_of(path).rfind(b"\n") + 1)


def session(command: Sequence[str], device: str) -> dict[str, Any]:
    """Return a record of the present process: time, operating system, Python, versions of packages, and the command."""
    return {
        "cortado": __version__,
        "python": platform.python_version(),
        "platform": platform.platform(),
        "executable": sys.executable,
        "packages": {name: _version(name) for name in _PACKAGES},
        "device": device,
        "command": list(command),
        "started": datetime.now(UTC).isoformat(timespec="seconds"),
    }


def plain(value: Any) -> Any:
    """Return NumPy numbers and arrays as Python numbers and lists."""
    if hasattr(value, "tolist"):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} has no JSON form")


def as_json(value: Any) -> Any:
    """Return a value as JSON stores it: arrays and tuples become lists."""
    return json.loads(json.dumps(value, default=plain))


def require_same(former: Any, given: Any, folder: Path) -> None:
    """Raise `InputError`, naming the field, if settings differ from those with which the run in a folder began."""
    for name, (before, now) in sorted(differences(former, given).items()):
        field = ".".join(part if not part.isdigit() else f"[{part}]" for part in name.split(".")).replace(".[", "[")
        raise InputError(
            f"The run in {folder} was begun with {field} = {_written(before)} and is now given {field} = "
            f"{_written(now)}; give the former, or choose another --out."
        )


def differences(one: Any, other: Any, missing: Any = None, name: str = "") -> dict[str, list[Any]]:
    """Return pairs of values that differ in two objects, by dotted names. An entry absent from one object has the value
    ``missing``."""
    if isinstance(one, Mapping) and isinstance(other, Mapping):
        pairs = {key: (one.get(key, missing), other.get(key, missing)) for key in {**one, **other}}
    elif _are_tables(one) and _are_tables(other) and len(one) == len(other):
        pairs = {str(k): pair for k, pair in enumerate(zip(one, other, strict=True))}
    else:
        return {} if one == other else {name: [one, other]}
    before = f"{name}." if name else ""
    each = [differences(*values, missing, f"{before}{part}") for part, values in pairs.items()]
    return {key: pair for found in each for key, pair in found.items()}


def _written(value: Any) -> str:
    """Return a value as a short text, as in a run's files; "nothing" for None."""
    if value is None:
        return "nothing"
    return json.dumps(value)[: 2 * LONGEST] if isinstance(value, dict) else shown(value)


def _are_tables(value: Any) -> bool:
    return isinstance(value, list) and any(isinstance(entry, Mapping) for entry in value)


def _version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def file_marks(scene_json: str) -> dict[str, str]:
    """Return, by path, a mark of the content of each file that a resolved scene names, such as a mesh."""
    return {table[key]: _mark(Path(table[key])) for table, key in files_named(json.loads(scene_json))}


def require_files(marks: Mapping[str, str], run: Path) -> None:
    """Raise `InputError` if a file is not the same as when the run was made."""
    for name, mark in marks.items():
        if not Path(name).is_file():
            raise InputError(f"{name} is missing, but the run in {run} was made with it: put it back.")
        if _mark(Path(name)) != mark:
            raise InputError(f"{name} has changed since the run in {run} was made with it: put the former file back.")


def _mark(path: Path) -> str:
    return sha256(bytes_of(path)).hexdigest()
