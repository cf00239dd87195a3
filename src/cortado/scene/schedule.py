"""What changes while a scene runs: parameters over time, as values at some times."""

from itertools import pairwise
from typing import Annotated, Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field, create_model, model_validator

from cortado.errors import Words
from cortado.scene.fields import FieldPath, Several, field_error, quantity
from cortado.scene.parameters import PARAMETERS, Axis, Parameter
from cortado.scene.tables import Table


def along_lines(times: NDArray, known: ArrayLike, values: NDArray) -> NDArray:
    """(n, components) at times (n,) [s]: values (k, components) at known times (k,), with straight lines between them,
    constant before the first and after the last."""
    return np.stack([np.interp(times, np.asarray(known), column) for column in values.T], axis=-1)


class Course(Table):
    """One parameter over time: linear between the times, constant before the first and after the last."""

    times: Several[Annotated[float, quantity("s", ge=0.0)]]
    """(k,) counted from the first state of the run, each greater than the one before [s]"""
    values: Any
    """(k, components) in the parameter's unit"""

    @model_validator(mode="after")
    def _check_times(self) -> Self:
        for index, (before, after) in enumerate(pairwise(self.times), 1):
            if after <= before:
                raise field_error(("times", index), after, f"greater than the time before, {before:g} s")
        if len(self.values) != len(self.times):
            wanted = f"a list of {len(self.times)}, one for each of the times"
            raise field_error(("values",), Words(f"a list of {len(self.values)}"), wanted)
        return self

    def at(self, times: NDArray) -> NDArray:
        """(n, components) at times (n,) [s]."""
        return along_lines(times, self.times, np.array(self.values, dtype=np.float64))

    def rates(self, times: NDArray) -> NDArray:
        """(n, components) the derivative with respect to time at times (n,) [s]; at a time of the course that of what
        comes after."""
        known, values = np.array(self.times), np.array(self.values, dtype=np.float64)
        rates = np.zeros((len(known) + 1, values.shape[1]))
        rates[1:-1] = np.diff(values, axis=0) / np.diff(known)[:, None]
        return rates[np.searchsorted(known, times, side="right")]


def _course(parameter: Parameter) -> type[Course]:
    """The table of one parameter, whose values have its unit."""
    unit = parameter.unit.replace("²", "2").replace("°", "degrees")
    row = Annotated[tuple[Annotated[float, quantity(unit)], ...], Field(min_length=1, max_length=3, fail_fast=True)]
    values: Any = (Several[row], Field(description="(k, components) one row for each of the times"))
    words = f"The parameter `{parameter.name}` over time: {parameter.meaning}."
    return create_model(f"Course_{parameter.name}", __base__=Course, __module__=__name__, __doc__=words, values=values)


_OVER_TIME = [p for p in PARAMETERS if p.axis is Axis.STEP]
_COURSES: dict[str, Any] = {p.name: (_course(p) | None, Field(default=None, description=p.meaning)) for p in _OVER_TIME}


class _Schedule(Table):
    """What changes while the scene runs; of what is left out, nothing does."""

    @property
    def courses(self) -> dict[str, Course]:
        """Those that are given, by the names of their parameters."""
        found = {name: getattr(self, name) for name in _COURSES}
        return {name: course for name, course in found.items() if course is not None}

    @property
    def leads_gravity(self) -> bool:
        """Whether gravity changes, as such or by a tilt."""
        return not self.courses.keys().isdisjoint(("gravity", "tilt"))

    def in_dimension(self, dimension: int, path: FieldPath = ()) -> Self:
        """This table, with rows of as many components as their parameters have in 2 or 3 dimensions."""
        for name, course in self.courses.items():
            components = next(p.components for p in _OVER_TIME if p.name == name)
            size = 1 if components is None else components(dimension, 1)
            for index, row in enumerate(course.values):
                if len(row) != size:
                    wanted = f"a list of {size}, as the scene has {dimension} dimensions"
                    raise field_error((*path, name, "values", index), row, wanted)
        return self


Schedule: Any = create_model("Schedule", __base__=_Schedule, __module__=__name__, __doc__=_Schedule.__doc__, **_COURSES)
"""A course for each parameter over time that changes, made from the registry of parameters."""
