"""What a run folder notes of where and with what it was begun, and whether it may go on with what is given now."""

from __future__ import annotations

import json
import platform
import sys
from collections.abc import Sequence
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any

from cortado.errors import LONGEST, InputError, shown
from cortado.version import __version__

_PACKAGES = ("warp-lang", "numpy", "scipy", "pydantic", "h5py", "matplotlib")


def session(command: Sequence[str], device: str) -> dict[str, Any]:
    """Where and when a part of a run happens: operating system, Python, the versions that matter, the command."""
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
    """NumPy numbers and arrays as Python numbers and lists."""
    if hasattr(value, "tolist"):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} has no JSON form")


def as_json(value: Any) -> Any:
    """A value as it comes back from a file: arrays and tuples are lists."""
    return json.loads(json.dumps(value, default=plain))


def require_same(former: Any, given: Any, folder: Path, field: str = "") -> None:
    """Raise InputError, with the field, where what is given differs from what the run in a folder was begun with."""
    if isinstance(former, dict) and isinstance(given, dict):
        for name in sorted({*former, *given}):
            require_same(former.get(name), given.get(name), folder, f"{field}.{name}".lstrip("."))
    elif _are_tables(former) and _are_tables(given) and len(former) == len(given):
        for k, pair in enumerate(zip(former, given, strict=True)):
            require_same(*pair, folder, f"{field}[{k}]")
    elif former != given:
        raise InputError(
            f"The run in {folder} was begun with {field} = {_written(former)} and is now given {field} = "
            f"{_written(given)}; give the former, or choose another --out."
        )


def _written(value: Any) -> str:
    """As in a file; what is left out has no value."""
    if value is None:
        return "nothing"
    return json.dumps(value)[: 2 * LONGEST] if isinstance(value, dict) else shown(value)


def _are_tables(value: Any) -> bool:
    return isinstance(value, list) and all(isinstance(entry, dict) for entry in value)


def _version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None
