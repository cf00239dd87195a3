"""Is the adjoint right? The derivative of the loss along a direction, by reverse mode, forward mode and differences."""

from dataclasses import dataclass

import numpy as np

from cortado.certificate.loss_history import LossHistory
from cortado.scene.parameter_values import Arrays
from cortado.words import ShortRepr

STEPS = tuple(10.0**-k for k in range(3, 9))
"""Steps h of the central differences, in units of the direction. Smaller ones are tried until the differences stop
converging and agree with forward mode."""
MODE_TOLERANCE = 1e-8
"""Relative distance at most of reverse mode from forward mode in float64; both are exact to round-off."""
PLATEAU = 1e-3
"""Relative distance at most of the central differences of two successive steps h for them to count as converged."""
CORNER = 1e-4
"""Relative distance of the slopes to both sides from which on the loss has a corner."""
SLACK = 10.0
"""Distance at most of forward mode from a central difference, in units of the least distance of two successive ones."""
RESOLUTION = 1e-6
"""Relative distance that is allowed in any case."""
GOLDEN = 0.5 * (5.0**0.5 - 1.0)
"""The parts of its multiples beyond whole numbers differ."""
FAINT = 1e-4
"""Parameters that change the loss by less than this part of what the strongest does are left out when the others are
scaled down to the weakest (`balanced`)."""
ROUND_OFF = 1e-13
"""Derivatives along the direction that are smaller than this part of the loss are taken as 0."""
DIFFERENCE_ROUND_OFF = 1e-15
"""The round-off of a central difference of step h is estimated as this part of the loss, divided by h."""


