"""Which part of a moving fluid a picture shows: its bulk, and not the drops that were spilt and fall for ever."""

from collections.abc import Sequence

import numpy as np

from cortado.discretise.domain import WITHOUT_PERIODS, Domain
from cortado.discretise.shapes import Points
from cortado.pictures.shown_solids import union

DROPS = 0.002
"""The share of particles at either end of an axis that may lie outside of a picture."""
SPILT, BEYOND = 0.1, 0.15
"""The share of particles at either end of an axis that does not widen the picture if it is far away; and how much wider
than all others a picture is, in their widths."""
NEAR = 0.25
"""How far from the first state, solids and container fluid is near enough for every drop to count, in their size."""
ENOUGH = 1_000_000
"""Positions, of all particles in all frames, that tell where the fluid comes to."""


def thinned(positions: Points | Sequence[Points], domain: Domain = WITHOUT_PERIODS) -> list[Points]:
    """The states (m, d) [m] that say where the fluid comes to, of positions (n, d) or (frames, n, d) [m]: all of them,
    with `ENOUGH` positions together if there are more, as their images within the period of a domain."""
    states = [positions] if isinstance(positions, np.ndarray) and positions.ndim == 2 else list(positions)
    stride = max(sum(map(len, states)) // ENOUGH, 1)
    return [domain.wrapped(state[k % min(stride, len(state) or 1) :: stride]) for k, state in enumerate(states)]


def fluid_extent(states: Sequence[Points], around: Sequence[tuple[Points, Points]]) -> tuple[Points, Points]:
    """Lower and upper ends (d,) [m] of the fluid that a picture shows, in states (n, d) [m].

    ``around`` are the ends of everything else in the picture. All of the first state counts. Of a later state the bulk
    counts, and drops that are near the first state and near everything else: drops that fall far away do not make the
    rest of the picture small.
    """
    first, *later = states
    found = [_ends(first, DROPS)]
    lower, upper = union([*found, *around])
    near = NEAR * float(np.max(upper - lower))
    for state in later:
        low, high = _ends(state, SPILT)
        found.append(
            (
                np.maximum(low - BEYOND * (high - low), state.min(axis=0)),
                np.minimum(high + BEYOND * (high - low), state.max(axis=0)),
            )
        )
        close = state[((state > lower - near) & (state < upper + near)).all(axis=1)]
        found += [_ends(close, DROPS)] if len(close) else []
    return union(found)


def _ends(positions: Points, share: float) -> tuple[Points, Points]:
    """Lower and upper ends (d,) [m] of positions (n, d) [m] without a share of them at either end of each axis."""
    lower, upper = np.quantile(positions, (share, 1.0 - share), axis=0)
    return lower, upper
