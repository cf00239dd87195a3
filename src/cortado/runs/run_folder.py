"""The folder of a run with its scene, versions, command, metrics, trajectory and pictures."""

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
from cortado.files.disk import REPLAY_LOG, UNFINISHED, content, parsed_json, reason, sentences, write_atomically
from cortado.runs.sensor import Readings, as_csv, from_csv
from cortado.scene.parameter_values import NAMES
from cortado.scene.scene import Scene, files_named
from cortado.version import __version__

LARGEST = 2**31
_PACKAGES = ("warp-lang", "numpy", "scipy", "pydantic", "h5py", "matplotlib")
_FILES = ("scene.json", "metrics.jsonl", "trajectory.vtkhdf", "report.html", "result.json", "sensors.csv")
_FOLDERS = ("checkpoint", "figures")
_PLOTS = ("particles", "measured", "rendered", "density_errors", "loss", "images", "progress", "residuals", "profiles")
_SHADED = ("first", "last", "picture", "found", "search")
_FILMS = ("run", "estimate", "film", "found", "search")
FIGURES = (
    *(f"{name}.png" for name in (*_PLOTS, *NAMES, *_SHADED, *(f"measured_{k}" for k in range(100)))),
    *(f"{name}.mp4" for name in _FILMS),
)
"""Names of the figures that runs write. All other files in the folder belong to the user."""
TO_RESUME = "; choose another --out, or begin a run without --resume"


class _Entry:
    def __init__(self, name: str):
        self._name = name

    def __get__(self, folder: RunFolder, owner: type[RunFolder]) -> Path:
        return folder.path / self._name


@dataclass(frozen=True)
class RunFolder:
    """The file environment.json marks a run folder. The file environment.json is written first and removed last, so
    that the folder of a killed process can be overwritten or resumed."""

    path: Path
    scene = _Entry("scene.json")
    environment = _Entry("environment.json")
    metrics = _Entry("metrics.jsonl")
    trajectory = _Entry("trajectory.vtkhdf")
    sensors = _Entry("sensors.csv")
    checkpoint = _Entry("checkpoint")
    figures = _Entry("figures")
    report = _Entry("report.html")
    result = _Entry("result.json")
    """File that exists only after the end of the run."""

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
        """Make the folder of a new run of the command ``kind``. If a run is resumed, the kind and the ``settings`` must
        be those of the first command. ``overwrite`` removes the files of an earlier run. Raises `InputError` if the
        folder contains files that the run would replace."""
        folder = cls(Path(path).absolute())
        noted = {**session(command, device), "kind": kind, "settings": as_json(settings or {}), "resumed": []}
        noted["files"] = {table[key]: _mark(table[key]) for table, key in files_named(json.loads(scene_json))}
        with sentences(folder.path):
            folder._make_room(kind, overwrite)
            folder.path.mkdir(parents=True, exist_ok=True)
            folder._complete(noted, scene_json)
        return folder

    @classmethod
    def open(cls, path: str | Path, otherwise: str = ", but RUN must be the folder of a run") -> Self:
        """Open the folder of a run. Raises `InputError` if there is no run. The message ends with ``otherwise``."""
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
        """Open the folder of a run, and record the process in environment.json. Arguments are as in `create`."""
        folder = cls.open(path, TO_RESUME)
        folder.require(scene_json, kind, settings)
        noted = read_json(folder.environment)
        noted.setdefault("resumed", []).append(session(command, device))
        with sentences(folder.path):
            folder.result.unlink(missing_ok=True)
            folder._remove_unfinished()
            folder._complete(noted, scene_json)
            if folder.metrics.exists():  # a line that a killed run left unfinished
                os.truncate(folder.metrics, bytes_of(folder.metrics).rfind(b"\n") + 1)
        return folder

    def require(self, scene_json: str, kind: str, settings: Mapping[str, Any] | None = None) -> None:
        noted = read_json(self.environment)
        former = noted.get("kind", kind)
        if former != kind:
            advice = "choose another --out, or replace it with --overwrite"
            found = f"{self.path} contains a run of `cortado {former}`, which `cortado {kind}` cannot resume"
            raise InputError(f"{found}; {advice}.")
        if self.scene.exists():
            require_same(computed(read_json(self.scene)), computed(json.loads(scene_json)), self.path)
        if "settings" in noted:
            require_same(noted["settings"], as_json(settings or {}), self.path)
        self.require_files()

    def require_files(self) -> None:
        """Raise `InputError` if a file of the scene, such as a mesh, is missing or has changed since the run began."""
        for name, mark in read_json(self.environment).get("files", {}).items():
            if not Path(name).is_file():
                raise InputError(f"{name} is missing, but the run in {self.path} needs this file: put the file back.")
            if _mark(name) != mark:
                found = f"{name} has changed since the run in {self.path} began"
                raise InputError(f"{found}: restore the former file.")

    def write_sensors(self, readings: Mapping[str, Readings]) -> None:
        if readings:
            write_atomically(self.sensors, as_csv(readings))

    def read_sensors(self) -> dict[str, Readings]:
        """Read sensors.csv without loss of digits. Return an empty table if sensors.csv does not exist."""
        return from_csv(self.sensors) if self.sensors.exists() else {}

    def read_scene(self, overrides: Sequence[str] = ()) -> Scene:
        text = bytes_of(self.scene).decode(errors="replace")
        with unwarned():
            try:
                return Scene.from_json(text, overrides)
            except SceneError as error:
                raise error.in_file(str(self.scene)) from None

    def write_result(self, **values: Any) -> None:
        write_atomically(self.result, json.dumps(finite(as_json(values)), indent=2) + "\n")

    def read_result(self) -> dict[str, Any] | None:
        return read_json(self.result) if self.result.exists() else None

    def append_metrics(self, **values: Any) -> None:
        """Append a line to metrics.jsonl. The line is kept if the process is killed afterwards."""
        line = json.dumps(values, default=plain) + "\n"
        with sentences(self.metrics), open(self.metrics, "a", encoding="utf-8") as file:
            file.write(line)

    def write_metrics(self, columns: Mapping[str, Any]) -> None:
        rows = (dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True))
        lines = [json.dumps({"step": step, **row}, default=plain) + "\n" for step, row in enumerate(rows, 1)]
        write_atomically(self.metrics, "".join(lines))

    def read_metrics(self) -> list[dict[str, Any]]:
        """Read the lines of metrics.jsonl, without an unfinished last line. Raises `InputError` for a damaged line."""
        if not self.metrics.exists():
            return []
        try:
            return [parsed_json(line) for line in bytes_of(self.metrics).split(b"\n")[:-1]]
        except ValueError as problem:
            raise InputError(f"{self.metrics} contains a line that is not JSON: {problem}.") from problem

    def _holds_run(self) -> bool:
        try:
            return "cortado" in dict(parsed_json(bytes_of(self.environment)))
        except (InputError, ValueError, TypeError):
            return False

    def _complete(self, noted: Mapping[str, Any], scene_json: str) -> None:
        write_atomically(self.environment, json.dumps(noted, indent=2) + "\n")
        write_atomically(self.scene, scene_json)
        self.figures.mkdir(exist_ok=True)

    def _make_room(self, kind: str, overwrite: bool) -> None:
        present = [name for name in (self.environment.name, *_FILES, *_FOLDERS) if (self.path / name).exists()]
        if not present and Path.cwd().is_relative_to(self.path.resolve()):
            raise InputError(f"{self.path} is or contains the current folder; choose another --out.")
        runs = [] if present else sorted(one.parent.name for one in self.path.glob(f"*/{self.environment.name}"))
        if runs:
            raise InputError(f"{self.path} contains other runs, such as {runs[0]}; choose another --out.")
        if present and not self._holds_run():
            raise InputError(f"{self.path} holds {', '.join(present)}, but no run of Cortado; choose another --out.")
        if present and not overwrite:
            resumable = kind in ("run", "optimise") and kind == read_json(self.environment).get("kind")
            advice = f"replace the run with --overwrite{', or continue the run with --resume' if resumable else ''}"
            raise InputError(f"{self.path} already holds a run; choose another --out, or {advice}.")
        self._remove_unfinished()
        if not present:
            return
        written = (*map(self.figures.joinpath, FIGURES), *map(self.path.joinpath, _FILES))
        for path in (*(folder / REPLAY_LOG for folder in self._checkpoints()), *written):
            path.unlink(missing_ok=True)
        for folder in (*self._checkpoints(), self.figures):
            with suppress(OSError):  # it is not there, or something of the user's is in it
                folder.rmdir()
        self.environment.unlink()

    def _remove_unfinished(self) -> None:
        for folder in (self.path, self.figures, *self._checkpoints()):
            for path in folder.glob(UNFINISHED):
                path.unlink(missing_ok=True)

    def _checkpoints(self) -> list[Path]:
        return [*self.checkpoint.glob("[0-9]*/"), self.checkpoint]


