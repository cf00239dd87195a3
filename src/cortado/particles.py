"""What a scene becomes: dataclasses of plain Warp arrays. Vectors have three components here, z is 0 in 2-D."""

from dataclasses import dataclass, fields
from typing import Any, Self

import numpy as np
import warp as wp

from cortado.parameter_values import TABLES
from cortado.precision import Precision


def padded(vectors: np.ndarray) -> np.ndarray:
    """Vectors (n, 2) or (n, 3) with three components, in float64."""
    return np.hstack([vectors, np.zeros((len(vectors), 3 - vectors.shape[1]))])


def to_device(values: np.ndarray, precision: Precision, device: Any) -> wp.array:
    """Vectors (n, 2) or (n, 3) as a Warp array of vectors (n,)."""
    return wp.array(padded(values), dtype=precision.vector, device=device)


class Arrays:
    """A dataclass of Warp arrays."""

    def arrays(self) -> list[wp.array]:
        """Its arrays, in the order of its fields."""
        return [getattr(self, field.name) for field in fields(self)]  # type: ignore[arg-type]

    def assign(self, other: Self) -> None:
        """Copy another of the same device and sizes, without a host round trip."""
        for own, source in zip(self.arrays(), other.arrays(), strict=True):
            wp.copy(own, source)

    def like(self) -> Self:
        """One of the same sizes that is still to be written."""
        return type(self)(*(wp.empty_like(array, requires_grad=False) for array in self.arrays()))

    def clear(self) -> None:
        """Make everything 0."""
        for array in self.arrays():
            array.zero_()


@dataclass(frozen=True)
class State(Arrays):
    """Where the fluid is, how it moves and what it is, in the scene's order of particles. Also the type of its
    derivatives."""

    positions: wp.array
    """(n,) vectors [m]."""
    velocities: wp.array
    """(n,) vectors [m / s]."""
    mass_fractions: wp.array
    """(n,) of as many numbers as there are phases [-]."""

    @classmethod
    def zeros(
        cls, particles: int, phases: int, precision: Precision, device: Any, requires_grad: bool = False
    ) -> "State":
        """A state of zeros."""
        types = (precision.vector, precision.vector, precision.fractions(phases))
        return cls(*(wp.zeros(particles, dtype=t, device=device, requires_grad=requires_grad) for t in types))

    def set(self, positions: np.ndarray, velocities: np.ndarray, mass_fractions: np.ndarray) -> None:
        """Write arrays, (n, d) vectors and (n, phases)."""
        self.positions.assign(padded(positions))
        self.velocities.assign(padded(velocities))
        self.mass_fractions.assign(mass_fractions)

    def numpy(self, dimension: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Positions and velocities (n, dimension), mass fractions (n, phases), as new arrays."""
        return (
            self.positions.numpy()[:, :dimension].copy(),
            self.velocities.numpy()[:, :dimension].copy(),
            self.mass_fractions.numpy().copy(),
        )


@dataclass(frozen=True)
class Parameters(Arrays):
    """What a run depends on besides its first state. Also the type of its derivatives."""

    gravity: wp.array
    """(steps,) vectors [m / s2]: one for each step."""
    masses: wp.array
    """(n,) of a particle over its volume on the rest lattice [kg / m3], in the scene's order."""
    rest_density: wp.array
    """(phases,) [kg / m3]"""
    viscosity: wp.array
    """(phases,) dynamic [Pa s]"""
    time_step: wp.array
    """(1,) [s]"""
    mobility: wp.array
    """(1,) M_0 of Cahn-Hilliard diffusion [m2 / s]"""
    interface_width: wp.array
    """(1,) epsilon of Cahn-Hilliard diffusion [m]"""
    nozzle_path: wp.array
    """(steps,) vectors [m]: where the opening of the nozzle is after each step."""
    flow_rate: wp.array
    """(1,) of the nozzle [m3 / s]"""

    @classmethod
    def zeros(
        cls, steps: int, particles: int, phases: int, precision: Precision, device: Any, requires_grad: bool = False
    ) -> "Parameters":
        """Parameters of a run of so many steps, all 0."""
        options = {"device": device, "requires_grad": requires_grad}
        sizes = {"masses": particles, "rest_density": phases, "viscosity": phases}
        return cls(
            *(
                wp.zeros(max(steps, 1), dtype=precision.vector, **options)
                if field.name in TABLES
                else wp.zeros(sizes.get(field.name, 1), dtype=precision.real, **options)
                for field in fields(cls)
            )
        )

    def set_tables(self, **values: np.ndarray) -> None:
        """Write any of `TABLES` by name, (d,) for every step or (steps, d)."""
        for name, value in values.items():
            table = np.zeros((len(getattr(self, name)), 3))
            table[:, : value.shape[-1]] = value
            getattr(self, name).assign(table)

    def set_constants(self, **values: Any) -> None:
        """Write any of the others by name, numbers or arrays."""
        for name, value in values.items():
            array = getattr(self, name)
            array.assign(np.broadcast_to(np.asarray(value, dtype=np.float64), array.shape))


@dataclass(frozen=True)
class Fields(Arrays):
    """Sorted particles within a step. Also the type of tangents and adjoints."""

    x: wp.array
    """(n,) positions [m]"""
    v: wp.array
    """(n,) velocities [m / s]"""
    n: wp.array
    """(n,) number densities [-]: 1 on the rest lattice"""
    m: wp.array
    """(n,) masses over the volume on the rest lattice [kg / m3]: the density is m n"""
    rho_0: wp.array
    """(n,) rest densities [kg / m3]"""
    mu: wp.array
    """(n,) dynamic viscosities [Pa s]"""

    @classmethod
    def zeros(cls, particles: int, precision: Precision, device: Any, requires_grad: bool = False) -> "Fields":
        """Fields of zeros."""
        types = [precision.vector] * 2 + [precision.real] * 4
        return cls(*(wp.zeros(particles, dtype=t, device=device, requires_grad=requires_grad) for t in types))
