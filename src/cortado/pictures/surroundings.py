"""What is around the fluid, as Warp functions: the sky with its lamps, and the floor.

All is in the frame of the picture: y points upwards. Colours are linear.
"""

from typing import Any

import warp as wp

from cortado.device.modules import kernel_module
from cortado.pictures.lit_surface import LitSurface

OPAQUE, CLEAR = wp.constant(0), wp.constant(1)
"""Which of the surfaces of solids."""
NO_GLASS, GLASS_BOX, GLASS_CYLINDER = 0, 1, 2
FAR = wp.constant(wp.float32(1.0e9))


def shading_module(has_opaque: bool, has_clear: bool) -> Any:
    """The Warp module of kernels for scenes with opaque or transparent solids, or with none."""
    return kernel_module("shading" + "_opaque" * has_opaque + "_clear" * has_clear)


@wp.struct
class Solids:
    """What fluid flows around, or is inside of."""

    opaque: wp.uint64
    """The mesh of opaque ones."""
    are_cut: wp.int32
    """Whether opaque ones are shown within the container only."""
    clear: wp.uint64
    """The mesh of those that are transparent and of tanks, which all of space outside of a cavity is within."""
    has_tank: wp.int32
    surfaces: wp.array(dtype=LitSurface)
    """(2,) of opaque and of clear ones, if there are any; in an array, as functions get a copy of their arguments"""


@wp.struct
class Environment:
    """Everything around the fluid."""

    size: wp.float32
    """Of what is shown [m]: floor, grid and rims go by it."""
    nearest: wp.float32
    """How far a ray starts from the surface that sends it [m]."""
    sun: wp.vec3
    """Unit vector towards the lamp."""
    fill: wp.vec3
    """Unit vector towards a second, weak one, which is only seen in reflections."""
    lamp: wp.vec3
    """What is seen of the first in reflections."""
    strip: wp.vec3
    """What is seen of the second."""
    sunlight: wp.vec3
    """The light of the lamp that falls on what faces it."""
    horizon: wp.vec3
    zenith: wp.vec3
    has_floor: wp.int32
    floor_colour: wp.vec3
    floor_height: wp.float32
    """[m]"""
    floor_centre: wp.vec3
    """[m]; its height does not matter"""
    grid: wp.float32
    """Distance between the lines on the floor [m]; none if 0."""
    shadow_corner: wp.vec3
    """[m] where the first node of the shadow lies"""
    shadow_cell: wp.float32
    """Distance between its nodes [m]."""
    glass: wp.int32
    """NO_GLASS, GLASS_BOX or GLASS_CYLINDER, whose axis is the second of its own frame."""
    glass_frame: wp.mat33
    """From the frame of the picture to that of the container."""
    glass_lower: wp.vec3
    """[m] in its own frame"""
    glass_upper: wp.vec3
    """[m]"""
    has_room: wp.int32
    """Whether fluid is shown within the container only."""
    room_lower: wp.vec3
    """[m] in the frame of the container: where that ends; -FAR where it does not"""
    room_upper: wp.vec3
    """[m]"""
    panes: wp.mat33
    """1 where the container has a pane, 0 where it is open: rows for lower and upper ends, columns for axes."""
    edge_colour: wp.vec3
    """Of the container's edges."""
    has_walls: wp.int32
    """Whether the container is opaque: one looks into it from outside, and sees its walls from within."""
    wall_colour: wp.vec3
    wall_reflectivity: wp.float32
    solids: Solids


@wp.func
def smooth_step(lower: wp.float32, upper: wp.float32, x: wp.float32):
    t = wp.clamp((x - lower) / (upper - lower), 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)


@wp.func
def schlick(normal_reflectance: wp.float32, cosine: wp.float32):
    """Fresnel's reflectance, as Schlick (1994) approximates it."""
    m = wp.clamp(1.0 - cosine, 0.0, 1.0)
    m2 = m * m
    return normal_reflectance + (1.0 - normal_reflectance) * m2 * m2 * m


@wp.func
def mirrored(direction: wp.vec3, normal: wp.vec3):
    return direction - 2.0 * wp.dot(direction, normal) * normal


@wp.func
def sky(s: Environment, d: wp.vec3):
    """Light from a direction above the floor: a gradient, a soft lamp, and a strip of light on the other side."""
    base = wp.lerp(s.horizon, s.zenith, smooth_step(0.0, 0.9, d[1]))
    lamp = smooth_step(0.945, 0.985, wp.dot(d, s.sun))
    strip = smooth_step(0.90, 0.96, wp.dot(d, s.fill))
    return base + s.lamp * lamp + s.strip * strip


@wp.func
def open_light(s: Environment, normal: wp.vec3):
    """The light that falls on what nothing lies in the way of."""
    return 0.35 * (s.horizon + s.zenith) + s.sunlight * wp.max(wp.dot(normal, s.sun), 0.0)


@wp.func
def shadow_at(s: Environment, shadow: wp.array2d(dtype=wp.vec3), x: wp.float32, z: wp.float32):
    """The part of the light that reaches a place of the floor, interpolated between nodes; all of it elsewhere."""
    u = (x - s.shadow_corner[0]) / s.shadow_cell
    v = (z - s.shadow_corner[2]) / s.shadow_cell
    i = wp.int32(wp.floor(u))
    j = wp.int32(wp.floor(v))
    if i < 0 or j < 0 or i + 1 >= shadow.shape[0] or j + 1 >= shadow.shape[1]:
        return wp.vec3(1.0)
    a = u - wp.float32(i)
    b = v - wp.float32(j)
    low = wp.lerp(shadow[i, j], shadow[i + 1, j], a)
    high = wp.lerp(shadow[i, j + 1], shadow[i + 1, j + 1], a)
    return wp.lerp(low, high, b)


@wp.func
def line(x: wp.float32, grid: wp.float32, width: wp.float32):
    """1 on the lines of a grid, 0 between them; thinner than a pixel they fade."""
    off = wp.abs(x / grid - wp.round(x / grid)) * grid
    return 1.0 - smooth_step(0.35 * width, width, off)


@wp.func
def floor(s: Environment, shadow: wp.array2d(dtype=wp.vec3), p: wp.vec3, footprint: wp.float32):
    """The floor at p, which becomes the horizon further out; ``footprint``: the width of a pixel there [m]."""
    colour = s.floor_colour
    if s.grid > 0.0:
        thin = 0.0035 * s.size
        width = wp.max(thin, 1.5 * footprint)
        ink = wp.max(line(p[0] - s.floor_centre[0], s.grid, width), line(p[2] - s.floor_centre[2], s.grid, width))
        colour = colour * (1.0 - 0.10 * ink * thin / width)
    lit = wp.cw_mul(colour, shadow_at(s, shadow, p[0], p[2]))
    away = wp.length(wp.vec2(p[0] - s.floor_centre[0], p[2] - s.floor_centre[2])) / s.size
    return wp.lerp(lit, s.horizon, smooth_step(0.9, 3.2, away))


@wp.func
def open_background(s: Environment, shadow: wp.array2d(dtype=wp.vec3), o: wp.vec3, d: wp.vec3, spread: wp.float32):
    """What a ray sees that meets neither fluid nor glass; ``spread``: the width of a pixel at 1 m [m]."""
    if s.has_floor > 0 and d[1] < -1.0e-4:
        t = (s.floor_height - o[1]) / d[1]
        if t > 0.0:
            slant = wp.max(-d[1], 0.05)
            return floor(s, shadow, o + t * d, spread * t / slant)
    return sky(s, wp.vec3(d[0], wp.max(d[1], 0.0), d[2]))
