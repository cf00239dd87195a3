"""Kernels for observations and rewards of all scenes of a batch, with one thread per particle."""

from functools import cache
from types import SimpleNamespace
from typing import Any

import warp as wp

from cortado.device.modules import kernel_module
from cortado.device.precision import Precision, TypesByName

FAR = wp.constant(1.0e30)


@cache
def environment_kernels(precision: Precision) -> Any:
    """Build the kernels, which store one float64 value per particle.

    ``per`` is the number of particles of a scene. Derivatives are multiplied by ``factor`` (scenes,). ``period`` [m]
    and ``frequency`` [1/m] are the lengths and inverse lengths of the periodic box, 0 along axes without a period.
    """
    real, vector = precision.real, precision.vector
    module, boxes = kernel_module(f"environments_{precision.name}"), wp.array2d(dtype=vector)
    samples, names = wp.array(dtype=wp.float32, ndim=4), "r period frequency x v place"
    typed = TypesByName(real, {vector: names, wp.int32: "chosen step", wp.float64: "value"})

    @wp.func
    def rounded(t: vector):
        return vector(wp.round(t[0]), wp.round(t[1]), wp.round(t[2]))

    @wp.func
    def shortest(r: vector, period: vector, frequency: vector):
        return r - wp.cw_mul(rounded(wp.cw_mul(r, frequency)), period)

    @wp.kernel(module=module, enable_backward=False)
    @typed.arrays
    def sample(per: int, origin: vector, period: vector, frequency: vector, chosen, x, v, seen: samples):
        """Store the state of ``chosen`` particles. Positions are moved into the periodic box."""
        b, p, axis = wp.tid()
        i = b * per + chosen[p]
        lap = wp.floor((x[i][axis] - origin[axis]) * frequency[axis])
        seen[b, p, 0, axis] = wp.float32(x[i][axis] - lap * period[axis])
        seen[b, p, 1, axis] = wp.float32(v[i][axis])

    @wp.func
    def turned(r: vector, angle: real):
        c, s = wp.cos(angle), wp.sin(angle)
        return vector(c * r[0] - s * r[1], s * r[0] + c * r[1], r[2])

    @wp.func
    @typed
    def outside(r, angle, period, frequency, b: int, lower: boxes, upper: boxes):
        """Return a particle's position relative to the boxes, and its offset from the nearest box."""
        place, found, least = vector(), vector(), real(FAR)
        for k in range(lower.shape[1]):
            middle = turned(real(0.5) * (lower[b, k] + upper[b, k]), angle)
            lap = wp.cw_mul(rounded(wp.cw_mul(r - middle, frequency)), period)
            y = turned(r - lap, -angle)
            e = y - wp.min(wp.max(y, lower[b, k]), upper[b, k])
            if wp.dot(e, e) < least:
                place = y
                found = e
                least = wp.dot(e, e)
        return place, found

    @wp.kernel(module=module, enable_backward=False)
    @typed.arrays
    def share(
        per: int, width: real, period: vector, frequency: vector, x, place, turn, lower: boxes, upper: boxes, value
    ):
        """Store 1 / (1 + e^2 / w^2), where e is the distance to the nearest box and w the ``width``."""
        i = wp.tid()
        b = i // per
        _y, way = outside(x[i] - place[b], turn[b], period, frequency, b, lower, upper)
        e = way / width
        value[i] = wp.float64(real(1.0) / (real(1.0) + wp.dot(e, e)))

    @wp.kernel(module=module, enable_backward=False)
    @typed.arrays
    def share_adjoint(
        per: int,
        width: real,
        period: vector,
        frequency: vector,
        factor,
        x,
        place,
        turn,
        lower: boxes,
        upper: boxes,
        x_bar,
        place_bar,
        turn_bar,
    ):
        i = wp.tid()
        b = i // per
        y, e = outside(x[i] - place[b], turn[b], period, frequency, b, lower, upper)
        s = real(1.0) / (real(1.0) + wp.dot(e, e) / (width * width))
        g = -real(2.0) * factor[b] * s * s / (width * width) * e
        x_bar[i] += turned(g, turn[b])
        place_bar[i] = -turned(g, turn[b])
        turn_bar[i] = g[0] * y[1] - g[1] * y[0]

    @wp.kernel(module=module, enable_backward=False)
    @typed.arrays
    def apart(per: int, period: vector, frequency: vector, chosen, x, value: wp.array2d(dtype=wp.float64)):
        """Store the sum of the distances |dx| + |dy| + |dz| from each particle to all chosen particles."""
        b, p = wp.tid()
        own, total = x[b * per + chosen[p]], wp.float64(0.0)
        for q in range(chosen.shape[0]):
            r = shortest(own - x[b * per + chosen[q]], period, frequency)
            total += wp.float64(wp.abs(r[0]) + wp.abs(r[1]) + wp.abs(r[2]))
        value[b, p] = total

    @wp.kernel(module=module, enable_backward=False)
    @typed.arrays
    def apart_adjoint(per: int, period: vector, frequency: vector, factor, chosen, x, x_bar):
        b, p = wp.tid()
        i = b * per + chosen[p]
        total = vector()
        for q in range(chosen.shape[0]):
            r = shortest(x[i] - x[b * per + chosen[q]], period, frequency)
            for axis in range(3):
                if r[axis] > real(0.0):
                    total[axis] += real(1.0)
                elif r[axis] < real(0.0):
                    total[axis] -= real(1.0)
        x_bar[i] += real(2.0) * factor[b] * total

    @wp.kernel(module=module, enable_backward=False)
    @typed.arrays
    def missed(per: int, step, target: wp.array2d(dtype=vector), weight: wp.array2d(dtype=real), x, value):
        i = wp.tid()
        k, p = step[i // per], i % per
        r = x[i] - target[k, p]
        value[i] = wp.float64(weight[k, p] * wp.dot(r, r))

    @wp.kernel(module=module, enable_backward=False)
    @typed.arrays
    def missed_adjoint(
        per: int, factor, step, target: wp.array2d(dtype=vector), weight: wp.array2d(dtype=real), x, x_bar
    ):
        i = wp.tid()
        k, p = step[i // per], i % per
        x_bar[i] += real(2.0) * factor[i // per] * weight[k, p] * (x[i] - target[k, p])

    forward = {"sample": sample, "share": share, "apart": apart, "missed": missed}
    back = {"share_adjoint": share_adjoint, "apart_adjoint": apart_adjoint, "missed_adjoint": missed_adjoint}
    return SimpleNamespace(**forward, **back)
