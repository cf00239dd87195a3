"""The kernels of free bodies on the coarse grid: see `cortado.solvers.projection.coarse_bodies`."""

from dataclasses import dataclass
from functools import cache
from typing import Any

import warp as wp

from cortado.device.cells import cell_grid_type
from cortado.device.launching import bundle
from cortado.device.modules import kernel_module
from cortado.device.precision import Precision
from cortado.solvers.projection.coarse_hats import hat_functions, node_functions
from cortado.sph.moment_functions import matrix_type


@dataclass(frozen=True)
class CoarseBodyKernels:
    """By what they do."""

    gather: Any
    """The rows of one body."""
    lift: Any
    """c E, the part of a pressure on the grid that particles feel, times a factor."""
    lift_tangent: Any
    source_tangent: Any
    """What the tangent of c G c E takes from what is spread for that of e."""
    source_adjoint: Any
    """From the adjoint of c E to those of c and x."""


@cache
def coarse_body_kernels(precision: Precision, dimension: int) -> CoarseBodyKernels:
    """In 2 or 3 dimensions."""
    real, vector, matrix = precision.real, precision.vector, matrix_type(precision)
    grid_type, hats, among = cell_grid_type(precision), hat_functions(precision, dimension), node_functions(dimension)
    hat, at, corner_step = hats.hat, hats.at, hats.corner_step
    number_of, node_of = among.number_of, among.node_of
    module = kernel_module(f"coarse_bodies_{dimension}d_{precision.name}")
    CORNERS, FLAT = wp.constant(2**dimension), wp.constant(dimension == 2)

    @wp.kernel(module=module, enable_backward=False)
    def gather(
        grid: grid_type,
        order: wp.array(dtype=wp.int32),
        first: int,
        number: int,
        density: wp.array(dtype=real),
        volume: real,
        root: matrix,
        turns: wp.array2d(dtype=matrix),
        x: wp.array(dtype=vector),
        of: bundle(coarse=real, gamma_of=vector, arm=vector),
        # out
        B: wp.array2d(dtype=real),
    ):
        """From row ``first`` on; ``root`` is a square root of I^-1."""
        node = wp.tid()
        nodes = grid.shape[0] * grid.shape[1] * grid.shape[2]
        member = node // nodes
        here, force, torque = node_of(node - member * nodes, grid.shape), vector(), vector()
        for corner in range(CORNERS):
            cell = member * nodes + number_of(here - corner_step(corner), grid.shape)
            for p in range(grid.starts[cell], grid.starts[cell + 1]):
                i = order[p]
                pushed = (hat(x[i], corner, grid).value * of.coarse[i]) * of.gamma_of[i]
                force += pushed
                torque += wp.cross(of.arm[i], pushed)
        force = force / wp.sqrt(density[member] * volume)
        torque = root * (wp.transpose(turns[member, number]) * torque) / wp.sqrt(density[member])
        B[first, node] = force[0]
        B[first + 1, node] = force[1]
        if FLAT:
            B[first + 2, node] = torque[2]
        else:
            B[first + 2, node] = force[2]
            for axis in range(3):
                B[first + 3 + axis, node] = torque[axis]

    @wp.kernel(module=module, enable_backward=False)
    def lift(
        grid: grid_type,
        particles: int,
        factor: real,
        x: wp.array(dtype=vector),
        coarse: wp.array(dtype=real),
        e: wp.array(dtype=real),
        # out
        lifted: wp.array(dtype=real),
    ):
        i = wp.tid()
        lifted[i] = factor * coarse[i] * at(i, particles, x[i], e, grid).value

    @wp.kernel(module=module, enable_backward=False)
    def lift_tangent(
        grid: grid_type,
        particles: int,
        x: wp.array(dtype=vector),
        x_dot: wp.array(dtype=vector),
        coarse: wp.array(dtype=real),
        coarse_dot: wp.array(dtype=real),
        e: wp.array(dtype=real),
        # out
        lifted_dot: wp.array(dtype=real),
    ):
        """Of c E, with e as it is."""
        i = wp.tid()
        f = at(i, particles, x[i], e, grid)
        lifted_dot[i] = coarse_dot[i] * f.value + coarse[i] * wp.dot(f.slope, x_dot[i])

    @wp.kernel(module=module, enable_backward=False)
    def source_tangent(
        x_dot: wp.array(dtype=vector),
        of: bundle(coarse=real, carried=real),
        dot: bundle(coarse=real, carried=real),
        # in and out
        s_value: wp.array(dtype=real),
        s_slope: wp.array(dtype=vector),
    ):
        i = wp.tid()
        s_value[i] = s_value[i] - dot.coarse[i] * of.carried[i] - of.coarse[i] * dot.carried[i]
        s_slope[i] = s_slope[i] - (of.coarse[i] * of.carried[i]) * x_dot[i]

    @wp.kernel(module=module, enable_backward=False)
    def source_adjoint(
        grid: grid_type,
        particles: int,
        x: wp.array(dtype=vector),
        coarse: wp.array(dtype=real),
        e: wp.array(dtype=real),
        multiplier: wp.array(dtype=real),
        carried: wp.array(dtype=real),
        lifted_bar: wp.array(dtype=real),
        # in and out
        bar: bundle(x=vector, coarse=real),
    ):
        """``multiplier`` is lambda, and ``carried`` G c E."""
        i = wp.tid()
        f, g = at(i, particles, x[i], e, grid), at(i, particles, x[i], multiplier, grid)
        bar.coarse[i] = bar.coarse[i] + lifted_bar[i] * f.value - carried[i] * g.value
        bar.x[i] = bar.x[i] + coarse[i] * (lifted_bar[i] * f.slope - carried[i] * g.slope)

    return CoarseBodyKernels(gather, lift, lift_tangent, source_tangent, source_adjoint)
