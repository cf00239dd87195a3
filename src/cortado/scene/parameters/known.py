"""The parameters of one simulation: those of the registry, and those that its own forces and solver bring.

Without Warp."""

from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cortado.errors import InputError
from cortado.scene.parameters.parameter import Axis, Parameter, Role
from cortado.scene.parameters.registry import BY_NAME


class Known(Mapping[str, Parameter]):
    """Parameters by name, those of the registry first. It is equal to itself alone."""

    __eq__, __hash__ = object.__eq__, object.__hash__

    def __init__(self, own: Iterable[tuple[Parameter, str]] = ()):
        """``own``: those of forces and of a solver, each with whose it is, in words; `TIME` may be among them several
        times. Raises `InputError` where two parameters have one name, or the same arguments of kernels."""
        self._by_name = dict(BY_NAME)
        arguments = {argument(name): name for name in BY_NAME}
        for parameter, whose in dict(own).items():
            name = parameter.name
            if argument(name) in arguments:
                raise InputError(
                    f"parameter {name} of {whose} has the name of another one, {arguments[argument(name)]}, but must "
                    f"have its own: give {whose.replace('a ', 'the ')} another name."
                )
            arguments[argument(name)] = name
            self._by_name[name] = parameter
        self.own = tuple(p for p in self._by_name.values() if p.name not in BY_NAME)
        """Those of forces and of a solver."""
        self.run = tuple(name for name, p in self.items() if p.role in (Role.RUN, Role.CLOCK))
        """Names of what steps depend on."""
        self.state = tuple(name for name, p in self.items() if p.role is Role.STATE)
        """Names of what the first state has, and other states have of their own."""
        self.over_time = tuple(name for name, p in self.items() if p.axis is Axis.STEP)
        """Names of those that may have a row for each step."""
        self.vectors = tuple(name for name in self.run if self[name].components is not None)
        """Names of what steps depend on and has the components of a vector."""
        self.views = {p.name: p.in_place_of for p in self.values() if p.in_place_of is not None}
        """Names of other ways to write parameters, with those of these parameters."""
        self.courses = {p.name: p.course for p in self.own if p.course is not None}
        """How these change while a scene runs."""

    def has_rows(self, name: str, value: Any) -> bool:
        """Whether a value of a parameter has rows in time: one for each step, or for each of some knots."""
        parameter = self[name]
        return parameter.axis is Axis.STEP and np.ndim(value) == parameter.rank + 1

    def __getitem__(self, name: str) -> Parameter:
        return self._by_name[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._by_name)

    def __len__(self) -> int:
        return len(self._by_name)


class _Passing:
    """Time itself, as a course of a parameter."""

    def at(self, times: NDArray) -> NDArray:
        return times

    def rates(self, times: NDArray) -> NDArray:
        return np.ones_like(times)


TIME = Parameter(
    "time",
    "s",
    "when a step begins",
    Axis.STEP,
    lambda source: 0.0,
    role=Role.CLOCK,
    moment=0.0,
    course=_Passing(),
)
"""For forces that depend on time. Kernels find (members, steps) numbers; derivatives with respect to the time step
follow, and runs that go on have their own."""


def argument(name: str) -> str:
    """What arguments of kernels call a parameter: ``drag_k`` is that of ``drag.k``."""
    return name.replace(".", "_")


REGISTRY = Known()
"""Those of a simulation without forces of its own."""
