"""Decisions of the pressure loop and records of a step, taken on the device."""

from functools import cache
from types import SimpleNamespace

import warp as wp

from cortado.precision import Precision

NO_PARTICLE = 2**31 - 1
"""What stands for 'every particle is well' where the first bad one would be named."""


@cache
def convergence_kernels(precision: Precision) -> SimpleNamespace:
    """Kernels ``decide`` (go on iterating?), ``check`` (has a particle left every bound?), ``finish`` (a step)."""
    real, vector, pair = precision.real, precision.vector, precision.pair
    module = wp.get_module(f"cortado_convergence_{precision.name}")
    module.options["enable_backward"] = False

    @wp.kernel(module=module, enable_backward=False)
    def decide(
        done: int,
        most: int,
        particles: int,
        tolerance: real,
        greatest_tolerance: real,
        sums: wp.array(dtype=pair),
        # in and out
        iteration: wp.array(dtype=wp.int32),
        # out
        active: wp.array(dtype=wp.int32),
    ):
        """``done`` iterations are added to the count; ``active`` stays 1 while the error is above a tolerance."""
        count = iteration[0] + done
        average = sums[0][0] / real(particles)
        iteration[0] = count
        active[0] = wp.where(count < most and (average > tolerance or sums[0][1] > greatest_tolerance), 1, 0)

    @wp.kernel(module=module, enable_backward=False)
    def check(
        order: wp.array(dtype=wp.int32),
        origin: vector,
        bound: real,
        x: wp.array(dtype=vector),
        v: wp.array(dtype=vector),
        rho_0: wp.array(dtype=real),
        # out
        bad: wp.array(dtype=wp.int32),
    ):
        """``bad``: the first particle, in scene order, not finite, further than ``bound`` from ``origin`` [m], or of a
        mixture without a volume."""
        i = wp.tid()
        x_i = x[i] - origin
        size = wp.max(wp.max(wp.abs(x_i[0]), wp.abs(x_i[1])), wp.abs(x_i[2]))
        if not (size < bound and wp.isfinite(v[i]) and rho_0[i] > real(0.0)):
            wp.atomic_min(bad, 0, order[i])

    @wp.kernel(module=module, enable_backward=False)
    def finish(
        particles: int,
        sums: wp.array(dtype=pair),
        bad: wp.array(dtype=wp.int32),
        # in and out
        step: wp.array(dtype=wp.int32),
        iteration: wp.array(dtype=wp.int32),
        bad_step: wp.array(dtype=wp.int32),
        # out
        iterations: wp.array(dtype=wp.int32),
        errors: wp.array(dtype=pair),
    ):
        """Record the step's iterations and its (average, greatest) density error, and count the step."""
        n = step[0]
        iterations[n] = iteration[0]
        errors[n] = pair(sums[0][0] / real(particles), sums[0][1])
        if bad[0] != wp.static(NO_PARTICLE) and bad_step[0] < 0:
            bad_step[0] = n
        iteration[0] = 0
        step[0] = n + 1

    return SimpleNamespace(decide=decide, check=check, finish=finish)
