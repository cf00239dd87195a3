"""What each quantity is of the sorted particles of a step, with its tangent and its adjoint.

Sums over neighbours are kernels; what is done with the sum of each particle alone is NumPy in float64. n is the number
density, m a particle's mass over its volume V on the rest lattice, p the pressure that it pushes walls with.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from cortado.particles.arrays import padded
from cortado.particles.solid_shares import ALL_WALLS
from cortado.runs.quantities.loads import SolidLoad, WallLoads
from cortado.runs.quantities.particles import Particles, Sums
from cortado.scene.quantities import load_name
from cortado.solvers.particles import ParticleSolver
from cortado.sph.parts import Tangents


class QuantityFormula(Protocol):
    """A quantity of the sorted particles of a step."""

    def value(self, at: Particles, sums: Sums) -> NDArray:
        """(n,) or (n, k); of the load on a solid (scenes, k)"""

    def tangent(self, at: Particles, sums: Sums, dot: Particles, along: Tangents) -> NDArray:
        """The same along ``dot``; ``along`` has it on the device."""

    def adjoint(self, at: Particles, sums: Sums, own: NDArray, bar: Particles) -> None:
        """From its own adjoint, in the shape of its value, add to those of the particles."""


class Density:
    """rho_i = m_i n_i"""

    def value(self, at: Particles, sums: Sums) -> NDArray:
        return at["m"] * at["n"]

    def tangent(self, at: Particles, sums: Sums, dot: Particles, along: Tangents) -> NDArray:
        return dot["m"] * at["n"] + at["m"] * dot["n"]

    def adjoint(self, at: Particles, sums: Sums, own: NDArray, bar: Particles) -> None:
        bar["m"][:] += own * at["n"]
        bar["n"][:] += own * at["m"]


class Pressure:
    """What a gauge would read."""

    def value(self, at: Particles, sums: Sums) -> NDArray:
        return at.stress

    def tangent(self, at: Particles, sums: Sums, dot: Particles, along: Tangents) -> NDArray:
        return dot.stress

    def adjoint(self, at: Particles, sums: Sums, own: NDArray, bar: Particles) -> None:
        bar.stress[:] += own


class SpeedQuantity:
    """|v_i|; of a particle at rest, where it has a kink, the derivative is taken as 0."""

    def value(self, at: Particles, sums: Sums) -> NDArray:
        return np.linalg.norm(at["v"], axis=1)

    def tangent(self, at: Particles, sums: Sums, dot: Particles, along: Tangents) -> NDArray:
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

    def tangent(self, at: Particles, sums: Sums, dot: Particles, along: Tangents) -> NDArray:
        change = sums(sums.circulation.tangent, *along.named)
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
    """What a particle pushes all walls with: see `cortado.runs.quantities.loads`."""

    loads: WallLoads
    dimension: int

    def value(self, at: Particles, sums: Sums) -> NDArray:
        return self.loads.forces(at, sums, ALL_WALLS)[:, : self.dimension]

    def tangent(self, at: Particles, sums: Sums, dot: Particles, along: Tangents) -> NDArray:
        return self.loads.tangent(at, sums, dot, along, ALL_WALLS)[:, : self.dimension]

    def adjoint(self, at: Particles, sums: Sums, own: NDArray, bar: Particles) -> None:
        self.loads.adjoint(at, sums, padded(own), bar, ALL_WALLS)


def formulas(solver: ParticleSolver, dimension: int, circulation_factor: float) -> dict[str, QuantityFormula]:
    """Those of a solver's particles, and of the loads on its solids, by their names."""
    loads = WallLoads(solver)
    return {
        "density": Density(),
        "pressure": Pressure(),
        "speed": SpeedQuantity(),
        "vorticity": Vorticity(circulation_factor, dimension),
        "wall_force": WallForceQuantity(loads, dimension),
        **{load_name(name): SolidLoad(loads, solver, solid, dimension) for name, solid in solver.system.solids.items()},
    }
