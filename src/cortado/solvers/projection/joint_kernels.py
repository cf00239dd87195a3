"""Hinges between free bodies and other solids in a step of the projection, with derivatives.

A hinge keeps a point of a body A at a point of another solid B. The hinge point is at a in A's frame. The vector from
A's middle to the hinge point is R a at the start of a step, and R' a at the predicted pose of A. At the end of the
step, the velocity changes V - V_0 and angular velocity changes W - W_0 (`cortado.sph.free_solids`) must satisfy

    b = (V - V_0)_A + (W - W_0)_A x R'_A a_A - (the same of B) + (p'_A - p'_B) / dt = 0.

Each solid predicts the hinge point at p' = c' + R' a. The hinge gives A the momentum lambda at R_A a_A, and gives B the
momentum -lambda. The hinge therefore conserves momentum and angular momentum. The gap p'_A - p'_B that remains is of
the order of dt^4, and the next step removes the gap. In 3-D a hinge with the axis n also fixes two of the three
relative angles. With P = I - n n^T, A gets the angular momentum P lambda and B gets -P lambda, so that

    b = P ((W - W_0)_A - (W - W_0)_B) + n x (n'_A - n'_B) / dt = 0.

The vector equations of all hinges are the linear system b = b_0 + K lambda = 0 with 3 x 3 blocks K_kl. Equations k and
l are coupled if both contain the same body. For each pressure, a step solves K lambda = -b_0 once by block elimination.
A solid with a prescribed motion gets no momentum. The coarse grid of the pressure is approximate and ignores hinges.
"""

from collections.abc import Sequence
from functools import cache
from types import SimpleNamespace
from typing import Any

import warp as wp

from cortado.device.modules import Kernels, by_name, kernel_module
from cortado.device.precision import Precision, TypesByName
from cortado.particles.particle_kernels import pointwise_kernels
from cortado.sph.moving_solids import hold_functions

POSES = ("turns_before", "after", "turns")
ROW = ("give", "take", "other_give", "other_take", "apart")


