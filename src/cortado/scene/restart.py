"""States from which a later run continues an earlier one bit for bit, and the times of these states."""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cortado.calls import FixedDict, ShortRepr
from cortado.errors import InputError, shown


@dataclass(frozen=True)
class Clock:
    """Time of a state since the first state of the first run."""

    steps: int = 0
    """Number of steps since the first state."""
    time: float = 0.0
    """Time since the first state [s]."""
    time_step: float = field(default=0.0, repr=False)
    """Length of the previous step, which bounds the next one, if steps are adaptive [s]; otherwise 0."""

    def times(self, steps: NDArray, time_step: float) -> NDArray:
        """Return times (frames,) [s] after more ``steps`` (frames,) of ``time_step`` [s], bit for bit as without a
        break."""
        return (self.time - self.steps * time_step) + (self.steps + steps) * time_step

    def after(self, steps: int, time_step: float) -> "Clock":
        """Return the clock of the state ``steps`` steps later."""
        return Clock(self.steps + steps, float(self.times(np.array(steps), time_step)))


@dataclass(frozen=True)
class RecordedClock(Clock):
    """Clock of the first state of a run with adaptive, recorded time steps."""

    recorded: NDArray = field(default_factory=lambda: np.zeros(1), repr=False, compare=False)
    """(steps + 1,) time of each state [s]; undefined for states that the run did not reach."""
    sizes: NDArray = field(default_factory=lambda: np.zeros(0), repr=False, compare=False)
    """(steps,) length of each step [s]."""

    def times(self, steps: NDArray, time_step: float) -> NDArray:
        """Return times (frames,) [s] after ``steps`` more steps, interpolated within steps; ``time_step`` is unused."""
        return np.interp(steps, np.arange(len(self.recorded)), self.recorded)

    def after(self, steps: int, time_step: float) -> Clock:
        if steps == 0:
            return Clock(self.steps, self.time, self.time_step)
        return Clock(self.steps + steps, float(self.recorded[steps]), float(self.sizes[steps - 1]))


@dataclass(frozen=True)
class Origin:
    """Properties of a state's particles that every run which continues from the state must share."""

    spacing: float
    """[m]"""
    support: float
    """[spacings]"""
    kernel: str
    periods: tuple[float, ...]
    """(d,) lengths of the periods [m]; 0 along an axis that is not periodic."""
    waiting: tuple[int, ...]
    """Number of particles of each emitter; these are the last particles."""
    rest_density: tuple[float, ...]
    """(phases,) rest densities of the run [kg/m3]."""
    solver: str | None = None
    """Name of the solver, for messages, if the state has fields of this solver; None without such fields."""

    def to_json(self) -> str:
        return json.dumps(asdict(self))

    @classmethod
    def from_json(cls, text: str) -> "Origin":
        """Read the JSON of `to_json`; raise `ValueError` or `TypeError` for any other text."""
        read: dict[str, Any] = json.loads(text)
        values: dict[str, Any] = {name: tuple(v) if isinstance(v, list) else v for name, v in read.items()}
        return cls(**values)


@dataclass(frozen=True, eq=False, repr=False)
class RestartState(ShortRepr):
    """The complete state at the end of a step: `Trajectory.last_state` returns it, `Simulation.run` accepts it."""

    fields: Mapping[str, NDArray]
    """Arrays by field name: positions [m] and velocities [m/s], (n, d); mass_fractions (n, phases); reference_density
    (n,), each particle's mass divided by its volume on the rest lattice [kg/m3]. For each emitter NAME.outlet (1, d) is
    the position of its opening [m], and NAME.emitted (1,) the length of fluid that has left it [m]. Solvers other than
    PCISPH may add fields that they carry from step to step."""
    clock: Clock = field(default_factory=Clock)
    """Time of the state."""
    origin: Origin | None = None
    """Origin of the particles; None for a state that a user built, or that an earlier version wrote."""

    def __getitem__(self, name: str) -> NDArray:
        """Return a field by name; raise `InputError` for an unknown field."""
        if name not in self.fields:
            raise InputError(f"state has no {shown(name)}, but has {', '.join(self.fields)}.")
        return self.fields[name]

    def fixed(self) -> "RestartState":
        """Return the state with read-only copies of the arrays."""
        own = {name: np.array(value) for name, value in self.fields.items()}
        for array in own.values():
            array.setflags(write=False)
        return replace(self, fields=FixedDict(own))
