"""Bundles: several arrays that a kernel takes as one argument, so that its arguments can be read.

A launch finds the arrays of a bundle by their names, as it finds arguments (`cortado.device.binding`). In a bundle
called ``dot`` or ``bar``, x is the array ``x_dot`` or ``x_bar``. Kernels with few arrays take them one by one: with a
bundle, that of the density is 6 % slower on an H200. Kernels that a tape differentiates take them
one by one too.
"""

from collections.abc import Iterable, Iterator, Sequence
from functools import cache
from typing import Any

import warp as wp

MOST = 4_096
"""Filled bundles that are kept; then all are let go, and filled anew."""
_FIELDS: dict[Any, tuple[str, ...]] = {}
"""Names of the arrays of each bundle."""


def bundle(**entries: Any) -> Any:
    """The Warp struct of arrays of these names, with entries of these types."""
    return _bundle(tuple(entries.items()))


@cache
def _bundle(entries: tuple[tuple[str, Any], ...]) -> Any:
    words = (f"{name}_{wp.types.type_size_in_bytes(kind)}" for name, kind in entries)
    arrays = {name: wp.array(dtype=kind) for name, kind in entries}
    made = wp.struct(type("_".join(("Bundle", *words)), (), {"__annotations__": arrays, "__module__": __name__}))
    _FIELDS[made] = tuple(arrays)
    return made


@cache
def bundles_of(kernel: wp.Kernel) -> dict[str, dict[str, str]]:
    """The arguments of a kernel that are bundles: the names of the arrays that their fields are."""
    found = {a.label: _FIELDS[a.type] for a in kernel.adj.args if a.type.__hash__ and a.type in _FIELDS}
    return {label: {name: _array(name, label) for name in fields} for label, fields in found.items()}


def _array(field: str, label: str) -> str:
    return f"{field}_{label}" if label in ("dot", "bar") else field


def unbundled(arguments: Iterable[Any]) -> Iterator[Any]:
    """The arguments of a launch, with its arrays instead of the bundles that they are in."""
    for argument in arguments:
        struct = getattr(argument, "_cls", None)
        if struct in _FIELDS:
            yield from (getattr(argument, name) for name in _FIELDS[struct])
        else:
            yield argument


class Bundles:
    """Bundles filled with arrays. Filling one takes longer than a launch, so that they are kept."""

    def __init__(self) -> None:
        self._filled: dict[tuple[Any, ...], Any] = {}

    def clear(self) -> None:
        """Let go of them and of their arrays; the next launches fill theirs anew."""
        self._filled.clear()

    def filled(self, struct: Any, arrays: Sequence[wp.array]) -> Any:
        """The bundle of a type with these arrays, in the order of its fields."""
        key = (struct, *map(id, arrays))  # a bundle holds its arrays, so that their ids stay theirs
        found = self._filled.get(key)
        if found is None:
            if len(self._filled) >= MOST:
                self.clear()
            found = self._filled[key] = struct()
            for name, array in zip(_FIELDS[struct], arrays, strict=True):
                setattr(found, name, array)
        return found
