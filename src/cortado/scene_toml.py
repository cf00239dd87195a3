"""From a TOML file and overrides such as ``solver.time_step=0.002`` to a dictionary."""

import os
import re
import tomllib
from collections.abc import Sequence
from typing import Any

from cortado.errors import SceneError

_KEY = re.compile(r"[A-Za-z0-9_-]+(\[\d+\])*(\.[A-Za-z0-9_-]+(\[\d+\])*)*")


def read_toml(path: str | os.PathLike[str], overrides: Sequence[str] = ()) -> dict[str, Any]:
    """The contents of a TOML file with overrides put in. Raises `SceneError`.

    An override is ``key=value``: ``forces.gravity=[0,-5,0]``, ``fluid.0.upper=[1,1,1]`` or ``fluid[0].upper=[1,1,1]``.
    A value that is not TOML is taken as text.
    """
    file = os.fspath(path)
    try:
        with open(path, "rb") as stream:
            data = tomllib.loads(stream.read().decode("utf-8"))
    except UnicodeDecodeError as problem:
        line = problem.object[: problem.start].count(b"\n") + 1
        raise _unreadable(file, f"is not text in UTF-8 (at line {line}).") from None
    except (ValueError, RecursionError) as problem:  # among them TOMLDecodeError, which names the line
        raise _unreadable(file, f"is not valid TOML: {_reason(problem)}.") from None
    except OSError as problem:
        raise _unreadable(file, f"cannot be read: {_reason(problem)}.") from None
    for override in overrides:
        _apply(data, override, file)
    return data


def _unreadable(file: str, sentence: str) -> SceneError:
    return SceneError(file, "", sentence=sentence)


def _reason(problem: BaseException) -> str:
    text = getattr(problem, "strerror", None) or str(problem) or type(problem).__name__
    return " ".join(text.split()).rstrip(".")


def _apply(data: dict[str, Any], override: str, file: str) -> None:
    """Put one override in."""
    key, equals, text = override.partition("=")
    key = key.strip()
    if not equals or not _KEY.fullmatch(key):
        raise SceneError(file, repr(override), sentence="is not an override of the form key=value.")
    parts = key.replace("[", ".").replace("]", "").split(".")
    place: Any = data
    for depth, part in enumerate(parts):
        last = depth == len(parts) - 1
        index: str | int = part
        if isinstance(place, list):
            if not part.isdecimal() or int(part) >= len(place):
                wanted = f"an index from 0 to {len(place) - 1}" if place else "left out, as the list is empty"
                raise SceneError(file, key, part, wanted)
            index = int(part)
        elif not isinstance(place, dict):
            raise SceneError(file, key, sentence=f"cannot be set, as {'.'.join(parts[:depth])} is not a table.")
        elif not last:
            place.setdefault(part, {})
        if last:
            place[index] = _value(text.strip())
        else:
            place = place[index]


def _value(text: str) -> Any:
    """A TOML value, or the text itself."""
    try:
        parsed = tomllib.loads(f"value = {text}")
    except (ValueError, RecursionError):
        return text
    return parsed["value"] if parsed.keys() == {"value"} else text
