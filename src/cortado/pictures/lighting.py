"""The light that falls on surfaces, by rays: from all around, and from the lamp."""

from functools import cache
from typing import Any

import warp as wp

from cortado.pictures.lit_surface import LitSurface
from cortado.pictures.surroundings import FAR, OPAQUE, Environment, shading_module

BOUNCED = wp.constant(wp.float32(0.45))
"""The part of the light around that falls on solids, and back from them."""


@wp.func
def past_solids(s: Environment, p: wp.vec3, d: wp.vec3, reach: wp.float32, light: wp.vec3):
    """The light that comes to a point against a direction d, of ``light``, which comes if no solid is there.

    A solid within ``reach`` [m] hides it, the less the further off it is, and sends a little light in its own colour.
    Nothing is hidden from points within a solid, which are not seen.
    """
    hit = wp.mesh_query_ray(s.solids.opaque, p, d, reach)
    if not hit.result or hit.sign < 0.0:
        return light
    point = s.solids.surfaces[OPAQUE].corners[3 * hit.face]
    colour = s.solids.surfaces[OPAQUE].colours[point]
    return wp.lerp(BOUNCED * wp.cw_mul(colour, s.horizon), light, 0.35 * hit.t / reach)


@cache
def illuminate_kernel(has_opaque: bool, has_clear: bool) -> Any:
    """The kernel that finds the light on surfaces, where there are opaque or transparent solids."""
    module = shading_module(has_opaque, has_clear)

    @wp.kernel(module=module, enable_backward=False)
    def illuminate(
        first: wp.int32,
        s: Environment,
        surface: LitSurface,
        points: wp.array(dtype=wp.vec3),
        normals: wp.array(dtype=wp.vec3),
        directions: wp.array(dtype=wp.vec3),
        sun_directions: wp.array(dtype=wp.vec3),
        reach: wp.float32,
        clearness: wp.float32,
        light: wp.array(dtype=wp.vec3),
    ):
        """The light that falls on each of the points of a surface with normals: from all around, as far as neither
        other fluid nor a solid is within ``reach`` [m], and from the lamp; ``clearness``: the part of it that goes
        through fluid, from 0 to 1."""
        i = first + wp.tid()
        n = normals[i]
        p = points[i] + s.nearest * n
        is_under_floor = s.has_floor > 0 and p[1] < s.floor_height and n[1] < 0.0  # not seen: nothing is in its way
        around = wp.vec3(0.0)
        for k in range(directions.shape[0]):
            d = wp.normalize(n + 0.999 * directions[k])  # cosine-weighted
            arriving = wp.lerp(s.horizon, s.zenith, wp.max(d[1], 0.0))
            if d[1] < 0.0:
                arriving = 0.55 * s.floor_colour
            if not is_under_floor:
                hit = wp.mesh_query_ray(surface.mesh, p, d, reach)
                if hit.result:
                    arriving = arriving * wp.max(clearness, 0.35 * hit.t / reach)
            if has_opaque:
                arriving = past_solids(s, p, d, reach, arriving)
            around += arriving
        around = around / wp.float32(directions.shape[0])
        cosine = wp.max(wp.dot(n, s.sun), 0.0)
        sunlight = wp.float32(0.0)
        if cosine > 0.0:
            for k in range(sun_directions.shape[0]):
                arriving_sun = wp.float32(1.0)
                if wp.mesh_query_ray_anyhit(surface.mesh, p, sun_directions[k], FAR):
                    arriving_sun = clearness
                if has_opaque:
                    solid = wp.mesh_query_ray(s.solids.opaque, p, sun_directions[k], FAR)
                    if solid.result and solid.sign > 0.0:
                        arriving_sun = 0.0
                sunlight += arriving_sun
            sunlight = sunlight * cosine / wp.float32(sun_directions.shape[0])
        light[i] = 0.70 * around + s.sunlight * sunlight

    return illuminate
