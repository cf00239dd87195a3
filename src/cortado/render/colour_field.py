"""The colour field: coverage by fluid and colour at the nodes of a regular grid.

The colour of particle j is mixed from the colours of its phases k by their mass fractions c_jk. Particle j is at x_j
and has the volume V. At a node g at x_g, the coverage A_g and the colour times coverage P_g are sums over particles
with the smoothing kernel W:

    colour_j = sum_k c_jk colours_k
    A_g = V sum_j W(x_g - x_j),    P_g = V sum_j W(x_g - x_j) colour_j

The coverage is 1 inside the fluid. The sums include periodic images of particles.
"""

from collections.abc import Mapping
from functools import cache, cached_property, partial
from math import prod
from typing import Any

import numpy as np
import warp as wp

from cortado.device.cells import CellSort, cell_functions, cell_grid_type
from cortado.device.grid import Grid
from cortado.device.launching import launch
from cortado.device.modules import Kernels, kernel_module
from cortado.device.precision import Precision, TypesByName, struct_of
from cortado.device.reduction import sum_of
from cortado.device.threads import field_parts, require
from cortado.discretise.smoothing_functions import smoothing_functions
from cortado.errors import InputError
from cortado.particles.neighbourhood import Discretisation

MOST_NODES = 2**27
MOST_CELLS = 2**20


@cache
def rgba_type(precision: Precision) -> Any:
    return wp.types.vector(length=4, dtype=precision.real)


@cache
def nodes_type(precision: Precision) -> Any:
    """Arrays over nodes are indexed [z, y, x]. ``cell`` [m] is the distance between nodes, and ``period`` [m] is the
    length     of the periodic box along each axis, or 0."""
    real, vector = precision.real, precision.vector
    sizes, periods = {"cell": real, "frequency": real, "shape": wp.vec3i}, {"period": vector, "turn": vector}
    return struct_of("Nodes", precision, origin=vector, **sizes, periodic=wp.int32, **periods, images=wp.vec3i)


