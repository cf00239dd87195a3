"""The method of conjugate gradients (Hestenes and Stiefel 1952) for B y = r, of numbers or vectors of particles.

B is symmetric and positive with respect to the product sum_i w_i a_i . b_i with weights w, in which everything is
measured here. Each scene of a batch goes on until |r| has fallen to a part of the first, and stays as it is then.
"""

from collections.abc import Callable
from functools import cache
from types import SimpleNamespace
from typing import Any

import warp as wp

from cortado.device.modules import by_name, kernel_module
from cortado.device.precision import FLOAT32, Precision, TypesByName
from cortado.device.reduction import type_name
from cortado.particles.state import Layout, zeros
from cortado.sph.parts import StepContext


@cache
def solve_kernels(precision: Precision, kind: Any) -> SimpleNamespace:
    """Make the kernels of conjugate gradients for numbers or vectors; ``going`` (members,) is 1 for a scene to go on.
    ``begin`` and ``start`` begin a solve; ``descend`` takes a step along p, ``turn`` gives the next p, and ``decide``
    which scenes go on."""
    real = precision.real
    module = kernel_module(f"conjugate_gradients_{type_name(kind)}")
    typed = TypesByName(real, {kind: "r p y product", wp.int32: "count going active"})
    dot = wp.mul if kind is real else wp.dot

    @wp.kernel(module=module, enable_backward=False)
    @typed.arrays
    def begin(w, r, p, y, share):
        i = wp.tid()
        p[i] = r[i]
        y[i] = kind(real(0.0))
        share[i] = w[i] * dot(r[i], r[i])

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
        share[i] = w[i] * dot(left, left)

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

    return by_name(begin, start, descend, turn, decide)


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
        self._own = layout.arrays(p=kind, product=kind, share=real)
        kinds = {"first": real, "size": real, "count": wp.int32, "going": wp.int32}
        self._scenes = zeros({name: (layout.members, one) for name, one in kinds.items()}, layout.device)
        self.count = self._scenes["count"]
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
        own, scene = {**self._own, "w": w, "r": r, "y": y}, {**self._scenes, "active": self._active}
        p, product, share = self._own.values()
        step.launch(kernels.begin, own, threads=n)
        self._active.zero_()
        step.launch(kernels.start, scene, total=sum_shares(share), threads=members)

        def iterate() -> None:
            multiply(p, {"product": product, "share": share})
            step.launch(kernels.descend, scene, own, self._sizes, curvature=sum_curvatures(share), threads=n)
            total = sum_shares(share)
            step.launch(kernels.turn, scene, own, self._sizes, total=total, threads=n)
            step.launch(kernels.decide, scene, self._limits, total=total, threads=members)

        step.join()  # a loop of a graph cannot begin while something is computed aside
        wp.capture_while(self._active, iterate)
