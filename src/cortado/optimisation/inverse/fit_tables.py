"""The table [fit] of a task with measured data."""

from typing import Annotated

from cortado.optimisation.inverse.named_values import Values
from cortado.optimisation.inverse.tables import ProblemTable
from cortado.scene.fields import count
from cortado.scene.tables import Table


class FitTable(Table):
    """[fit]: the parameters that are fitted to measured data, and how long."""

    start: Values
    """By name the parameters that are fitted, as the fit starts; positive ones are searched by their logarithm."""
    bounds: Values | None = None
    """By the name of a parameter the lower and the upper bound; a number whose bounds are the same is not fitted."""
    iterations: Annotated[int, count(1, 10_000)] = 50
    """Trial points at most, of each of the two fits."""
    starts: Annotated[int, count(1, 100)] | None = None
    """From how many starts the fit searches; if left out, from the one that is given, and from three others where that
    ends in doubt. Others lie within the bounds, or within two decades of a positive number."""
    profiles: Annotated[int, count(0, 100)] = 7
    """Points of the profile of each number, each with a fit of all others; 0 for no profiles."""


class FitTables(Table):
    """The two tables of a task whose target was measured."""

    problem: ProblemTable
    fit: FitTable
