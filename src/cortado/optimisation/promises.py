"""What gradients promised of the steps of a search, beside what these brought."""

from dataclasses import dataclass, field

import numpy as np

from cortado.gradients import Exact
from cortado.optimisation.line_search import LineSearch
from cortado.optimisation.replay_log import LoggedEvaluation, ParameterLayout, Vector

WRONG = 10.0
"""A step contradicts its gradients if it changed the loss by less than the smaller promise of both its ends over this,
or by more than the greater one times this."""
FELT = 0.01
"""Of the range of all losses: smaller promises tell little, if the loss has not changed by more."""
ROUND_OFF = 1e-5
"""Of the greatest loss: smaller promises tell nothing, as losses of runs in float32 are not as precise."""
MISLED = 0.25
"""Share of the steps that tell, of which at least `FEW` have to contradict: in searches of 30 to 400 steps of a splash
it was 0 within the horizon, and 0.3 to 0.9 beyond it."""
FEW = 2
STAYED = 1.0 / 3.0
"""Share of the evaluations, the last ones, by which the loss has fallen by less than `FELT` where it stays."""
LEAST = 8
"""Evaluations from which on a loss may be said to stay."""


@dataclass
class Promises:
    """The evaluations of a search, each with the step to it from the one before.

    The slopes of the loss along a step, at both of its ends, bound its change unless the slope has an extremum in
    between: a loss that is as smooth as the steps are long keeps near to them. Steps along which the slope changes its
    sign tell nothing, as they may cross a valley.
    """

    losses: list[float] = field(default_factory=list)
    steps: list[tuple[float, float, float]] = field(default_factory=list, repr=False)
    """Of each step the change of the loss by the slope at its first end, by that at its last, and the change."""
    _last: LoggedEvaluation | None = field(default=None, repr=False)
    _best: LoggedEvaluation | None = field(default=None, repr=False)

    def note(self, evaluation: LoggedEvaluation) -> None:
        """The next evaluation."""
        if self._last is not None:
            step = evaluation.parameters - self._last.parameters
            with np.errstate(over="ignore", invalid="ignore"):
                promised = float(self._last.gradient @ step), float(evaluation.gradient @ step)
            self.steps.append((*promised, evaluation.loss - self._last.loss))
        self.losses.append(evaluation.loss)
        self._last = evaluation
        if self._best is None or evaluation.loss < self._best.loss:
            self._best = evaluation

    def held(self, lower: Vector, upper: Vector, layout: ParameterLayout) -> str:
        """A sentence that names parameters whose bounds keep the lowest loss from falling further; empty without."""
        if self._best is None:
            return ""
        best, gradient = self._best.parameters, self._best.gradient
        outwards = ((best <= lower) & (gradient > 0.0)) | ((best >= upper) & (gradient < 0.0))
        names = [name for name, marks in layout.unravel(np.where(outwards, 1.0, 0.0)).items() if marks.any()]
        found = " and ".join(names) + (" is at a bound" if len(names) == 1 else " are at bounds")
        return f" {found}, beyond which the loss falls further: widen them, if that makes sense." if names else ""

    @property
    def kept(self) -> tuple[int, int]:
        """How many steps contradict their gradients, and how many tell."""
        first, last, change = np.array(self.steps or np.zeros((0, 3))).T
        least, most = np.minimum(np.abs(first), np.abs(last)), np.maximum(np.abs(first), np.abs(last))
        felt = max(FELT * (max(self.losses) - min(self.losses)), ROUND_OFF * max(map(abs, self.losses)))
        tells = (np.sign(first) == np.sign(last)) & (np.maximum(most, np.abs(change)) > felt)
        along = np.sign(first) * change
        broken = (along < least / WRONG) | (along > most * WRONG)
        return int(np.count_nonzero(tells & broken)), int(np.count_nonzero(tells))

    @property
    def misled(self) -> bool:
        """Whether the loss does not do what gradients say."""
        broken, told = self.kept
        return broken >= max(FEW, MISLED * told)

    def stays(self, converged: bool) -> bool:
        """Whether the loss has stopped to fall while it is still a good part of the first one."""
        best, before = min(self.losses), min(self.losses[: -max(int(STAYED * len(self.losses)), 1)], default=np.inf)
        stopped = len(self.losses) >= LEAST and before - best < FELT * abs(best)
        return best > FELT * self.losses[0] and (converged or stopped)

    def doubt(self, estimator: object, optimiser: object, converged: bool, is_run: bool, held: str = "") -> "Doubt":
        """Of a search by an ``estimator``, None for that of the problem, and an ``optimiser`` whose own test may be
        met; ``is_run``: of runs of a simulation; ``held``: what `held` says. A line search bears estimators whose sizes
        are wrong."""
        by_direction, is_exact = isinstance(optimiser, LineSearch), estimator is None or isinstance(estimator, Exact)
        misled, stays = self.misled and (is_exact or not by_direction), not held and self.stays(converged)
        to_try = ["another start"]
        if misled:
            broken, told = self.kept
            said = f" The gradient disagrees with what steps did: in {broken} of {told} that tell, the loss changed by"
            said += " less than a tenth of what it promised, or by more than ten times as much."
            if is_run and is_exact:
                said += " certify says up to which step of the run it is of use; beyond that, search with the gradient"
                return Doubt(misled, stays, f"{said} AdjointViscosity() and the optimiser LineSearch, or elsewhere.")
            to_try += [] if is_run else ["differences, to check it"]
        elif stays:
            said = f" The loss has stayed at {min(self.losses) / self.losses[0]:.0%} of the first one, maybe in a wrong"
            said += " valley."
            to_try += ["fewer steps"] if is_run else []
            if is_run and is_exact:
                pair = "the gradient AdjointViscosity() with the optimiser LineSearch"
                said += f" Try {', or '.join(to_try)}; or {pair}, where certify says that the exact one is of no use."
                return Doubt(misled, stays, said)
        else:
            return Doubt(misled, stays, held)
        to_try += [] if by_direction else ["the optimiser LineSearch, which steps over dents"]
        return Doubt(misled, stays, f"{said} Try {', or '.join(to_try)}.")


@dataclass(frozen=True)
class Doubt:
    """Whether a search can be trusted."""

    misled: bool
    """Its gradient disagreed with what steps did, and it did not go by its direction alone."""
    stays: bool
    """Its loss has stopped to fall while it is still a good part of the first one."""
    words: str
    """Sentences that say so, and what to try; empty where there is nothing to say."""
