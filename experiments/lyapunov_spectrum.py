"""Lyapunov exponents from tangents that are made orthonormal after each segment of a run (Benettin et al. 1980).

The exponents, greatest first, are the sums of the logarithms of the diagonal of R in the QR factorisations.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

Push = Callable[[Any, NDArray[np.float64]], tuple[Any, NDArray[np.float64]]]
"""Takes a state and tangents (k, m) to those one segment later."""


def growth_by_segment(push: Push, state: Any, vectors: NDArray[np.float64], segments: int) -> NDArray[np.float64]:
    """Logarithms (segments, k) of the growth of each direction within each segment.

    ``vectors`` (k, m) are the first tangents, with k at most m.
    """
    logarithms = np.empty((segments, len(vectors)))
    frame = np.linalg.qr(vectors.T)[0].T
    for n in range(segments):
        state, pushed = push(state, frame)
        q, r = np.linalg.qr(pushed.T)
        frame = q.T
        with np.errstate(divide="ignore"):  # of a direction that has become dependent on others
            logarithms[n] = np.log(np.abs(np.diag(r)))
    return logarithms
