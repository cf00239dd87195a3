"""Trilinear interpolation between the nodes of a colour field, which is 0 at all nodes that are not there.

So it is continuous everywhere, and a field of one layer (2-D) is a sheet that is one node distance thick.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any

import warp as wp

from cortado.device.precision import Precision
from cortado.render.colour_field import nodes_type, rgba_type


@dataclass(frozen=True)
class InterpolationFunctions:
    """Warp functions of trilinear interpolation between the nodes of a field."""

    value: Any
    gradient: Any
    derivative: Any
    trilinear_weight: Any


@cache
def interpolation_functions(precision: Precision) -> InterpolationFunctions:
    """Warp functions ``value`` at a point, ``gradient`` (of bar . value), ``derivative`` (of the value, along a
    direction) and ``trilinear_weight`` (of one node)."""
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
        """The node at which the cell of a point begins, and how far the point is from it, in node distances."""
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
        """The gradient of a corner's weight, in node distances."""
        return vector(
            real(2 * a - 1) * part(f[1], b) * part(f[2], c),
            real(2 * b - 1) * part(f[2], c) * part(f[0], a),
            real(2 * c - 1) * part(f[0], a) * part(f[1], b),
        )

    @wp.func
    def gradient(x: vector, bar: rgba, field: wp.array3d(dtype=rgba), nodes: nodes_struct) -> vector:
        """On the face of a cell, where the gradient jumps, that of the cell which begins there."""
        i, j, k, f = cell(x, nodes)
        total = vector()
        for a in range(2):
            for b in range(2):
                for c in range(2):
                    total += wp.dot(bar, node(i + a, j + b, k + c, field, nodes)) * slope(f, a, b, c)
        return nodes.frequency * total

    @wp.func
    def derivative(x: vector, x_dot: vector, field: wp.array3d(dtype=rgba), nodes: nodes_struct) -> rgba:
        """Of the value at a point that moves; on the face of a cell as `gradient`."""
        i, j, k, f = cell(x, nodes)
        total = rgba()
        for a in range(2):
            for b in range(2):
                for c in range(2):
                    total += wp.dot(slope(f, a, b, c), x_dot) * node(i + a, j + b, k + c, field, nodes)
        return nodes.frequency * total

    @wp.func
    def trilinear_weight(x: vector, x_g: vector, nodes: nodes_struct) -> real:
        """The weight of the node at x_g in the value at x."""
        s = nodes.frequency * (x - x_g)
        w_x = wp.max(real(1.0) - wp.abs(s[0]), real(0.0))
        w_y = wp.max(real(1.0) - wp.abs(s[1]), real(0.0))
        w_z = wp.max(real(1.0) - wp.abs(s[2]), real(0.0))
        return w_x * w_y * w_z

    return InterpolationFunctions(
        value=value, gradient=gradient, derivative=derivative, trilinear_weight=trilinear_weight
    )
