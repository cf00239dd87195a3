"""Looks for lost particles at the end of every step, on the device. Any solver can use it."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import warp as wp

from cortado.device.launching import HostCopy, KernelLauncher
from cortado.device.precision import Precision
from cortado.discretise.region import TOLERANCE, Region
from cortado.discretise.shapes import Points
from cortado.particles.arrays import padded
from cortado.particles.moving_walls import MovingWalls, Poses
from cortado.particles.state import Layout, State
from cortado.solvers.containment_kernels import NO_PARTICLE, bounds_type, lost_kernel, solids_type
from cortado.solvers.obstacles import Obstacle, middle_of, obstacle_mesh

DEEPEST, THINNEST = 1.0, 0.45
"""In spacings, and of the thickness of a solid: particles that are deeper in it are lost. Sharp edges, behind which
there are few wall particles, let some in by half a spacing."""
REACH = 4.0
"""In spacings: how far from a surface particles are looked at."""
FURTHEST = 1e6
"""In spacings from the region of the first particles and walls: particles beyond are lost."""

Distance = Callable[[Points], Points]
"""(n,) how far points (n, d) [m] are outside of a wall [m]."""


@dataclass(frozen=True)
class Walled:
    """Where particles may go."""

    region: Region
    """The container, without the sides that nothing closes: along a period, or where no pressure acts."""
    near: Region
    """A box around the first particles and the walls."""
    spacing: float
    """[m]"""
    solids: tuple[Obstacle, ...]
    """Solids at rest, in their places."""
    moving: tuple[Obstacle, ...]
    """Solids that move, each about its middle."""
    periods: Points
    """(d,) the lengths of the period [m], 0 for axes without one"""

    @property
    def dimension(self) -> int:
        """2 or 3."""
        return len(self.near.lower)

    def tolerance(self, one: Obstacle) -> float:
        """How deep in a solid a particle may be [m]."""
        return min(DEEPEST * self.spacing, THINNEST * one.thickness)

    def furthest(self, precision: Precision) -> Region:
        """The box that positions must not leave [m]: far away, and as far from the origin as a precision resolves; what
        is spilled over the rim of an open cup may fall on."""
        spilled, reach = np.isfinite(self.region.rim), FURTHEST * self.spacing
        limit = np.inf if spilled else precision.furthest * self.spacing
        return Region.between(np.maximum(self.near.lower - reach, -limit), np.minimum(self.near.upper + reach, limit))


@dataclass(frozen=True)
class Lost:
    """The first particles that one scene has lost, all in one step."""

    step: int
    """From 0."""
    particle: int
    """The first of them, in the scene's order."""
    others: int
    """How many more there are."""