@cache
def joint_kernels(precision: Precision) -> SimpleNamespace:
    """``point`` and ``lean`` compute the matrices and the gap of an equation, ``weigh`` a body's term in a block."""
    real, vector, matrix, holds = precision.real, precision.vector, precision.matrix, hold_functions(precision)
    spin, held = holds.spin, holds.kind
    module = kernel_module(f"joints_derivative_{precision.name}")
    no, one = wp.constant(real(0.0)), wp.constant(real(1.0))
    matrices = "turns_before turns other_turns_before other_turns begun other_begun inertia inverse"
    typed = TypesByName(
        real,
        {
            vector: "place middle other_middle after other_after axis apart push faster turned_faster",
            matrix: f"{matrices} take give other_take",
            held: "hold",
            bool: "is_free",
        },
    )
    row = tuple[matrix, matrix, matrix, matrix, vector]

    @typed
    def point(
        time_step_i, place_i, turns_before_i, after_i, turns_i, other_turns_before_i, other_after_i, other_turns_i,
        middle, begun, other_middle, other_begun,
    ) -> row:  # fmt: skip
        own, other = wp.transpose(begun) * (place_i - middle), wp.transpose(other_begun) * (place_i - other_middle)
        reach, other_reach = turns_i * own, other_turns_i * other
        apart = (after_i + reach - other_after_i - other_reach) / time_step_i
        return (
            wp.skew(turns_before_i * own),
            wp.skew(-reach),
            wp.skew(other_turns_before_i * other),
            wp.skew(-other_reach),
            apart,
        )

    @typed
    def lean(
        time_step_i, turns_before_i, turns_i, other_turns_before_i, other_turns_i, axis, begun, other_begun
    ) -> row:
        own, other = wp.transpose(begun) * axis, wp.transpose(other_begun) * axis
        n = turns_before_i * own
        across = wp.identity(n=3, dtype=real) - wp.outer(n, n)
        apart = wp.cross(n, turns_i * own - other_turns_i * other) / time_step_i
        return across, across, across, across, apart

    @wp.func
    def turned(R: matrix, inertia: matrix, inverse: matrix, P: vector, T: vector, hold: held) -> vector:
        """Return the change of a body's angular velocity by a momentum ``P`` and an angular momentum ``T``."""
        return spin(R, inertia, inverse, T - wp.cross(R * hold.arm, P), hold)

    @wp.func
    def gone(R: matrix, P: vector, W: vector, volume: real, hold: held) -> vector:
        """Return the change of a body's velocity by a momentum ``P``. ``W`` is the change of angular velocity."""
        return wp.cw_mul(hold.moving, P) / volume - wp.cross(W, R * hold.arm)

    @wp.func
    def column(M: matrix, k: int) -> vector:
        return vector(M[0, k], M[1, k], M[2, k])

    @typed
    def weigh(
        density_i, turns_i, take_i, give_i, volume, inertia, inverse, hold, row_share, share, sign, guard, along
    ) -> matrix:
        x, y, z = vector(share, no, no), vector(no, share, no), vector(no, no, share)
        X = turned(turns_i, inertia, inverse, x, column(give_i, 0), hold)
        Y = turned(turns_i, inertia, inverse, y, column(give_i, 1), hold)
        Z = turned(turns_i, inertia, inverse, z, column(give_i, 2), hold)
        went = wp.matrix_from_cols(
            gone(turns_i, x, X, volume, hold), gone(turns_i, y, Y, volume, hold), gone(turns_i, z, Z, volume, hold)
        )
        found = (sign / density_i) * (row_share * went + take_i * wp.matrix_from_cols(X, Y, Z))
        unit = wp.identity(n=3, dtype=real)
        return found + wp.trace(found) * (guard * unit + along * (unit - give_i))

    @typed
    def read(
        apart_i, take_i, other_take_i, faster_i, turned_faster_i, other_faster_i: vector,
        other_turned_faster_i: vector, share, is_free,
    ) -> vector:  # fmt: skip
        against = wp.where(is_free, one, no) * (share * other_faster_i + other_take_i * other_turned_faster_i)
        return apart_i + share * faster_i + take_i * turned_faster_i - against

    @typed
    def push(
        density_i, turns_i, give_i, push_i, share, sign, volume, inertia, inverse, hold
    ) -> tuple[vector, vector, vector, vector, vector]:
        P, T = (sign * share) * push_i, sign * (give_i * push_i)
        W = turned(turns_i, inertia, inverse, P, T, hold) / density_i
        V = gone(turns_i, P / density_i, W, volume, hold)
        return V, T - wp.cross(turns_i * hold.arm, P), W, V, W

    whole = {wp.array2d(dtype=matrix): "blocks factors inverses blocks_dot blocks_bar"}
    arrays = TypesByName(wp.array2d(dtype=vector), {**whole, int: "rows transposed"})

    def kernel(function: Any) -> Any:
        return wp.kernel(arrays(function), module=module, enable_backward=False)

    @kernel
    def factor(rows, blocks, factors, inverses):
        b = wp.tid()
        for k in range(rows * rows):
            factors[k, b] = blocks[k, b]
        for k in range(rows):
            inverse = wp.inverse(factors[k * rows + k, b])
            inverses[k, b] = inverse
            for i in range(k + 1, rows):
                part = factors[i * rows + k, b] * inverse
                factors[i * rows + k, b] = part
                for j in range(k + 1, rows):
                    factors[i * rows + j, b] = factors[i * rows + j, b] - part * factors[k * rows + j, b]

    @wp.func
    def factor_of(i: int, j: int, rows: int, transposed: int, factors: wp.array2d(dtype=matrix), b: int) -> matrix:
        if transposed == 1:
            return wp.transpose(factors[j * rows + i, b])
        return factors[i * rows + j, b]

    @kernel
    def solve(rows, transposed, factors, inverses, wanted, pushes):
        b = wp.tid()
        for i in range(rows):
            x = wanted[i, b]
            for j in range(i):
                x = x - factor_of(i, j, rows, transposed, factors, b) * pushes[j, b]
            if transposed == 1:
                x = wp.transpose(inverses[i, b]) * x
            pushes[i, b] = x
        for n in range(rows):
            i = rows - 1 - n
            x = pushes[i, b]
            for j in range(i + 1, rows):
                x = x - factor_of(i, j, rows, transposed, factors, b) * pushes[j, b]
            if transposed == 0:
                x = inverses[i, b] * x
            pushes[i, b] = x
        for i in range(rows):
            pushes[i, b] = -pushes[i, b]

    @kernel
    def lengthen(rows, blocks_dot, pushes, wanted_dot):
        b = wp.tid()
        for i in range(rows):
            x = wanted_dot[i, b]
            for j in range(rows):
                x = x + blocks_dot[i * rows + j, b] * pushes[j, b]
            wanted_dot[i, b] = x

    @kernel
    def spread(rows, wanted_bar, pushes, blocks_bar):
        b = wp.tid()
        for i in range(rows):
            for j in range(rows):
                k = i * rows + j
                blocks_bar[k, b] = blocks_bar[k, b] + wp.outer(wanted_bar[i, b], pushes[j, b])

    def made(function: Any, results: Sequence[str], **names: Any) -> Kernels:
        return pointwise_kernels(precision, [module] * 3, lambda _: function, results, **names)

    turns, ends = {"turns": "turned", "turns_before": "turned_before"}, ["begun", "other_begun"]
    turns |= {f"other_{name}": f"other_{turn}" for name, turn in turns.items()}
    poses = [*POSES, *(f"other_{name}" for name in POSES)]
    rotations, places = [name for name in poses if "turns" in name], ["middle", "other_middle"]
    own, velocities = ["volume", "inertia", "inverse", "hold", "share", "sign"], ("V", "L", "W")
    moved = [f"{name}:{name}" for name in (*velocities, "faster", "turned_faster")]
    return SimpleNamespace(
        point=made(point, ROW, numbers=[*places, *ends], written=poses, turned=turns),
        lean=made(lean, ROW, numbers=["axis", *ends], written=rotations, turned=turns),
        weigh=made(weigh, ["block:block"], numbers=[*own, "row_share", "guard", "along"], turned=turns),
        read=made(read, ["wanted"], numbers=["share", "is_free"]),
        push=made(push, moved, numbers=own, turned=turns),
        **vars(by_name(factor, solve, lengthen, spread)),
    )
