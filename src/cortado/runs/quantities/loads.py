"""What particles push walls with, those of one solid or all, with derivatives.

Particle i pushes them with

    f_i = s^d (V p_i / n_i^power A_i - m_i sum a_i),

where A_i is the sum over wall particles along which its pressure acts (``wall_push`` of
`cortado.solvers.particles.ParticleSolver`) and a_i the acceleration that they give it by a force such as viscosity. The
walls so get what momentum the fluid loses to them: the mass of a particle is m_i s^d, with the spacing s.
"""

from dataclasses import dataclass

import numpy as np
import warp as wp
from numpy.typing import NDArray

from cortado.particles.arrays import padded
from cortado.runs.quantities.particles import Particles, Sums, vectors
from cortado.solvers.obstacles import NamedSolid
from cortado.solvers.particles import ParticleSolver
from cortado.sph.parts import Tangents
from cortado.sph.wall_sums import WallAction


@dataclass(frozen=True)
class _Rubbing:
    """factor m_i sum a_i over what walls do by forces, (n, 3)."""

    actions: list[WallAction]
    factor: float

    def value(self, at: Particles, sums: Sums, solid: int) -> NDArray:
        return self.factor * at["m"][:, None] * self._total(at, sums, solid)

    def tangent(self, at: Particles, sums: Sums, dot: Particles, along: Tangents, solid: int) -> NDArray:
        found = dot["m"][:, None] * self._total(at, sums, solid)
        for action in self.actions:
            found += at["m"][:, None] * vectors(action.tangent(sums.context, along, solid))
        return self.factor * found

    def adjoint(self, at: Particles, sums: Sums, own_bar: NDArray, bar: Particles, solid: int) -> None:
        bar["m"][:] += self.factor * (own_bar * self._total(at, sums, solid)).sum(axis=1)
        total_bar = sums.on_device(self.factor * at["m"][:, None] * own_bar)
        for action in self.actions:
            action.adjoint(sums.context, bar.within.bar, solid, total_bar, bar.within.v_star)

    def _total(self, at: Particles, sums: Sums, solid: int) -> NDArray:
        totals = (vectors(action.total(sums.context, solid)) for action in self.actions)
        return sum(totals, np.zeros((len(at["m"]), 3)))


class WallLoads:
    """Of a solver's particles, (n, 3) in float64. ``solid`` is the number of a solid's wall particles, or
    `cortado.particles.solid_shares.ALL_WALLS`."""

    def __init__(self, solver: ParticleSolver):
        cell, self._power = solver.lattice.cell, solver.density_power
        self._scale = cell * solver.lattice.volume
        self._push = solver.wall_push()

        def of(name: str) -> list[WallAction]:
            return [action for force in solver.forces if (action := getattr(force, name, None)) is not None]

        self._rubbing = _Rubbing(of("wall_action"), -cell)
        self.couples = _Rubbing(of("wall_couple"), cell)
        """What f_i that act beneath particles twist walls with [N m]."""

    def forces(self, at: Particles, sums: Sums, solid: int) -> NDArray:
        """f [N]"""
        pushed = self._strength(at)[:, None] * vectors(self._push.total(sums.context, solid))
        return pushed + self._rubbing.value(at, sums, solid)

    def tangent(self, at: Particles, sums: Sums, dot: Particles, along: Tangents, solid: int) -> NDArray:
        """That of f."""
        strength_dot = self._scale / at["n"] ** self._power * (dot.push - self._power * at.push * dot["n"] / at["n"])
        pushed = vectors(self._push.total(sums.context, solid))
        pushed_dot = vectors(self._push.tangent(sums.context, along, solid))
        found = strength_dot[:, None] * pushed + self._strength(at)[:, None] * pushed_dot
        return found + self._rubbing.tangent(at, sums, dot, along, solid)

    def adjoint(self, at: Particles, sums: Sums, forces_bar: NDArray, bar: Particles, solid: int) -> None:
        """From that of f, add to those of the particles."""
        step, strength = sums.context, self._strength(at)
        strength_bar = (forces_bar * vectors(self._push.total(step, solid))).sum(axis=1)
        bar.push[:] += strength_bar * self._scale / at["n"] ** self._power
        bar["n"][:] -= self._power * strength_bar * strength / at["n"]
        within = bar.within
        self._push.adjoint(step, within.bar, solid, sums.on_device(strength[:, None] * forces_bar), within.v_star)
        self._rubbing.adjoint(at, sums, forces_bar, bar, solid)

    def _strength(self, at: Particles) -> NDArray:
        return np.asarray(self._scale * at.push / at["n"] ** self._power)


