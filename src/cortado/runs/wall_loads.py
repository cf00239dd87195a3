"""The forces of particles on walls, and the loads on solids, with their tangents and adjoints.

Particle i pushes walls, those of one solid or all, with

    f_i = s^d (V p_i / n_i^power A_i - m_i sum a_i + B_i),

where A_i is the sum over wall particles along which its pressure acts (``wall_push`` of
`cortado.solvers.particles.ParticleSolver`), a_i the acceleration that they give it by a force such as viscosity, and
B_i the part of images (`cortado.solvers.projection.mean_stress`), if walls mirror. The walls so get what momentum the
fluid loses to them: the mass of a particle is m_i s^d, with the spacing s.
"""

from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from cortado.device.modules import Kernels, kernel_module
from cortado.device.precision import Precision
from cortado.device.reduction import TreeReduction, add
from cortado.particles.neighbourhood import Discretisation
from cortado.particles.particle_kernels import particle_kernel, pointwise_kernels
from cortado.particles.state import padded
from cortado.particles.wall_terms import ALL_WALLS
from cortado.runs.particle_sums import in_the_scene
from cortado.runs.quantity_formulas import Particles, Sums, vectors
from cortado.solvers.obstacles import NamedSolid
from cortado.solvers.particles import ParticleSolver
from cortado.sph.density import WallAction
from cortado.sph.parts import StepContext, Tangents


@cache
def wall_force_kernels(discretisation: Discretisation) -> Kernels:
    """Make the kernels of the forces f of particles on walls, given the sums A, a and B as ``push``, ``rub`` and
    ``by_images``."""
    real, vector = discretisation.precision.real, discretisation.precision.vector

    def wall_force(
        scale: real,
        power: real,
        cell: real,
        p_i: real,
        n_i: real,
        m_i: real,
        push_i: vector,
        rub_i: vector,
        by_images_i: vector,
    ) -> vector:
        return (scale * p_i / wp.pow(n_i, power)) * push_i - (cell * m_i) * rub_i + cell * by_images_i

    numbers, written, modules = (
        ["scale", "power", "cell"],
        ["push", "rub", "by_images"],
        discretisation.modules("wall_force"),
    )
    make = pointwise_kernels
    return make(discretisation.precision, modules, lambda _: wall_force, ["f"], numbers=numbers, written=written)


SIX = wp.types.vector(6, wp.float64)
"""The type of a force and a torque on the device."""


@cache
def load_kernel(precision: Precision) -> Any:
    """Make the kernel of each particle's share in the force and the torque on a solid, whose middle is at ``rest``, or
    where a moving one of this ``number`` has ``moved`` to; along a periodic axis by the shorter arm."""
    real, vector = precision.real, precision.vector
    module, numbers = kernel_module(f"load_{precision.name}"), ["cell", "period", "number", "rest", "moved"]

    @particle_kernel(module, "load", numbers=numbers)
    def load(
        member: int,
        cell: real,
        period: vector,
        number: int,
        rest: vector,
        moved: wp.array2d(dtype=vector),
        x_i: vector,
        m_i: real,
        f_i: vector,
        twist_i: vector,
    ) -> SIX:
        middle = vector(rest)
        if moved.shape[1] > 0:
            middle = moved[member, number]
        arm, force, torque, found = wp.vec3d(), wp.vec3d(), wp.vec3d(), SIX()
        for k in range(3):
            arm[k] = wp.float64(x_i[k]) - wp.float64(middle[k])
            if period[k] > real(0.0):
                length = wp.float64(period[k])
                arm[k] = arm[k] - length * wp.rint(arm[k] / length)
            force[k] = wp.float64(f_i[k])
            torque[k] = wp.float64(cell) * wp.float64(m_i) * wp.float64(twist_i[k])
        torque = torque + wp.cross(arm, force)  # type: ignore[arg-type]
        for k in range(3):
            found[k] = force[k]
            found[k + 3] = torque[k]
        return found

    return load


