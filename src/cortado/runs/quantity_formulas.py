"""Quantities of the sorted particles of a step, with their tangents and adjoints.

Sums over neighbours are kernels; what is done with the sum of each particle alone is NumPy in float64. n is the number
density, m a particle's mass over its volume V on the rest lattice. Forces on walls are in `cortado.runs.wall_loads`.

Vorticity is by summation over the fluid around a particle (Monaghan 1992):

    c_i = V sum_j (v_i - v_j) x G_ij,   omega_i = c_i / (mu n_i).

mu = -(V / d) sum_j x_j . G_j is that of the rest lattice, on which a fluid that turns as a whole has twice its rate of
turning. Walls have no part in it.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any, Protocol, Self

import numpy as np
import warp as wp
from numpy.typing import NDArray

from cortado.device.launching import Named
from cortado.device.modules import Kernels
from cortado.particles.made_derivatives import made_adjoint, made_tangent
from cortado.particles.neighbourhood import Discretisation, neighbourhood_type, pair_functions
from cortado.particles.pair_sums import fluid_sum
from cortado.particles.particle_kernels import sum_kernels
from cortado.particles.state import Fields
from cortado.solvers.particles import ParticleSolver
from cortado.sph.parts import Adjoints, StepContext, Tangents


def turns(discretisation: Discretisation) -> Callable[..., Any]:
    """Make the function of a pair's term (v_i - v_j) x G_ij in the circulation."""
    vector, neighbourhood = discretisation.precision.vector, neighbourhood_type(discretisation.precision)
    gradient = pair_functions(discretisation).gradient

    def turning(x_ij: vector, v_ij: vector, s: neighbourhood) -> vector:
        return wp.cross(v_ij, gradient(x_ij, s))

    return turning


@cache
def circulation_kernels(discretisation: Discretisation) -> Kernels:
    """Make kernels ``forward``, ``tangent`` and ``adjoint`` of the sum c, the vorticity times mu n."""
    sums = (
        fluid_sum(discretisation)(turns(discretisation)),
        *(make(discretisation, turns) for make in (made_tangent, made_adjoint)),
    )
    _, tangent_module, adjoint_module = discretisation.modules("vorticity")
    modules = adjoint_module, tangent_module, adjoint_module  # a tape does not see the sum
    return sum_kernels("circulation", modules, sums, "circulation", times="s.volume")


def vectors(array: wp.array) -> NDArray:
    """Read an array of vectors from the device, (n, 3) in float64."""
    return np.asarray(array.numpy(), dtype=np.float64)


@dataclass(frozen=True)
class Pressures:
    """The pressures of the sorted particles of a step: copies."""

    push: wp.array
    """(n,) pressures with which they push walls [Pa], on the device."""
    stress: NDArray | None
    """(n,) pressures that a gauge would read [Pa], float64; None where nobody asks for them."""


@dataclass(frozen=True)
class Particles:
    """Numbers of sorted particles in float64, off the device: of a step, their tangents, or adjoints."""

    fields: Mapping[str, NDArray]
    """By the names of `Fields`: ``x`` and ``v`` (n, 3), ``n`` and ``m`` (n,)."""
    pressures: Pressures | None
    """Their pressures; None where none were computed."""
    on_device: "OnDevice | None" = None
    """For adjoints, the arrays to which kernels add."""

    @classmethod
    def of(cls, fields: Fields, pressures: Pressures | None) -> Self:
        """Read the fields of particles from the device."""
        return cls({name: fields[name].numpy().astype(np.float64) for name in "xvnm"}, pressures)

    @classmethod
    def zeros(cls, push: wp.array, on_device: "OnDevice | None" = None) -> Self:
        """Make fields and stresses of zeros, beside pressures ``push`` that are zeros."""
        particles, shapes = len(push), {"x": (3,), "v": (3,), "n": (), "m": ()}
        fields = {name: np.zeros((particles, *shape)) for name, shape in shapes.items()}
        return cls(fields, Pressures(push, np.zeros(particles)), on_device)

    def __getitem__(self, name: str) -> NDArray:
        return self.fields[name]

    @property
    def push(self) -> wp.array:
        """Return the pressures (n,) with which they push walls [Pa], on the device."""
        assert self.pressures is not None
        return self.pressures.push

    @property
    def stress(self) -> NDArray:
        """Return the pressures (n,) that a gauge would read [Pa]."""
        assert self.pressures is not None and self.pressures.stress is not None
        return self.pressures.stress

    @property
    def within(self) -> "OnDevice":
        """Return the arrays to which kernels add adjoints."""
        assert self.on_device is not None
        return self.on_device


