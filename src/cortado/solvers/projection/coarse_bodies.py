"""Free bodies on the coarse grid of the pressure, so that a light body gives way from the first step on.

Pressure impulses y give a body the momenta F = sum_i y_i gamma_i and T = sum_i y_i r_i x gamma_i
(`cortado.solvers.projection.body_kernels`). So they give it the velocities V = F / (rho K) and W = R' I^-1 R'^T T /
rho, which take (G y)_i = gamma_i . (V + W x r_i) from the divergence of particle i. G is symmetric and not negative: y
. G y is twice the kinetic energy that y gives to bodies at rest. On the grid it adds

    B^T B,   B_I = (F_I / sqrt(rho K), S R'^T T_I / sqrt(rho)),   S S = I^-1,

with F_I and T_I of y = phi_I c, to the matrix A: three rows for a body in the plane and six in space.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import warp as wp

from cortado.device.cells import cell_grid_type
from cortado.device.launching import Named, bundle
from cortado.device.modules import kernel_module
from cortado.device.precision import Precision
from cortado.particles.particle_kernels import particle_kernel
from cortado.particles.state import Layout
from cortado.solvers.projection.bodies import Bodies, BodiesAdjoint, BodiesTangent
from cortado.solvers.projection.coarse_nodes import hat_functions, node_functions
from cortado.solvers.projection.names import types_by_name
from cortado.sph.moment_functions import matrix_type
from cortado.sph.parts import Adjoints, StepContext, Tangents


@dataclass(frozen=True)
class CoarseBodyKernels:
    """Kernels of free bodies on the coarse grid of the pressure."""

    gather: Any
    """The rows of one body in the matrix B."""
    lift: Any
    """The pressure c E that particles feel from the grid, times a factor."""
    lift_tangent: Any
    source_tangent: Any
    """The part of c G c E in the source that is spread for the tangent of e."""
    source_adjoint: Any
    """The adjoints of c and x from that of c E."""


@cache
def coarse_body_kernels(precision: Precision, dimension: int) -> CoarseBodyKernels:
    """Make the kernels of free bodies on the coarse grid, in 2 or 3 dimensions."""
    real, vector, matrix = precision.real, precision.vector, matrix_type(precision)
    grid_type, hats, among = cell_grid_type(precision), hat_functions(precision, dimension), node_functions(dimension)
    hat, at, beside, corner_step = hats.hat, hats.at, among.beside, among.corner_step
    module = kernel_module(f"coarse_bodies_{dimension}d_{precision.name}")
    CORNERS, FLAT = wp.constant(2**dimension), wp.constant(dimension == 2)

    @wp.kernel(module=module, enable_backward=False)
    def gather(
        grid: grid_type,
        order: wp.array(dtype=wp.int32),
        first: int,
        density: wp.array(dtype=real),
        volume: real,
        root: matrix,
        turns: wp.array(dtype=matrix),
        x: wp.array(dtype=vector),
        of: bundle(coarse=real, gamma_of=vector, arm=vector),
        # out
        B: wp.array2d(dtype=real),
    ):
        """Write a body's rows of B from row ``first`` on, by node; ``root`` is a square root of I^-1."""
        node, force, torque = wp.tid(), vector(), vector()
        member = node // (grid.shape[0] * grid.shape[1] * grid.shape[2])
        for corner in range(CORNERS):
            cell = beside(node, -corner_step(corner), grid.shape)
            for p in range(grid.starts[cell], grid.starts[cell + 1]):
                i = order[p]
                pushed = (hat(x[i], corner, grid).value * of.coarse[i]) * of.gamma_of[i]
                force += pushed
                torque += wp.cross(of.arm[i], pushed)
        force = force / wp.sqrt(density[member] * volume)
        torque = root * (wp.transpose(turns[member]) * torque) / wp.sqrt(density[member])
        B[first, node] = force[0]
        B[first + 1, node] = force[1]
        if FLAT:
            B[first + 2, node] = torque[2]
        else:
            B[first + 2, node] = force[2]
            for axis in range(3):
                B[first + 3 + axis, node] = torque[axis]

    numbers, values = ["grid", "particles"], wp.array(dtype=real)

    @particle_kernel(module, "lifted", numbers=[*numbers, "factor"])
    def lift(i: int, grid: grid_type, particles: int, factor: real, x_i: vector, coarse_i: real, e: values) -> real:
        return factor * coarse_i * at(i, particles, x_i, e, grid).value

    typed = types_by_name(precision, {grid_type: "grid", values: "e multiplier", int: "i particles", real: "lifted"})

    @particle_kernel(module, "lifted_dot", numbers=numbers)
    @typed
    def lift_tangent(i: int, grid, particles: int, x_i, x_dot_i, coarse_i, coarse_dot_i, e) -> real:
        """Return the tangent of the lifted pressure c E for fixed node values e."""
        f = at(i, particles, x_i, e, grid)
        return coarse_dot_i * f.value + coarse_i * wp.dot(f.slope, x_dot_i)

    @particle_kernel(module, "+s_value +s_slope")
    @typed
    def source_tangent(x_dot_i, coarse_i, coarse_dot_i, carried_i, carried_dot_i) -> tuple[real, vector]:
        return -coarse_dot_i * carried_i - coarse_i * carried_dot_i, -(coarse_i * carried_i) * x_dot_i

    @particle_kernel(module, "+coarse_bar +x_bar", numbers=numbers)
    @typed
    def source_adjoint(
        i: int, grid, particles: int, x_i, coarse_i, e, multiplier, carried_i, lifted_bar_i
    ) -> tuple[real, vector]:
        """Add to the adjoints of c and x; ``multiplier`` is lambda, and ``carried`` G c E."""
        f, g = at(i, particles, x_i, e, grid), at(i, particles, x_i, multiplier, grid)
        slope = lifted_bar_i * f.slope - carried_i * g.slope
        return lifted_bar_i * f.value - carried_i * g.value, coarse_i * slope

    return CoarseBodyKernels(gather, lift, lift_tangent, source_tangent, source_adjoint)


