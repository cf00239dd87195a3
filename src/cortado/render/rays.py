"""Rays of a camera: where its pixels look, where along a ray samples lie, and which of them lie in a box.

In the camera's frame x points to the right, y up and z backwards. Pixel coordinates (u, v) run from -1 to 1 over the
width of the picture, v upwards and in the same unit; at depth z the pixel (u, v) sees (w u, w v, -z), with the half
width w = half_width + growth z. So one formula holds for parallel rays (growth 0) and for rays from a point
(half_width 0).
"""

from dataclasses import dataclass
from functools import cache
from typing import Any

import warp as wp

from cortado.device.precision import Precision


@cache
def camera_type(precision: Precision) -> Any:
    """The Warp struct of a camera."""
    real, vector = precision.real, precision.vector
    matrix = wp.types.matrix(shape=(3, 3), dtype=real)

    class Camera:
        position: vector
        """[m]"""
        orientation: matrix
        """Columns: right, up and backwards."""
        half_width: real
        """Half of the width of what is seen at the camera [m]."""
        growth: real
        """Growth of the half width with depth [-]."""
        columns: wp.int32
        rows: wp.int32
        near: real
        """Where samples begin along a ray [m]."""
        step: real
        """Distance of neighbouring samples [m]."""
        samples: wp.int32

    Camera.__name__ = Camera.__qualname__ = f"Camera_{precision.name}"
    return wp.struct(Camera)


@cache
def camera_tangent_type(precision: Precision) -> Any:
    """The Warp struct of how a view changes; see `cortado.render.calibration.ViewTangent`."""
    real, vector = precision.real, precision.vector

    class CameraTangent:
        position: vector
        turn: vector
        half_width: real
        growth: real
        thickness: real

    CameraTangent.__name__ = CameraTangent.__qualname__ = f"CameraTangent_{precision.name}"
    return wp.struct(CameraTangent)


@dataclass(frozen=True)
class RayFunctions:
    """Warp functions of a camera's rays."""

    start: Any
    direction: Any
    distance: Any
    start_tangent: Any
    direction_tangent: Any
    samples_within: Any
    pixels_before: Any


@cache
def ray_functions(precision: Precision) -> RayFunctions:
    """Warp functions ``start`` and ``direction`` of a pixel's ray, ``distance`` of a sample along it,
    ``start_tangent`` and ``direction_tangent`` as the view changes,
    ``samples_within`` a box, and ``pixels_before`` a box: the range of pixels whose rays may hit it."""
    real, vector = precision.real, precision.vector
    camera_struct, tangent_struct = camera_type(precision), camera_tangent_type(precision)
    tiny, huge = wp.constant(real(precision.tiny)), wp.constant(real(1.0 / precision.tiny))

    @wp.func
    def on_screen(pixel: int, c: camera_struct) -> vector:
        """(u, v, 0) of the middle of a pixel; row 0 is at the top."""
        column = pixel % c.columns
        row = pixel // c.columns
        return vector(real(2 * column + 1 - c.columns), real(c.rows - 2 * row - 1), real(0.0)) / real(c.columns)

    @wp.func
    def start(pixel: int, c: camera_struct) -> vector:
        return c.position + c.orientation * (c.half_width * on_screen(pixel, c))

    @wp.func
    def direction(pixel: int, c: camera_struct) -> vector:
        return c.orientation * wp.normalize(c.growth * on_screen(pixel, c) - vector(real(0.0), real(0.0), real(1.0)))

    @wp.func
    def start_tangent(pixel: int, c: camera_struct, c_dot: tangent_struct) -> vector:
        turned = wp.cross(c_dot.turn, c.orientation * (c.half_width * on_screen(pixel, c)))
        return c_dot.position + turned + c.orientation * (c_dot.half_width * on_screen(pixel, c))

    @wp.func
    def direction_tangent(pixel: int, c: camera_struct, c_dot: tangent_struct) -> vector:
        uv = on_screen(pixel, c)
        ahead = c.growth * uv - vector(real(0.0), real(0.0), real(1.0))
        d = wp.normalize(ahead)
        d_dot = (c_dot.growth / wp.length(ahead)) * (uv - wp.dot(d, uv) * d)
        return wp.cross(c_dot.turn, c.orientation * d) + c.orientation * d_dot

    @wp.func
    def distance(sample: int, c: camera_struct) -> real:
        return c.near + (real(sample) + real(0.5)) * c.step

    @wp.func
    def samples_within(o: vector, d: vector, lower: vector, upper: vector, c: camera_struct) -> wp.vec2i:
        """First sample in a box and the one behind the last; up to one more at either end, never one too few."""
        t_in = -huge
        t_out = huge
        for axis in range(3):
            if wp.abs(d[axis]) > tiny:
                t_lower = (lower[axis] - o[axis]) / d[axis]
                t_upper = (upper[axis] - o[axis]) / d[axis]
                t_in = wp.max(t_in, wp.min(t_lower, t_upper))
                t_out = wp.min(t_out, wp.max(t_lower, t_upper))
            elif o[axis] < lower[axis] or o[axis] > upper[axis]:
                t_out = -huge
        n = real(c.samples)
        first = wp.floor((t_in - c.near) / c.step - real(0.5))
        last = wp.ceil((t_out - c.near) / c.step - real(0.5)) + real(1.0)
        return wp.vec2i(int(wp.clamp(first, real(0.0), n)), int(wp.clamp(last, real(0.0), n)))

    @wp.func
    def pixels_before(lower: vector, upper: vector, c: camera_struct) -> wp.vec4i:
        """First column, the one behind the last, first row, the one behind the last; never one too few.

        Where the map to the screen is regular, over the whole box, its extremes are at corners. A box that
        reaches behind a camera with a point of view may be anywhere on the screen.
        """
        n_x = real(c.columns)
        n_y = real(c.rows)
        left = n_x
        right = -real(1.0)
        top = n_y
        bottom = -real(1.0)
        deepest = real(0.0)
        for corner in range(8):
            x = vector(
                wp.where(corner % 2 == 0, lower[0], upper[0]),
                wp.where((corner // 2) % 2 == 0, lower[1], upper[1]),
                wp.where(corner // 4 == 0, lower[2], upper[2]),
            )
            q = wp.transpose(c.orientation) * (x - c.position)
            w = c.half_width - c.growth * q[2]
            deepest = wp.max(deepest, -q[2])
            if w > tiny:
                column = real(0.5) * (q[0] / w * n_x + n_x - real(1.0))
                row = real(0.5) * (n_y - real(1.0) - q[1] / w * n_x)
                left = wp.min(left, column)
                right = wp.max(right, column)
                top = wp.min(top, row)
                bottom = wp.max(bottom, row)
            else:
                left = real(0.0)
                right = n_x
                top = real(0.0)
                bottom = n_y
        if deepest <= real(0.0):
            return wp.vec4i(0, 0, 0, 0)
        return wp.vec4i(
            int(wp.clamp(wp.floor(left), real(0.0), n_x)),
            int(wp.clamp(wp.ceil(right) + real(1.0), real(0.0), n_x)),
            int(wp.clamp(wp.floor(top), real(0.0), n_y)),
            int(wp.clamp(wp.ceil(bottom) + real(1.0), real(0.0), n_y)),
        )

    return RayFunctions(
        start=start,
        direction=direction,
        distance=distance,
        start_tangent=start_tangent,
        direction_tangent=direction_tangent,
        samples_within=samples_within,
        pixels_before=pixels_before,
    )
