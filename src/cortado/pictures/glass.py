"""Glass on a ray, of the container and of transparent solids, as Warp functions; and what is behind it."""

from functools import cache
from typing import Any

import warp as wp

from cortado.pictures.container_room import between, within_tube
from cortado.pictures.opaque_walls import opaque_wall
from cortado.pictures.pane import Passed, pane, rim_of
from cortado.pictures.solid_hit import clear_layers, meet_solid, shaded_solid
from cortado.pictures.surroundings import FAR, Environment, open_background


@wp.func
def box_pane(s: Environment, o: wp.vec3, d: wp.vec3, world: wp.vec3, t: wp.float32, width: wp.float32, before: Passed):
    """The side of the box where a ray, o and d in its own frame, passes at t."""
    q = o + t * d
    axis = wp.int32(0)
    best = FAR
    side = wp.int32(0)
    for a in range(3):
        low = wp.abs(q[a] - s.glass_lower[a])
        high = wp.abs(q[a] - s.glass_upper[a])
        if low < best:
            best = low
            axis = a
            side = 0
        if high < best:
            best = high
            axis = a
            side = 1
    off = FAR
    for a in range(3):
        if a != axis:
            off = wp.min(off, wp.min(q[a] - s.glass_lower[a], s.glass_upper[a] - q[a]))
    n = wp.vec3(0.0)
    n[axis] = 1.0
    return pane(
        s, world, wp.transpose(s.glass_frame) * n, rim_of(off, width), s.panes[side, axis], s.edge_colour, before
    )


@wp.func
def box_glass(
    s: Environment,
    o: wp.vec3,
    d: wp.vec3,
    world: wp.vec3,
    least: wp.float32,
    most: wp.float32,
    spread: wp.float32,
    before: Passed,
):
    span = wp.vec2(-FAR, FAR)
    for a in range(3):
        span = between(s.glass_lower[a], s.glass_upper[a], o[a], d[a], span)
    enter = span[0]
    leave = span[1]
    passed = before
    if enter < leave:
        if enter > least and enter < most:
            passed = box_pane(s, o, d, world, enter, wp.max(0.006 * s.size, 1.2 * spread * enter), passed)
        if leave > least and leave < most:
            passed = box_pane(s, o, d, world, leave, wp.max(0.006 * s.size, 1.2 * spread * leave), passed)
    return passed


@wp.func
def tube(s: Environment, o: wp.vec3, d: wp.vec3, world: wp.vec3, t: wp.float32, width: wp.float32, before: Passed):
    """The side of the cylinder where a ray passes at t; nothing above and below it."""
    q = o + t * d
    if q[1] < s.glass_lower[1] or q[1] > s.glass_upper[1]:
        return before
    x = 0.5 * (s.glass_lower[0] + s.glass_upper[0])
    z = 0.5 * (s.glass_lower[2] + s.glass_upper[2])
    n = wp.normalize(wp.vec3(q[0] - x, 0.0, q[2] - z))
    off = wp.min(q[1] - s.glass_lower[1], s.glass_upper[1] - q[1])
    return pane(
        s,
        world,
        wp.transpose(s.glass_frame) * n,
        rim_of(off, width),
        1.0 - wp.float32(s.has_walls),
        s.edge_colour,
        before,
    )


@wp.func
def cylinder_glass(
    s: Environment,
    o: wp.vec3,
    d: wp.vec3,
    world: wp.vec3,
    least: wp.float32,
    most: wp.float32,
    spread: wp.float32,
    before: Passed,
):
    span = within_tube(s.glass_lower, s.glass_upper, o, d)
    t1 = span[0]
    t2 = span[1]
    passed = before
    if t1 > least and t1 < most:
        passed = tube(s, o, d, world, t1, wp.max(0.010 * s.size, 1.2 * spread * t1), passed)
    if t2 > least and t2 < most:
        passed = tube(s, o, d, world, t2, wp.max(0.010 * s.size, 1.2 * spread * t2), passed)
    return passed


@cache
def glass_functions(has_opaque: bool, has_clear: bool) -> tuple[Any, Any]:
    """`glass` and `background`, where there are opaque or transparent solids."""

    @wp.func
    def glass(s: Environment, o: wp.vec3, d: wp.vec3, most: wp.float32, spread: wp.float32):
        """The glass that a ray passes up to the distance ``most`` [m]."""
        passed = Passed()
        passed.light = wp.vec3(0.0)
        passed.through = 1.0
        own_o = s.glass_frame * o
        own_d = s.glass_frame * d
        if s.glass == 1:
            passed = box_glass(s, own_o, own_d, d, s.nearest, most, spread, passed)
        if s.glass == 2:
            passed = cylinder_glass(s, own_o, own_d, d, s.nearest, most, spread, passed)
        if has_clear:
            passed = clear_layers(s, o, d, most, spread, passed)
        if s.has_walls > 0:
            passed = opaque_wall(s, o, d, most + 2.0 * s.nearest, passed)
        return passed

    @wp.func
    def background(s: Environment, shadow: wp.array2d(dtype=wp.vec3), o: wp.vec3, d: wp.vec3, spread: wp.float32):
        """What a ray sees that meets no fluid."""
        most = FAR
        if s.has_floor > 0 and d[1] < -1.0e-4:
            most = wp.max((s.floor_height - o[1]) / d[1], 0.0)
        if has_opaque:
            met = meet_solid(s, o, d)
            if met.found and met.t < most:
                before = glass(s, o, d, met.t + 2.0 * s.nearest, spread)
                return before.light + before.through * shaded_solid(s, met, d, 1.0)
        passed = glass(s, o, d, most, spread)
        return passed.light + passed.through * open_background(s, shadow, o, d, spread)

    return glass, background