class Containment:
    """What one solver asks at the end of each step."""

    def __init__(
        self, walled: Walled, layout: Layout, launch: KernelLauncher, first_waiting: int, moving: MovingWalls | None
    ):
        """``first_waiting``: the first particle, in the scene's order, that may wait in a nozzle; ``moving`` knows
        where solids that move are."""
        self.walled, self._precision, self._launch = walled, layout.precision, launch
        self._kernel = lost_kernel(layout.precision)
        members, device = layout.members, layout.device
        self._obstacles = (*walled.solids, *walled.moving)
        self._meshes = [obstacle_mesh(one, walled.spacing, device) for one in self._obstacles]
        nothing = Poses.zeros(members, 0, layout.precision, device)
        self._poses = (nothing, nothing) if moving is None else (moving.before, moving.after)
        """Before and after a step."""
        none = wp.zeros((members, 0), dtype=layout.precision.real, device=device)
        self._scales = none if moving is None else moving.sizes.scales
        self._constants: dict[str, Any] = {
            "bounds": self._made_bounds(),
            "solids": self._made_solids(device),
            "particles": layout.particles,
            "first_waiting": first_waiting,
        }
        self.bad_step = wp.full(members, -1, dtype=wp.int32, device=device)
        """(members,) the first step in which a scene lost a particle; -1 while it has lost none."""
        self.bad_particle = wp.full(members, NO_PARTICLE, dtype=wp.int32, device=device)
        """(members,) the first particle that was lost in it; `NO_PARTICLE` while none was."""
        self._count = wp.zeros(members, dtype=wp.int32, device=device)
        self._seen = HostCopy(self.bad_step)

    def reset(self, step: int = 0) -> None:
        """Forget what was lost from a step on; from the first on, an earlier run."""
        steps = self.bad_step.numpy() if step > 0 else np.array([-1])
        kept = (steps >= 0) & (steps < step)
        for array, well in ((self.bad_step, -1), (self.bad_particle, NO_PARTICLE), (self._count, 0)):
            if kept.any():
                array.assign(np.where(kept, array.numpy(), well))
            else:
                array.fill_(well)

    def look(
        self, order: wp.array, x_before: wp.array, rho_0: wp.array, x_free: wp.array, v_free: wp.array, state: State
    ) -> None:
        """Look at the end of a step: sorted positions and rest densities before it, sorted positions and velocities
        after it without what a nozzle leads, and the state with it."""
        self._launch(
            self._kernel,
            self._constants,
            order=order,
            x_before=x_before,
            rho_0=rho_0,
            x_free=x_free,
            v_free=v_free,
            x=state.positions,
            bad_step=self.bad_step,
            bad=self.bad_particle,
            count=self._count,
        )

    def lost(self) -> dict[int, Lost]:
        """Which particles were lost since `reset`, by the number of their scene; reads from the device."""
        steps = self._seen.read()
        members = np.flatnonzero(steps >= 0).tolist()
        if not members:
            return {}
        particles, counts = self.bad_particle.numpy(), self._count.numpy()
        return {b: Lost(int(steps[b]), int(particles[b]), int(counts[b]) - 1) for b in members}

    def is_imprecise(self, position: np.ndarray) -> bool:
        """Whether a position (d,) [m] is further from the origin than the precision resolves."""
        distance = float(np.abs(position).max())
        return self._precision.furthest * self.walled.spacing < distance < np.inf

    def where(self, position: np.ndarray) -> str:
        """What happened to a lost particle that is now at a position (d,) [m], in words."""
        place = f"({', '.join(f'{x:g}' for x in position)}) m"
        if not np.isfinite(position).all():
            return "has no finite position"
        if not self.walled.region.contains(position[None], TOLERANCE * self.walled.spacing)[0]:
            return f"left the container and was at {place}"
        if name := self._entered(position):
            return f"entered the solid {name!r} and was at {place}"
        if self.is_imprecise(position):
            limit = f"{self._precision.furthest:g} spacings from the origin"
            return f"was at {place}, further than positions are precise in {self._precision.name}, {limit}"
        if not self.walled.furthest(self._precision).contains(position[None], 0.0)[0]:
            return f"was at {place}, further than {FURTHEST:g} spacings from the scene"
        return f"at {place} has no finite velocity or no volume"

    def walls(self, member: int) -> Iterator[tuple[str, Distance]]:
        """What closes a scene of a batch, each with its name in words: the sides of the container, and solids, those
        that move as they are after the last step."""
        for side in self.walled.region.sides():
            yield "the container", side
        for one, distance in self._solids(member):
            yield f"the solid {one.name!r}", distance

    def _entered(self, position: np.ndarray) -> str | None:
        """The name of the solid that holds a position (d,) [m]; of a batch, as they are in its first scene."""
        for one, distance in self._solids(0):
            if distance(position[None])[0] < -self.walled.tolerance(one):
                return one.name
        return None

    def _solids(self, member: int) -> Iterator[tuple[Obstacle, Distance]]:
        """Solids as they are in a scene of a batch after the last step."""
        yield from ((one, one.solid.distance) for one in self.walled.solids)
        after = self._poses[1]
        poses = (after.positions.numpy()[member], after.turns.numpy()[member], self._scales.numpy()[member])
        for one, *pose in zip(self.walled.moving, *poses, strict=True):
            yield one, partial(_moved_distance, one, *pose)

    def _made_solids(self, device: wp.Device) -> Any:
        precision, walled = self._precision, self.walled
        solids, middles = solids_type(precision)(), [middle_of(one) for one in self._obstacles]
        places = padded(np.array(middles)) if middles else np.zeros((0, 3))
        periods = padded(walled.periods[None])[0]
        solids.meshes = wp.array([mesh.id for mesh in self._meshes], dtype=wp.uint64, device=device)
        solids.middles = wp.array(places, dtype=precision.vector, device=device)
        sides = [-1.0 if one.is_hollow else 1.0 for one in self._obstacles]
        solids.sides = wp.array(sides, dtype=precision.real, device=device)
        tolerances = [walled.tolerance(one) for one in self._obstacles]
        solids.tolerances = wp.array(tolerances, dtype=precision.real, device=device)
        before, after = self._poses
        solids.before, solids.turns_before = before.positions, before.turns
        solids.after, solids.turns, solids.scales = after.positions, after.turns, self._scales
        solids.reach, solids.still = REACH * walled.spacing, len(walled.solids)
        solids.period = precision.vector(*periods)
        solids.frequency = precision.vector(*(1.0 / length if length else 0.0 for length in periods))
        return solids

    def _made_bounds(self) -> Any:
        precision, region, tolerance = self._precision, self.walled.region, TOLERANCE * self.walled.spacing
        furthest, up = self.walled.furthest(precision), np.isfinite(region.rim) * (1.0 - region.across)
        bounds = bounds_type(precision)()

        def vector(values: np.ndarray) -> Any:
            return precision.vector(*padded(values[None])[0])

        bounds.lower, bounds.upper = vector(region.lower - tolerance), vector(region.upper + tolerance)
        bounds.base, bounds.across, bounds.up = vector(region.base), vector(region.across), vector(up)
        bounds.radius, bounds.rim = region.radius + tolerance, region.rim
        bounds.nearest, bounds.furthest = vector(furthest.lower), vector(furthest.upper)
        return bounds


def _moved_distance(one: Obstacle, middle: np.ndarray, turn: np.ndarray, scale: float, points: Points) -> Points:
    """(n,) how far points (n, d) [m] are outside of a solid [m] whose middle is there, turned and scaled."""
    d = points.shape[1]
    return np.asarray(scale * one.solid.distance((points - middle[:d]) @ turn[:d, :d] / scale))
