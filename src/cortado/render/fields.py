"""The colour field of particles on a device, with its tangent and the way back from it."""

from functools import cached_property, partial
from math import prod
from typing import Any

import numpy as np
import warp as wp

from cortado.device.cells import CellSort
from cortado.device.grid import Grid
from cortado.device.launching import launch
from cortado.device.memory import field_parts, require
from cortado.device.precision import Precision
from cortado.device.reduction import sum_of
from cortado.discretise.smoothing import SmoothingKernel
from cortado.errors import InputError
from cortado.particles.neighbourhood import Discretisation
from cortado.render.colour_field import colour_field_kernels, nodes_type, rgba_type
from cortado.render.phase_colours import colours_type, phase_colour_kernels

MOST_NODES = 2**27
"""Of a colour field: 2 GiB in float32."""
MOST_CELLS = 2**20
"""Of the grid in which particles are sorted."""


def nodes_over(
    lower: np.ndarray, upper: np.ndarray, periods: np.ndarray, cell: float, support: float, precision: Precision
) -> Any:
    """The struct of nodes of that distance [m] over a region (d,) to (d,) [m], and beyond as far as particles in it
    are felt, but not along axes with a period [m]. In 2-D they are one layer."""
    margin = np.where(periods > 0.0, 0, int(np.ceil(support / cell)))
    counts = np.ceil((upper - lower) / cell * (1 - 1e-12)) + 2 * margin + 1
    if np.prod(counts) > MOST_NODES:
        raise InputError(
            f"cell is {cell:g}, which makes {np.prod(counts):.1e} nodes; {MOST_NODES} at most, take a larger."
        )
    flat = 3 - len(lower)
    nodes = nodes_type(precision)()
    nodes.origin = precision.vector(*(lower - margin * cell), *[0.0] * flat)
    nodes.cell, nodes.frequency = cell, 1.0 / cell
    nodes.shape = wp.vec3i(*(int(n) for n in counts), *[1] * flat)
    turns = np.divide(1.0, periods, out=np.zeros(len(periods)), where=periods > 0.0)
    images = np.floor((cell * (counts - 1) + 2 * support) * turns) + 1
    nodes.periodic = int(periods.any())
    nodes.period, nodes.turn = (precision.vector(*values, *[0.0] * flat) for values in (periods, turns))
    nodes.images = wp.vec3i(*(int(n) for n in images), *[1] * flat)
    return nodes


class ColourField:
    """Gathers a fixed number of particles into a field. What `adjoint` returns is overwritten by its next call."""

    def __init__(
        self,
        lower: np.ndarray,
        upper: np.ndarray,
        periods: np.ndarray,
        cell: float,
        smoothing: SmoothingKernel,
        support: float,
        volume: float,
        particles: int,
        phases: int,
        precision: Precision,
        device: Any,
    ):
        """Of particles in a region (d,) to (d,) [m]; arguments as those of the `Renderer`."""
        self._particles = particles
        self._tint = phase_colour_kernels(precision, phases)
        self._field = colour_field_kernels(Discretisation(smoothing, precision))
        self._device, self._precision = device, precision
        grid = Grid.around(lower, upper, periods, support, MOST_CELLS)
        self._sort = CellSort(grid, particles, precision, device)
        sigma = smoothing.normalisation(len(lower), support)
        self._kernel = {"h": support, "per_h": 1.0 / support, "sigma": sigma, "volume": volume}
        zeros, mix, palette = (
            partial(wp.zeros, device=device),
            precision.fractions(phases),
            colours_type(precision, phases),
        )
        self._x, self._x_bar, self._colour, self._colour_bar = (
            zeros(particles, dtype=precision.vector) for _ in range(4)
        )
        self._fractions, self._fractions_bar = (zeros(particles, dtype=mix) for _ in range(2))
        self._colours, self._colours_dot = zeros(1, dtype=palette), zeros(1, dtype=palette)
        self._colours_bar = zeros(particles, dtype=palette)
        self._known = {"order": self._sort.order, "colours": self._colours, "c_scene": self._fractions}
        self._sum = sum_of(palette, particles, device)
        self.nodes = nodes_over(lower, upper, periods, cell, support, precision)
        """The struct that kernels see."""
        require(field_parts(prod(self.nodes.shape), precision.bytes), "take a larger cell", device)
        self.values = zeros(tuple(self.nodes.shape)[::-1], dtype=rgba_type(precision))
        """(nz, ny, nx) colour times coverage, and coverage [-]."""

    def gather(self, positions: wp.array, fractions: wp.array, colours: np.ndarray) -> None:
        """Make the field of positions (n,) [m], mass fractions (n,) [-] and the colours (phases, 3) of the phases."""
        self._sort(positions)
        wp.copy(self._fractions, fractions)
        self._colours.assign(colours[None])
        own = {"x": self._x, "colour": self._colour}
        launch(self._tint.forward, self._particles, self._device, self._known, own, x_scene=positions)
        grid, shape = self._sort.grid, self.values.shape
        launch(
            self._field.forward, shape, self._device, self._kernel, own, nodes=self.nodes, grid=grid, field=self.values
        )

    def tangent(self, positions_dot: wp.array, fractions_dot: wp.array, colours_dot: np.ndarray) -> wp.array:
        """The tangent (nz, ny, nx) of the last field, along those of positions (n,), fractions (n,) and colours
        (phases, 3). The next call overwrites it, and what `adjoint` returned."""
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
        """The derivative with respect to positions (n,), fractions (n,) and colours (phases, 3), from that with respect
        to the field."""
        own = {"x": self._x, "colour": self._colour, "nodes": self.nodes, "field_bar": field_bar}
        bars = {
            "x_scene_bar": self._x_bar,
            "colour_scene_bar": self._colour_bar,
            "c_scene_bar": self._fractions_bar,
            "colours_bar": self._colours_bar,
        }
        launch(self._field.adjoint, self._particles, self._device, self._kernel, self._known, own, bars)
        launch(self._tint.adjoint, self._particles, self._device, self._known, bars)
        colours = self._sum(self._colours_bar).numpy()[0].astype(np.float64)
        return self._x_bar, self._fractions_bar, colours
