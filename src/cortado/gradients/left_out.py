"""Runs of an ensemble that its average leaves out, as there are none: they diverged, or do not fit the scene."""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from cortado.errors import CortadoWarning, DivergedError, OutOfRangeError, warn
from cortado.gradients.ensemble_members import Ensemble
from cortado.gradients.estimator import Differentiable, Estimate
from cortado.gradients.points import without_runs
from cortado.rollout.rollout import Observer
from cortado.scene.parameters.values import Values

MOST = 0.25
"""Share of what is averaged that may be left out; with more the average would be that of another ensemble."""
ADVICE = "take a smaller spread, or a logarithm (cortado.optimisation.transforms)"


class LeftOutWarning(CortadoWarning):
    """An average is one over fewer runs than were asked for."""


def remaining(runs: Sequence[Estimate], members: int, what: str) -> np.ndarray:
    """(members,) whether each member of an ensemble can be averaged, given the runs of one member after the other. One
    run that there is not leaves its whole member out, so that those that remain are as symmetric about the parameters
    as before.

    ``what``: the members in words, in the plural. Warns of what is left out; where that is more than `MOST` of all, it
    raises the error of the first run that there is not.
    """
    errors = [getattr(one, "diverged", None) for one in runs]  # an estimator of one's own may return anything
    lost = np.array([error is not None for error in errors], dtype=bool).reshape(members, -1)
    kept = np.array([not any(member) for member in lost], dtype=bool)
    out = int(np.count_nonzero(~kept))
    if not out:
        return kept
    present = [error for error in errors if error is not None]
    said = f"{without_runs(present, f'{lost.size} runs of the ensemble')}, by which {out} of {len(kept)} {what}"
    if out > MOST * len(kept):
        preface = f"{said} cannot be averaged, but at most a quarter may be left out: {ADVICE}. The first:"
        if isinstance(present[0], DivergedError):
            raise present[0].among_others(preface)
        raise OutOfRangeError(f"{preface} {present[0]}")
    warn(f"{said} are left out of the average. The first: {present[0]}", LeftOutWarning)
    return kept


@dataclass
class Tally:
    """An `Ensemble` that is asked again and again, such as by a search: it counts the runs that averages leave out, and
    warns the first time alone."""

    ensemble: Any
    left_out: int = 0
    """Runs, over all estimates."""

    def estimate(self, problem: Differentiable, parameters: Values, observe: Observer | None = None) -> Estimate:
        """That of the ensemble."""
        with warnings.catch_warnings():
            if self.left_out:
                warnings.simplefilter("ignore", LeftOutWarning)
            found = self.ensemble.estimate(problem, parameters, observe)
        self.left_out += found.left_out
        return found


def tallied(estimator: Any) -> Any:
    """An ensemble as a `Tally`; anything else as it is."""
    return Tally(estimator) if isinstance(estimator, Ensemble) else estimator
