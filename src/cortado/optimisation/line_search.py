"""Descent along the gradient with several step lengths tried at a time."""

from dataclasses import dataclass

import numpy as np

from cortado.arrays import is_whole, require_at_most
from cortado.device.memory import require
from cortado.errors import InputError, shown
from cortado.fixed import keep_own
from cortado.optimisation.iterate import Iterate
from cortado.optimisation.replay_log import ParameterLayout, Vector
from cortado.optimisation.search import (
    Outcome,
    PerParameter,
    Search,
    require_fraction,
    require_names,
    require_positive,
)

MOST_TRIALS = 1_000
"""Trials of an update; more are taken for a mistake, as each is a run."""
GROWTH = 3.0
"""How much longer than the best length the longest one may be at the next update."""


@dataclass(frozen=True)
class LineSearch:
    """Descent along the gradient, as far as the best of several lengths that are tried in one launch.

    For losses that are rough, and for gradients that have the right direction and not the right size, such as those of
    long runs: a search steps over dents that are narrower than its trials, and never to where the run diverges or
    parameters are out of their range. A trial is a run without a gradient, and all trials of an update are one batch.

    Formula: with g the gradient times the scale, and unit(a) = a over its root mean square,

        d_k = unit(momentum d_{k-1} - unit(g_k)),   x_{k+1} = the best of P(x_k + r_k s scale d_k),

    over lengths s at even ratios from ``shortest`` to 1; P projects onto the bounds. The reach r is 1 at first, and
    then `GROWTH` times the length that was best, at most 1. Where no trial lowers the loss, at the bottom of a dent or
    of the valley, an update still takes the best one, and the reach is 1 again, by which the search leaves dents. So
    the last iterate need not be the best. Where every trial diverges, x stays, the momentum is dropped, and the reach
    is ``shortest`` times what it was. Where the gradient of the best one diverges, as that of an ensemble may, x moves
    a part of the way, and the reach is that part of what it would be. There is no test of convergence: all the
    iterations are made.

    Raises InputError for settings out of range.
    """

    scale: PerParameter = 1.0
    """The longest change worth trying, one number or one per parameter by name [unit of the parameter]."""
    trials: int = 5
    """Lengths that are tried at a time, at most 1,000."""
    shortest: float = 1.0 / 64.0
    """Of these lengths, over the longest."""
    momentum: float = 0.5
    """How much of the direction before is kept, in [0, 1) [-]."""

    def __post_init__(self) -> None:
        require_positive("scale", self.scale)
        keep_own(self, "scale")
        require_fraction("momentum", self.momentum)
        require_fraction("shortest", self.shortest)
        if not is_whole(self.trials) or self.trials < 2 or self.shortest == 0.0:
            raise InputError(
                f"trials is {shown(self.trials)} and shortest {shown(self.shortest)}, but must be at least 2 and "
                "greater than 0."
            )
        require_at_most("trials", self.trials, MOST_TRIALS)

    def check(self, layout: ParameterLayout) -> None:
        """Raise InputError if the scales are not those of these parameters, or there is no memory for the trials."""
        require_names("scale", self.scale, layout)
        require({f"{self.trials:,} trials": 16.0 * self.trials * layout.size}, "take fewer trials")

    def minimise(self, search: Search) -> Outcome:
        """Make at most `search.iterations` updates, of one gradient and some trials each; evaluate the last iterate."""
        scale, at, reach = search.layout.spread(self.scale), Iterate(search), 1.0
        along = np.zeros_like(at.x)
        for _ in range(search.iterations):
            along = unit(self.momentum * along - unit(at.gradient * scale))
            lengths = reach * np.geomspace(self.shortest, 1.0, self.trials)
            tried = [search.project(at.x + length * scale * along) for length in lengths]
            losses = search.losses(tried)
            best = int(np.argmin(losses))
            if np.isfinite(losses[best]):
                reach = min(GROWTH * lengths[best], 1.0) if losses[best] < at.loss else 1.0
                reach *= at.move(tried[best])
            else:
                along, reach = np.zeros_like(at.x), reach * self.shortest
                at.move(at.x)
        return at.outcome("The line search")


def unit(vector: Vector) -> Vector:
    """A vector (size,) divided by its root mean square, or 0."""
    greatest = np.abs(vector).max(initial=0.0)
    scaled = vector / greatest if greatest else vector
    size = np.sqrt(np.mean(scaled**2)) if greatest else 1.0
    return scaled / size
