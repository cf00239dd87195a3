"""How fast the adjoint of a run grows on the way back."""

import numpy as np


def growth(norms: np.ndarray, time_step: float) -> float:
    """Growth of an adjoint from the last state to the first, in e-folds: of a line fitted to the logarithm of its norm.

    The norm is sqrt(|x^|^2 + |v^|^2 / T^2) with the time T of the whole run. In free flight, where v^ grows linearly,
    it hardly grows.
    """
    steps = len(norms) - 1
    total = np.hypot(norms[:, 0], norms[:, 1] / max(steps * time_step, 1e-300))[::-1]
    there = np.flatnonzero(total > 0.0)
    if len(there) < 3:
        return 0.0
    if not np.isfinite(total).all():
        return np.inf
    return float(np.polyfit(there, np.log(total[there]), 1)[0] * (there[-1] - there[0]))