@cache
def node_functions(precision: Precision) -> tuple[Any, Any, Any]:
    """``nearest`` returns the shortest periodic image of a vector."""
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
        """Return the position of the periodic image with the index ``number`` of a particle at ``x``."""
        t = wp.cw_mul(x - nodes.origin + vector(h, h, h), nodes.turn)
        n_x = nodes.images[0]
        n_y = nodes.images[1]
        q = vector(real(number % n_x), real((number // n_x) % n_y), real(number // (n_x * n_y)))
        return x + wp.cw_mul(q - vector(wp.floor(t[0]), wp.floor(t[1]), wp.floor(t[2])), nodes.period)

    return place, nearest, image


@cache
def colours_type(precision: Precision, phases: int) -> Any:
    return wp.types.matrix(shape=(phases, 3), dtype=precision.real)


@cache
def phase_colour_kernels(precision: Precision, phases: int) -> Kernels:
    """The kernels ``forward`` and ``tangent`` also sort the particles."""
    vector, fractions = precision.vector, precision.fractions(phases)
    colours_matrix = colours_type(precision, phases)
    module = kernel_module(f"phase_colour_{phases}_{precision.name}")

    kinds = {colours_matrix: "colours", wp.int32: "order", vector: "x colour tint", fractions: "c"}
    typed = TypesByName(precision.real, kinds)

    @wp.kernel(module=module, enable_backward=False)
    @typed.arrays
    def phase_colour(colours, order, x_scene, c_scene, x, colour):
        i = wp.tid()
        j = order[i]
        x[i] = x_scene[j]
        colour[i] = wp.transpose(colours[0]) * c_scene[j]

    @wp.kernel(module=module, enable_backward=False)
    @typed.arrays
    def phase_colour_tangent(colours, order, c_scene, x_scene_dot, c_scene_dot, colours_dot, x_dot, colour_dot):
        i = wp.tid()
        j = order[i]
        x_dot[i] = x_scene_dot[j]
        colour_dot[i] = wp.transpose(colours[0]) * c_scene_dot[j] + wp.transpose(colours_dot[0]) * c_scene[j]

    @wp.kernel(module=module, enable_backward=False)
    @typed.arrays
    def phase_colour_adjoint(colours, c_scene, tint_scene_bar, c_scene_bar, colours_bar):
        """``colours_bar`` has each particle's contribution to the adjoint of the phase colours."""
        j = wp.tid()
        bar = tint_scene_bar[j]
        c_scene_bar[j] = colours[0] * bar
        colours_bar[j] = wp.outer(c_scene[j], bar)

    return Kernels(phase_colour, phase_colour_tangent, phase_colour_adjoint)


@cache
def colour_field_kernels(discretisation: Discretisation) -> Kernels:
    """``forward`` and ``tangent`` have a thread for each node. ``adjoint`` has a thread for each particle."""
    precision = discretisation.precision
    real, vector, rgba = precision.real, precision.vector, rgba_type(precision)
    nodes_struct, grid_type = nodes_type(precision), cell_grid_type(precision)
    cells, smooth = cell_functions(precision), smoothing_functions(discretisation.smoothing, precision)
    wrap, cell_of, below, above = cells.wrap, cells.cell_of, cells.below, cells.above
    weight, gradient = smooth.weight, smooth.gradient
    place, nearest, image = node_functions(precision)
    module, fields = discretisation.module(False, "colour_field"), wp.array3d(dtype=rgba)

    kinds = {vector: "x colour tint", nodes_struct: "nodes", grid_type: "grid", wp.int32: "order", fields: "field"}
    typed = TypesByName(real, kinds)

    @wp.func
    @typed
    def row_sum(
        row: int, c_x: int, x_g, x: wp.array(dtype=vector), colour: wp.array(dtype=vector), nodes, grid, h, per_h, sigma
    ) -> rgba:
        """Sum over the particles in three adjacent cells along x."""
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
    @typed.arrays
    def colour_field(nodes, grid, h: real, per_h: real, sigma: real, volume: real, x, colour, field):
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
    @typed.arrays
    def colour_field_tangent(
        nodes, grid, h: real, per_h: real, sigma: real, volume: real, x, colour, x_dot, colour_dot, field_dot
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
        """Return the first of ``n`` nodes at or above the coordinate ``s``, in node distances."""
        return int(wp.clamp(wp.ceil(s), real(0.0), real(n)))

    @wp.kernel(module=module, enable_backward=False)
    @typed.arrays
    def colour_field_adjoint(
        nodes, h: real, per_h: real, sigma: real, volume: real, order, x, colour, field_bar, x_scene_bar, tint_scene_bar
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
        tint_scene_bar[order[p]] = volume * vector(rgba_bar[0], rgba_bar[1], rgba_bar[2])

    return Kernels(colour_field, colour_field_tangent, colour_field_adjoint)


def nodes_over(
    lower: np.ndarray, upper: np.ndarray, periods: np.ndarray, cell: float, support: float, precision: Precision
) -> Any:
    """The region from ``lower`` to ``upper`` (d,) [m] is extended by the support radius, except along periodic axes."""
    margin = np.where(periods > 0.0, 0, int(np.ceil(support / cell)))
    counts = np.ceil((upper - lower) / cell * (1 - 1e-12)) + 2 * margin + 1
    if np.prod(counts) > MOST_NODES:
        found = f"cell is {cell:g}, which makes {np.prod(counts):.1e} nodes"
        raise InputError(f"{found}, but at most {MOST_NODES} nodes are possible: take a larger cell.")
    flat = 3 - len(lower)
    nodes = nodes_type(precision)()
    nodes.origin = precision.vector_of(lower - margin * cell)
    nodes.cell, nodes.frequency = cell, 1.0 / cell
    nodes.shape = wp.vec3i(*(int(n) for n in counts), *[1] * flat)
    turns = np.divide(1.0, periods, out=np.zeros(len(periods)), where=periods > 0.0)
    images = np.floor((cell * (counts - 1) + 2 * support) * turns) + 1
    nodes.periodic = int(periods.any())
    nodes.period, nodes.turn = map(precision.vector_of, (periods, turns))
    nodes.images = wp.vec3i(*(int(n) for n in images), *[1] * flat)
    return nodes


class ColourField:
    """The colour field of a fixed number of particles. Each call of ``adjoint`` overwrites the previous result."""

    def __init__(self, of: Mapping[str, Any], precision: Precision, device: Any):
        """Allocate the field. ``of`` maps the names of a `Renderer`'s arguments to their values."""
        particles, phases, support, smoothing = (of[name] for name in ("particles", "phases", "support", "smoothing"))
        lower, upper, periods = (np.array(of[name]) for name in ("lower", "upper", "periods"))
        self._particles, self._device, self._precision = particles, device, precision
        self._tint = phase_colour_kernels(precision, phases)
        self._field = colour_field_kernels(Discretisation(smoothing, precision))
        self._sort = CellSort(Grid.around(lower, upper, periods, support, MOST_CELLS), particles, precision, device)
        sigma = smoothing.normalisation(len(lower), support)
        self._kernel = {"h": support, "per_h": 1.0 / support, "sigma": sigma, "volume": of["volume"]}
        zeros, mix = partial(wp.zeros, device=device), precision.fractions(phases)
        palette = colours_type(precision, phases)
        self._x, self._x_bar, self._colour, self._colour_bar = (
            zeros(particles, dtype=precision.vector) for _ in range(4)
        )
        self._fractions, self._fractions_bar = (zeros(particles, dtype=mix) for _ in range(2))
        self._colours, self._colours_dot = zeros(1, dtype=palette), zeros(1, dtype=palette)
        self._colours_bar = zeros(particles, dtype=palette)
        self._known = {"order": self._sort.order, "colours": self._colours, "c_scene": self._fractions}
        self._sum = sum_of(palette, particles, device)
        self.nodes = nodes_over(lower, upper, periods, of["cell"], support, precision)
        require(field_parts(prod(self.nodes.shape), precision.bytes), "take a larger cell", device)
        self.values = zeros(tuple(self.nodes.shape)[::-1], dtype=rgba_type(precision))
        """Colour times coverage (three components), then coverage, at the nodes (nz, ny, nx) [-]."""

    def gather(self, positions: wp.array, fractions: wp.array, colours: np.ndarray) -> None:
        """Compute the field from positions (n,) [m], mass fractions (n,) and phase colours (phases, 3)."""
        self._sort(positions)
        wp.copy(self._fractions, fractions)
        self._colours.assign(colours[None])
        own = {"x": self._x, "colour": self._colour}
        launch(self._tint.forward, self._particles, self._device, self._known, own, x_scene=positions)
        given = {"nodes": self.nodes, "grid": self._sort.grid, "field": self.values}
        launch(self._field.forward, self.values.shape, self._device, self._kernel, own, given)

    def tangent(self, positions_dot: wp.array, fractions_dot: wp.array, colours_dot: np.ndarray) -> wp.array:
        """Return the tangent (nz, ny, nx) of the last field. The next ``tangent`` overwrites the result."""
        own = {"x": self._x, "colour": self._colour, "x_dot": self._x_bar, "colour_dot": self._colour_bar}
        along = {"x_scene_dot": positions_dot, "c_scene_dot": fractions_dot, "colours_dot": self._colours_dot}
        self._colours_dot.assign(colours_dot[None])
        launch(self._tint.tangent, self._particles, self._device, self._known, own, along)
        out = {"nodes": self.nodes, "grid": self._sort.grid, "field_dot": self._values_dot}
        launch(self._field.tangent, self.values.shape, self._device, self._kernel, own, out)
        return self._values_dot

    @cached_property
    def _values_dot(self) -> wp.array:
        require(field_parts(prod(self.nodes.shape), self._precision.bytes), "take a larger cell", self._device)
        return wp.zeros_like(self.values)

    def adjoint(self, field_bar: wp.array) -> tuple[wp.array, wp.array, np.ndarray]:
        """Return derivatives with respect to positions (n,), mass fractions (n,) and phase colours (phases, 3)."""
        own = {"x": self._x, "colour": self._colour, "nodes": self.nodes, "field_bar": field_bar}
        bars = {"x_scene_bar": self._x_bar, "tint_scene_bar": self._colour_bar}
        bars |= {"c_scene_bar": self._fractions_bar, "colours_bar": self._colours_bar}
        launch(self._field.adjoint, self._particles, self._device, self._kernel, self._known, own, bars)
        launch(self._tint.adjoint, self._particles, self._device, self._known, bars)
        return self._x_bar, self._fractions_bar, self._sum(self._colours_bar).numpy()[0].astype(np.float64)
