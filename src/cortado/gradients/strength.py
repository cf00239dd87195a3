"""How strong a smoothing of the adjoint has to be for it not to grow exponentially.

Ladder, `AdjointViscosity.limit` and the factor on the least strength were chosen on dam breaks of 144 particles in the
plane, of 400 and 800 steps, with four losses and two first states (for the second order eight);
`validation/gradients.py` judges them on others.
"""

from collections.abc import Callable

import numpy as np

LADDER = (0.0125, 0.025, 0.0375, 0.05, 0.075, 0.1, 0.15, 0.2, 0.3, 0.5)
"""Strengths that are tried, weakest first, after 0."""
MOST_GROWTH = 1.0
"""e-folds over all steps that are not taken for exponential growth."""


def sufficient(history: Callable[[float], np.ndarray], time_step: float) -> float:
    """The weakest rung of the ladder with which the adjoint's norm stops growing, the strongest where none does it, and
    0 where it does not grow anyway.

    ``history`` (steps + 1, 2): norms of the adjoints of positions and velocities with a strength.
    """
    for strength in (0.0, *LADDER):
        if growth(history(strength), time_step) <= MOST_GROWTH:
            return strength
    return LADDER[-1]


def growth(norms: np.ndarray, time_step: float) -> float:
    """e-folds of an adjoint from the last state to the first, by the slope of a line through the logarithm of its norm.

    In the norm sqrt(|x^|^2 + |v^|^2 / T^2), T the time of the whole run, free flight, in which v^ grows linearly, is no
    growth to speak of.
    """
    steps = len(norms) - 1
    total = np.hypot(norms[:, 0], norms[:, 1] / max(steps * time_step, 1e-300))[::-1]
    there = np.flatnonzero(total > 0.0)
    if len(there) < 3:
        return 0.0
    if not np.isfinite(total).all():
        return np.inf
    return float(np.polyfit(there, np.log(total[there]), 1)[0] * (there[-1] - there[0]))
