"""The arguments of a kernel, found by their names."""

from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any

import warp as wp

from cortado.device.bundles import Bundles, bundles_of

Named = Mapping[str, Any]
"""Arguments of kernels by name, of which a launch takes those that its kernel has."""


def bound(kernel: wp.Kernel, groups: Sequence[Named], given: Named, bundles: Bundles) -> list[Any]:
    """The arguments of a kernel in its order: out of ``given``, all of which it must have, and out of the first of the
    ``groups`` that has them, which may hold more. A bundle is filled with the arrays that it names.

    Kernels take many arrays of one type, and nothing else would notice a mistake: raises `TypeError` for an argument
    that is missing or that the kernel does not have.
    """
    names, arguments = _signature(kernel)
    for name in given:
        if name not in names:
            raise TypeError(f"kernel {kernel.key} has no argument {name!r}; it has {', '.join(names)}.")
    sources, found = (given, *groups), []
    for name, struct, arrays in arguments:
        if struct is None:
            found.append(_found(name, sources, kernel))
        else:
            found.append(bundles.filled(struct, [_found(array, sources, kernel) for array in arrays]))
    return found


def _found(name: str, sources: Sequence[Named], kernel: wp.Kernel) -> Any:
    for source in sources:
        if name in source:
            return source[name]
    names, known = _signature(kernel)[0], ", ".join(dict.fromkeys(known for source in sources for known in source))
    raise TypeError(
        f"argument {name!r} of kernel {kernel.key} is missing; it has {', '.join(names)}; known are {known}."
    )


@cache
def _signature(kernel: wp.Kernel) -> tuple[dict[str, None], tuple[tuple[str, Any, tuple[str, ...]], ...]]:
    """All names, with the arrays of bundles in their place; and each argument with its bundle's type and arrays."""
    bundled = bundles_of(kernel)
    arguments = tuple(
        (a.label, a.type if a.label in bundled else None, tuple(bundled.get(a.label, {}).values()))
        for a in kernel.adj.args
    )
    return dict.fromkeys(name for label, _, arrays in arguments for name in (arrays or (label,))), arguments
