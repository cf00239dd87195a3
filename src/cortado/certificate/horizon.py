"""How long does an exact gradient mean something: as long as it says what a change that an optimiser makes would do."""

from dataclasses import dataclass

import numpy as np

from cortado.certificate.course import Course
from cortado.parameters.values import Arrays
from cortado.words import Brief

WITHIN = 0.25
"""The exact derivative means something where it is this near to the change of the loss, relative."""
LINEAR = 0.3
"""How far a change may part neighbours for their forces to answer linearly [spacings]."""


@dataclass(frozen=True, repr=False)
class Horizon(Brief):
    """The loss's derivative along a meaningful change of one parameter, exact and as that change finds it."""

    parameter: str
    moments: np.ndarray
    """(moments,) steps after which the loss is asked."""
    exact: np.ndarray
    """(moments,) by forward mode."""
    difference: np.ndarray
    """(moments,) central difference over the whole change, both ways."""
    strain: np.ndarray
    """(moments,) how far the change parts neighbours, to first order [spacings]."""

    @property
    def meaningful(self) -> np.ndarray:
        """(moments,) whether the exact derivative is near the difference, in units of the greatest one so far."""
        return np.abs(self.exact - self.difference) <= WITHIN * np.maximum.accumulate(np.abs(self.difference))

    @property
    def measured(self) -> int:
        """The last step at which the exact derivative means something, as at the moment before; 0 for none."""
        good = self.meaningful
        there = np.flatnonzero(good & np.append(good[:1], good[:-1]))
        return int(self.moments[there[-1]]) if there.size else 0

    @property
    def lasts(self) -> bool:
        """Whether the exact derivative means something to the end."""
        return self.measured == self.moments[-1]

    @property
    def predicted(self) -> int | None:
        """The first step at which the change, by its tangent, parts neighbours too far; None where that is later."""
        beyond = np.flatnonzero(self.strain > LINEAR)
        return int(self.moments[beyond[0]]) if beyond.size else None


def horizon(course: Course, values: Arrays, name: str, change: np.ndarray) -> Horizon:
    """That of one of the parameters, for a change of it."""
    along, spacing = {name: change}, course.problem.simulation.scene.discretisation.spacing
    tangent = course.tangent(values, along)
    difference = course.difference(values, along, 1.0)
    return Horizon(name, course.moments, tangent.slopes, difference, tangent.strain / spacing)
