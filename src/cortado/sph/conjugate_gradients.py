"""The method of conjugate gradients (Hestenes and Stiefel 1952) for B y = r, of numbers or vectors of particles.

B is symmetric and positive with respect to the product sum_i w_i a_i . b_i with weights w, in which everything is
measured here. Each scene of a batch goes on until |r| has fallen to a part of the first, and stays as it is then.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any

import warp as wp

from cortado.device.modules import kernel_module
from cortado.device.precision import FLOAT32, Precision, TypesByName
from cortado.device.reduction import type_name
from cortado.particles.state import Layout
from cortado.sph.parts import StepContext


@dataclass(frozen=True)
class SolveKernels:
    """The kernels of conjugate gradients, which need no neighbours."""

    begin: Any
    """p = r, y = 0."""
    start: Any
    """Tells for each scene whether there is anything to solve."""
    descend: Any
    """y and r after a step along p."""
    turn: Any
    """The next p."""
    decide: Any
    """Tells for each scene whether to go on."""


@cache
def solve_kernels(precision: Precision, kind: Any) -> SolveKernels:
    """Make the kernels of conjugate gradients for numbers or vectors; ``going`` (members,) is 1 for a scene to go
    on."""
    real = precision.real
    module = kernel_module(f"conjugate_gradients_{type_name(kind)}")
    square = _square_of_numbers(real, module) if kind is real else _square_of_vectors(kind, real, module)

    typed = TypesByName(real, {kind: "r p y product", wp.int32: "count going active"})

    @wp.kernel(module=module, enable_backward=False)
    @typed.arrays
    def begin(w, r, p, y, share):
        i = wp.tid()
        p[i] = r[i]
        y[i] = kind(real(0.0))
        share[i] = w[i] * square(r[i])

    @wp.kernel(module=module, enable_backward=False)
    @typed.arrays
    def start(total, first, size, count, going, active):
        """Begin the solve of each scene that has a residual; ``active`` becomes the number of scenes that go on."""
        b = wp.tid()
        first[b] = total[b]
        size[b] = total[b]
        count[b] = 0
        going[b] = 0
        if total[b] > real(0.0):
            going[b] = 1
            wp.atomic_add(active, 0, 1)

    @wp.kernel(module=module, enable_backward=False)
    @typed.arrays
    def descend(particles: int, going, size, curvature, w, p, product, y, r, share):
        i = wp.tid()
        b = i // particles
        if going[b] == 0:
            return
        step = size[b] / curvature[b]
        left = r[i] - step * product[i]
        y[i] = y[i] + step * p[i]
        r[i] = left
        share[i] = w[i] * square(left)

    @wp.kernel(module=module, enable_backward=False)
    @typed.arrays
    def turn(particles: int, going, size, total, r, p):
        i = wp.tid()
        b = i // particles
        if going[b] == 1:
            p[i] = r[i] + (total[b] / size[b]) * p[i]

    @wp.kernel(module=module, enable_backward=False)
    @typed.arrays
    def decide(tolerance: real, most: int, total, first, size, count, going, active):
        b = wp.tid()
        if going[b] == 0:
            return
        size[b] = total[b]
        count[b] = count[b] + 1
        if count[b] >= most or not total[b] > tolerance * tolerance * first[b]:
            going[b] = 0
            wp.atomic_sub(active, 0, 1)

    return SolveKernels(begin, start, descend, turn, decide)


def _square_of_numbers(real: Any, module: Any) -> Any:
    @wp.func(module=module)
    def square(a: real) -> real:
        return a * a

    return square


def _square_of_vectors(vector: Any, real: Any, module: Any) -> Any:
    @wp.func(module=module)
    def square(a: vector) -> real:
        return wp.dot(a, a)

    return square


def round_off(precision: Precision) -> float:
    """Return the part of the first residual |r| below which a solve in a precision gets no better."""
    return 3e-7 if precision is FLOAT32 else 1e-14


class ConjugateGradients:
    """A solver by conjugate gradients for the particles, or other entries, of a layout, with arrays of its own."""

    def __init__(self, layout: Layout, kind: Any, tolerance: float, most: int):
        """Prepare solves for numbers or vectors, a Warp ``kind``, which end when |r| has fallen to ``tolerance`` of the
        first, or after ``most`` iterations."""
        real = layout.precision.real
        self._kernels, self._layout = solve_kernels(layout.precision, kind), layout
        self._limits = {"tolerance": tolerance, "most": most}
        self._sizes = {"particles": layout.particles}
        sizes = {"shape": layout.all_particles, "device": layout.device}
        self._p, self._product = (wp.zeros(dtype=kind, **sizes) for _ in range(2))
        self._share = wp.zeros(dtype=real, **sizes)
        scenes = {"shape": layout.members, "device": layout.device}
        self._first, self._size = (wp.zeros(dtype=real, **scenes) for _ in range(2))
        self.count, self._going = (wp.zeros(dtype=wp.int32, **scenes) for _ in range(2))
        """(members,) iterations of the last solve."""
        self._active = wp.zeros(1, dtype=wp.int32, device=layout.device)
        self._sums = layout.sum_of(real), layout.sum_of(real)

    def solve(
        self,
        step: StepContext,
        multiply: Callable[[wp.array, dict[str, wp.array]], None],
        w: wp.array,
        r: wp.array,
        y: wp.array,
    ) -> None:
        """Write to ``y`` the solution of B y = r, (n,) both, with weights ``w``, and overwrite ``r``.

        ``multiply`` launches what writes B p, for ``p``, its first argument, to the ``product`` of its second, and the
        w p B p of each particle to the ``share``.
        """
        kernels, members, (sum_shares, sum_curvatures) = self._kernels, self._layout.members, self._sums
        n = self._layout.all_particles
        step.launch(kernels.begin, w=w, r=r, p=self._p, y=y, share=self._share, threads=n)
        self._active.zero_()
        scene = {"size": self._size, "count": self.count, "going": self._going, "active": self._active}
        total = sum_shares(self._share)
        step.launch(kernels.start, scene, total=total, first=self._first, threads=members)

        def iterate() -> None:
            multiply(self._p, {"product": self._product, "share": self._share})
            curvature = sum_curvatures(self._share)
            own = {"w": w, "p": self._p, "product": self._product, "r": r, "y": y, "share": self._share}
            step.launch(kernels.descend, scene, own, self._sizes, curvature=curvature, threads=n)
            total = sum_shares(self._share)
            step.launch(kernels.turn, scene, own, self._sizes, total=total, threads=n)
            step.launch(kernels.decide, scene, self._limits, total=total, first=self._first, threads=members)

        step.join()  # a loop of a graph cannot begin while something is computed aside
        wp.capture_while(self._active, iterate)
