"""Kernels of observations and of rewards, each with its derivative: particle by particle, for all scenes of a batch."""

from dataclasses import dataclass
from functools import cache
from typing import Any

import warp as wp

from cortado.device.modules import kernel_module
from cortado.device.precision import Precision

FAR = wp.constant(1.0e30)


@dataclass(frozen=True)
class EnvironmentKernels:
    """``per`` is the number of particles of a scene, ``factor`` (scenes,) what a derivative is multiplied by."""

    sample: Any
    """Positions and velocities of some particles."""
    share: Any
    """1 / (1 + e^2 / w^2), where e is the distance of a particle to the nearest of some boxes, which may be fixed to a
    solid in the plane."""
    share_adjoint: Any
    apart: Any
    """For each of some particles, its distances to all of them, component by component, added up."""
    apart_adjoint: Any
    missed: Any
    """Squared distance of a particle to a target of its own, times a weight; targets change from step to step."""
    missed_adjoint: Any


@cache
def environment_kernels(precision: Precision) -> EnvironmentKernels:
    """In one precision; values to be added up are in float64."""
    real, vector = precision.real, precision.vector
    module = kernel_module(f"environments_{precision.name}")

    @wp.kernel(module=module, enable_backward=False)
    def sample(
        per: int,
        chosen: wp.array(dtype=wp.int32),
        x: wp.array(dtype=vector),
        v: wp.array(dtype=vector),
        # out
        seen: wp.array(dtype=wp.float32, ndim=4),
    ):
        b, p, axis = wp.tid()
        i = b * per + chosen[p]
        seen[b, p, 0, axis] = wp.float32(x[i][axis])
        seen[b, p, 1, axis] = wp.float32(v[i][axis])

    @wp.func
    def turned(r: vector, angle: real):
        c, s = wp.cos(angle), wp.sin(angle)
        return vector(c * r[0] - s * r[1], s * r[0] + c * r[1], r[2])

    @wp.func
    def outside(y: vector, b: int, lower: wp.array2d(dtype=vector), upper: wp.array2d(dtype=vector)):
        """From the nearest point of the nearest box to y."""
        found, least = vector(), real(FAR)
        for k in range(lower.shape[1]):
            e = y - wp.min(wp.max(y, lower[b, k]), upper[b, k])
            if wp.dot(e, e) < least:
                found = e
                least = wp.dot(e, e)
        return found

    @wp.kernel(module=module, enable_backward=False)
    def share(
        per: int,
        width: real,
        x: wp.array(dtype=vector),
        place: wp.array(dtype=vector),
        turn: wp.array(dtype=real),
        lower: wp.array2d(dtype=vector),
        upper: wp.array2d(dtype=vector),
        # out
        value: wp.array(dtype=wp.float64),
    ):
        i = wp.tid()
        b = i // per
        e = outside(turned(x[i] - place[b], -turn[b]), b, lower, upper) / width
        value[i] = wp.float64(real(1.0) / (real(1.0) + wp.dot(e, e)))

    @wp.kernel(module=module, enable_backward=False)
    def share_adjoint(
        per: int,
        width: real,
        factor: wp.array(dtype=real),
        x: wp.array(dtype=vector),
        place: wp.array(dtype=vector),
        turn: wp.array(dtype=real),
        lower: wp.array2d(dtype=vector),
        upper: wp.array2d(dtype=vector),
        # out
        x_bar: wp.array(dtype=vector),
        place_bar: wp.array(dtype=vector),
        turn_bar: wp.array(dtype=real),
    ):
        i = wp.tid()
        b = i // per
        y = turned(x[i] - place[b], -turn[b])
        e = outside(y, b, lower, upper)
        s = real(1.0) / (real(1.0) + wp.dot(e, e) / (width * width))
        g = -real(2.0) * factor[b] * s * s / (width * width) * e
        x_bar[i] += turned(g, turn[b])
        place_bar[i] = -turned(g, turn[b])
        turn_bar[i] = g[0] * y[1] - g[1] * y[0]

    @wp.kernel(module=module, enable_backward=False)
    def apart(
        per: int,
        chosen: wp.array(dtype=wp.int32),
        x: wp.array(dtype=vector),
        # out
        value: wp.array2d(dtype=wp.float64),
    ):
        b, p = wp.tid()
        own, total = x[b * per + chosen[p]], wp.float64(0.0)
        for q in range(chosen.shape[0]):
            r = own - x[b * per + chosen[q]]
            total += wp.float64(wp.abs(r[0]) + wp.abs(r[1]) + wp.abs(r[2]))
        value[b, p] = total

    @wp.kernel(module=module, enable_backward=False)
    def apart_adjoint(
        per: int,
        factor: wp.array(dtype=real),
        chosen: wp.array(dtype=wp.int32),
        x: wp.array(dtype=vector),
        # out
        x_bar: wp.array(dtype=vector),
    ):
        b, p = wp.tid()
        i = b * per + chosen[p]
        total = vector()
        for q in range(chosen.shape[0]):
            r = x[i] - x[b * per + chosen[q]]
            for axis in range(3):
                if r[axis] > real(0.0):
                    total[axis] += real(1.0)
                elif r[axis] < real(0.0):
                    total[axis] -= real(1.0)
        x_bar[i] += real(2.0) * factor[b] * total

    @wp.kernel(module=module, enable_backward=False)
    def missed(
        per: int,
        step: wp.array(dtype=wp.int32),
        target: wp.array2d(dtype=vector),
        weight: wp.array2d(dtype=real),
        x: wp.array(dtype=vector),
        # out
        value: wp.array(dtype=wp.float64),
    ):
        i = wp.tid()
        k, p = step[i // per], i % per
        r = x[i] - target[k, p]
        value[i] = wp.float64(weight[k, p] * wp.dot(r, r))

    @wp.kernel(module=module, enable_backward=False)
    def missed_adjoint(
        per: int,
        factor: wp.array(dtype=real),
        step: wp.array(dtype=wp.int32),
        target: wp.array2d(dtype=vector),
        weight: wp.array2d(dtype=real),
        x: wp.array(dtype=vector),
        # out
        x_bar: wp.array(dtype=vector),
    ):
        i = wp.tid()
        k, p = step[i // per], i % per
        x_bar[i] += real(2.0) * factor[i // per] * weight[k, p] * (x[i] - target[k, p])

    return EnvironmentKernels(sample, share, share_adjoint, apart, apart_adjoint, missed, missed_adjoint)