def computed(scene: Any) -> Any:
    """Return a scene without the tables for pictures and readings."""
    shown = ("picture", "sensor")
    return {name: table for name, table in scene.items() if name not in shown} if isinstance(scene, dict) else scene


def finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: finite(entry) for name, entry in value.items()}
    if isinstance(value, list):
        return [finite(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def bytes_of(path: Path) -> bytes:
    try:
        return content(path, LARGEST)
    except OSError as problem:
        raise InputError(f"{path} cannot be read: {reason(problem)}.") from problem


def read_json(path: Path) -> Any:
    try:
        return parsed_json(bytes_of(path))
    except ValueError as problem:
        raise InputError(f"{path} cannot be read: {reason(problem)}.") from problem


def session(command: Sequence[str], device: str) -> dict[str, Any]:
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
    if hasattr(value, "tolist"):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} has no JSON form")


def as_json(value: Any) -> Any:
    return json.loads(json.dumps(value, default=plain))


def require_same(former: Any, given: Any, folder: Path) -> None:
    for name, (before, now) in sorted(differences(former, given).items()):
        field = ".".join(part if not part.isdigit() else f"[{part}]" for part in name.split(".")).replace(".[", "[")
        found = f"The run in {folder} was begun with {field} = {_written(before)} and is now given"
        raise InputError(f"{found} {field} = {_written(now)}; give the former value, or choose another --out.")


def differences(one: Any, other: Any, missing: Any = None, name: str = "") -> dict[str, list[Any]]:
    """Return pairs of different values by dotted name. A name without a value has the value ``missing``."""
    are_lists = all(isinstance(own, list) and any(isinstance(e, Mapping) for e in own) for own in (one, other))
    if isinstance(one, Mapping) and isinstance(other, Mapping):
        pairs = {key: (one.get(key, missing), other.get(key, missing)) for key in {**one, **other}}
    elif are_lists and len(one) == len(other):
        pairs = {str(k): pair for k, pair in enumerate(zip(one, other, strict=True))}
    else:
        return {} if one == other else {name: [one, other]}
    before = f"{name}." if name else ""
    each = [differences(*values, missing, f"{before}{part}") for part, values in pairs.items()]
    return {key: pair for found in each for key, pair in found.items()}


def _written(value: Any) -> str:
    if value is None:
        return "nothing"
    return json.dumps(value)[: 2 * LONGEST] if isinstance(value, dict) else shown(value)


def _version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def _mark(path: str) -> str:
    return sha256(bytes_of(Path(path))).hexdigest()
