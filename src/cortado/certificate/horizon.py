"""The horizon: the number of steps up to which the exact gradient predicts what a meaningful perturbation does."""

from dataclasses import dataclass

import numpy as np

from cortado.certificate.loss_history import LossHistory
from cortado.scene.parameters.values import Arrays
from cortado.words import ShortRepr

WITHIN = 0.25
"""The exact derivative counts as useful where its relative distance from the finite difference is at most this."""
LINEAR = 0.3
"""Relative displacement of neighbours up to which their forces are nearly linear in it [spacings]."""


@dataclass(frozen=True, repr=False)
class Horizon(ShortRepr):
    """The derivative of the loss along a meaningful perturbation of one parameter, exact and as a finite difference."""

    parameter: str
    sample_steps: np.ndarray
    """(sample_steps,) numbers of steps after which the loss is computed."""
    exact: np.ndarray
    """(sample_steps,) by forward mode."""
    difference: np.ndarray
    """(sample_steps,) central difference over the whole perturbation, in both directions; NaN beyond the last step that
    both of its runs come to."""
    strain: np.ndarray
    """(sample_steps,) how far the perturbation separates nearest neighbours, to first order [spacings]."""

    @property
    def meaningful(self) -> np.ndarray:
        """(sample_steps,) whether the exact derivative is near the difference, relative to the greatest up to there."""
        return np.abs(self.exact - self.difference) <= WITHIN * np.maximum.accumulate(np.abs(self.difference))

    @property
    def measured(self) -> int:
        """The last sample step at which the exact derivative is useful, as it is at the one before; 0 for none."""
        good = self.meaningful
        there = np.flatnonzero(good & np.append(good[:1], good[:-1]))
        return int(self.sample_steps[there[-1]]) if there.size else 0

    @property
    def reached(self) -> int:
        """The last sample step that has a difference; 0 for none."""
        there = np.flatnonzero(~np.isnan(self.difference))
        return int(self.sample_steps[there[-1]]) if there.size else 0

    @property
    def lasts(self) -> bool:
        """Whether the exact derivative is useful up to the last step."""
        return self.measured == self.sample_steps[-1]

    @property
    def predicted(self) -> int | None:
        """The first sample step at which the perturbation separates neighbours by more than `LINEAR`, None for none."""
        beyond = np.flatnonzero(self.strain > LINEAR)
        return int(self.sample_steps[beyond[0]]) if beyond.size else None


def horizon(history: LossHistory, values: Arrays, name: str, perturbation: np.ndarray) -> Horizon:
    """The horizon of one parameter, for a perturbation of it."""
    along, spacing = {name: perturbation}, history.problem.simulation.scene.discretisation.spacing
    tangent = history.tangent(values, along)
    difference = history.difference(values, along, 1.0)
    return Horizon(name, history.sample_steps, tangent.slopes, difference, tangent.strain / spacing)
