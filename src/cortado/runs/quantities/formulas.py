"""What each quantity is of the sorted particles of a step, with its tangent and its adjoint.

Sums over neighbours are kernels; what is done with the sum of each particle alone is NumPy in float64. n is the number
density, m a particle's mass over its volume V on the rest lattice, p the pressure of the solver's last iteration.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol, Self

import numpy as np
import warp as wp
from numpy.typing import NDArray

from cortado.device.binding import Named
from cortado.particles.arrays import Fields, padded
from cortado.solvers.particles import ParticleSolver
from cortado.sph.parts import StepContext
from cortado.sph.vorticity import circulation_kernels
from cortado.sph.wall_slope import wall_slope_kernels


@dataclass(frozen=True)
class Particles:
    """Numbers of sorted particles in float64, off the device: of a step, their tangents, or adjoints."""

    fields: Mapping[str, NDArray]
    """By the names of `Fields`: ``x`` and ``v`` (n, 3), ``n`` and ``m`` (n,)."""
    pressure: NDArray | None
    """(n,) [Pa]; None where none was computed."""
    slope: NDArray | None = None
    """(n, 3) of adjoints that of the walls' g."""

    @classmethod
    def of(cls, fields: Fields, pressure: NDArray | None) -> Self:
        """Those of fields on the device."""
        return cls({name: fields[name].numpy().astype(np.float64) for name in "xvnm"}, pressure)

    @classmethod
    def zeros(cls, particles: int) -> Self:
        """All 0."""
        vectors, numbers = (dict.fromkeys(names, shape) for names, shape in (("xv", (3,)), ("nm", ())))
        fields = {name: np.zeros((particles, *shape)) for name, shape in (vectors | numbers).items()}
        return cls(fields, np.zeros(particles), np.zeros((particles, 3)))

    def __getitem__(self, name: str) -> NDArray:
        return self.fields[name]

    @property
    def p(self) -> NDArray:
        """(n,) [Pa]"""
        assert self.pressure is not None
        return self.pressure


class Sums:
    """The sums over neighbours of a step, on the device."""

    def __init__(self, solver: ParticleSolver, context: StepContext):
        self._solver, self._context = solver, context
        self.circulation = circulation_kernels(solver.discretisation)
        self.walls = wall_slope_kernels(solver.discretisation)

    def __call__(self, kernel: Any, *named: Named, **vectors: NDArray) -> NDArray:
        """(n, 3) what a kernel writes to its last argument, given the step's fields and further ``vectors``."""
        arrays = {name: self._on_device(value) for name, value in vectors.items()}
        found = self._solver.vectors()
        self._context.launch(kernel, *named, **arrays, **{kernel.adj.args[-1].label: found})
        return found.numpy().astype(np.float64)

    def add(self, kernel: Any, bar: Particles, **vectors: NDArray) -> None:
        """Have a kernel add to ``x_bar`` and ``v_bar``."""
        arrays = {name: self._on_device(value) for name, value in vectors.items()}
        own = {"x": self._solver.vectors(), "v": self._solver.vectors()}
        self._context.launch(kernel, **arrays, **{f"{name}_bar": array for name, array in own.items()})
        for name, array in own.items():
            bar[name][:] += array.numpy()

    def _on_device(self, values: NDArray) -> wp.array:
        return wp.array(values, dtype=self._solver.discretisation.precision.vector, device=self._solver.device)


class QuantityFormula(Protocol):
    """A quantity of the sorted particles of a step."""

    def value(self, at: Particles, sums: Sums) -> NDArray:
        """(n,) or (n, k)"""

    def tangent(self, at: Particles, sums: Sums, dot: Particles, named: tuple[Named, ...]) -> NDArray:
        """The same along ``dot``; ``named`` has it on the device."""

    def adjoint(self, at: Particles, sums: Sums, own: NDArray, bar: Particles) -> None:
        """From its own adjoint, in the shape of its value, add to those of the particles."""


class Density:
    """rho_i = m_i n_i"""

    def value(self, at: Particles, sums: Sums) -> NDArray:
        return at["m"] * at["n"]

    def tangent(self, at: Particles, sums: Sums, dot: Particles, named: tuple[Named, ...]) -> NDArray:
        return dot["m"] * at["n"] + at["m"] * dot["n"]

    def adjoint(self, at: Particles, sums: Sums, own: NDArray, bar: Particles) -> None:
        bar["m"][:] += own * at["n"]
        bar["n"][:] += own * at["m"]


