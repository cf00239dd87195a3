"""What a scene becomes: dataclasses of plain Warp arrays. Vectors have three components here, z is 0 in 2-D."""

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import warp as wp

from cortado.precision import Precision


def padded(vectors: np.ndarray) -> np.ndarray:
    """Vectors (n, 2) or (n, 3) with three components, in float64."""
    return np.hstack([vectors, np.zeros((len(vectors), 3 - vectors.shape[1]))])


def to_device(values: np.ndarray, precision: Precision, device: Any) -> wp.array:
    """Vectors (n, 2) or (n, 3) as a Warp array of vectors (n,)."""
    return wp.array(padded(values), dtype=precision.vector, device=device)


@dataclass(frozen=True)
class State:
    """Where the fluid is and how it moves, in the scene's order of particles. Also the type of its derivatives."""

    positions: wp.array
    """(n,) vectors [m]."""
    velocities: wp.array
    """(n,) vectors [m / s]."""

    @classmethod
    def zeros(cls, particles: int, precision: Precision, device: Any, requires_grad: bool = False) -> "State":
        """A state of zeros."""
        return cls(
            *(
                wp.zeros(particles, dtype=precision.vector, device=device, requires_grad=requires_grad)
                for _ in fields(cls)
            )
        )

    @classmethod
    def empty(cls, particles: int, precision: Precision, device: Any) -> "State":
        """A state that is still to be written."""
        return cls(*(wp.empty(particles, dtype=precision.vector, device=device) for _ in fields(cls)))

    def assign(self, other: "State") -> None:
        """Copy another state of the same device and size, without a host round trip."""
        wp.copy(self.positions, other.positions)
        wp.copy(self.velocities, other.velocities)

    def set(self, positions: np.ndarray, velocities: np.ndarray) -> None:
        """Write arrays (n, 2) or (n, 3)."""
        self.positions.assign(padded(positions))
        self.velocities.assign(padded(velocities))

    def numpy(self, dimension: int) -> tuple[np.ndarray, np.ndarray]:
        """Positions and velocities as new arrays (n, dimension)."""
        return (
            self.positions.numpy()[:, :dimension].copy(),
            self.velocities.numpy()[:, :dimension].copy(),
        )


@dataclass(frozen=True)
class Parameters:
    """What a run depends on besides its first state. Also the type of its derivatives."""

    gravity: wp.array
    """(steps,) vectors [m / s2]: one for each step."""
    rest_density: wp.array
    """(1,) [kg / m3]"""
    viscosity: wp.array
    """(1,) dynamic [Pa s]"""
    time_step: wp.array
    """(1,) [s]"""

    @classmethod
    def zeros(cls, steps: int, precision: Precision, device: Any, requires_grad: bool = False) -> "Parameters":
        """Parameters of a run of so many steps, all 0."""
        options = {"device": device, "requires_grad": requires_grad}
        return cls(
            wp.zeros(max(steps, 1), dtype=precision.vector, **options),
            *(wp.zeros(1, dtype=precision.real, **options) for _ in range(3)),
        )

    def set(self, gravity: np.ndarray, rest_density: float, viscosity: float, time_step: float) -> None:
        """Write values; gravity (d,) for every step or (steps, d)."""
        table = np.zeros((self.gravity.shape[0], 3))
        table[:, : gravity.shape[-1]] = gravity
        self.gravity.assign(table)
        self.rest_density.fill_(rest_density)
        self.viscosity.fill_(viscosity)
        self.time_step.fill_(time_step)


@dataclass(frozen=True)
class Fields:
    """Sorted particles within a step. Also the type of tangents and adjoints."""

    x: wp.array
    """(n,) positions [m]"""
    v: wp.array
    """(n,) velocities [m / s]"""
    rho: wp.array
    """(n,) densities [kg / m3]"""

    @classmethod
    def zeros(cls, particles: int, precision: Precision, device: Any, requires_grad: bool = False) -> "Fields":
        """Fields of zeros."""
        options = {"device": device, "requires_grad": requires_grad}
        return cls(
            wp.zeros(particles, dtype=precision.vector, **options),
            wp.zeros(particles, dtype=precision.vector, **options),
            wp.zeros(particles, dtype=precision.real, **options),
        )
