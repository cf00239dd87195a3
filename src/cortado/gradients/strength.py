"""The strength of `AdjointViscosity` that is needed for the adjoint not to grow exponentially.

The ladder, `AdjointViscosity.limit` and the factor on the least strength were chosen on dam breaks of 144 particles in
the plane, of 400 and 800 steps, with four losses and two first states (for the second order eight);
`validation/gradients.py` tests them on others.
"""

from collections.abc import Callable

import numpy as np

LADDER = (0.0125, 0.025, 0.0375, 0.05, 0.075, 0.1, 0.15, 0.2, 0.3, 0.5)
"""Strengths that are tried, weakest first, after 0."""
MOST_GROWTH = 1.0
"""Growth over all steps, in e-folds, up to which an adjoint counts as not growing exponentially."""


def sufficient(history: Callable[[float], np.ndarray], time_step: float) -> float:
    """The smallest strength of the ladder with which the adjoint's norm does not grow exponentially.

    0 where it does not grow without; the greatest strength where it grows with every one. ``history`` computes, for a
    strength, the norms (steps + 1, 2) of the adjoints of positions and velocities.
    """
    for strength in (0.0, *LADDER):
        if growth(history(strength), time_step) <= MOST_GROWTH:
            return strength
    return LADDER[-1]


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