class CoarseBodies:
    """The free bodies' rows of the matrix B on the coarse grid, and their operator G."""

    def __init__(self, bodies: Bodies, layout: Layout, dimension: int):
        """Prepare rows for a solver's bodies, given the ``layout`` of its particles."""
        precision, matrix = layout.precision, matrix_type(layout.precision)
        self.bodies, self.kernels = bodies.at_rest(), coarse_body_kernels(precision, dimension)
        self._each = 3 * dimension - 3
        self._roots = [matrix(*_root(held.body.table.mass.inertia).ravel()) for held in bodies.held]
        self.rows = self._each * len(bodies.held)
        """Number of rows of all bodies."""
        self._none = layout.arrays(none=precision.real)["none"]

    def begin(self, context: StepContext, grid: Named, around: Named, B: wp.array) -> None:
        """Write the bodies' rows of a step to ``B`` (rows, nodes)."""
        for number, (held, root) in enumerate(zip(self.bodies.held, self._roots, strict=True)):
            own, known = {"first": self._each * number, "root": root}, self.bodies.known(context, held)
            context.launch(self.kernels.gather, grid, own, around, *known, B=B, threads=B.shape[1])

    def carried(self, context: StepContext, y: wp.array) -> wp.array:
        """Return G y, the divergence that pressures y take away by moving bodies; the next call overwrites it."""
        return self.bodies.drifted(context, self._none, y)


def _root(inertia: np.ndarray) -> np.ndarray:
    """Return the square root S of I^-1, with 0 for turns about axes that have no inertia."""
    values, axes = np.linalg.eigh(np.linalg.pinv(inertia))
    found: np.ndarray = (axes * np.sqrt(np.maximum(values, 0.0))) @ axes.T
    return found


class CoarseBodiesTangent:
    """The tangent of free bodies on the coarse grid, for forward mode."""

    def __init__(self, own: CoarseBodies, bodies: BodiesTangent, dot: Tangents):
        self._own, self._bodies, self._dot = own, bodies.at_rest(own.bodies), dot
        self._none = wp.zeros_like(own.bodies.drift)
        self._lifted = {"lifted": wp.zeros_like(self._none), "lifted_dot": wp.zeros_like(self._none)}

    def carried(self, context: StepContext, y: wp.array, y_dot: wp.array) -> dict[str, wp.array]:
        """Return G y and its tangent, which the next call overwrites."""
        carried = self._own.carried(context, y)
        change = self._bodies.drifted(context, self._dot, self._none, y, y_dot)
        return {"carried": carried, "carried_dot": change}

    def add_source(self, context: StepContext, known: tuple[Named, ...], source: Named) -> None:
        """Add the tangent of c G c E to the source that is spread for the tangent of e."""
        kernels, lifted = self._own.kernels, self._lifted
        context.launch(kernels.lift, *known, lifted, factor=1.0)
        context.launch(kernels.lift_tangent, *known, lifted)
        found = self.carried(context, lifted["lifted"], lifted["lifted_dot"])
        context.launch(kernels.source_tangent, found, *known, source)


class CoarseBodiesAdjoint:
    """The adjoint of free bodies on the coarse grid, for reverse mode."""

    def __init__(self, own: CoarseBodies, bodies: BodiesAdjoint, bar: Adjoints):
        self._own, self._bodies, self._bar = own, bodies.at_rest(own.bodies), bar
        names = ("lifted", "lifted_bar", "carried_bar")
        self._lifted = {name: wp.zeros_like(own.bodies.drift) for name in names}

    def carried(self, context: StepContext, carried_bar: wp.array, y: wp.array, y_bar: wp.array) -> None:
        """Apply the adjoint of G y: add to ``y_bar`` and to the adjoints of bodies and particles."""
        self._bodies.carried(context, self._bar, carried_bar, y, y_bar)

    def add_source(self, context: StepContext, known: tuple[Named, ...], e: wp.array, multiplier: wp.array) -> None:
        """Add the adjoints of - lambda . c G c E, given the ``multiplier`` lambda, to those of all inputs."""
        kernels, (lifted, lifted_bar, carried_bar) = self._own.kernels, self._lifted.values()
        context.launch(kernels.lift, *known, e=e, lifted=lifted, factor=1.0)
        context.launch(kernels.lift, *known, e=multiplier, lifted=carried_bar, factor=-1.0)
        lifted_bar.zero_()
        self.carried(context, carried_bar, lifted, lifted_bar)
        found = {"carried": self._own.carried(context, lifted), "lifted_bar": lifted_bar, "e": e}
        context.launch(kernels.source_adjoint, found, *known, multiplier=multiplier)