@dataclass(frozen=True)
class SolidLoad:
    """Force and torque on a solid, F = sum_i f_i and T = sum_i r_i x f_i, with r_i from its middle at the end of the
    step, where its walls are, to particle i; of viscosity as a stress to the surface beneath it, where that acts. Each
    scene has F and T one behind the other, in the plane the component of T that stands on it."""

    loads: WallLoads
    solver: ParticleSolver
    solid: NamedSolid
    dimension: int

    def value(self, at: Particles, sums: Sums) -> NDArray:
        forces = self.loads.forces(at, sums, self.solid.number)
        couples = self.loads.couples.value(at, sums, self.solid.number)
        return self._joined(forces, np.cross(self._arms(at), forces) + couples)

    def tangent(self, at: Particles, sums: Sums, dot: Particles, along: Tangents) -> NDArray:
        forces = self.loads.forces(at, sums, self.solid.number)
        forces_dot = self.loads.tangent(at, sums, dot, along, self.solid.number)
        moving = self.solver.search.moving
        shift = self._each(None if moving is None else moving.after_dot.positions, np.zeros(3))
        turned = np.cross(dot["x"] - shift, forces) + np.cross(self._arms(at), forces_dot)
        return self._joined(forces_dot, turned + self.loads.couples.tangent(at, sums, dot, along, self.solid.number))

    def adjoint(self, at: Particles, sums: Sums, own: NDArray, bar: Particles) -> None:
        d, members, number = self.dimension, len(own), self.solid.number
        force_bar = padded(own[:, :d])
        torque_bar = own[:, d:] if d == 3 else np.pad(own[:, d:], ((0, 0), (2, 0)))
        force_bar, torque_bar = (self._for_each(array) for array in (force_bar, torque_bar))
        pulled = np.cross(self.loads.forces(at, sums, number), torque_bar)
        self.loads.adjoint(at, sums, force_bar + np.cross(torque_bar, self._arms(at)), bar, number)
        self.loads.couples.adjoint(at, sums, torque_bar, bar, number)
        bar["x"][:] += pulled
        if number >= 0:
            layout = self.solver.layout
            total = -pulled.reshape(members, -1, 3).sum(axis=1)
            places = (wp.array(a, dtype=layout.precision.vector, device=layout.device) for a in (total, 0.0 * total))
            bar.within.bar.solids.add_whole(number, *places)

    def _arms(self, at: Particles) -> NDArray:
        """(n, 3) [m], along a periodic axis the shorter way."""
        moving = self.solver.search.moving
        arms = at["x"] - self._each(None if moving is None else moving.after.positions, self.solid.middle)
        periods = np.array(self.solver.system.periods)
        around = np.round(np.divide(arms, periods, out=np.zeros_like(arms), where=periods > 0.0))
        return np.asarray(arms - periods * around)

    def _each(self, of_moving: wp.array | None, at_rest: NDArray) -> NDArray:
        """(n, 3) the solid's entry of an array (scenes, solids) of those that move, or what it is of one at rest."""
        if of_moving is None or self.solid.number < 0:
            return np.broadcast_to(at_rest, (self.solver.layout.all_particles, 3))
        return self._for_each(vectors(of_moving)[:, self.solid.number])

    def _for_each(self, of_scenes: NDArray) -> NDArray:
        """(n, 3) of (scenes, 3)."""
        return np.repeat(of_scenes, self.solver.layout.particles, axis=0)

    def _joined(self, forces: NDArray, torques: NDArray) -> NDArray:
        """(scenes, k) the sums over particles."""
        members = self.solver.layout.members
        force, torque = (array.reshape(members, -1, 3).sum(axis=1) for array in (forces, torques))
        return np.concatenate([force[:, : self.dimension], torque if self.dimension == 3 else torque[:, 2:]], axis=1)