@dataclass(frozen=True, repr=False)
class Consistency(ShortRepr):
    """Derivatives of the loss along one direction, by reverse mode, forward mode and central differences."""

    sample_steps: np.ndarray
    """(sample_steps,) numbers of steps after which the loss is computed."""
    losses: np.ndarray
    """(sample_steps,)"""
    adjoint: float
    """The derivative of the last loss by reverse mode: gradient times direction, summed over all numbers."""
    size: float
    """Root sum of squares of those products: the round-off of their sum is proportional to it."""
    tangents: np.ndarray
    """(sample_steps,) by forward mode."""
    differences: np.ndarray
    """(tried, sample_steps) central differences; no rows where reverse and forward mode already differ."""
    sides: np.ndarray
    """(tried, sample_steps) by how much the differences to one side and to the other differ."""
    steps: np.ndarray
    """(tried,) their steps h, in units of the direction."""

    @property
    def disagreement(self) -> float:
        """Relative distance of reverse mode from forward mode; 0 where both are below round-off."""
        last, least = float(self.tangents[-1]), ROUND_OFF * abs(float(self.losses[-1]))
        size = max(abs(self.adjoint), abs(last), self.size)
        distance = abs(self.adjoint - last) / size if size > least else 0.0
        return distance if np.isfinite(self.adjoint + last) else float("inf")

    @property
    def gaps(self) -> np.ndarray:
        """(tried - 1, sample_steps) relative distance of central differences of successive h, with their round-off.

        At every sample step it is the greatest up to there.
        """
        round_off = DIFFERENCE_ROUND_OFF * np.abs(self.losses).max() / self.steps[1:, None]
        return self._worst(np.abs(np.diff(self.differences, axis=0)) + round_off)

    @property
    def misses(self) -> np.ndarray:
        """(tried, sample_steps) relative distance of differences from forward mode, the greatest up to there."""
        return self._worst(np.abs(self.differences - self.tangents))

    @property
    def corner(self) -> np.ndarray:
        """(sample_steps,) the least relative distance of differences to one side and to the other, the greatest up to
        there. It is small in the limit of small h but on a corner of the loss, where both have limits of their own."""
        return np.asarray(self._worst(self.sides).min(axis=0, initial=np.inf))

    @property
    def is_on_a_corner(self) -> bool:
        """Whether reverse mode agrees with forward mode, and differences to one side and to the other have limits of
        their own, up to where they converge."""
        slopes = self.corner[self.converged]
        return self.disagreement < MODE_TOLERANCE and bool(len(slopes)) and float(slopes[-1]) > CORNER

    @property
    def converged(self) -> np.ndarray:
        """(sample_steps,) whether differences of two successive h agree up to there. Where none do, chaos or round-off
        hides the limit of differences."""
        return np.asarray(self.gaps.min(axis=0, initial=np.inf) < PLATEAU)

    @property
    def last_converged(self) -> int | None:
        """The last sample step at which differences converge; None where they do nowhere."""
        return int(self.sample_steps[self.converged][-1]) if self.converged.any() else None

    @property
    def miss(self) -> float | None:
        """Relative distance of forward mode from the nearest difference at that sample step."""
        return float(self.misses[:, self.converged].min(axis=0)[-1]) if self.converged.any() else None

    @property
    def differences_agree(self) -> bool:
        """Whether forward mode is near a central difference at every sample step at which differences converge.

        Near means within `SLACK` times the least distance of two successive differences, or, on a corner of the loss,
        within the distance of both sides. One near difference is enough: beside a kink of the loss, differences agree
        with each other and are off until h is smaller than the distance to the kink.
        """
        allowed = np.maximum(SLACK * self.gaps.min(axis=0, initial=np.inf), RESOLUTION)
        near = self.misses.min(axis=0, initial=np.inf) <= np.maximum(allowed, self.corner)
        return bool(near[self.converged].all())

    @property
    def right(self) -> bool:
        """Whether reverse mode agrees with forward mode, and forward mode with differences."""
        return self.disagreement < MODE_TOLERANCE and self.differences_agree

    def _worst(self, distances: np.ndarray) -> np.ndarray:
        """Distances relative to the derivatives, both the greatest up to each sample step."""
        size = np.maximum.accumulate(np.abs(self.differences[len(self.differences) - len(distances) :]), axis=1)
        worst = np.maximum.accumulate(distances, axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.nan_to_num(worst / size, nan=np.inf, posinf=np.inf)


def balanced(gradient: Arrays, directions: Arrays) -> Arrays:
    """The directions scaled so that each parameter's changes the loss by as much as the weakest, or up to twice that.

    Along their sum an error in one parameter's adjoint is not hidden by a parameter that changes the loss far more; and
    as no two change it by the same, wrong signs of two of them do not cancel.
    """
    changes = {name: abs(float((gradient[name] * along).sum())) for name, along in directions.items()}
    finite = [change for change in changes.values() if np.isfinite(change)]
    strongest = max(finite, default=0.0)
    felt = [change for change in finite if change > FAINT * strongest]

    def scale(k: int, name: str) -> float:
        wanted = (1.0 + k * GOLDEN % 1.0) * min(felt, default=0.0)
        return wanted / changes[name] if changes[name] > FAINT * strongest else 1.0

    return {name: scale(k, name) * along for k, (name, along) in enumerate(directions.items())}


def check_consistency(history: LossHistory, values: Arrays, gradient: Arrays, along: Arrays) -> Consistency:
    """Reverse mode's ``gradient`` along a direction, beside forward mode and central differences."""
    tangent = history.tangent(values, along)
    losses, tangents = tangent.losses, tangent.slopes
    products = np.concatenate([(gradient[name] * along[name]).ravel() for name in along])
    found: list[tuple[np.ndarray, np.ndarray]] = []

    def so_far() -> Consistency:
        differences, sides = np.array(found).reshape(-1, 2, len(losses)).transpose(1, 0, 2)
        return Consistency(
            history.sample_steps,
            losses,
            adjoint=float(products.sum()),
            size=float(np.linalg.norm(products)),
            tangents=tangents,
            differences=differences,
            sides=sides,
            steps=np.array(STEPS[: len(found)]),
        )

    best = np.inf
    for h in STEPS if so_far().disagreement < MODE_TOLERANCE else ():
        found.append(history.sides(values, along, h, losses))
        gap = so_far().gaps[-1, -1] if len(found) > 1 else np.inf
        settled = gap < RESOLUTION / SLACK or (best < PLATEAU and gap > best)
        if settled and so_far().differences_agree:
            break
        best = min(best, gap)
    return so_far()
