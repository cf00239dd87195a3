"""Lyapunov exponents from tangents: pushed along a run, and made orthonormal again now and then (Benettin et al. 1980).

The logarithms of the factors that QR takes out add up to the exponents, greatest first.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

Push = Callable[[Any, NDArray[np.float64]], tuple[Any, NDArray[np.float64]]]
"""A state and tangents (k, m) to the state and tangents a segment later."""


def growth_by_segment(push: Push, state: Any, vectors: NDArray[np.float64], segments: int) -> NDArray[np.float64]:
    """Logarithms (segments, k) of the growth of each direction within each segment; ``vectors`` (k, m) to start with,
    k at most m."""
    logarithms = np.empty((segments, len(vectors)))
    frame = np.linalg.qr(vectors.T)[0].T
    for n in range(segments):
        state, pushed = push(state, frame)
        q, r = np.linalg.qr(pushed.T)
        frame = q.T
        with np.errstate(divide="ignore"):  # a direction that was lost has shrunk to nothing
            logarithms[n] = np.log(np.abs(np.diag(r)))
    return logarithms