class WallLoads:
    """The forces of a solver's particles on walls [N], vectors (n,) on the device, which the next call overwrites.
    ``solid`` is the number of a solid's wall particles, or `cortado.particles.wall_terms.ALL_WALLS`."""

    def __init__(self, solver: ParticleSolver):
        self._solver, self._kernels, self.cell = solver, wall_force_kernels(solver.discretisation), solver.lattice.cell
        power, scale = float(solver.density_power), self.cell * solver.lattice.volume
        self._numbers = {"power": power, "scale": scale, "cell": self.cell}
        self._push, self._images = solver.wall_push(), solver.image_loads()
        self._rubs, self._twists = self._actions("wall_action"), self._actions("wall_couple")
        names = ("rub", "f", "twist", "by_images", "rub_dot", "f_dot", "twist_dot", "by_images_dot")
        self._vectors = {name: solver.vectors() for name in names}
        self._bars = {name: solver.vectors() for name in ("push_bar", "rub_bar", "by_images_bar")}

    def _actions(self, name: str) -> list[WallAction]:
        return [action for force in self._solver.forces if (action := getattr(force, name, None)) is not None]

    def forces(self, step: StepContext, p: wp.array, solid: int) -> wp.array:
        """Return the forces f of particles on the walls of a solid."""
        found, known = self._vectors["f"], self._sums(step, p, solid)
        step.launch(self._kernels.forward, known, self._numbers, f=found)
        return found

    def tangent(self, step: StepContext, p: wp.array, p_dot: wp.array, along: Tangents, solid: int) -> wp.array:
        """Return the tangent of the forces f of particles on the walls of a solid."""
        rub_dot = self._total("rub_dot", [action.tangent(step, along, solid) for action in self._rubs])
        dots = {"push_dot": self._push.tangent(step, along, solid), "rub_dot": rub_dot, "p_dot": p_dot}
        dots["by_images_dot"] = self._vectors["by_images_dot"]
        if self._images is not None:
            dots["by_images_dot"] = self._images.tangent(step, along, solid, p, p_dot)
        found, known = self._vectors["f_dot"], self._sums(step, p, solid)
        step.launch(self._kernels.tangent, known, dots, *along.named, self._numbers, f_dot=found)
        return found

    def adjoint(self, step: StepContext, p: wp.array, f_bar: wp.array, bar: "Particles", solid: int) -> None:
        """Add to the adjoints of the particles by that of the forces f."""
        within, known = bar.within, self._sums(step, p, solid)
        bars = {**self._bars, "p_bar": bar.push}
        step.launch(self._kernels.adjoint, known, bars, *within.bar.named, self._numbers, f_bar=f_bar)
        self._push.adjoint(step, within.bar, solid, self._bars["push_bar"], within.v_star)
        if self._images is not None:
            self._images.adjoint(step, within.bar, solid, p, self._bars["by_images_bar"], bar.push)
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

    def _sums(self, step: StepContext, p: wp.array, solid: int) -> dict[str, wp.array]:
        rub = self._total("rub", [action.total(step, solid) for action in self._rubs])
        found = {"push": self._push.total(step, solid), "rub": rub, "by_images": self._vectors["by_images"], "p": p}
        if self._images is not None:
            found["by_images"] = self._images.total(step, solid, p)
        return found

    def _total(self, name: str, arrays: list[wp.array]) -> wp.array:
        """Add up arrays; the sum of one is itself."""
        if len(arrays) == 1:
            return arrays[0]
        total = self._vectors[name]
        if arrays:  # else it is 0 from the start
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
        return in_the_scene(self.on_device(sums.context, at.push).numpy(), self.dimension)

    def on_device(self, step: StepContext, p: wp.array) -> wp.array:
        """Return F and T (scenes,), six numbers each, on the device, which the next call overwrites."""
        solver, number, vector = self.solver, self.solid.number, self.solver.layout.precision.vector
        moving = None if number < 0 else solver.search.moving
        moved = self._no_middles if moving is None else moving.named["after"]
        middles = {"rest": vector(*self.solid.middle), "number": number, "moved": moved}
        middles["period"] = vector(*solver.system.periods)
        found, own = (
            self._each_load,
            {"f": self.loads.forces(step, p, number), "twist": self.loads.twists(step, number)},
        )
        step.launch(load_kernel(solver.layout.precision), middles, own, load=found)
        return self._sum(found)

    @cached_property
    def _each_load(self) -> wp.array:
        return wp.zeros(self.solver.layout.all_particles, dtype=SIX, device=self.solver.device)

    @cached_property
    def _sum(self) -> TreeReduction:
        return self.solver.layout.sum_of(SIX)

    @cached_property
    def _no_middles(self) -> wp.array:
        return wp.empty((1, 0), dtype=self.solver.layout.precision.vector, device=self.solver.device)

    def tangent(self, at: Particles, sums: Sums, dot: Particles, along: Tangents) -> NDArray:
        number, cell, forces = self.solid.number, self.loads.cell, self._forces(at, sums)
        forces_dot = vectors(self.loads.tangent(sums.context, at.push, dot.push, along, number))
        moving = self.solver.search.moving
        shift = self._each(None if moving is None else moving.named["after_dot"], np.zeros(3))
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

    def _arms(self, at: Particles) -> NDArray:
        """Return the arms (n, 3) [m] from the solid to particles, along a periodic axis the shorter way."""
        moving = self.solver.search.moving
        arms = at["x"] - self._each(None if moving is None else moving.named["after"], self.solid.middle)
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


@dataclass(frozen=True)
class WallForceQuantity:
    """The quantity of forces with which particles push all walls: see `cortado.runs.quantity_formulas`."""

    loads: WallLoads
    dimension: int

    def value(self, at: Particles, sums: Sums) -> NDArray:
        return vectors(self.on_device(sums.context, at.push))[:, : self.dimension]

    def on_device(self, step: StepContext, p: wp.array) -> wp.array:
        """Return the forces (n,) of sorted particles, vectors."""
        return self.loads.forces(step, p, ALL_WALLS)

    def tangent(self, at: Particles, sums: Sums, dot: Particles, along: Tangents) -> NDArray:
        found = self.loads.tangent(sums.context, at.push, dot.push, along, ALL_WALLS)
        return vectors(found)[:, : self.dimension]

    def adjoint(self, at: Particles, sums: Sums, own: NDArray, bar: Particles) -> None:
        self.loads.adjoint(sums.context, at.push, sums.on_device(padded(own)), bar, ALL_WALLS)
