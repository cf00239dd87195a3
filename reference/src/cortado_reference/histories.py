"""What a run of the reference engine leaves, step by step."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cortado_reference.digits import Digits


@dataclass(frozen=True, eq=False)
class History:
    """A run, and what its derivative did. Without a derivative the last four are None."""

    steps: NDArray[np.int32]
    """(frames,) steps taken before each recorded state; 0 is the first."""
    times: NDArray[np.float64]
    """(frames,) [s]"""
    positions: Digits
    """(frames, n, d) [m]"""
    velocities: Digits
    """(frames, n, d) [m / s]"""
    iterations: NDArray[np.int32]
    """(steps,) pressure iterations."""
    density_errors: NDArray[np.float64]
    """(steps,) average (rho* - rho_0)+ / rho_0 as it was before the last correction."""
    position_tangents: Digits | None
    """(frames, n, d) derivatives of the positions along the direction; None for an adjoint."""
    velocity_tangents: Digits | None
    """(frames, n, d), of the velocities."""
    position_norms: NDArray[np.float64] | None
    """(steps + 1,) Euclidean norm over all particles of the tangent or adjoint of each state's positions."""
    velocity_norms: NDArray[np.float64] | None
    """(steps + 1,) of its velocities."""

    @classmethod
    def of(cls, raw: Any, shape: tuple[int, int], time_step: float) -> "History":
        """From what the extension module returns, for particles in the ``shape`` (n, d)."""

        def numbers(name: str) -> Digits | None:
            found = getattr(raw, name)
            high = found.high
            return Digits(high, found.low).reshape((-1, *shape)) if high.size else None

        def norms(name: str) -> NDArray[np.float64] | None:
            found = getattr(raw, name)
            return found if found.size else None

        positions, velocities = numbers("positions"), numbers("velocities")
        assert positions is not None and velocities is not None, "the first state is always recorded"
        return cls(
            steps=raw.frames,
            times=raw.frames * time_step,
            positions=positions,
            velocities=velocities,
            iterations=raw.iterations,
            density_errors=raw.errors,
            position_tangents=numbers("position_dots"),
            velocity_tangents=numbers("velocity_dots"),
            position_norms=norms("position_norms"),
            velocity_norms=norms("velocity_norms"),
        )


@dataclass(frozen=True, eq=False)
class Gradient:
    """A loss and its derivatives."""

    value: float
    """The loss."""
    parameters: dict[str, Digits]
    """For each parameter asked for, an array of its shape."""
    history: History
    """Of the states; the norms are those of the adjoints."""
