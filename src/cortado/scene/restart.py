"""States from which a run goes on where another one stopped, bit for bit, and when they are."""

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
    """The time of a state, counted from the first state of the first run; by default that is the state itself."""

    steps: int = 0
    """Steps taken."""
    time: float = 0.0
    """[s]"""
    time_step: float = field(default=0.0, repr=False)
    """Length of the step that led to the state, if it was chosen: the next one is hardly longer [s]; else 0."""

    def times(self, steps: NDArray, time_step: float) -> NDArray:
        """Return times (frames,) [s] after more steps of ``time_step`` [s]; for equal steps they are those of one run,
        bit for bit."""
        return (self.time - self.steps * time_step) + (self.steps + steps) * time_step

    def after(self, steps: int, time_step: float) -> "Clock":
        """Return the clock of the state ``steps`` steps later."""
        return Clock(self.steps + steps, float(self.times(np.array(steps), time_step)))


@dataclass(frozen=True)
class RecordedClock(Clock):
    """The clock of the first state of a run whose time steps were chosen, and recorded."""

    recorded: NDArray = field(default_factory=lambda: np.zeros(1), repr=False, compare=False)
    """(steps + 1,) time of each state [s]; the states that the run did not come to have no meaning."""
    sizes: NDArray = field(default_factory=lambda: np.zeros(0), repr=False, compare=False)
    """(steps,) [s]"""

    def times(self, steps: NDArray, time_step: float) -> NDArray:
        """Return times (frames,) [s] after ``steps`` more steps, evenly within a step; ``time_step`` is not used."""
        return np.interp(steps, np.arange(len(self.recorded)), self.recorded)

    def after(self, steps: int, time_step: float) -> Clock:
        """Return the clock of the state ``steps`` steps later."""
        if steps == 0:
            return Clock(self.steps, self.time, self.time_step)
        return Clock(self.steps + steps, float(self.recorded[steps]), float(self.sizes[steps - 1]))


@dataclass(frozen=True)
class Origin:
    """The particles of a state, with all that is equal in every run that goes on from it. Forces, walls and the length
    of a step may be others there, as they may change within a run."""

    spacing: float
    """[m]"""
    support: float
    """[spacings]"""
    kernel: str
    """Name of the smoothing kernel."""
    periods: tuple[float, ...]
    """(d,) lengths [m], 0 along an axis that is not periodic."""
    waiting: tuple[int, ...]
    """Number of particles, the last ones, of each emitter."""
    rest_density: tuple[float, ...]
    """(phases,) that the run had [kg/m3]."""
    solver: str | None = None
    """Name in messages of the solver whose own fields the state has; None for a state without such fields."""

    def to_json(self) -> str:
        """Write the origin as a text, to be read by `from_json`."""
        return json.dumps(asdict(self))

    @classmethod
    def from_json(cls, text: str) -> "Origin":
        """Read the origin that `to_json` wrote; raise `ValueError` or `TypeError` for anything else."""
        read: dict[str, Any] = json.loads(text)
        values: dict[str, Any] = {name: tuple(v) if isinstance(v, list) else v for name, v in read.items()}
        return cls(**values)


@dataclass(frozen=True, eq=False, repr=False)
class RestartState(ShortRepr):
    """The state at the end of a step, whole: `Trajectory.last_state` gives it and `Simulation.run` takes it."""

    fields: Mapping[str, NDArray]
    """By the names that the solver declares: positions [m] and velocities [m/s], (n, d); mass_fractions (n, phases);
    reference_density (n,), the mass of a particle over its volume on the rest lattice [kg/m3]; of each emitter
    NAME.outlet (1, d), where its opening is [m], and NAME.emitted (1,), the length of fluid that has left it [m]; and
    what else a solver carries from step to step, of which PCISPH has nothing."""
    clock: Clock = field(default_factory=Clock)
    """Time of the state."""
    origin: Origin | None = None
    """Origin of its particles; None for a state that was made by hand, or that an earlier version wrote."""

    def __getitem__(self, name: str) -> NDArray:
        """Return a field by name; raise `InputError` for one that the state does not have."""
        if name not in self.fields:
            raise InputError(f"state has no {shown(name)}, but has {', '.join(self.fields)}.")
        return self.fields[name]

    def fixed(self) -> "RestartState":
        """Return this state in arrays of its own, which nobody can change."""
        own = {name: np.array(value) for name, value in self.fields.items()}
        for array in own.values():
            array.setflags(write=False)
        return replace(self, fields=FixedDict(own))
