"""The force between a body and a solid that it touches: a smooth penalty.

Points of a body's surface that are in the other solid, d_j > 0 deep, give it the momentum

    P = (q / dt) M sum_j f_j n_j,   f_j = d_j^3 / sqrt(S),   S = sum_j d_j^4,

along the normals n_j of the faces above them, and the other one -P. It is that of the potential q M sqrt(S) / (2 dt^2),
for a depth S^(1/4) that is near the greatest one whatever the number of points: of a spring in which the lighter of two
bodies, with M m / (M + m), would swing with sqrt(q) / dt. As d_j is where the body would go, a swing shrinks by
sqrt(1 - q) in a step: a body leaves what it falls on with 0.6 of its speed, whatever the time step. At a depth of 0 f_j
has two derivatives, both 0; where the face above a point changes, there is a corner.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any

import warp as wp

from cortado.device.launching import bundle
from cortado.device.modules import Kernels
from cortado.device.precision import Precision
from cortado.particles.moving_walls import matrix_of
from cortado.particles.particle_kernels import pointwise_kernels
from cortado.sph.free_kernels import free_module

STIFFNESS = 0.04
"""The stiffness q of contacts [-]."""
FAR = 1e6
"""[m] beyond which no face is looked for."""
SHARES = ("push", "twist", "other", "square")
"""What a point adds: d^3 n, its moments about the middles of both solids, and d^4."""


@dataclass(frozen=True)
class ContactKernels:
    """Kernels of contact between a body and a solid; the first two have a thread for each surface point in each
    scene."""

    look: Any
    """This finds the face that a point is deepest behind, and goes on from the deepest so far: the normal in the frame
    of the other solid, how far the plane is from the middle of that along it, for a scale of 1, and the shift to the
    image that is near."""
    push: Kernels
    """These compute `SHARES` from both poses and the scale of the other solid; adjoints of these are written, point by
    point."""
    give: Kernels
    """These turn the sums of shares into the momenta of both, with a thread for each scene; a solid that is not free
    gets none."""


@cache
def contact_kernels(precision: Precision) -> ContactKernels:
    """Make the kernels of contacts between bodies and solids in a precision."""
    real, vector, matrix, pair = precision.real, precision.vector, matrix_of(precision), precision.pair
    modules, stiffness = [free_module(precision)] * 3, wp.constant(real(STIFFNESS))

    @wp.func
    def vec(a: wp.vec3f) -> vector:
        return vector(real(a[0]), real(a[1]), real(a[2]))

    @wp.func
    def along(way: real, length: real) -> real:
        """Shorten a separation along one axis [m] to that of the nearest periodic image."""
        found = way
        if length > real(0.0):
            found = way - length * wp.round(way / length)
        return found

    @wp.kernel(module=modules[0], enable_backward=False)
    def look(
        particles: int,
        period: vector,
        mesh: wp.uint64,
        origin: vector,
        inner: vector,
        side: real,
        own: wp.array(dtype=vector),
        after: wp.array(dtype=vector),
        turns: wp.array(dtype=matrix),
        other_after: wp.array(dtype=vector),
        other_turns: wp.array(dtype=matrix),
        other_scales: wp.array(dtype=real),
        # in and out
        of: bundle(face=vector, plane=real, shift=vector, depth=real),
    ):
        """Find the face. The mesh is about ``origin`` of a solid at rest, and about ``inner`` in the frame of one that
        moves; ``period`` is 0 along an axis without one."""
        j = wp.tid()
        b = j // particles
        way = after[b] + turns[b] * own[j] - other_after[b] - origin
        x = vector(along(way[0], period[0]), along(way[1], period[1]), along(way[2], period[2]))
        y = wp.transpose(other_turns[b]) * x / other_scales[b] - inner
        place = wp.vec3f(wp.float32(y[0]), wp.float32(y[1]), wp.float32(y[2]))
        found = wp.mesh_query_point_sign_winding_number(mesh, place, wp.float32(FAR))
        if not found.result or real(found.sign) * side > real(0.0):
            return
        corners = wp.mesh_get(mesh)
        first = vec(corners.points[corners.indices[3 * found.face]])
        second = vec(corners.points[corners.indices[3 * found.face + 1]])
        third = vec(corners.points[corners.indices[3 * found.face + 2]])
        n = side * wp.normalize(wp.cross(second - first, third - first))
        d = other_scales[b] * wp.dot(n, first - y)
        if d > of.depth[j]:
            of.face[j] = n
            of.plane[j] = wp.dot(n, first + inner)
            of.shift[j] = way - x + origin
            of.depth[j] = d

    def push(
        after: vector,
        turns: matrix,
        other_after: vector,
        other_turns: matrix,
        other_scales: real,
        own_i: vector,
        face_i: vector,
        plane_i: real,
        shift_i: vector,
    ) -> tuple[vector, vector, vector, real]:
        r = turns * own_i
        x, n = after + r - other_after - shift_i, other_turns * face_i
        d = other_scales * plane_i - wp.dot(n, x)
        f = (d * d * d) * n
        return f, wp.cross(r, f), wp.cross(x, f), d * d * d * d

    def give(
        time_step_i: real,
        density_i: real,
        other_density_i: real,
        is_free: bool,
        volumes: pair,
        push_sum_i: vector,
        twist_sum_i: vector,
        other_sum_i: vector,
        square_sum_i: real,
    ) -> tuple[vector, vector, vector, vector]:
        mass, other, strength = density_i * volumes[0], other_density_i * volumes[1], real(0.0)
        both = wp.where(is_free, mass * other / (mass + other), mass)
        if square_sum_i > real(0.0):
            strength = stiffness * both / (time_step_i * wp.sqrt(square_sum_i))
        against = wp.where(is_free, -strength, real(0.0))
        return strength * push_sum_i, strength * twist_sum_i, against * push_sum_i, against * other_sum_i

    moved = ["after", "turns", "other_after", "other_turns", "other_scales"]
    pushes = pointwise_kernels(
        precision,
        modules,
        lambda _: push,
        SHARES,
        written=moved,
        known=["own", "face", "plane", "shift"],
        where="depth",
        summed=SHARES,
        turned={"turns": "turned", "other_turns": "other_turned"},
    )
    gives = pointwise_kernels(
        precision,
        modules,
        lambda _: give,
        [f"{name}:{name}" for name in ("pushed", "twisted", "pushed_other", "twisted_other")],
        numbers=["is_free", "volumes"],
        written=[f"{name}_sum" for name in SHARES],
    )
    return ContactKernels(look, pushes, gives)
