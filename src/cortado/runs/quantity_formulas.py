"""Quantities of the sorted particles of a step, with their tangents and adjoints.

Sums over neighbours and the forces on walls are kernels; other formulas of a particle are NumPy in float64. n is the
number density, m a particle's mass over its volume V on the rest lattice, p the pressure that it pushes walls with.

Vorticity is by summation over the fluid around a particle (Monaghan 1992):

    c_i = V sum_j (v_i - v_j) x G_ij,   omega_i = c_i / (mu n_i).

mu = -(V / d) sum_j x_j . G_j is that of the rest lattice, on which a fluid that turns as a whole has twice its rate of
turning. Walls have no part in it.

Particle i pushes walls, those of one solid or all, with

    f_i = s^d (V p_i / n_i^power A_i - m_i sum a_i),

where A_i is the sum over wall particles along which its pressure acts (``wall_push`` of
`cortado.solvers.particles.ParticleSolver`) and a_i the acceleration that they give it by a force such as viscosity. The
walls so get what momentum the fluid loses to them: the mass of a particle is m_i s^d, with the spacing s.
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
from cortado.device.reduction import add
from cortado.particles.made_derivatives import made_adjoint, made_tangent
from cortado.particles.neighbourhood import Discretisation, neighbourhood_type, pair_functions
from cortado.particles.pair_sums import fluid_sum
from cortado.particles.particle_kernels import pointwise_kernels, sum_kernels
from cortado.particles.state import Fields, padded
from cortado.particles.wall_terms import ALL_WALLS
from cortado.scene.quantity_names import load_name
from cortado.solvers.obstacles import NamedSolid
from cortado.solvers.particles import ParticleSolver
from cortado.sph.parts import Adjoints, StepContext, Tangents
from cortado.sph.walls import WallAction


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


@cache
def wall_force_kernels(discretisation: Discretisation) -> Kernels:
    """Make the kernels of the forces f of particles on walls, given the sums A as ``push`` and a as ``rub``."""
    real, vector = discretisation.precision.real, discretisation.precision.vector

    def wall_force(
        scale: real, power: real, cell: real, p_i: real, n_i: real, m_i: real, push_i: vector, rub_i: vector
    ) -> vector:
        return (scale * p_i / wp.pow(n_i, power)) * push_i - (cell * m_i) * rub_i

    numbers, written, modules = ["scale", "power", "cell"], ["push", "rub"], discretisation.modules("wall_force")
    make = pointwise_kernels
    return make(discretisation.precision, modules, lambda _: wall_force, ["f"], numbers=numbers, written=written)


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


class WallLoads:
    """The forces of a solver's particles on walls [N], vectors (n,) on the device, which the next call overwrites.
    ``solid`` is the number of a solid's wall particles, or `cortado.particles.wall_terms.ALL_WALLS`."""

    def __init__(self, solver: ParticleSolver):
        self._solver, self._kernels, self.cell = solver, wall_force_kernels(solver.discretisation), solver.lattice.cell
        power, scale = float(solver.density_power), self.cell * solver.lattice.volume
        self._numbers = {"power": power, "scale": scale, "cell": self.cell}
        self._push, self._rubs, self._twists = (
            solver.wall_push(),
            self._actions("wall_action"),
            self._actions("wall_couple"),
        )
        self._vectors = {name: solver.vectors() for name in ("rub", "f", "twist", "rub_dot", "f_dot", "twist_dot")}
        self._bars = {name: solver.vectors() for name in ("push_bar", "rub_bar")}

    def _actions(self, name: str) -> list[WallAction]:
        return [action for force in self._solver.forces if (action := getattr(force, name, None)) is not None]

    def forces(self, step: StepContext, p: wp.array, solid: int) -> wp.array:
        """Return the forces f of particles on the walls of a solid."""
        found, known = self._vectors["f"], {**self._sums(step, solid), "p": p}
        step.launch(self._kernels.forward, known, self._numbers, f=found)
        return found

    def tangent(self, step: StepContext, p: wp.array, p_dot: wp.array, along: Tangents, solid: int) -> wp.array:
        """Return the tangent of the forces f of particles on the walls of a solid."""
        rub_dot = self._total("rub_dot", [action.tangent(step, along, solid) for action in self._rubs])
        dots = {"push_dot": self._push.tangent(step, along, solid), "rub_dot": rub_dot, "p_dot": p_dot}
        found, known = self._vectors["f_dot"], {**self._sums(step, solid), "p": p}
        step.launch(self._kernels.tangent, known, dots, *along.named, self._numbers, f_dot=found)
        return found

    def adjoint(self, step: StepContext, p: wp.array, f_bar: wp.array, bar: "Particles", solid: int) -> None:
        """Add to the adjoints of the particles by that of the forces f."""
        within, known = bar.within, {**self._sums(step, solid), "p": p}
        bars = {**self._bars, "p_bar": bar.push}
        step.launch(self._kernels.adjoint, known, bars, *within.bar.named, self._numbers, f_bar=f_bar)
        self._push.adjoint(step, within.bar, solid, self._bars["push_bar"], within.v_star)
        for action in self._rubs:
            action.adjoint(step, within.bar, solid, self._bars["rub_bar"], within.v_star)

    def twists(self, step: StepContext, solid: int) -> wp.array:
        """Return the sums of y x a over forces that act at x_i - y, by the walls of a solid; times m_i s^d they twist
        it [N m]."""
        return self._total("twist", [action.total(step, solid) for action in self._twists])

    def twists_tangent(self, step: StepContext, along: Tangents, solid: int) -> wp.array:
        """Return the tangent of `twists`."""
        return self._total("twist_dot", [action.tangent(step, along, solid) for action in self._twists])

    def twists_adjoint(self, step: StepContext, total_bar: wp.array, bar: "Particles", solid: int) -> None:
        """Add to the adjoints of the particles by that of `twists`."""
        for action in self._twists:
            action.adjoint(step, bar.within.bar, solid, total_bar, bar.within.v_star)

    def _sums(self, step: StepContext, solid: int) -> dict[str, wp.array]:
        rub = self._total("rub", [action.total(step, solid) for action in self._rubs])
        return {"push": self._push.total(step, solid), "rub": rub}

    def _total(self, name: str, arrays: list[wp.array]) -> wp.array:
        """Add up arrays; the sum of one is itself."""
        if len(arrays) == 1:
            return arrays[0]
        total = self._vectors[name]
        total.zero_()
        for array in arrays:
            add(array, total)
        return total


