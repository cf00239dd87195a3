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
    names = _names(kernel)
    surplus = [name for name in given if name not in names]
    if surplus:
        raise TypeError(f"kernel {kernel.key} has no argument {surplus[0]!r}; it has {', '.join(names)}.")
    sources, bundled = (given, *groups), bundles_of(kernel)

    def found(name: str) -> Any:
        for source in sources:
            if name in source:
                return source[name]
        known = ", ".join(dict.fromkeys(known for source in sources for known in source))
        raise TypeError(
            f"argument {name!r} of kernel {kernel.key} is missing; it has {', '.join(names)}; known are {known}."
        )

    def argument(one: Any) -> Any:
        if one.label not in bundled:
            return found(one.label)
        return bundles.filled(one.type, {field: found(name) for field, name in bundled[one.label].items()})

    return [argument(one) for one in kernel.adj.args]


@cache
def _names(kernel: wp.Kernel) -> tuple[str, ...]:
    """Of all arguments, with the arrays of bundles in their place."""
    bundled = bundles_of(kernel)
    return tuple(name for a in kernel.adj.args for name in bundled.get(a.label, {a.label: a.label}).values())
