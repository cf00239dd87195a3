"""Finds lost particles at the end of every step.

A particle is lost if it is outside the container, inside a solid, too far away, or not finite.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache, partial
from itertools import combinations
from typing import Any

import numpy as np
import warp as wp

from cortado.device.launching import HostCopy, KernelLauncher, Named
from cortado.device.modules import kernel_module
from cortado.device.precision import Precision, TypesByName, struct_of
from cortado.discretise.room import TOLERANCE
from cortado.discretise.shapes import Points
from cortado.particles.moving_walls import MovingWalls, pose_arrays
from cortado.particles.state import Layout, State, padded
from cortado.solvers.obstacles import FURTHEST, Obstacle, Walled, middle_of, obstacle_mesh

NO_PARTICLE = 2**31 - 1
"""Particle number of a scene without lost particles."""


@cache
def bounds_type(precision: Precision) -> Any:
    """Return the Warp struct of a container. ``up`` is the upward unit vector of an open cylinder, else 0."""
    real = precision.real
    vectors = dict.fromkeys(("lower", "upper", "base", "across", "up", "nearest", "furthest"), precision.vector)
    return struct_of("Bounds", precision, **vectors, radius=real, rim=real)


@cache
def solids_type(precision: Precision) -> Any:
    """Return the Warp struct of solids, of which the first ``still`` solids are at rest. ``middles`` are the centres of
    meshes [m]. ``sides`` is 1 for fluid outside a mesh and -1 for fluid inside."""
    real, vector, matrix = precision.real, precision.vector, precision.matrix
    meshes = {"meshes": wp.array(dtype=wp.uint64), "still": wp.int32, "middles": wp.array(dtype=vector)}
    poses = dict.fromkeys(("before", "after"), wp.array2d(dtype=vector))
    poses |= dict.fromkeys(("turns_before", "turns"), wp.array2d(dtype=matrix)) | {"scales": wp.array2d(dtype=real)}
    numbers, periods = wp.array(dtype=real), {"period": vector, "frequency": vector}
    own = {"sides": numbers, "tolerances": numbers, "reach": wp.float32}
    return struct_of("Solids", precision, **meshes, **poses, **own, **periods)


@cache
def lost_kernel(precision: Precision) -> Any:
    real, vector = precision.real, precision.vector
    bounds_struct, solids_struct, poses = bounds_type(precision), solids_type(precision), wp.array2d(dtype=vector)
    turnings = wp.array2d(dtype=precision.matrix)
    module = kernel_module(f"containment_{precision.name}")

    @wp.func
    def between(x: vector, lower: vector, upper: vector) -> bool:
        return (
            x[0] >= lower[0]
            and x[1] >= lower[1]
            and x[2] >= lower[2]
            and x[0] <= upper[0]
            and x[1] <= upper[1]
            and x[2] <= upper[2]
        )

    @wp.func
    def contains(x: vector, b: bounds_struct) -> bool:
        return between(x, b.lower, b.upper) and wp.length(wp.cw_mul(x - b.base, b.across)) <= b.radius

    @wp.func
    def nearest_image(y: vector, solids: solids_struct) -> vector:
        turns = wp.cw_mul(y, solids.frequency)
        return y - wp.cw_mul(vector(wp.round(turns[0]), wp.round(turns[1]), wp.round(turns[2])), solids.period)

    @wp.func
    def scale_of(k: int, member: int, solids: solids_struct) -> real:
        scale = real(1.0)
        if k >= solids.still:
            scale = solids.scales[member, k - solids.still]
        return scale

    @wp.func
    def seen_from(x: vector, k: int, member: int, positions: poses, turns: turnings, solids: solids_struct) -> vector:
        """Return the nearest periodic image of ``x`` in the frame of solid ``k``."""
        if k < solids.still:
            return nearest_image(x - solids.middles[k], solids)
        away = nearest_image(x - positions[member, k - solids.still], solids)
        return wp.transpose(turns[member, k - solids.still]) * away / scale_of(k, member, solids) - solids.middles[k]

    @wp.func
    def is_deep(y: vector, k: int, scale: real, solids: solids_struct) -> bool:
        place = wp.vec3f(wp.float32(y[0]), wp.float32(y[1]), wp.float32(y[2]))
        found = wp.mesh_query_point_sign_winding_number(solids.meshes[k], place, solids.reach)
        depth = real(0.0)
        if found.result:
            surface = wp.mesh_eval_position(solids.meshes[k], found.face, found.u, found.v)
            depth = -real(found.sign) * solids.sides[k] * scale * real(wp.length(place - surface))
        return depth > solids.tolerances[k]

    @wp.func
    def is_free(x: vector, member: int, solids: solids_struct) -> bool:
        for k in range(solids.meshes.shape[0]):
            y = seen_from(x, k, member, solids.before, solids.turns_before, solids)
            if is_deep(y, k, scale_of(k, member, solids), solids):
                return False
        return True

    @wp.func
    def has_entered(before: vector, x: vector, member: int, solids: solids_struct) -> bool:
        for k in range(solids.meshes.shape[0]):
            y = seen_from(x, k, member, solids.after, solids.turns, solids)
            gone = wp.length(y - seen_from(before, k, member, solids.before, solids.turns_before, solids))
            scale = scale_of(k, member, solids)
            furthest = wp.float32(real(1.001) * (solids.tolerances[k] / scale + gone))
            place = wp.vec3f(wp.float32(y[0]), wp.float32(y[1]), wp.float32(y[2]))
            found = wp.mesh_query_point_no_sign(solids.meshes[k], place, wp.min(furthest, solids.reach))
            if found.result:
                surface = wp.mesh_eval_position(solids.meshes[k], found.face, found.u, found.v)
                if scale * real(wp.length(place - surface)) > solids.tolerances[k]:  # noqa: SIM102, as Warp reads both
                    if is_deep(y, k, scale, solids):
                        return is_free(before, member, solids)
        return False

    @wp.func
    def below_rim(x: vector, b: bounds_struct) -> bool:
        return wp.dot(x, b.up) < b.rim

    typed = TypesByName(vector, {wp.int32: "order bad count", real: "rho"})

    @typed.kernel(module)
    def find_lost(
        bounds: bounds_struct, solids: solids_struct, particles: int, first_waiting: int, order, x_before, rho_0,
        x_free, v_free, x, bad_step, bad, count,
    ):  # fmt: skip
        """Find lost particles. Emitters and drains may move particles with indices from ``first_waiting`` through
        walls."""
        i = wp.tid()
        member = i // particles
        if bad_step[member] >= 0:
            return
        p = order[i] - member * particles
        x_i = x_free[i]
        let_go = bool(True)
        if p >= first_waiting:
            let_go = x[order[i]] == x_i
            x_i = x[order[i]]
        before = x_before[i]
        good = between(x_i, bounds.nearest, bounds.furthest) and wp.isfinite(v_free[i]) and rho_0[i] > real(0.0)
        escaped = (
            let_go
            and contains(before, bounds)
            and not contains(x_i, bounds)
            and below_rim(before, bounds)
            and below_rim(x_i, bounds)
        )
        entered = bool(False)
        if let_go and good:
            entered = has_entered(before, x_i, member, solids)
        if escaped or entered or not good:
            wp.atomic_min(bad, member, p)
            wp.atomic_add(count, member, 1)

    return find_lost


REACH = 4.0
"""Greatest distance from a surface at which particles are tested [spacings]."""

Distance = Callable[[Points], Points]
"""Function that maps points (n, d) to signed distances from a wall [m], which are positive outside the wall."""


@dataclass(frozen=True)
class Lost:
    """The particles that a scene lost in the first step with lost particles."""

    step: int
    particle: int
    others: int


class Containment:
    def __init__(
        self, walled: Walled, layout: Layout, launch: KernelLauncher, first_waiting: int, moving: MovingWalls | None
    ):
        """An emitter or a drain may move particles with indices from ``first_waiting``."""
        precision, members, device = layout.precision, layout.members, layout.device
        self.walled, self._precision, self._launch = walled, precision, launch
        self._kernel, vector, obstacles = lost_kernel(precision), precision.vector_of, (*walled.solids, *walled.moving)
        self._meshes = [obstacle_mesh(one, walled.spacing, device) for one in obstacles]
        self._poses = pose_arrays(members, 0, precision, device) if moving is None else moving.named
        solids, middles = solids_type(precision)(), [middle_of(one) for one in obstacles]
        places = padded(np.array(middles)) if middles else np.zeros((0, 3))
        sides, tolerances = [-1.0 if one.is_hollow else 1.0 for one in obstacles], [*map(walled.tolerance, obstacles)]
        solids.meshes = wp.array([mesh.id for mesh in self._meshes], dtype=wp.uint64, device=device)
        solids.middles = wp.array(places, dtype=precision.vector, device=device)
        solids.sides = wp.array(sides, dtype=precision.real, device=device)
        solids.tolerances = wp.array(tolerances, dtype=precision.real, device=device)
        for name in ("before", "turns_before", "after", "turns", "scales"):
            setattr(solids, name, self._poses[name])
        solids.reach, solids.still, solids.period = REACH * walled.spacing, len(walled.solids), vector(walled.periods)
        solids.frequency = vector([1.0 / length if length else 0.0 for length in walled.periods])
        region, furthest, tolerance = walled.region, walled.furthest(precision), TOLERANCE * walled.spacing
        bounds, up = bounds_type(precision)(), np.isfinite(region.rim) * (1.0 - region.across)
        bounds.lower, bounds.upper = vector(region.lower - tolerance), vector(region.upper + tolerance)
        bounds.base, bounds.across, bounds.up = vector(region.base), vector(region.across), vector(up)
        bounds.radius, bounds.rim = region.radius + tolerance, region.rim
        bounds.nearest, bounds.furthest = vector(furthest.lower), vector(furthest.upper)
        self._constants: dict[str, Any] = {"particles": layout.particles, "first_waiting": first_waiting}
        self._constants |= {"bounds": bounds, "solids": solids}
        self.bad_step = wp.full(members, -1, dtype=wp.int32, device=device)
        """Array of shape (members,) with the first step in which each scene lost a particle, or -1."""
        self.bad_particle = wp.full(members, NO_PARTICLE, dtype=wp.int32, device=device)
        """Array of shape (members,) with the first lost particle of each scene, or `NO_PARTICLE`."""
        self._count = wp.zeros(members, dtype=wp.int32, device=device)
        self.bad_step_copy = HostCopy(self.bad_step)

    def reset(self, step: int = 0) -> None:
        """Forget particles that were lost in step ``step`` or later."""
        steps = self.bad_step.numpy() if step > 0 else np.array([-1])
        kept = (steps >= 0) & (steps < step)
        for array, well in ((self.bad_step, -1), (self.bad_particle, NO_PARTICLE), (self._count, 0)):
            if kept.any():
                array.assign(np.where(kept, array.numpy(), well))
            else:
                array.fill_(well)

    def look(self, known: Named, state: State) -> None:
        """Find lost particles in the new ``state``. ``known`` contains ``order``, ``x_before`` and ``rho_0`` from
        before the step, and the new positions ``x_free`` and velocities ``v_free`` before emitters and drains act."""
        found = {"bad_step": self.bad_step, "bad": self.bad_particle, "count": self._count}
        self._launch(self._kernel, self._constants, known, found, x=state.positions)

    def lost(self) -> dict[int, Lost]:
        """Return the lost particles since `reset`, by scene number."""
        steps = self.bad_step_copy.read()
        if steps.max() < 0:
            return {}
        members = np.flatnonzero(steps >= 0).tolist()
        particles, counts = self.bad_particle.numpy(), self._count.numpy()
        return {b: Lost(int(steps[b]), int(particles[b]), int(counts[b]) - 1) for b in members}

    def is_imprecise(self, position: np.ndarray) -> bool:
        distance = float(np.abs(position).max())
        return self._precision.furthest * self.walled.spacing < distance < np.inf

    def where(self, position: np.ndarray) -> str:
        """Describe where the lost particle at ``position`` [m] is."""
        place = f"({', '.join(f'{x:g}' for x in position)}) m"
        if not np.isfinite(position).all():
            return "has no finite position"
        if not self.walled.region.contains(position[None], TOLERANCE * self.walled.spacing)[0]:
            return f"left the container and was at {place}"
        for one, distance in self._solids(0):
            if distance(position[None])[0] < -self.walled.tolerance(one):
                return f"entered the solid {one.name!r} and was at {place}"
        if self.is_imprecise(position):
            limit = f"{self._precision.furthest:g} spacings from the origin"
            return f"was at {place}, further than positions are precise in {self._precision.name}, {limit}"
        if not self.walled.furthest(self._precision).contains(position[None], 0.0)[0]:
            return f"was at {place}, further than {FURTHEST:g} spacings from the scene"
        return f"at {place} has no finite velocity or no volume"

    def walls(self, member: int) -> Iterator[tuple[str, Distance]]:
        """Yield the name and the distance function of each wall and solid of a scene after the last step."""
        for side in self.walled.region.sides():
            yield "the container", side
        for one, distance in self._solids(member):
            yield f"the solid {one.name!r}", distance

    def _solids(self, member: int) -> Iterator[tuple[Obstacle, Distance]]:
        yield from ((one, one.solid.distance) for one in self.walled.solids)
        poses = (self._poses[name].numpy()[member] for name in ("after", "turns", "scales"))
        for one, *pose in zip(self.walled.moving, *poses, strict=True):
            yield one, partial(_moved_distance, one, *pose)


def _moved_distance(one: Obstacle, middle: np.ndarray, turn: np.ndarray, scale: float, points: Points) -> Points:
    d = points.shape[1]
    return np.asarray(scale * one.solid.distance((points - middle[:d]) @ turn[:d, :d] / scale))


NARROW = 0.95
"""Smallest gap between two walls that does not squeeze particles [spacings]."""
FACING = -0.5
"""Scalar product of the normals of two walls, below which the walls face each other."""
STEP = 1e-3
"""Step of finite differences for normals [spacings]."""


def shut_in(containment: Containment, member: int, points: Points) -> str | None:
    """Describe two walls with too narrow a gap at ``points`` [m], or return None."""
    spacing = containment.walled.spacing
    best, found = NARROW * spacing, None
    near = [(name, one, d) for name, one in containment.walls(member) if ((d := one(points)) < best).any()]
    for (name, one, d), (other, two, e) in combinations(near, 2):
        narrow = np.flatnonzero(d + e < best)
        x = points[narrow]
        facing = (_normals(one, x, STEP * spacing) * _normals(two, x, STEP * spacing)).sum(axis=1) < FACING
        if facing.any():
            best = float((d + e)[narrow][facing].min())
            found = f"{name} and {other}" if name != other else name
    if found is None:
        return None
    gap = f"{max(best, 0.0):.2g} m apart" if best > STEP * spacing else "with no room between them"
    return f"fluid is shut in by {found}, {gap}, nearer than a spacing: leave a spacing, or make the spacing smaller"


def _normals(distance: Distance, points: Points, step: float) -> Points:
    moves = step * np.eye(points.shape[1])
    return np.stack([(distance(points + move) - distance(points - move)) / (2.0 * step) for move in moves], axis=1)
