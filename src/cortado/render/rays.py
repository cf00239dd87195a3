"""Rays of a camera, and interpolation of the colour field at samples on a ray.

In the camera's frame x points to the right, y up and z backwards. Pixel coordinates (u, v) are in units of half the
width of the picture: u runs from -1 to 1 to the right, and v upwards. At depth z the pixel (u, v) shows the point (w u,
w v, -z), with the half width w = half_width + growth z. Parallel rays have a growth of 0. Rays from one point have a
half_width of 0.

The field at a sample is interpolated trilinearly between nodes, and is 0 outside the grid. The interpolated field is
continuous. In 2-D, the grid has one layer of nodes, so that the fluid appears as a sheet whose thickness is the node
distance.
"""

from functools import cache
from typing import Any

import warp as wp

from cortado.device.precision import Precision, struct_of
from cortado.render.colour_field import nodes_type, rgba_type


@cache
def camera_type(precision: Precision) -> Any:
    """The columns of ``orientation`` point right, up and backwards. ``half_width`` [m] is half the visible width at the
    camera, and ``growth`` [-] is the increase of the half width with depth."""
    real, pixels = precision.real, {"columns": wp.int32, "rows": wp.int32}
    pose, widths = {"position": precision.vector, "orientation": precision.matrix}, {"half_width": real, "growth": real}
    ray = {"near": real, "step": real, "samples": wp.int32}
    return struct_of("Camera", precision, **pose, **widths, **pixels, **ray)


@cache
def camera_tangent_type(precision: Precision) -> Any:
    vectors = dict.fromkeys(("position", "turn"), precision.vector)
    numbers = dict.fromkeys(("half_width", "growth", "thickness"), precision.real)
    return struct_of("CameraTangent", precision, **vectors, **numbers)


@cache
def ray_functions(precision: Precision) -> tuple[Any, ...]:
    real, vector = precision.real, precision.vector
    camera_struct, tangent_struct = camera_type(precision), camera_tangent_type(precision)
    tiny, huge = wp.constant(real(precision.tiny)), wp.constant(real(1.0 / precision.tiny))

    @wp.func
    def on_screen(pixel: int, c: camera_struct) -> vector:
        """Return the pixel coordinates (u, v, 0) of the middle of a pixel."""
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
        """Return the first sample inside a box, and the last sample plus 1."""
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
        """Return the columns and rows that may show a box: first column, last column plus 1, then rows."""
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

    return start, direction, distance, start_tangent, direction_tangent, samples_within, pixels_before


@cache
def interpolation_functions(precision: Precision) -> tuple[Any, ...]:
    real, vector, rgba = precision.real, precision.vector, rgba_type(precision)
    nodes_struct = nodes_type(precision)

    @wp.func
    def node(i: int, j: int, k: int, field: wp.array3d(dtype=rgba), nodes: nodes_struct) -> rgba:
        n = nodes.shape
        if i >= 0 and j >= 0 and k >= 0 and i < n[0] and j < n[1] and k < n[2]:
            return field[k, j, i]
        return rgba()

    @wp.func
    def part(f: real, side: int) -> real:
        return wp.where(side == 0, real(1.0) - f, f)

    @wp.func
    def cell(x: vector, nodes: nodes_struct):
        """Return the first node of the cell around a point, and the point's offset from this node in node distances."""
        s = nodes.frequency * (x - nodes.origin)
        i = int(wp.floor(s[0]))
        j = int(wp.floor(s[1]))
        k = int(wp.floor(s[2]))
        f = s - vector(real(i), real(j), real(k))
        return i, j, k, f

    @wp.func
    def value(x: vector, field: wp.array3d(dtype=rgba), nodes: nodes_struct) -> rgba:
        i, j, k, f = cell(x, nodes)
        total = rgba()
        for a in range(2):
            for b in range(2):
                for c in range(2):
                    w = part(f[0], a) * part(f[1], b) * part(f[2], c)
                    total += w * node(i + a, j + b, k + c, field, nodes)
        return total

    @wp.func
    def slope(f: vector, a: int, b: int, c: int) -> vector:
        return vector(
            real(2 * a - 1) * part(f[1], b) * part(f[2], c),
            real(2 * b - 1) * part(f[2], c) * part(f[0], a),
            real(2 * c - 1) * part(f[0], a) * part(f[1], b),
        )

    @wp.func
    def gradient(x: vector, bar: rgba, field: wp.array3d(dtype=rgba), nodes: nodes_struct) -> vector:
        """Return the gradient at ``x`` of the dot product of ``bar`` and the interpolated value."""
        i, j, k, f = cell(x, nodes)
        total = vector()
        for a in range(2):
            for b in range(2):
                for c in range(2):
                    total += wp.dot(bar, node(i + a, j + b, k + c, field, nodes)) * slope(f, a, b, c)
        return nodes.frequency * total

    @wp.func
    def derivative(x: vector, x_dot: vector, field: wp.array3d(dtype=rgba), nodes: nodes_struct) -> rgba:
        """Return the derivative of the interpolated value at ``x`` along ``x_dot``."""
        i, j, k, f = cell(x, nodes)
        total = rgba()
        for a in range(2):
            for b in range(2):
                for c in range(2):
                    total += wp.dot(slope(f, a, b, c), x_dot) * node(i + a, j + b, k + c, field, nodes)
        return nodes.frequency * total

    @wp.func
    def trilinear_weight(x: vector, x_g: vector, nodes: nodes_struct) -> real:
        """Return the weight of the node at ``x_g`` in the interpolated value at ``x``."""
        s = nodes.frequency * (x - x_g)
        w_x = wp.max(real(1.0) - wp.abs(s[0]), real(0.0))
        w_y = wp.max(real(1.0) - wp.abs(s[1]), real(0.0))
        w_z = wp.max(real(1.0) - wp.abs(s[2]), real(0.0))
        return w_x * w_y * w_z

    return value, gradient, derivative, trilinear_weight
