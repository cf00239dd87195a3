"""The walls of a container that is not clear, seen from within, as Warp functions."""

import warp as wp

from cortado.pictures.container_room import wall_normal, within_walls
from cortado.pictures.lit_surface import SurfaceHit
from cortado.pictures.pane import Passed
from cortado.pictures.solid_hit import shaded_solid
from cortado.pictures.surroundings import Environment, open_light


@wp.func
def wall_hit(s: Environment, t: wp.float32, normal: wp.vec3):
    """Where a ray meets a wall with a normal, inwards."""
    met = SurfaceHit()
    met.found = True
    met.is_solid = True
    met.t = t
    met.normal = normal
    met.colour = s.wall_colour
    met.light = open_light(s, normal)
    met.reflectivity = s.wall_reflectivity
    return met


@wp.func
def opaque_wall(s: Environment, o: wp.vec3, d: wp.vec3, most: wp.float32, before: Passed):
    """The wall that a ray meets where it leaves the container, if that is no further than ``most`` [m]."""
    part = within_walls(s, o, d)
    t = part[1]
    if t <= wp.max(part[0], s.nearest) or t >= most:
        return before
    p = o + t * d
    q = s.glass_frame * p
    for a in range(3):  # there is no wall above
        if q[a] < s.glass_lower[a] - 2.0 * s.nearest or q[a] > s.glass_upper[a] + 2.0 * s.nearest:
            return before
    passed = Passed()
    passed.light = before.light + before.through * shaded_solid(s, wall_hit(s, t, -wall_normal(s, p)), d, 1.0)
    passed.through = 0.0
    return passed