@dataclass(frozen=True)
class SolidLoadQuantity:
    """The quantity of force and torque on a solid, F = sum_i f_i and T = sum_i r_i x f_i, with r_i from its middle at
    the end of the step, where its walls are, to particle i. For viscosity as a stress r_i leads to the surface beneath
    the particle. Each scene has F and T one behind the other, in the plane the component of T that stands on it."""

    loads: WallLoads
    solver: ParticleSolver
    solid: NamedSolid
    dimension: int

    def value(self, at: Particles, sums: Sums) -> NDArray:
        forces = self._forces(at, sums)
        return self._joined(forces, np.cross(self._arms(at), forces) + self._couples(at, sums))

    def tangent(self, at: Particles, sums: Sums, dot: Particles, along: Tangents) -> NDArray:
        number, cell, forces = self.solid.number, self.loads.cell, self._forces(at, sums)
        forces_dot = vectors(self.loads.tangent(sums.context, at.push, dot.push, along, number))
        moving = self.solver.search.moving
        shift = self._each(None if moving is None else moving.after_dot.positions, np.zeros(3))
        turned = np.cross(dot["x"] - shift, forces) + np.cross(self._arms(at), forces_dot)
        turned += cell * dot["m"][:, None] * vectors(self.loads.twists(sums.context, number))
        turned += cell * at["m"][:, None] * vectors(self.loads.twists_tangent(sums.context, along, number))
        return self._joined(forces_dot, turned)

    def adjoint(self, at: Particles, sums: Sums, own: NDArray, bar: Particles) -> None:
        d, members, number, context = self.dimension, len(own), self.solid.number, sums.context
        force_bar = padded(own[:, :d])
        torque_bar = own[:, d:] if d == 3 else np.pad(own[:, d:], ((0, 0), (2, 0)))
        force_bar, torque_bar = (self._for_each(array) for array in (force_bar, torque_bar))
        pulled, cell = np.cross(self._forces(at, sums), torque_bar), self.loads.cell
        whole_bar = sums.on_device(force_bar + np.cross(torque_bar, self._arms(at)))
        self.loads.adjoint(context, at.push, whole_bar, bar, number)
        bar["m"][:] += cell * (torque_bar * vectors(self.loads.twists(context, number))).sum(axis=1)
        self.loads.twists_adjoint(context, sums.on_device(cell * at["m"][:, None] * torque_bar), bar, number)
        bar["x"][:] += pulled
        if number >= 0:
            layout = self.solver.layout
            total = -pulled.reshape(members, -1, 3).sum(axis=1)
            places = (wp.array(a, dtype=layout.precision.vector, device=layout.device) for a in (total, 0.0 * total))
            bar.within.bar.solids.add_whole(number, *places)

    def _forces(self, at: Particles, sums: Sums) -> NDArray:
        return vectors(self.loads.forces(sums.context, at.push, self.solid.number))

    def _couples(self, at: Particles, sums: Sums) -> NDArray:
        return self.loads.cell * at["m"][:, None] * vectors(self.loads.twists(sums.context, self.solid.number))

    def _arms(self, at: Particles) -> NDArray:
        """Return the arms (n, 3) [m] from the solid to particles, along a periodic axis the shorter way."""
        moving = self.solver.search.moving
        arms = at["x"] - self._each(None if moving is None else moving.after.positions, self.solid.middle)
        periods = np.array(self.solver.system.periods)
        around = np.round(np.divide(arms, periods, out=np.zeros_like(arms), where=periods > 0.0))
        return np.asarray(arms - periods * around)

    def _each(self, of_moving: wp.array | None, at_rest: NDArray) -> NDArray:
        """Return for each particle (n, 3) the solid's entry of an array (scenes, solids) of moving solids, or a
        constant for one at rest."""
        if of_moving is None or self.solid.number < 0:
            return np.broadcast_to(at_rest, (self.solver.layout.all_particles, 3))
        return self._for_each(vectors(of_moving)[:, self.solid.number])

    def _for_each(self, of_scenes: NDArray) -> NDArray:
        """Repeat vectors of scenes (scenes, 3) for their particles (n, 3)."""
        return np.repeat(of_scenes, self.solver.layout.particles, axis=0)

    def _joined(self, forces: NDArray, torques: NDArray) -> NDArray:
        """Return sums (scenes, k) of forces and torques over particles."""
        members = self.solver.layout.members
        force, torque = (array.reshape(members, -1, 3).sum(axis=1) for array in (forces, torques))
        return np.concatenate([force[:, : self.dimension], torque if self.dimension == 3 else torque[:, 2:]], axis=1)