class Pressure:
    """p_i"""

    def value(self, at: Particles, sums: Sums) -> NDArray:
        return at.p

    def tangent(self, at: Particles, sums: Sums, dot: Particles, named: tuple[Named, ...]) -> NDArray:
        return dot.p

    def adjoint(self, at: Particles, sums: Sums, own: NDArray, bar: Particles) -> None:
        bar.p[:] += own


class SpeedQuantity:
    """|v_i|; of a particle at rest, where it has a kink, the derivative is taken as 0."""

    def value(self, at: Particles, sums: Sums) -> NDArray:
        return np.linalg.norm(at["v"], axis=1)

    def tangent(self, at: Particles, sums: Sums, dot: Particles, named: tuple[Named, ...]) -> NDArray:
        return (self._direction(at) * dot["v"]).sum(axis=1)

    def adjoint(self, at: Particles, sums: Sums, own: NDArray, bar: Particles) -> None:
        bar["v"][:] += self._direction(at) * own[:, None]

    def _direction(self, at: Particles) -> NDArray:
        speed = np.linalg.norm(at["v"], axis=1, keepdims=True)
        return np.divide(at["v"], speed, out=np.zeros_like(at["v"]), where=speed > 0.0)


@dataclass(frozen=True)
class Vorticity:
    """c_i / (mu n_i): see `cortado.sph.vorticity`. In the plane it is the component that stands on it."""

    factor: float
    """mu [-]"""
    dimension: int

    def value(self, at: Particles, sums: Sums) -> NDArray:
        return self._shown(sums(sums.circulation.forward) / self._divisor(at))

    def tangent(self, at: Particles, sums: Sums, dot: Particles, named: tuple[Named, ...]) -> NDArray:
        change = sums(sums.circulation.tangent, *named)
        whole = sums(sums.circulation.forward) / self._divisor(at)
        return self._shown(change / self._divisor(at) - whole * (dot["n"] / at["n"])[:, None])

    def adjoint(self, at: Particles, sums: Sums, own: NDArray, bar: Particles) -> None:
        turned = own if self.dimension == 3 else np.stack([np.zeros_like(own), np.zeros_like(own), own], axis=1)
        sums.add(sums.circulation.adjoint, bar, circulation_bar=turned / self._divisor(at))
        whole = sums(sums.circulation.forward) / self._divisor(at)
        bar["n"][:] -= (turned * whole).sum(axis=1) / at["n"]

    def _divisor(self, at: Particles) -> NDArray:
        return self.factor * at["n"][:, None]

    def _shown(self, turning: NDArray) -> NDArray:
        return turning if self.dimension == 3 else turning[:, 2]


@dataclass(frozen=True)
class WallForceQuantity:
    """V^2 p_i / n_i^power g_i: see `cortado.sph.wall_slope`."""

    volume: float
    dimension: int
    power: int
    """That of the solver's pressure force."""

    def value(self, at: Particles, sums: Sums) -> NDArray:
        return (self._strength(at)[:, None] * sums(sums.walls.slope))[:, : self.dimension]

    def tangent(self, at: Particles, sums: Sums, dot: Particles, named: tuple[Named, ...]) -> NDArray:
        slope, change = sums(sums.walls.slope), sums(sums.walls.tangent, *named)
        strength_dot = self.volume**2 / at["n"] ** self.power * (dot.p - self.power * at.p * dot["n"] / at["n"])
        return (strength_dot[:, None] * slope + self._strength(at)[:, None] * change)[:, : self.dimension]

    def adjoint(self, at: Particles, sums: Sums, own: NDArray, bar: Particles) -> None:
        whole = padded(own)
        strength_bar = (whole * sums(sums.walls.slope)).sum(axis=1)
        bar.p[:] += strength_bar * self.volume**2 / at["n"] ** self.power
        bar["n"][:] -= self.power * strength_bar * self._strength(at) / at["n"]
        assert bar.slope is not None
        bar.slope[:] += self._strength(at)[:, None] * whole
        bar["x"][:] += sums(sums.walls.change, along=self._strength(at)[:, None] * whole)

    def _strength(self, at: Particles) -> NDArray:
        return self.volume**2 * at.p / at["n"] ** self.power


def formulas(solver: ParticleSolver, dimension: int, circulation_factor: float) -> dict[str, QuantityFormula]:
    """Those of a solver's particles, by their names."""
    return {
        "density": Density(),
        "pressure": Pressure(),
        "speed": SpeedQuantity(),
        "vorticity": Vorticity(circulation_factor, dimension),
        "wall_force": WallForceQuantity(solver.lattice.volume, dimension, solver.density_power),
    }
