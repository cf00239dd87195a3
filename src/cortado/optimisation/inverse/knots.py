"""The knots of a course in time that was searched: when they are, and what was found and hidden there."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from cortado.optimisation.inverse.setup import Setup
from cortado.optimisation.transforms import TimeInterpolation
from cortado.scene.parameter_values import Arrays


@dataclass(frozen=True)
class KnotValues:
    """Of one parameter; between two knots it changes along a straight line."""

    times: np.ndarray
    """(k,) [s] A step has the value of its middle, so the first knot is half a step after the start of the run; that of
    where something is is a step after it."""
    start: np.ndarray
    """(k, d), or (k,) of numbers, in the unit of the parameter, as the search started."""
    estimate: np.ndarray
    """(k, d) in the unit of the parameter."""
    true: np.ndarray | None
    """(k, d) the course with these knots that is nearest to the true one; None where a picture is the target."""

    def for_machines(self) -> dict[str, np.ndarray]:
        """By names; without the true values where there are none."""
        known = {} if self.true is None else {"true": self.true}
        return {"times": self.times, "estimate": self.estimate, **known}


def knot_values(made: Setup, coordinates: Arrays, estimate: Mapping[str, np.ndarray]) -> dict[str, KnotValues]:
    """By name, of the parameters that were searched by their knots; ``coordinates`` of the search give ``estimate``."""
    step = float(estimate.get("time_step", made.task.scene.solver.time_step))
    found = {}
    for name, bijector in made.search.coordinates.items():
        if isinstance(bijector, TimeInterpolation):
            true = made.true_parameter(name)
            if true is not None:
                rank = made.task.known[name].rank
                course = np.broadcast_to(true, (bijector.steps, *np.shape(true)[np.ndim(true) - rank :]))
                true = _without_round_off(bijector.coordinate(course))
            times = (bijector.places + made.task.known[name].moment) * step
            found[name] = KnotValues(times, made.start[name], coordinates[name], true)
    return found


def _without_round_off(values: np.ndarray) -> np.ndarray:
    """To twelve digits of the largest: what a user wrote comes back from the course as it was written."""
    largest = np.abs(values).max()
    return np.round(values, 11 - int(np.floor(np.log10(largest)))) + 0.0 if largest > 0.0 else values  # no -0
