"""What a scene becomes on a device: Warp arrays by name. Vectors have three components here, z is 0 in 2-D."""

from collections.abc import Mapping
from typing import Any, Self

import numpy as np
import warp as wp

from cortado.device.precision import Precision
from cortado.parameters.registry import BY_NAME, Axis, Role, names
from cortado.parameters.values import OVER_TIME


def padded(vectors: np.ndarray) -> np.ndarray:
    """Vectors (n, 2) or (n, 3) with three components, in float64."""
    return np.hstack([vectors, np.zeros((len(vectors), 3 - vectors.shape[1]))])


def to_device(values: np.ndarray, precision: Precision, device: Any) -> wp.array:
    """Vectors (n, 2) or (n, 3) as a Warp array of vectors (n,)."""
    return wp.array(padded(values), dtype=precision.vector, device=device)


class Arrays:
    """Warp arrays by name."""

    def __init__(self, arrays: Mapping[str, wp.array]):
        self._arrays = dict(arrays)
        self._named: dict[str, dict[str, wp.array]] = {}

    def __getitem__(self, name: str) -> wp.array:
        return self._arrays[name]

    @property
    def names(self) -> tuple[str, ...]:
        """Their names, in their order."""
        return tuple(self._arrays)

    def arrays(self) -> list[wp.array]:
        """The arrays, in their order."""
        return list(self._arrays.values())

    def named(self, suffix: str = "") -> dict[str, wp.array]:
        """The arrays as kernels call their arguments: "_dot" behind the name of a tangent, "_bar" of an adjoint."""
        if suffix not in self._named:
            self._named[suffix] = {name + suffix: array for name, array in self._arrays.items()}
        return self._named[suffix]

    def assign(self, other: Self) -> None:
        """Copy another of the same device and sizes, without a host round trip."""
        for own, source in zip(self.arrays(), other.arrays(), strict=True):
            wp.copy(own, source)

    def like(self) -> Self:
        """One of the same sizes that is still to be written."""
        return type(self)({name: wp.empty_like(a, requires_grad=False) for name, a in self._arrays.items()})

    def gradients(self) -> Self:
        """The adjoints of the arrays that Warp's tape has written."""
        return type(self)({name: array.grad for name, array in self._arrays.items()})

    def clear(self) -> None:
        """Make everything 0."""
        for array in self.arrays():
            array.zero_()


def zeros(kinds: Mapping[str, tuple[int, Any]], device: Any, requires_grad: bool = False) -> dict[str, wp.array]:
    """Arrays of zeros by name, each of a size and a Warp type."""
    options = {"device": device, "requires_grad": requires_grad}
    return {name: wp.zeros(size, dtype=dtype, **options) for name, (size, dtype) in kinds.items()}


class State(Arrays):
    """Where the fluid is, how it moves and what it is, in the scene's order of particles. Also the type of its
    derivatives.

    ``positions`` (n,) vectors [m], ``velocities`` (n,) vectors [m / s], ``mass_fractions`` (n,) of as many numbers as
    there are phases [-].
    """

    @property
    def positions(self) -> wp.array:
        """(n,) vectors [m]."""
        return self["positions"]

    @property
    def velocities(self) -> wp.array:
        """(n,) vectors [m / s]."""
        return self["velocities"]

    @property
    def mass_fractions(self) -> wp.array:
        """(n,) of as many numbers as there are phases [-]."""
        return self["mass_fractions"]

    @classmethod
    def zeros(cls, particles: int, phases: int, precision: Precision, device: Any, requires_grad: bool = False) -> Self:
        """A state of zeros."""
        vectors = (particles, precision.vector)
        fractions = (particles, precision.fractions(phases))
        kinds = {"positions": vectors, "velocities": vectors, "mass_fractions": fractions}
        return cls(zeros(kinds, device, requires_grad))

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


class Parameters(Arrays):
    """What steps depend on besides the state, by the names of the registry. Also the type of its derivatives.

    A parameter over time is (steps,) vectors, one of phases (phases,) numbers, any other (1,) number. Besides them
    ``reference_density`` (n,) [kg / m3]: the mass of a particle over its volume on the rest lattice, in the scene's
    order.
    """

    @classmethod
    def zeros(
        cls, steps: int, particles: int, phases: int, precision: Precision, device: Any, requires_grad: bool = False
    ) -> Self:
        """Parameters of a run of so many steps, all 0."""
        sizes = {Axis.STEP: (max(steps, 1), precision.vector), Axis.PHASE: (phases, precision.real)}
        kinds = {name: sizes.get(BY_NAME[name].axis, (1, precision.real)) for name in names(Role.RUN)}
        return cls(zeros({**kinds, "reference_density": (particles, precision.real)}, device, requires_grad))

    def set(self, values: Mapping[str, Any]) -> None:
        """Write some by name: a vector (d,) for every step, or vectors (steps, d); numbers or arrays of them."""
        for name, value in values.items():
            array, given = self[name], np.asarray(value, dtype=np.float64)
            if name in OVER_TIME:
                table = np.zeros((len(array), 3))
                table[:, : given.shape[-1]] = given
                array.assign(table)
            else:
                array.assign(np.broadcast_to(given, array.shape))


class Fields(Arrays):
    """Sorted particles within a step. Also the type of tangents and adjoints.

    ``x`` (n,) positions [m]; ``v`` (n,) velocities [m / s]; ``n`` (n,) number densities [-], 1 on the rest lattice;
    ``m`` (n,) masses over the volume on the rest lattice [kg / m3], so that the density is m n; ``rho_0`` (n,) rest
    densities [kg / m3]; ``mu`` (n,) dynamic viscosities [Pa s].
    """

    @classmethod
    def zeros(cls, particles: int, precision: Precision, device: Any, requires_grad: bool = False) -> Self:
        """Fields of zeros."""
        types = dict.fromkeys("xv", precision.vector) | dict.fromkeys(("n", "m", "rho_0", "mu"), precision.real)
        return cls(zeros({name: (particles, dtype) for name, dtype in types.items()}, device, requires_grad))
