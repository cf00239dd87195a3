"""The colour field: how much fluid there is at the nodes of a regular grid, and of what colour.

    A_g = V sum_j W(x_g - x_j),    P_g = V sum_j W(x_g - x_j) colour_j

The coverage A is 1 within a filled fluid. P is the colour times the coverage; neither is ever divided by the other.
Along a periodic axis the images of a particle count like itself.
Both sums are gathers: of particles, cell by cell, on the way there, of the nodes within the support on the way back.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any

import warp as wp

from cortado.device.cells import cell_functions, cell_grid_type
from cortado.device.precision import Precision
from cortado.discretise.smoothing_functions import smoothing_functions
from cortado.particles.neighbourhood import Discretisation


@cache
def rgba_type(precision: Precision) -> Any:
    """Warp vector type of (P, A): the colour times the coverage, three components, and the coverage."""
    return wp.types.vector(length=4, dtype=precision.real)


@cache
def nodes_type(precision: Precision) -> Any:
    """The Warp struct of a regular grid of nodes; arrays over nodes are [z, y, x]."""
    real, vector = precision.real, precision.vector

    class Nodes:
        origin: vector
        """The first node [m]."""
        cell: real
        """Distance of neighbouring nodes [m]."""
        frequency: real
        """1 / cell [1 / m]."""
        shape: wp.vec3i
        """Number of nodes along x, y and z."""
        periodic: wp.int32
        period: vector
        """[m], 0 along an axis that is not periodic; greater than two supports."""
        turn: vector
        """1 / period [1 / m], or 0."""
        images: wp.vec3i
        """How many images of a particle, one period after the other, may be felt by nodes."""

    Nodes.__name__ = Nodes.__qualname__ = f"Nodes_{precision.name}"
    return wp.struct(Nodes)


@dataclass(frozen=True)
class NodeFunctions:
    """Warp functions of the nodes of a field."""

    place: Any
    nearest: Any
    image: Any


@cache
def node_functions(precision: Precision) -> NodeFunctions:
    """Warp functions ``place``: where a node is [m]; ``nearest``: a separation from the nearest image; ``image``: where
    one of the images of a particle is that nodes may feel."""
    real, vector = precision.real, precision.vector
    nodes_struct = nodes_type(precision)

    @wp.func
    def place(i: int, j: int, k: int, nodes: nodes_struct) -> vector:
        return nodes.origin + nodes.cell * vector(real(i), real(j), real(k))

    @wp.func
    def nearest(x: vector, nodes: nodes_struct) -> vector:
        if nodes.periodic != 0:
            t = wp.cw_mul(x, nodes.turn)
            return x - wp.cw_mul(vector(wp.round(t[0]), wp.round(t[1]), wp.round(t[2])), nodes.period)
        return x

    @wp.func
    def image(number: int, x: vector, h: real, nodes: nodes_struct) -> vector:
        """The first is the lowest that reaches up to the first node along every axis; h is the support."""
        t = wp.cw_mul(x - nodes.origin + vector(h, h, h), nodes.turn)
        n_x = nodes.images[0]
        n_y = nodes.images[1]
        q = vector(real(number % n_x), real((number // n_x) % n_y), real(number // (n_x * n_y)))
        return x + wp.cw_mul(q - vector(wp.floor(t[0]), wp.floor(t[1]), wp.floor(t[2])), nodes.period)

    return NodeFunctions(place=place, nearest=nearest, image=image)


@dataclass(frozen=True)
class ColourFieldKernels:
    """The kernel of the field of colours, its tangent and its adjoint."""

    forward: Any
    tangent: Any
    adjoint: Any


@cache
def colour_field_kernels(discretisation: Discretisation) -> ColourFieldKernels:
    """Kernels ``forward`` and ``tangent``, over nodes, and ``adjoint``, over sorted particles."""
    precision = discretisation.precision
    real, vector, rgba = precision.real, precision.vector, rgba_type(precision)
    nodes_struct, grid_type = nodes_type(precision), cell_grid_type(precision)
    cells, smooth = cell_functions(precision), smoothing_functions(discretisation.smoothing, precision)
    wrap, cell_of, below, above = cells.wrap, cells.cell_of, cells.below, cells.above
    weight, gradient = smooth.weight, smooth.gradient
    node = node_functions(precision)
    place, nearest, image = node.place, node.nearest, node.image
    module = discretisation.module(False, "colour_field")

    @wp.func
    def row_sum(
        row: int,
        c_x: int,
        x_g: vector,
        x: wp.array(dtype=vector),
        colour: wp.array(dtype=vector),
        nodes: nodes_struct,
        grid: grid_type,
        h: real,
        per_h: real,
        sigma: real,
    ) -> rgba:
        """Over the particles of the cells c_x - 1, c_x and c_x + 1 of one row."""
        n = grid.shape[0]
        total = rgba()
        for o in range(below(n), above(n)):
            cell = row + wrap(c_x + o, n)
            for j in range(grid.starts[cell], grid.starts[cell + 1]):
                x_gj = nearest(x_g - x[j], nodes)
                if wp.dot(x_gj, x_gj) < h * h:
                    total += weight(x_gj, per_h, sigma) * rgba(colour[j][0], colour[j][1], colour[j][2], real(1.0))
        return total

    @wp.kernel(module=module, enable_backward=False)
    def colour_field(
        nodes: nodes_struct,
        grid: grid_type,
        h: real,
        per_h: real,
        sigma: real,
        volume: real,
        x: wp.array(dtype=vector),
        colour: wp.array(dtype=vector),
        # out
        field: wp.array3d(dtype=rgba),
    ):
        k, j, i = wp.tid()
        x_g = place(i, j, k, nodes)
        c = cell_of(x_g, grid)
        n_y = grid.shape[1]
        n_z = grid.shape[2]
        total = rgba()
        for o_z in range(below(n_z), above(n_z)):
            for o_y in range(below(n_y), above(n_y)):
                row = (wrap(c[2] + o_z, n_z) * n_y + wrap(c[1] + o_y, n_y)) * grid.shape[0]
                total += row_sum(row, c[0], x_g, x, colour, nodes, grid, h, per_h, sigma)
        field[k, j, i] = volume * total

    @wp.kernel(module=module, enable_backward=False)
    def colour_field_tangent(
        nodes: nodes_struct,
        grid: grid_type,
        h: real,
        per_h: real,
        sigma: real,
        volume: real,
        x: wp.array(dtype=vector),
        colour: wp.array(dtype=vector),
        x_dot: wp.array(dtype=vector),
        colour_dot: wp.array(dtype=vector),
        # out
        field_dot: wp.array3d(dtype=rgba),
    ):
        k, j, i = wp.tid()
        x_g = place(i, j, k, nodes)
        c = cell_of(x_g, grid)
        n = grid.shape
        total = rgba()
        for o_z in range(below(n[2]), above(n[2])):
            for o_y in range(below(n[1]), above(n[1])):
                row = (wrap(c[2] + o_z, n[2]) * n[1] + wrap(c[1] + o_y, n[1])) * n[0]
                for o_x in range(below(n[0]), above(n[0])):
                    cell = row + wrap(c[0] + o_x, n[0])
                    for p in range(grid.starts[cell], grid.starts[cell + 1]):
                        x_gp = nearest(x_g - x[p], nodes)
                        if wp.dot(x_gp, x_gp) < h * h:
                            moved = -wp.dot(gradient(x_gp, per_h, sigma), x_dot[p])
                            tinted = weight(x_gp, per_h, sigma)
                            total += moved * rgba(colour[p][0], colour[p][1], colour[p][2], real(1.0))
                            total += tinted * rgba(colour_dot[p][0], colour_dot[p][1], colour_dot[p][2], real(0.0))
        field_dot[k, j, i] = volume * total

    @wp.func
    def first_node(s: real, n: int) -> int:
        """The first of n nodes that is not below s, in node distances."""
        return int(wp.clamp(wp.ceil(s), real(0.0), real(n)))

    @wp.kernel(module=module, enable_backward=False)
    def colour_field_adjoint(
        nodes: nodes_struct,
        h: real,
        per_h: real,
        sigma: real,
        volume: real,
        order: wp.array(dtype=wp.int32),
        x: wp.array(dtype=vector),
        colour: wp.array(dtype=vector),
        field_bar: wp.array3d(dtype=rgba),
        # out
        x_scene_bar: wp.array(dtype=vector),
        colour_scene_bar: wp.array(dtype=vector),
    ):
        p = wp.tid()
        x_p = x[p]
        rgba_p = rgba(colour[p][0], colour[p][1], colour[p][2], real(1.0))
        r = nodes.frequency * h
        x_bar = vector()
        rgba_bar = rgba()
        for q in range(nodes.images[0] * nodes.images[1] * nodes.images[2]):
            x_q = image(q, x_p, h, nodes)
            s = nodes.frequency * (x_q - nodes.origin)
            for k in range(first_node(s[2] - r, nodes.shape[2]), first_node(s[2] + r, nodes.shape[2])):
                for j in range(first_node(s[1] - r, nodes.shape[1]), first_node(s[1] + r, nodes.shape[1])):
                    for i in range(first_node(s[0] - r, nodes.shape[0]), first_node(s[0] + r, nodes.shape[0])):
                        x_gq = place(i, j, k, nodes) - x_q
                        if wp.dot(x_gq, x_gq) < h * h:
                            bar = field_bar[k, j, i]
                            rgba_bar += weight(x_gq, per_h, sigma) * bar
                            x_bar += -wp.dot(bar, rgba_p) * gradient(x_gq, per_h, sigma)
        x_scene_bar[order[p]] = volume * x_bar
        colour_scene_bar[order[p]] = volume * vector(rgba_bar[0], rgba_bar[1], rgba_bar[2])

    return ColourFieldKernels(forward=colour_field, tangent=colour_field_tangent, adjoint=colour_field_adjoint)
