"""Free bodies on the coarse grid of the pressure, so that a light body gives way from the first step on.

Pressure impulses y give a body the momenta F = sum_i y_i gamma_i and T = sum_i y_i r_i x gamma_i
(`cortado.solvers.projection.body_kernels`), so the velocities V = F / (rho K) and W = R' I^-1 R'^T T / rho, which take
(G y)_i = gamma_i . (V + W x r_i) from the divergence of particle i. G is symmetric and not negative: y . G y is twice
the kinetic energy that y gives to bodies at rest. On the grid it adds

    B^T B,   B_I = (F_I / sqrt(rho K), S R'^T T_I / sqrt(rho)),   S S = I^-1,

with F_I and T_I of y = phi_I c, to the matrix A: three rows for a body in the plane and six in space.
"""

import numpy as np
import warp as wp

from cortado.device.launching import Named
from cortado.particles.state import Layout
from cortado.solvers.projection.bodies import Bodies, BodiesAdjoint, BodiesTangent
from cortado.solvers.projection.coarse_body_kernels import coarse_body_kernels
from cortado.sph.moment_functions import matrix_type
from cortado.sph.parts import Adjoints, StepContext, Tangents


class CoarseBodies:
    """Their rows of a step, and G."""

    def __init__(self, bodies: Bodies, layout: Layout, dimension: int):
        """``layout`` of particles."""
        precision, matrix = layout.precision, matrix_type(layout.precision)
        self.bodies, self.kernels = bodies.at_rest(), coarse_body_kernels(precision, dimension)
        self._each = 3 * dimension - 3
        self._roots = [matrix(*_root(held.body.table.mass.inertia).ravel()) for held in bodies.held]
        self.rows = self._each * len(bodies.held)
        """How many there are."""
        self._none = layout.arrays(none=precision.real)["none"]

    def begin(self, context: StepContext, grid: Named, around: Named, B: wp.array) -> None:
        """Write those of a step to ``B`` (rows, nodes)."""
        for number, (held, root) in enumerate(zip(self.bodies.held, self._roots, strict=True)):
            own, known = {"first": self._each * number, "root": root}, self.bodies.known(context, held)
            context.launch(self.kernels.gather, grid, own, around, *known, B=B, threads=B.shape[1])

    def carried(self, context: StepContext, y: wp.array) -> wp.array:
        """G y, which the next call overwrites."""
        return self.bodies.drifted(context, self._none, y)


def _root(inertia: np.ndarray) -> np.ndarray:
    """S, without turns about axes that have no inertia."""
    values, axes = np.linalg.eigh(np.linalg.pinv(inertia))
    found: np.ndarray = (axes * np.sqrt(np.maximum(values, 0.0))) @ axes.T
    return found


class CoarseBodiesTangent:
    """Forward mode."""

    def __init__(self, own: CoarseBodies, bodies: BodiesTangent, dot: Tangents):
        self._own, self._bodies, self._dot = own, bodies.at_rest(own.bodies), dot
        self._none = wp.zeros_like(own.bodies.drift)
        self._lifted = {"lifted": wp.zeros_like(self._none), "lifted_dot": wp.zeros_like(self._none)}

    def carried(self, context: StepContext, y: wp.array, y_dot: wp.array) -> dict[str, wp.array]:
        """G y and its tangent, which the next call overwrites."""
        carried = self._own.carried(context, y)
        change = self._bodies.drifted(context, self._dot, self._none, y, y_dot)
        return {"carried": carried, "carried_dot": change}

    def add_source(self, context: StepContext, known: tuple[Named, ...], source: Named) -> None:
        """Of c G c E, to what is spread for the tangent of e."""
        kernels, lifted = self._own.kernels, self._lifted
        context.launch(kernels.lift, *known, lifted, factor=1.0)
        context.launch(kernels.lift_tangent, *known, lifted)
        found = self.carried(context, lifted["lifted"], lifted["lifted_dot"])
        context.launch(kernels.source_tangent, found, *known, source)


class CoarseBodiesAdjoint:
    """Reverse mode."""

    def __init__(self, own: CoarseBodies, bodies: BodiesAdjoint, bar: Adjoints):
        self._own, self._bodies, self._bar = own, bodies.at_rest(own.bodies), bar
        names = ("lifted", "lifted_bar", "carried_bar")
        self._lifted = {name: wp.zeros_like(own.bodies.drift) for name in names}

    def carried(self, context: StepContext, carried_bar: wp.array, y: wp.array, y_bar: wp.array) -> None:
        """Of G y."""
        self._bodies.carried(context, self._bar, carried_bar, y, y_bar)

    def add_source(self, context: StepContext, known: tuple[Named, ...], e: wp.array, multiplier: wp.array) -> None:
        """Of - lambda . c G c E, given the ``multiplier`` lambda, to all adjoints."""
        kernels, (lifted, lifted_bar, carried_bar) = self._own.kernels, self._lifted.values()
        context.launch(kernels.lift, *known, e=e, lifted=lifted, factor=1.0)
        context.launch(kernels.lift, *known, e=multiplier, lifted=carried_bar, factor=-1.0)
        lifted_bar.zero_()
        self.carried(context, carried_bar, lifted, lifted_bar)
        found = {"carried": self._own.carried(context, lifted), "lifted_bar": lifted_bar, "e": e}
        context.launch(kernels.source_adjoint, found, *known, multiplier=multiplier)
