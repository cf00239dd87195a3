"""Solids on a ray, as Warp functions: opaque ones that it meets, and transparent ones that it passes."""

import warp as wp

from cortado.pictures.container_room import wall_normal, within_walls
from cortado.pictures.lit_surface import SurfaceHit, at_surface
from cortado.pictures.pane import GLASS_EDGE, Passed, pane, rim_of
from cortado.pictures.surroundings import (
    CLEAR,
    FAR,
    OPAQUE,
    Environment,
    mirrored,
    open_light,
    schlick,
    sky,
    smooth_step,
)

LAYERS = 8
"""Surfaces of transparent solids that a ray passes at most."""


@wp.struct
class SolidHit:
    """Where a ray meets an opaque solid."""

    t: wp.float32
    """FAR where it does not."""
    is_cut: wp.bool
    """Whether that is a wall of the container, through which the solid reaches."""
    face: wp.int32
    u: wp.float32
    v: wp.float32


@wp.func
def reach_solid(s: Environment, o: wp.vec3, d: wp.vec3):
    """Where a ray meets an opaque solid."""
    met = SolidHit()
    met.t = FAR
    part = wp.vec2(-FAR, FAR)
    if s.solids.are_cut > 0:
        part = within_walls(s, o, d)
    start = wp.max(part[0] - s.nearest, 0.0)  # a side that lies in a wall is seen
    if part[1] <= start:
        return met
    hit = wp.mesh_query_ray(s.solids.opaque, o + start * d, d, FAR)
    if not hit.result:
        return met
    met.is_cut = hit.sign < 0.0 and part[0] > 0.0
    if met.is_cut:
        met.t = part[0]
    elif start + hit.t <= part[1] - 2.0 * s.nearest:
        met.t = start + hit.t
    met.face = hit.face
    met.u = hit.u
    met.v = hit.v
    return met


@wp.func
def meet_solid(s: Environment, o: wp.vec3, d: wp.vec3):
    """The same with what is known of the surface there."""
    reached = reach_solid(s, o, d)
    met = SurfaceHit()
    met.found = False
    met.t = FAR
    if reached.t >= FAR:
        return met
    met = at_surface(s.solids.surfaces[OPAQUE], reached.t, d, reached.face, reached.u, reached.v)
    met.is_solid = True
    met.reflectivity = s.solids.surfaces[OPAQUE].reflectivity[reached.face]
    if reached.is_cut:
        n = wall_normal(s, o + reached.t * d)
        met.normal = wp.where(wp.dot(n, d) > 0.0, -n, n)
        met.light = open_light(s, met.normal)
    return met


@wp.func
def shaded_solid(s: Environment, met: SurfaceHit, d: wp.vec3, glossy: wp.float32):
    """The light of a solid; ``glossy``: 0 where it is in fluid."""
    r = mirrored(d, met.normal)
    seen = sky(s, wp.vec3(r[0], wp.abs(r[1]), r[2]))
    seen = wp.vec3(wp.min(seen[0], 1.8), wp.min(seen[1], 1.8), wp.min(seen[2], 1.8))
    reflectance = 0.6 * glossy * schlick(0.04, -wp.dot(met.normal, d))
    lit = wp.min(wp.max(met.light[0], wp.max(met.light[1], met.light[2])), 1.0)
    paint = (1.0 - reflectance) * wp.cw_mul(met.colour, met.light) + reflectance * lit * seen
    if s.has_floor > 0:
        seen = wp.lerp(seen, s.floor_colour, smooth_step(0.0, 0.25, -r[1]))
    return wp.lerp(paint, lit * wp.cw_mul(met.colour, seen), met.reflectivity)


@wp.func
def clear_layers(s: Environment, o: wp.vec3, d: wp.vec3, most: wp.float32, spread: wp.float32, before: Passed):
    """The surfaces of transparent solids that a ray passes up to the distance ``most`` [m].

    Those on the floor are left out, as the floor is seen there.
    """
    passed = before
    start = s.nearest
    for _ in range(LAYERS):
        if start >= most:
            break
        hit = wp.mesh_query_ray(s.solids.clear, o + start * d, d, most - start)
        if not hit.result:
            break
        t = start + hit.t
        if s.has_floor == 0 or o[1] + t * d[1] > s.floor_height + 2.0 * s.nearest:
            met = at_surface(s.solids.surfaces[CLEAR], t, d, hit.face, hit.u, hit.v)
            off = s.solids.surfaces[CLEAR].from_edges[hit.face] * wp.vec3(hit.u, hit.v, 1.0 - hit.u - hit.v)
            rim = rim_of(wp.min(off[0], wp.min(off[1], off[2])), wp.max(0.006 * s.size, 1.2 * spread * t))
            passed = pane(s, d, met.normal, rim, 1.0, GLASS_EDGE, passed)
            both = s.solids.surfaces[CLEAR].left[hit.face]
            left = wp.where(hit.sign < 0.0, both[0], both[1])
            passed.light += passed.through * (1.0 - left) * wp.cw_mul(met.colour, met.light)
            passed.through = passed.through * left
        start = t + s.nearest
    return passed
