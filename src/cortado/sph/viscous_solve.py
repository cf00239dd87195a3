"""The solve of the implicit viscous stress by conjugate gradients (Hestenes and Stiefel 1952).

The unknowns are one vector for each particle and a few numbers for each free body. The matrix is symmetric and positive
definite in the scalar product weighted with masses. Each scene of a batch iterates until its residual has fallen to
round-off.
"""

from functools import cache
from types import SimpleNamespace
from typing import Any

import warp as wp

from cortado.device.modules import by_name, kernel_module
from cortado.device.precision import Precision, TypesByName
from cortado.device.reduction import add, type_name
from cortado.particles.neighbourhood import Discretisation
from cortado.particles.particle_kernels import over, particle_kernel
from cortado.particles.state import Layout, zeros
from cortado.sph.formula import Formula
from cortado.sph.free_friction import FreeFriction
from cortado.sph.moment_functions import round_off
from cortado.sph.parts import StepContext
from cortado.sph.stress_forces import stress_sums
from cortado.sph.stress_kernels import moment_sums, traction_function


@cache
def operator_kernels(discretisation: Discretisation, dimension: int, law: Formula, sticks: bool) -> tuple[Any, Any]:
    precision = discretisation.precision
    real, vector, matrix = precision.real, precision.vector, precision.matrix
    module = discretisation.module(False, f"implicit_viscosity_{law.topic}{dimension}d" + "_no_slip" * sticks)
    traction = traction_function(precision, dimension, module)
    moments, force = moment_sums(discretisation, sticks).forward, stress_sums(discretisation, sticks).force
    constants = ["control", "least"]

    @particle_kernel(module, "A T", [over(moments, "diagonal others row_x row_y row_z thin")], numbers=constants)
    def pull(
        row_x: vector, row_y: vector, row_z: vector, control: real, M_i: matrix, eta_i: real
    ) -> tuple[matrix, matrix]:
        A = wp.matrix_from_rows(row_x, row_y, row_z)
        return A, traction(M_i, A, eta_i, control)

    @particle_kernel(module, "product share", [over(force, "total", mu="eta")], numbers=constants)
    def multiply(total: vector, time_step: real, v_i: vector, m_i: real) -> tuple[vector, real]:
        found = v_i - time_step * total
        return found, m_i * wp.dot(v_i, found)

    return pull, multiply


@cache
def solve_kernels(precision: Precision) -> SimpleNamespace:
    """``going`` (members,) is 1 for scenes that still iterate."""
    real, vector = precision.real, precision.vector
    module = kernel_module(f"conjugate_gradients_{type_name(vector)}")
    typed = TypesByName(real, {vector: "r p y product", wp.int32: "count going active"})

    @typed.kernel(module, enable_backward=False)
    def begin(w, r, p, y, share):
        i = wp.tid()
        p[i] = r[i]
        y[i] = vector()
        share[i] = w[i] * wp.dot(r[i], r[i])

    @typed.kernel(module, enable_backward=False)
    def start(total, first, size, count, going, active):
        b = wp.tid()
        first[b] = total[b]
        size[b] = total[b]
        count[b] = 0
        going[b] = 0
        if total[b] > real(0.0):
            going[b] = 1
            wp.atomic_add(active, 0, 1)

    @typed.kernel(module, enable_backward=False)
    def descend(particles: int, going, size, curvature, w, p, product, y, r, share):
        i = wp.tid()
        b = i // particles
        if going[b] == 0:
            return
        step = size[b] / curvature[b]
        left = r[i] - step * product[i]
        y[i] = y[i] + step * p[i]
        r[i] = left
        share[i] = w[i] * wp.dot(left, left)

    @typed.kernel(module, enable_backward=False)
    def turn(particles: int, going, size, total, r, p):
        i = wp.tid()
        b = i // particles
        if going[b] == 1:
            p[i] = r[i] + (total[b] / size[b]) * p[i]

    @typed.kernel(module, enable_backward=False)
    def decide(tolerance: real, most: int, total, first, size, count, going, active):
        b = wp.tid()
        if going[b] == 0:
            return
        size[b] = total[b]
        count[b] = count[b] + 1
        if count[b] >= most or not total[b] > tolerance * tolerance * first[b]:
            going[b] = 0
            wp.atomic_sub(active, 0, 1)

    return by_name(begin, start, descend, turn, decide)


MOST = 1_000


class Solve:
    name, most = "viscous_iterations", MOST

    def __init__(self, layout: Layout, operator: tuple[Any, Any], free: FreeFriction):
        real, vector = layout.precision.real, layout.precision.vector
        self._kernels, self._layout, self._free = solve_kernels(layout.precision), layout, free
        self._pull, self._multiply = operator
        self._limits = {"tolerance": round_off(layout.precision), "most": MOST}
        self._own = layout.arrays(p=vector, product=vector, share=real)
        kinds = {"first": real, "size": real, "count": wp.int32, "going": wp.int32}
        self._scenes = zeros({name: (layout.members, one) for name, one in kinds.items()}, layout.device)
        self.count = self._scenes["count"]
        self._active = wp.zeros(1, dtype=wp.int32, device=layout.device)
        self._sums = layout.sum_of(real), layout.sum_of(real)

    def __call__(self, step: StepContext, known: Any, r: wp.array, y: wp.array) -> None:
        """Write the solution to ``y`` (n,), given the right-hand side ``r`` (n,), which is overwritten."""
        kernels, (sum_shares, sum_curvatures), rows = self._kernels, self._sums, self._free.rows
        n, members, sizes = self._layout.all_particles, self._layout.members, {"particles": self._layout.particles}
        own = {**self._own, "w": step.fields["m"], "r": r, "y": y}
        scene = {**self._scenes, "active": self._active}
        step.launch(kernels.begin, own, threads=n)
        self._active.zero_()
        total = sum_shares(own["share"])
        for row in rows:
            row.launch(step, row.kernels.lift, total=total)
            row.launch(step, row.kernels.begin)
        step.launch(kernels.start, scene, total=total, threads=members)

        def iterate() -> None:
            self._apply(step, known, own["p"])
            curvature = sum_curvatures(own["share"])
            for row in rows:
                row.launch(step, row.kernels.multiply, load=row.load, curvature=curvature)
            going = {**scene, "curvature": curvature}
            step.launch(kernels.descend, going, own, sizes, threads=n)
            total = sum_shares(own["share"])
            for row in rows:
                row.launch(step, row.kernels.descend, going)
                row.launch(step, row.kernels.lift, total=total)
            step.launch(kernels.turn, scene, own, sizes, total=total, threads=n)
            for row in rows:
                row.launch(step, row.kernels.turn, scene, total=total)
            step.launch(kernels.decide, scene, self._limits, total=total, threads=members)

        step.join()  # a loop of a graph cannot begin while something is computed aside
        wp.capture_while(self._active, iterate)

    def _apply(self, step: StepContext, known: Any, p: wp.array) -> None:
        """Write ``product``, the matrix times ``p``, and ``share``, each particle's term of ``p`` times ``product``."""
        step.launch(self._pull, *known, v=p)
        self._free.pull(step, *known, v=p, solves=True)
        step.launch(self._multiply, *known, self._own, v=p)
        self._free.multiply(step, known, p, self._own)

    def respond(self, step: StepContext, known: Any, still: wp.array, r: wp.array) -> None:
        """Add the matrix times velocities to ``r``. The array ``still`` contains the velocities of particles."""
        self._apply(step, known, still)
        add(self._own["product"], r)
