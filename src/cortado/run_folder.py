"""The folder of one run: its scene, where and how it ran, its metrics, its trajectory and its pictures."""

from __future__ import annotations

import json
import os
import platform
import shutil
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any, Self

from cortado.errors import InputError

_PACKAGES = ("warp-lang", "numpy", "scipy", "pydantic", "h5py", "matplotlib")
_FILES = ("scene.json", "environment.json", "metrics.jsonl", "trajectory.vtkhdf", "report.html")
_FOLDERS = ("checkpoint", "figures")


@dataclass(frozen=True)
class RunFolder:
    """Paths and files of one run: `create` makes one, `open` finds one, `resume` goes on with one."""

    path: Path

    @classmethod
    def create(
        cls,
        path: str | Path,
        scene_json: str,
        command: Sequence[str],
        *,
        device: str = "",
        overwrite: bool = False,
    ) -> Self:
        """Makes the folder of a new run.

        Args:
            path: the folder, made with its parents when missing.
            scene_json: the resolved scene.
            command: the command line, word by word.
            device: where the run computes, in words.
            overwrite: removes an earlier run in this folder (its files only).

        Raises:
            InputError: the folder holds a run already, or files that a run would replace, or is not writable.
        """
        folder = cls(Path(path).absolute())
        with _sentences(folder.path):
            folder._make_room(overwrite)
            folder.figures.mkdir(parents=True, exist_ok=True)
            environment = {**_environment(), **_session(command, device), "resumed": []}
            write_atomically(folder.environment, json.dumps(environment, indent=2) + "\n")
            write_atomically(folder.scene, scene_json)
        return folder

    @classmethod
    def open(cls, path: str | Path) -> Self:
        """The folder of an existing run.

        Raises:
            InputError: there is no run in it.
        """
        folder = cls(Path(path).absolute())
        if not folder._holds_run():
            raise InputError(f"There is no run in {folder.path}.")
        return folder

    @classmethod
    def resume(cls, path: str | Path, scene_json: str, command: Sequence[str], *, device: str = "") -> Self:
        """The folder of an existing run that goes on, noted in environment.json with versions and command.

        Raises:
            InputError: there is no run in it, or one of another scene.
        """
        folder = cls.open(path)
        environment = _read_json(folder.environment)
        if _read_json(folder.scene) != json.loads(scene_json):
            raise InputError(
                f"The run in {folder.path} is of another scene than the one given; choose another --out, or "
                f"give the scene that it began with."
            )
        with _sentences(folder.path):
            environment["resumed"].append({**_environment(), **_session(command, device)})
            write_atomically(folder.environment, json.dumps(environment, indent=2) + "\n")
            _cut_torn_line(folder.metrics)
        return folder

    @property
    def scene(self) -> Path:
        """The resolved scene."""
        return self.path / "scene.json"

    @property
    def environment(self) -> Path:
        """Versions, device, command line and start of the run."""
        return self.path / "environment.json"

    @property
    def metrics(self) -> Path:
        """One JSON object a line."""
        return self.path / "metrics.jsonl"

    @property
    def trajectory(self) -> Path:
        """The recorded frames (VTKHDF)."""
        return self.path / "trajectory.vtkhdf"

    @property
    def checkpoint(self) -> Path:
        """The optimiser's own folder, from which it resumes."""
        return self.path / "checkpoint"

    @property
    def figures(self) -> Path:
        """The folder of the pictures."""
        return self.path / "figures"

    @property
    def report(self) -> Path:
        """The page that shows it all."""
        return self.path / "report.html"

    def append_metrics(self, **values: Any) -> None:
        """Adds one line to metrics.jsonl, kept even if the process is killed next; takes NumPy values too."""
        line = json.dumps(values, default=_plain) + "\n"
        with _sentences(self.path), open(self.metrics, "a", encoding="utf-8") as file:
            file.write(line)

    def read_metrics(self) -> list[dict[str, Any]]:
        """All lines of metrics.jsonl; a last line that a killed run left unfinished is left out.

        Raises:
            InputError: an earlier line is damaged.
        """
        if not self.metrics.exists():
            return []
        lines = self.metrics.read_bytes().split(b"\n")[:-1]
        try:
            return [json.loads(line) for line in lines]
        except ValueError as problem:
            raise InputError(f"{self.metrics} holds a line that is not JSON: {problem}.") from problem

    def _holds_run(self) -> bool:
        try:
            return "cortado" in json.loads(self.environment.read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return False

    def _make_room(self, overwrite: bool) -> None:
        present = [name for name in _FILES + _FOLDERS if (self.path / name).exists()]
        if not present:
            return
        if not self._holds_run():
            raise InputError(f"{self.path} holds {', '.join(present)}, but no run of Cortado; choose another --out.")
        if not overwrite:
            raise InputError(
                f"{self.path} already holds a run; choose another --out, or continue it with --resume, or "
                f"replace it with --overwrite."
            )
        for name in _FOLDERS:
            shutil.rmtree(self.path / name, ignore_errors=True)
        for name in sorted(_FILES, key="environment.json".__eq__):  # the mark of a run goes last
            (self.path / name).unlink(missing_ok=True)


def write_atomically(path: Path, content: str | bytes) -> None:
    """Writes a whole file under a temporary name and then renames it, so that no reader meets half of it."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with open(temporary, "wb") as file:
            file.write(content.encode() if isinstance(content, str) else content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def _sentences(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as problem:
        raise InputError(f"The run folder {path} cannot be written: {problem}.") from problem


def _environment() -> dict[str, Any]:
    """Where the run happens: operating system, Python, and the versions that matter."""
    return {
        "cortado": _version("cortado"),
        "python": platform.python_version(),
        "platform": platform.platform(),
        "executable": sys.executable,
        "packages": {name: _version(name) for name in _PACKAGES},
    }


def _session(command: Sequence[str], device: str) -> dict[str, Any]:
    now = datetime.now(UTC).isoformat(timespec="seconds")
    return {"device": device, "command": list(command), "started": now}


def _version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def _read_json(path: Path) -> Any:
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as problem:
        raise InputError(f"{path} cannot be read: {problem}.") from problem


def _cut_torn_line(path: Path) -> None:
    """Removes what a killed run left of a last line, so that the next line begins a line."""
    if path.exists():
        with open(path, "r+b") as file:
            file.truncate(file.read().rfind(b"\n") + 1)


def _plain(value: Any) -> Any:
    """NumPy numbers and arrays as Python numbers and lists."""
    if hasattr(value, "tolist"):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} has no JSON form")