class QuantityFormula(Protocol):
    """A formula of a quantity of the sorted particles of a step, with its derivatives."""

    def value(self, at: Particles, sums: Sums) -> NDArray:
        """Return the quantity (n,) or (n, k); for the load on a solid (scenes, k)."""

    def tangent(self, at: Particles, sums: Sums, dot: Particles, along: Tangents) -> NDArray:
        """Return the tangent of the quantity along ``dot``; ``along`` has it on the device."""

    def adjoint(self, at: Particles, sums: Sums, own: NDArray, bar: Particles) -> None:
        """Add to the adjoints of the particles by the quantity's own adjoint, in the shape of its value."""


class Density:
    """The quantity of densities, rho_i = m_i n_i."""

    def value(self, at: Particles, sums: Sums) -> NDArray:
        return at["m"] * at["n"]

    def tangent(self, at: Particles, sums: Sums, dot: Particles, along: Tangents) -> NDArray:
        return dot["m"] * at["n"] + at["m"] * dot["n"]

    def adjoint(self, at: Particles, sums: Sums, own: NDArray, bar: Particles) -> None:
        bar["m"][:] += own * at["n"]
        bar["n"][:] += own * at["m"]


class Pressure:
    """The quantity of pressures that a gauge would read."""

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


@dataclass(frozen=True)
class WallForceQuantity:
    """The quantity of forces with which particles push all walls: see `cortado.runs.quantity_formulas`."""

    loads: WallLoads
    dimension: int

    def value(self, at: Particles, sums: Sums) -> NDArray:
        return vectors(self.loads.forces(sums.context, at.push, ALL_WALLS))[:, : self.dimension]

    def tangent(self, at: Particles, sums: Sums, dot: Particles, along: Tangents) -> NDArray:
        found = self.loads.tangent(sums.context, at.push, dot.push, along, ALL_WALLS)
        return vectors(found)[:, : self.dimension]

    def adjoint(self, at: Particles, sums: Sums, own: NDArray, bar: Particles) -> None:
        self.loads.adjoint(sums.context, at.push, sums.on_device(padded(own)), bar, ALL_WALLS)


def formulas(solver: ParticleSolver, dimension: int, circulation_factor: float) -> dict[str, QuantityFormula]:
    """Make the formulas of a solver's particles, and of the loads on its solids, by their names."""
    loads = WallLoads(solver)
    return {
        "density": Density(),
        "pressure": Pressure(),
        "speed": SpeedQuantity(),
        "vorticity": Vorticity(circulation_factor, dimension),
        "wall_force": WallForceQuantity(loads, dimension),
        **{
            load_name(name): SolidLoadQuantity(loads, solver, solid, dimension)
            for name, solid in solver.system.solids.items()
        },
    }
