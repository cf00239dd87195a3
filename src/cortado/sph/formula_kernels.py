"""What kernels of a force call that is one function f of a user's: f itself, and its derivatives."""

from typing import Any

import warp as wp

from cortado.device.precision import Precision
from cortado.sph.formula import Formula
from cortado.sph.packed import theta_of


def applied(text: Formula, precision: Precision, ranks: tuple[int, ...], dimension: int, module: Any) -> Any:
    """The Warp function of two vectors or numbers and theta that a user's function is; in 2-D without what a vector has
    along z."""
    timed, of_numbers = len(text.inputs) == 3, text.kind == "number"
    types = tuple(precision.vector if rank else precision.real for rank in ranks[timed:])
    terms, first = [], 0
    for rank in ranks:
        at = ", ".join(f"theta[{first + k}]" for k in range(3 if rank else 1))
        terms.append(f"vector({at})" if rank else at)
        first += 3 if rank else 1
    called = f"own({', '.join(['x', 'v', *terms])})"
    result = called if dimension == 3 or of_numbers else f"wp.cw_mul(vector(one, one, zero), {called})"
    source = f"def applied(x: own_type, v: own_type, theta: numbers):\n    return {result}\n"
    scope = {
        "vector": precision.vector,
        "own_type": precision.real if of_numbers else precision.vector,
        "one": wp.constant(precision.real(1.0)),
        "zero": wp.constant(precision.real(0.0)),
        "wp": wp,
        "numbers": theta_of(precision, ranks),
        "own": text.function(precision, types, module),
    }
    exec(source, scope)
    made: Any = scope["applied"]
    return wp.Function(func=made, key="applied", namespace="", module=module, source=source)


def work_of(text: Formula, precision: Precision, ranks: tuple[int, ...], dimension: int, module: Any) -> Any:
    """The Warp function f . bar, whose gradient a user's function f is differentiated by."""
    vector, theta_type = precision.vector, theta_of(precision, ranks)
    force = applied(text, precision, ranks, dimension, module)

    @wp.func(module=module)
    def work(x: vector, v: vector, theta: theta_type, bar: vector):
        return wp.dot(force(x, v, theta), bar)

    return work


def change_along(text: Formula, precision: Precision, ranks: tuple[int, ...], dimension: int, module: Any) -> Any:
    """The Warp function that is the derivative of a user's function along a direction, put together of the gradients of
    its components."""
    real, vector, theta_type = precision.real, precision.vector, theta_of(precision, ranks)
    work = work_of(text, precision, ranks, dimension, module)

    @wp.func(module=module)
    def change_of(
        x: vector, v: vector, theta: theta_type, x_dot: vector, v_dot: vector, theta_dot: theta_type
    ) -> vector:
        change = vector()
        for axis in range(3):
            along = vector()
            along[axis] = real(1.0)
            x_bar, v_bar, theta_bar, _along_bar = wp.grad(work)(x, v, theta, along)
            change[axis] = wp.dot(x_bar, x_dot) + wp.dot(v_bar, v_dot) + wp.dot(theta_bar, theta_dot)
        return change

    return change_of
