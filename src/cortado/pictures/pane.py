"""A sheet of glass, as Warp functions: what it adds to the light on a ray and takes away."""

import warp as wp

from cortado.pictures.surroundings import Environment, mirrored, schlick, sky, smooth_step

EDGE = (0.50, 0.62, 0.64)
"""Linear, of an edge of clear glass."""
GLASS_EDGE = wp.constant(wp.vec3(*EDGE))


@wp.struct
class Passed:
    """What the glass on a way adds and leaves."""

    light: wp.vec3
    through: wp.float32


@wp.func
def pane(
    s: Environment,
    d: wp.vec3,
    normal: wp.vec3,
    rim: wp.float32,
    is_pane: wp.float32,
    colour: wp.vec3,
    behind: Passed,
):
    """One more sheet of glass, behind what is passed already; ``rim``: how much of its edge, which
    has a colour, is seen, 0 to 1."""
    cosine = wp.abs(wp.dot(d, normal))
    f = schlick(0.04, cosine)
    reflectance = 0.7 * is_pane * 2.0 * f / (1.0 + f)
    r = mirrored(d, normal)
    seen = sky(s, wp.vec3(r[0], wp.abs(r[1]), r[2]))
    seen = wp.vec3(wp.min(seen[0], 1.8), wp.min(seen[1], 1.8), wp.min(seen[2], 1.8))
    edge = colour * 0.75 + 0.25 * seen
    light = behind.light + behind.through * (rim * edge + (1.0 - rim) * reflectance * seen)
    passed = Passed()
    passed.light = light
    passed.through = behind.through * (1.0 - rim) * (1.0 - reflectance) * (1.0 - 0.015 * is_pane)
    return passed


@wp.func
def rim_of(off: wp.float32, width: wp.float32):
    """How much of an edge is seen at a distance from it."""
    return 0.8 * (1.0 - smooth_step(0.55 * width, width, off))
