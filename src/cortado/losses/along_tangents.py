"""The derivative of the losses of a run along a direction, from tangents of the states that they judge."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from cortado.losses.loss import SnapshotAdjoint, by_field
from cortado.scene.parameters.values import Arrays


def derivative_along(
    bars: Mapping[int, SnapshotAdjoint],
    dots: Mapping[int, Arrays],
    colours_dot: Any,
    leading: tuple[int, ...],
) -> np.ndarray:
    """The sum of all products of adjoints and tangents, in the shape ``leading``: (batch,), or () of a single scene.

    ``bars`` are the adjoints of the states by the number of steps before them, ``dots`` their tangents by the names of
    fields and quantities, vectors (n, 3), ``colours_dot`` (phases, 3) the tangent of the colours, None where they stay.
    """

    def product(bar: np.ndarray, dot: Any) -> np.ndarray:
        each = bar.astype(np.float64) * np.asarray(dot, dtype=np.float64)
        return np.asarray(each.reshape(*leading, -1).sum(axis=-1))

    terms = [] if colours_dot is None else [product(bar.colours, colours_dot) for bar in bars.values()]
    for step in sorted(dots):
        bar = by_field(bars[step], 3)
        terms += [product(bar[name], dot) for name, dot in dots[step].items()]
    return sum(terms, np.zeros(leading))
