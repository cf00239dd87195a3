"""Is the adjoint right? Reverse mode against forward mode against central differences, of one change of everything."""

from dataclasses import dataclass

import numpy as np

from cortado.certificate.course import Course
from cortado.parameters.values import Arrays
from cortado.words import Brief

STEPS = tuple(10.0**-k for k in range(3, 9))
"""Steps of the central differences, in units of the direction; they are tried until they stop getting better, and
agree with forward mode."""
AGREEMENT = 1e-8
"""How near reverse and forward mode must be, relative, in float64; both are exact to round-off."""
PLATEAU = 1e-3
"""Two neighbouring differences this near to each other, relative, are believed."""
SLACK = 10.0
"""How far forward mode may be from a difference, in units of the least distance of two neighbouring ones."""
RESOLUTION = 1e-6
"""How far it may be in any case, relative."""
FAINT = 1e-4
"""What a parameter may change the loss by, relative to the strongest, for all others to be reduced to."""
ROUND_OFF = 1e-13
"""Derivatives along a direction below so much of the loss are taken as 0."""
DIFFERENCE_ROUND_OFF = 1e-15
"""Round-off of a central difference of step h is taken as this part of the loss, over h."""


@dataclass(frozen=True, repr=False)
class Comparison(Brief):
    """Derivatives of the loss along one direction, three times."""

    moments: np.ndarray
    """(moments,) steps after which the loss is asked."""
    losses: np.ndarray
    """(moments,)"""
    adjoint: float
    """At the last moment, by reverse mode."""
    size: float
    """Of what it is the sum of: round-off is in units of it."""
    tangents: np.ndarray
    """(moments,) by forward mode."""
    differences: np.ndarray
    """(tried, moments) central differences; none where reverse mode is wrong already."""
    steps: np.ndarray
    """(tried,) of the differences, in units of the direction."""

    @property
    def disagreement(self) -> float:
        """Relative distance of reverse and forward mode; 0 where both are below round-off."""
        last, least = float(self.tangents[-1]), ROUND_OFF * abs(float(self.losses[-1]))
        size = max(abs(self.adjoint), abs(last), self.size)
        distance = abs(self.adjoint - last) / size if size > least else 0.0
        return distance if np.isfinite(self.adjoint + last) else float("inf")

    @property
    def gaps(self) -> np.ndarray:
        """(tried - 1, moments) distance of neighbouring differences and their round-off, relative, the greatest so far
        at every moment."""
        round_off = DIFFERENCE_ROUND_OFF * np.abs(self.losses).max() / self.steps[1:, None]
        return self._worst(np.abs(np.diff(self.differences, axis=0)) + round_off)

    @property
    def misses(self) -> np.ndarray:
        """(tried, moments) distance of differences from forward mode, likewise."""
        return self._worst(np.abs(self.differences - self.tangents))

    @property
    def believed(self) -> np.ndarray:
        """(moments,) whether two neighbouring differences agree up to there; where none do, chaos hides the limit."""
        return np.asarray(self.gaps.min(axis=0, initial=np.inf) < PLATEAU)

    @property
    def last_believed(self) -> int | None:
        """The last step after which a limit of differences is to be seen."""
        return int(self.moments[self.believed][-1]) if self.believed.any() else None

    @property
    def miss(self) -> float | None:
        """How near forward mode is there to a difference, relative."""
        return float(self.misses[:, self.believed].min(axis=0)[-1]) if self.believed.any() else None

    @property
    def differences_agree(self) -> bool:
        """Whether forward mode is near a difference wherever there is a limit to be seen: nearer than neighbouring
        differences are to each other. Beside a kink these may agree and be off, until a step falls short of it."""
        allowed = np.maximum(SLACK * self.gaps.min(axis=0, initial=np.inf), RESOLUTION)
        near = self.misses.min(axis=0, initial=np.inf) <= allowed
        return bool(near[self.believed].all())

    @property
    def right(self) -> bool:
        """Whether nothing speaks against the adjoint."""
        return self.disagreement < AGREEMENT and self.differences_agree

    def _worst(self, distances: np.ndarray) -> np.ndarray:
        """The greatest so far over the greatest derivative so far."""
        size = np.maximum.accumulate(np.abs(self.differences[len(self.differences) - len(distances) :]), axis=1)
        worst = np.maximum.accumulate(distances, axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.nan_to_num(worst / size, nan=np.inf, posinf=np.inf)


def balanced(gradient: Arrays, directions: Arrays) -> Arrays:
    """The directions, the stronger ones reduced, so that each changes the loss by as much: no term hides another."""
    changes = {name: abs(float((gradient[name] * along).sum())) for name, along in directions.items()}
    finite = [change for change in changes.values() if np.isfinite(change)]
    strongest = max(finite, default=0.0)
    felt = [change for change in finite if change > FAINT * strongest]
    return {
        name: along * (min(felt) / changes[name] if changes[name] > FAINT * strongest else 1.0)
        for name, along in directions.items()
    }


def compare(course: Course, values: Arrays, gradient: Arrays, along: Arrays) -> Comparison:
    """Reverse mode's ``gradient`` against the two others, along a direction."""
    tangent = course.tangent(values, along)
    losses, tangents = tangent.losses, tangent.slopes
    products = np.concatenate([(gradient[name] * along[name]).ravel() for name in along])
    found: list[np.ndarray] = []

    def comparison() -> Comparison:
        differences = np.array(found).reshape(-1, len(losses))
        return Comparison(
            course.moments,
            losses,
            adjoint=float(products.sum()),
            size=float(np.linalg.norm(products)),
            tangents=tangents,
            differences=differences,
            steps=np.array(STEPS[: len(found)]),
        )

    best = np.inf
    for h in STEPS if comparison().disagreement < AGREEMENT else ():
        found.append(course.difference(values, along, h))
        gap = comparison().gaps[-1, -1] if len(found) > 1 else np.inf
        settled = gap < RESOLUTION / SLACK or (best < PLATEAU and gap > best)
        if settled and comparison().differences_agree:
            break
        best = min(best, gap)
    return comparison()
