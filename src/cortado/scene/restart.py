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
    """Time of a state, counted from the first state of the first run; by default the state is that first state."""

    steps: int = 0
    """Number of steps since the first state."""
    time: float = 0.0
    """Time since the first state [s]."""
    time_step: float = field(default=0.0, repr=False)
    """Length of the step before the state, if steps are adaptive: it bounds the next step [s]; otherwise 0."""

    def times(self, steps: NDArray, time_step: float) -> NDArray:
        """Return times (frames,) [s] after more steps of ``time_step`` [s]. With equal steps these are, bit for bit,
        the times of one uninterrupted run."""
        return (self.time - self.steps * time_step) + (self.steps + steps) * time_step

    def after(self, steps: int, time_step: float) -> "Clock":
        """Return the clock of the state ``steps`` steps later."""
        return Clock(self.steps + steps, float(self.times(np.array(steps), time_step)))


@dataclass(frozen=True)
class RecordedClock(Clock):
    """The clock of the first state of a run with adaptive, recorded time steps."""

    recorded: NDArray = field(default_factory=lambda: np.zeros(1), repr=False, compare=False)
    """(steps + 1,) time of each state [s]; entries for states that the run did not reach have no meaning."""
    sizes: NDArray = field(default_factory=lambda: np.zeros(0), repr=False, compare=False)
    """(steps,) length of each step [s]"""

    def times(self, steps: NDArray, time_step: float) -> NDArray:
        """Return times (frames,) [s] after ``steps`` more steps, interpolated within one; ``time_step`` is unused."""
        return np.interp(steps, np.arange(len(self.recorded)), self.recorded)

    def after(self, steps: int, time_step: float) -> Clock:
        """Return the clock of the state ``steps`` steps later."""
        if steps == 0:
            return Clock(self.steps, self.time, self.time_step)
        return Clock(self.steps + steps, float(self.recorded[steps]), float(self.sizes[steps - 1]))


@dataclass(frozen=True)
class Origin:
    """The properties of a state's particles that every run continuing from it must share. Forces, walls and the length
    of a step may differ, because they may change within a run, too."""

    spacing: float
    """[m]"""
    support: float
    """[spacings]"""
    kernel: str
    """Name of the smoothing kernel."""
    periods: tuple[float, ...]
    """(d,) lengths of the periods [m], 0 along an axis that is not periodic."""
    waiting: tuple[int, ...]
    """Number of particles of each emitter; these are the last particles."""
    rest_density: tuple[float, ...]
    """(phases,) rest densities of the run [kg/m3]."""
    solver: str | None = None
    """Name, in messages, of the solver whose own fields the state has; None if there are no such fields."""

    def to_json(self) -> str:
        """Return the origin as a text that `from_json` can read."""
        return json.dumps(asdict(self))

    @classmethod
    def from_json(cls, text: str) -> "Origin":
        """Read the origin that `to_json` wrote; raise `ValueError` or `TypeError` for anything else."""
        read: dict[str, Any] = json.loads(text)
        values: dict[str, Any] = {name: tuple(v) if isinstance(v, list) else v for name, v in read.items()}
        return cls(**values)


@dataclass(frozen=True, eq=False, repr=False)
class RestartState(ShortRepr):
    """The complete state at the end of a step: `Trajectory.last_state` returns it, `Simulation.run` accepts it."""

    fields: Mapping[str, NDArray]
    """Arrays by field name: positions [m] and velocities [m/s], (n, d); mass_fractions (n, phases); reference_density
    (n,), each particle's mass divided by its volume on the rest lattice [kg/m3]. For each emitter NAME.outlet (1, d) is
    the position of its opening [m], and NAME.emitted (1,) the length of fluid that has left it [m]. Solvers may add
    fields that they carry from step to step; PCISPH adds no field."""
    clock: Clock = field(default_factory=Clock)
    """Time of the state."""
    origin: Origin | None = None
    """Origin of the particles; None for a state that a user built, or that an earlier version wrote."""

    def __getitem__(self, name: str) -> NDArray:
        """Return a field by name; raise `InputError` for one that the state does not have."""
        if name not in self.fields:
            raise InputError(f"state has no {shown(name)}, but has {', '.join(self.fields)}.")
        return self.fields[name]

    def fixed(self) -> "RestartState":
        """Return this state with its own, read-only copies of the arrays."""
        own = {name: np.array(value) for name, value in self.fields.items()}
        for array in own.values():
            array.setflags(write=False)
        return replace(self, fields=FixedDict(own))