@dataclass(frozen=True)
class OnDevice:
    """Adjoints within a step on the device, for kernels."""

    bar: Adjoints
    """Adjoints of sorted particles at the start of the step, and of parameters and solids."""
    v_star: wp.array
    """(n,) adjoint of the predicted velocities, see `cortado.solvers.solver.WithinBar`."""


class Sums:
    """The sums over neighbours of a step, on the device."""

    def __init__(self, solver: ParticleSolver, context: StepContext):
        self._solver, self.context = solver, context
        self.circulation = circulation_kernels(solver.discretisation)

    def __call__(self, kernel: Any, *named: Named, **given: NDArray) -> NDArray:
        """Return the vectors (n, 3) that a kernel writes to its last argument, given the step's fields and further
        vectors."""
        arrays = {name: self.on_device(value) for name, value in given.items()}
        found = self._solver.vectors()
        self.context.launch(kernel, *named, **arrays, **{kernel.adj.args[-1].label: found})
        return vectors(found)

    def add(self, kernel: Any, bar: Particles, **given: NDArray) -> None:
        """Let a kernel add to the adjoints ``x_bar`` and ``v_bar``."""
        arrays = {name: self.on_device(value) for name, value in given.items()}
        own = {"x": self._solver.vectors(), "v": self._solver.vectors()}
        self.context.launch(kernel, **arrays, **{f"{name}_bar": array for name, array in own.items()})
        for name, array in own.items():
            bar[name][:] += array.numpy()

    def on_device(self, values: NDArray) -> wp.array:
        """Copy vectors (n, 3) to the device."""
        return wp.array(values, dtype=self._solver.discretisation.precision.vector, device=self._solver.device)


class QuantityFormula(Protocol):
    """A formula of a quantity of the sorted particles of a step, with its derivatives."""

    def value(self, at: Particles, sums: Sums) -> NDArray:
        """Return the quantity (n,) or (n, k); for the load on a solid (scenes, k)."""

    def tangent(self, at: Particles, sums: Sums, dot: Particles, along: Tangents) -> NDArray:
        """Return the tangent of the quantity along ``dot``; ``along`` has it on the device."""

    def adjoint(self, at: Particles, sums: Sums, own: NDArray, bar: Particles) -> None:
        """Add to the adjoints of the particles by the quantity's own adjoint, in the shape of its value."""


class OnDeviceFormula(Protocol):
    """A formula of a quantity that needs the step after a state, as captured steps compute it."""

    def on_device(self, step: StepContext, p: wp.array) -> wp.array:
        """Return the quantity of the step that was just taken, with the pressures ``p`` (n,) by which particles push
        walls: an entry for each sorted particle, or six numbers for each scene. The next call overwrites it."""


class Density:
    """The quantity of densities, rho_i = m_i n_i."""

    def value(self, at: Particles, sums: Sums) -> NDArray:
        return at["m"] * at["n"]

    def tangent(self, at: Particles, sums: Sums, dot: Particles, along: Tangents) -> NDArray:
        return dot["m"] * at["n"] + at["m"] * dot["n"]

    def adjoint(self, at: Particles, sums: Sums, own: NDArray, bar: Particles) -> None:
        bar["m"][:] += own * at["n"]
        bar["n"][:] += own * at["m"]


@dataclass(frozen=True)
class Pressure:
    """The quantity of pressures that a gauge would read."""

    solver: ParticleSolver

    def on_device(self, step: StepContext, p: wp.array) -> wp.array:
        """Return the pressures (n,) of sorted particles."""
        return self.solver.stresses()

    def value(self, at: Particles, sums: Sums) -> NDArray:
        return at.stress

    def tangent(self, at: Particles, sums: Sums, dot: Particles, along: Tangents) -> NDArray:
        return dot.stress

    def adjoint(self, at: Particles, sums: Sums, own: NDArray, bar: Particles) -> None:
        bar.stress[:] += own


class SpeedQuantity:
    """The quantity of speeds |v_i|; of a particle at rest, where it has a kink, the derivative is taken as 0."""

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
    """The quantity of vorticities c_i / (mu n_i): see `cortado.runs.quantity_formulas`. In the plane it is the
    component that stands on it."""

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
