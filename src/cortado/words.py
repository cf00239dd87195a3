"""Objects in a few words, for their ``repr`` and for sentences: how many, how large, never the numbers of an array."""

from collections.abc import Iterable, Mapping
from dataclasses import fields
from typing import Any


def counted(number: int, noun: str) -> str:
    """Return a number with its noun, ``1 phase`` or ``2 phases``."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def quoted(names: Iterable[str]) -> str:
    """Return names as a sentence shows them: ``'gravity', 'viscosity'``."""
    return ", ".join(f"'{name}'" for name in names) or "none"


def point_in_words(point: Iterable[float]) -> str:
    """Write the coordinates of a point, in brackets."""
    return f"({', '.join(f'{value:g}' for value in point)})"


def sized(arrays: Mapping[str, Any]) -> str:
    """Return names with the shapes of their arrays: ``gravity (3,), viscosity``."""
    shapes = {name: getattr(value, "shape", ()) for name, value in arrays.items()}
    return ", ".join(f"{name} {shape}" if shape else name for name, shape in shapes.items())


class ShortRepr:
    """A base of dataclasses (made with ``repr=False``) whose arrays are shown by their shapes."""

    def __repr__(self) -> str:
        values = {field.name: getattr(self, field.name) for field in fields(self)}  # type: ignore[arg-type]
        shown = (f"{name}={_brief(value)}" for name, value in values.items())
        return f"{type(self).__name__}({', '.join(shown)})"


def _brief(value: Any) -> str:
    if isinstance(value, dict):
        return f"{{{', '.join(f'{name}: {_brief(entry)}' for name, entry in value.items())}}}"
    shape = getattr(value, "shape", ())
    return f"array {shape}" if shape else repr(value)
