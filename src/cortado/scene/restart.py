"""States that a later run can continue exactly (bit for bit), and the times of such states."""

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
    steps: int = 0
    """Number of steps since the first state."""
    time: float = 0.0
    """Time since the first state [s]."""
    time_step: float = field(default=0.0, repr=False)
    """Length of the last adaptive time step [s]; 0 for fixed time steps."""

    def times(self, steps: NDArray | int, time_step: float) -> Any:
        """Return the times (frames,) [s] after ``steps`` (frames,) further steps of length ``time_step`` [s]."""
        return (self.time - self.steps * time_step) + (self.steps + steps) * time_step

    def after(self, steps: int, time_step: float) -> "Clock":
        return Clock(self.steps + steps, float(self.times(steps, time_step)))


@dataclass(frozen=True)
class RecordedClock(Clock):
    recorded: NDArray = field(default_factory=lambda: np.zeros(1), repr=False, compare=False)
    """Time of each state (steps + 1,) [s]."""
    sizes: NDArray = field(default_factory=lambda: np.zeros(0), repr=False, compare=False)
    """Length of each step (steps,) [s]."""

    def times(self, steps: NDArray | int, time_step: float) -> Any:
        """Return the times (frames,) [s] after ``steps`` further steps; ``time_step`` is ignored."""
        return np.interp(steps, np.arange(len(self.recorded)), self.recorded)

    def after(self, steps: int, time_step: float) -> Clock:
        if steps == 0:
            return Clock(self.steps, self.time, self.time_step)
        return Clock(self.steps + steps, float(self.recorded[steps]), float(self.sizes[steps - 1]))


@dataclass(frozen=True)
class Origin:
    """Properties of the scene of a state. A run can start from the state only in a scene with equal properties."""

    spacing: float
    """Particle spacing [m]."""
    support: float
    """Support radius of the smoothing kernel [spacings]."""
    kernel: str
    periods: tuple[float, ...]
    """Lengths of the periodic box (d,) [m]; 0 along an axis that is not periodic."""
    waiting: tuple[int, ...]
    """Number of particles of each emitter."""
    rest_density: tuple[float, ...]
    """Rest density of each phase (phases,) [kg/m3]."""
    solver: str | None = None
    """Name of the solver if the state has fields of the solver, else None."""

    def to_json(self) -> str:
        return json.dumps(asdict(self))

    @classmethod
    def from_json(cls, text: str) -> "Origin":
        read: dict[str, Any] = json.loads(text)
        values: dict[str, Any] = {name: tuple(v) if isinstance(v, list) else v for name, v in read.items()}
        return cls(**values)


@dataclass(frozen=True, eq=False, repr=False)
class RestartState(ShortRepr):
    """The complete state at the end of a step. `Simulation.run` accepts `Trajectory.last_state`."""

    fields: Mapping[str, NDArray]
    """Arrays by field name.

    The arrays are positions (n, d) [m], velocities (n, d) [m/s], mass_fractions (n, phases), and reference_density (n,)
    [kg/m3]. The reference density is the mass of a particle divided by its volume on the rest lattice.

    An emitter with the name NAME has two more arrays. NAME.outlet (1, d) is the position of the emitter's opening [m].
    NAME.emitted (1,) is the length of the emitted column [m]. Some solvers add fields to the state.
    """
    clock: Clock = field(default_factory=Clock)
    """Time of the state."""
    origin: Origin | None = None
    """Properties of the scene that made the state; None if unknown."""

    def __getitem__(self, name: str) -> NDArray:
        """Return a field by name. Raise `InputError` for an unknown field."""
        if name not in self.fields:
            raise InputError(f"state has no {shown(name)}, but has {', '.join(self.fields)}.")
        return self.fields[name]

    def fixed(self) -> "RestartState":
        """Return the state with read-only copies of the arrays."""
        own = {name: np.array(value) for name, value in self.fields.items()}
        for array in own.values():
            array.setflags(write=False)
        return replace(self, fields=FixedDict(own))
