"""What a parameter is: its name, unit, axis and value, and how an optimiser, a scene and a schedule see it."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import Enum
from math import inf
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray


class Axis(Enum):
    """What a parameter has a value for."""

    SCALAR = "one number"
    PHASE = "each phase"
    STEP = "each step, or all of them"
    PARTICLE = "each particle"


class Role(Enum):
    """What a parameter is to a run."""

    RUN = "what steps depend on"
    STATE = "part of the first state"
    VIEW = "another way to write a parameter"
    LOSS = "what only losses depend on"
    CLOCK = "when steps are, which nobody gives"


class Range(Enum):
    """Which numbers a parameter may be."""

    ANY = "any"
    POSITIVE = "greater than 0"
    NOT_NEGATIVE = "at least 0"
    FRACTIONS = "adding up to 1 for each particle"


class Source(Protocol):
    """A simulation as the registry sees it: a scene, cut into particles."""

    scene: Any
    positions: NDArray
    velocities: NDArray
    mass_fractions: NDArray


class Changing(Protocol):
    """How a parameter changes while a scene runs, at times (n,) [s]."""

    def at(self, times: NDArray) -> NDArray:
        """(n,) numbers or (n, components)."""

    def rates(self, times: NDArray) -> NDArray:
        """The derivatives with respect to time, of the same shape."""


Limit = Callable[[Any, Mapping[str, Any]], float]
"""A time step [s] of a scene, with values of parameters that replace the scene's; there may be none of these."""


@dataclass(frozen=True)
class Parameter:
    """Something that a run, or a loss of it, depends on."""

    name: str
    unit: str
    """In SI; empty for a plain number."""
    meaning: str
    """In words, for the documents."""
    axis: Axis
    value: Callable[[Source], Any]
    """What it is in a scene that has it."""
    components: Callable[[int, int], int] | None = None
    """Of a vector, in so many dimensions and with so many phases; None for a number."""
    role: Role = Role.RUN
    range: Range = Range.ANY
    change: Callable[[Source, NDArray], Any] = lambda source, value: np.abs(value)
    """What an optimiser would take for a large change, for one at a value: by default the value itself."""
    acts: Callable[[Source, Mapping[str, NDArray]], bool] = lambda source, values: True
    """Whether it can make a difference in a scene, with values of parameters by name."""
    present: Callable[[Any], bool] = lambda scene: True
    """Whether a scene has it."""
    absent: str = ""
    """What to say of a scene that does not: "has no emitter"."""
    force: str | None = None
    """The module whose ``force`` makes the force that reads it, in scenes that have it: see `cortado.sph.parts`."""
    is_optional: bool = False
    """Whether it is a key of [forces] that scenes may leave out, and its force with it."""
    longest_step: Limit = lambda scene, values: inf
    """The largest at which an optional force is likely to be stable."""
    moment: float = 0.5
    """Of a parameter over time: when within a step its row is taken from a schedule; 0 is the start, 1 the end."""
    grows: bool = False
    """Whether one over time is 0 where a run begins, so that a steady change of it grows."""
    in_place_of: str | None = None
    """Of another way to write a parameter: that one."""
    course: Changing | None = None
    """How one over time, of a force of one's own, changes where it is not given."""

    @property
    def rank(self) -> int:
        """How many axes the value has for one step, one phase or one particle: 1 of a vector."""
        return 0 if self.components is None else 1

    def shapes(self, steps: int, phases: int, positions: tuple[int, ...]) -> list[tuple[int, ...]]:
        """The shapes that its values may have, () for a number, where positions are (n, d)."""
        particles, dimension = positions
        own = () if self.components is None else (self.components(dimension, phases),)
        if self.axis is Axis.STEP:
            return [own, (steps, *own)] if steps > 0 else [own]
        if self.axis is Axis.PARTICLE:
            return [(particles, *own)]
        several = self.axis is Axis.PHASE and (phases > 1 or own)
        return [(phases, *own) if several else own]
