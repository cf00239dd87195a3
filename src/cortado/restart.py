"""What a run needs to go on from where another one stopped, bit for bit."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from cortado.words import Brief


@dataclass(frozen=True)
class Elapsed:
    """What went before a run; by default nothing."""

    steps: int = 0
    """Steps taken."""
    time: float = 0.0
    """[s]"""
    outlet: NDArray | None = None
    """(d,) where the opening of the nozzle was at the end [m]; None without an emitter."""

    def times(self, steps: NDArray, time_step: float) -> NDArray:
        """(frames,) [s] after so many steps more of ``time_step`` [s]; of the same size they are those of one run, bit
        for bit."""
        return (self.time - self.steps * time_step) + (self.steps + steps) * time_step


@dataclass(frozen=True, eq=False, repr=False)
class RunConstants(Brief):
    """What a restart needs of a run besides its frames."""

    reference_density: NDArray
    """(n,) mass of a particle over its volume on the rest lattice [kg/m3]. It follows from the particle's first mass
    fractions and is kept, so that present ones do not tell it."""
    time_step: float
    """[s]"""
    flow_rate: float | None = None
    """Of the nozzle [m3/s], in 2-D [m2/s]; None without an emitter."""
    outlets: NDArray | None = None
    """(frames, d) where the opening of the nozzle was at each frame [m]; None without an emitter."""

    def arrays(self) -> dict[str, NDArray]:
        """By name, without those that are None."""
        return {name: np.asarray(value) for name, value in vars(self).items() if value is not None}

    @classmethod
    def of(cls, arrays: Mapping[str, NDArray], frames: int) -> Self | None:
        """From arrays by name, of a run that may have recorded fewer frames; None if there are none."""
        if not arrays:
            return None
        numbers = {name: float(arrays[name]) for name in ("time_step", "flow_rate") if name in arrays}
        outlets = arrays["outlets"][:frames] if "outlets" in arrays else None
        return cls(reference_density=arrays["reference_density"], outlets=outlets, **numbers)


@dataclass(frozen=True, eq=False, repr=False)
class RestartState(Brief):
    """The state at the end of a step, whole: `Trajectory.last_state` gives it and `Simulation.run` takes it."""

    positions: NDArray
    """(n, d) [m]"""
    velocities: NDArray
    """(n, d) [m/s]"""
    mass_fractions: NDArray | None
    """(n, phases) [-]; None with one phase"""
    constants: RunConstants
    """Of the run that it is the end of."""
    elapsed: Elapsed
    """The steps and the time before, and where the nozzle was."""
