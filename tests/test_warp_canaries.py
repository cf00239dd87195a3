"""What Cortado knows about Warp's adjoints, row by row: where they are right, and where they are silently wrong.

Every kernel below is a small neighbour sum in float64. Its tape gradient is compared with central differences, and the
verdict that the engine was written around must still hold. A failure is not a bug of Cortado's: it says that a row of
knowledge has changed with the Warp that is installed. Where a trap is gone, the engine may become simpler; where a
right row is wrong, it has become incorrect.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
import warp as wp

wp.set_module_options({"optimization_level": 0, "fast_math": False})

N = 12
NEIGHBOURS = 8
SCALE = wp.constant(wp.float64(3.0))
CUT = wp.constant(wp.float64(1.0))
"""Between the least and the greatest neighbour sum, so that some particles lie on each side."""
real = wp.float64
reals = wp.array(dtype=wp.float64)
integers = wp.array(dtype=wp.int32)
lists = wp.array2d(dtype=wp.int32)


@wp.func
def weight(r: real) -> real:
    return wp.exp(-r * r)


# ---- the adjoint of a kernel with a neighbour loop: x (n,) positions, t (n,) a field, near lists of count neighbours
SUM = "s += weight(x[i] - x[near[i, k]])"
VECTOR = "weight(x[i] - x[near[i, k]]) * wp.vec2d(t[near[i, k]], x[near[i, k]])"
LOOPS = {
    "raw_sum": ("real(0.0)", SUM, "out[i] = s"),
    "constant_times_sum": ("real(0.0)", "s += t[near[i, k]] * weight(x[i] - x[near[i, k]])", "out[i] = SCALE * s"),
    "vector_sum": ("wp.vec2d()", f"s += {VECTOR}", "out[i] = s[0] + SCALE * s[1]"),
    "if_in_loop": (
        "real(0.0)",
        """
        j = near[i, k]
        if x[j] > x[i]:
            s += t[j] * weight(x[i] - x[j])
        else:
            s += weight(x[i] - x[j])""",
        "out[i] = s",
    ),
    "continue_before_sum": (
        "real(0.0)",
        """
        j = near[i, k]
        if x[j] > x[i]:
            continue
        s += t[j] * weight(x[i] - x[j])""",
        "out[i] = s",
    ),
    "square_after_loop": ("real(0.0)", SUM, "out[i] = s * s"),
    "power_after_loop": ("real(0.0)", SUM, "out[i] = wp.pow(s, real(7.0))"),
    "clamp_after_loop": ("real(0.0)", SUM, "out[i] = wp.max(s - CUT, real(0.0))"),
    "quotient_after_loop": ("real(0.0)", SUM, "out[i] = t[i] / s"),
    "factor_times_sum": ("real(0.0)\n    factor = -t[i]", SUM, "out[i] = factor * s"),
    "second_loop": (
        "real(0.0)",
        SUM,
        """total = real(0.0)
    for k in range(count[i]):
        total += s * t[near[i, k]]
    out[i] = total""",
    ),
    "if_after_loop": ("real(0.0)", SUM, "if s > CUT:\n        out[i] = s"),
    "continue_after_sum": (
        "real(0.0)",
        f"""
        {SUM}
        if x[near[i, k]] > x[i]:
            continue
        s += t[near[i, k]]""",
        "out[i] = s",
    ),
    "break_after_counter": (
        "real(0.0)\n    found = int(0)",
        f"""
        {SUM}
        found += 1
        if found == 3:
            break""",
        "out[i] = s",
    ),
    "recurrence": ("real(0.3)", "s = s * s + weight(x[i] - x[near[i, k]])", "out[i] = s"),
    "fixed_point": ("real(0.0)", "s = wp.cos(s * x[i])", "out[i] = s"),
    "plain_assignment": ("real(0.0)", "s = s + weight(x[i] - x[near[i, k]])", "out[i] = s"),
    "vector_plain_assignment": ("wp.vec2d()", f"s = s + {VECTOR}", "out[i] = s[0] + SCALE * s[1]"),
    "component_assignment": ("wp.vec2d()", "s[0] = s[0] + weight(x[i] - x[near[i, k]])", "out[i] = s[0]"),
    "component_increment": ("wp.vec2d()", "s[0] += weight(x[i] - x[near[i, k]])", "out[i] = s[0]"),
    "static_loop": ("real(0.0)", "s = s + weight(x[i] - x[near[i, k]])", "out[i] = t[i] * s * s"),
}
"""Of each kernel: what its sum s begins as, what stands in the loop over neighbours, and what stands after it."""


def kernel_of(name: str, arguments: str, body: str) -> Any:
    text = f"def {name}({arguments}):\n    i = wp.tid()\n{body}\n"
    known = dict(globals())
    exec(text, known)
    return wp.Kernel(known[name], source=text)


def loop_kernel(name: str) -> Any:
    begin, body, after = LOOPS[name]
    text = f"""    s = {begin}
    for k in range({8 if name == "static_loop" else "count[i]"}):
        {body.lstrip()}
    {after}"""
    return kernel_of(name, "x: reals, t: reals, near: lists, count: integers, out: reals", text)


@wp.func
def sum_of(i: int, x: reals, near: lists, count: integers) -> real:
    s = real(0.0)
    for k in range(count[i]):
        s += weight(x[i] - x[near[i, k]])
    return s


@wp.kernel
def function_returns_raw_sum(x: reals, t: reals, near: lists, count: integers, out: reals):
    i = wp.tid()
    s = sum_of(i, x, near, count)
    out[i] = t[i] / s + wp.pow(s, real(3.0)) + wp.max(s - CUT, real(0.0))


@wp.func
def square_of_sum(i: int, x: reals, near: lists, count: integers) -> real:
    s = real(0.0)
    for k in range(count[i]):
        s += weight(x[i] - x[near[i, k]])
    return s * s


@wp.kernel
def function_returns_square(x: reals, t: reals, near: lists, count: integers, out: reals):
    i = wp.tid()
    out[i] = square_of_sum(i, x, near, count)


# ---- arrays on the tape
ARRAYS = {
    "copy_to": "b[i] = a[i]",
    "multiply_in_place": "b[i] *= a[i]",
    "square_in_place": "b[i] = b[i] * b[i]",
    "square_to": "b[i] = a[i] * a[i]",
    "add_square_to": "b[i] += a[i] * a[i]",
    "length_to": "b[i] = wp.length(wp.vec3d(a[i], a[i], a[i]))",
    "guarded_root_where": "b[i] = wp.where(a[i] > real(0.0), wp.sqrt(a[i]), real(0.0))",
    "guarded_root_if": "if a[i] > real(0.0):\n        b[i] = wp.sqrt(a[i])",
}
"""What each kernel writes to b, of a or in place."""
KERNELS = {
    name: kernel_of(name, "b: reals" if name == "square_in_place" else "a: reals, b: reals", f"    {body}")
    for name, body in ARRAYS.items()
}


# ---- the harness
def array(values: Any, grad: bool = True) -> Any:
    return wp.array(np.asarray(values, dtype=np.float64), dtype=wp.float64, device="cpu", requires_grad=grad)


def launch(kernel: Any, inputs: list[Any], output: Any) -> None:
    wp.launch(kernel, output.shape[0], inputs=inputs, outputs=[output], device="cpu")


Program = Callable[[Any, Any], Any]
"""From Warp arrays x, t to an output array, by launches."""


def neighbour_program(name: str) -> Program:
    kernel = loop_kernel(name) if name in LOOPS else globals()[name]
    random = np.random.default_rng(1)
    near = [random.permutation(np.delete(np.arange(N), i))[:NEIGHBOURS] for i in range(N)]
    near = wp.array(np.array(near, dtype=np.int32), dtype=wp.int32, device="cpu")
    count = wp.array(random.integers(4, NEIGHBOURS + 1, N).astype(np.int32), dtype=wp.int32, device="cpu")

    def program(x: Any, t: Any) -> Any:
        out = array(np.zeros(N))
        launch(kernel, [x, t, near, count], out)
        return out

    return program


def values() -> tuple[np.ndarray, np.ndarray]:
    random = np.random.default_rng(2)
    return random.uniform(-1.5, 1.5, N), random.uniform(0.5, 1.5, N)


LOSS_WEIGHTS = np.random.default_rng(3).uniform(0.5, 1.5, N)


def tape_gradient(program: Program) -> np.ndarray:
    x, t = (array(v) for v in values())
    with wp.Tape() as tape:
        out = program(x, t)
    tape.backward(grads={out: array(LOSS_WEIGHTS, grad=False)})
    return np.stack([x.grad.numpy(), t.grad.numpy()])


def difference_gradient(program: Program) -> np.ndarray:
    start, gradient = np.stack(values()), np.zeros((2, N))
    for index in np.ndindex(2, N):
        ends = []
        for sign in (1, -1):
            moved = start.copy()
            moved[index] += sign * 1e-5
            ends.append(program(array(moved[0]), array(moved[1])).numpy() @ LOSS_WEIGHTS)
        gradient[index] = (ends[0] - ends[1]) / (2 * 1e-5)
    return gradient


def errors(program: Program) -> np.ndarray:
    """Relative error of the tape's gradient with respect to x and to t."""
    tape, difference = tape_gradient(program), difference_gradient(program)
    return np.linalg.norm(tape - difference, axis=1) / np.maximum(np.linalg.norm(difference, axis=1), 1e-8)


@dataclass(frozen=True)
class Row:
    """One row of knowledge: what was written, what became of its gradient."""

    name: str
    program: Program
    what: str
    right: bool


def loops(right: bool, what: str, names: str) -> list[Row]:
    return [Row(name, neighbour_program(name), what, right) for name in names.split()]


def launched(*steps: Any) -> Program:
    """Launches of kernels by name: "kernel source target", of the arrays x, t, out, scratch ones, which are zero at
    first, and "plain" without a gradient; or what is done to the output in between."""

    def program(x: Any, t: Any) -> Any:
        arrays = {"x": x, "t": t, "out": array(np.zeros(N))}
        for step in steps:
            if callable(step):
                step(arrays["out"])
                continue
            kernel, *sources, target = step.split()
            arrays.setdefault(target, array(np.zeros(N), grad=target != "plain"))
            launch(KERNELS[kernel], [arrays[source] for source in sources], arrays[target])
        return arrays["out"]

    return program


SQUARES = ("add_square_to x out", "add_square_to t out")
WITHOUT_GRADIENT = launched("square_to x plain", "square_to plain out")

ROWS = [
    *loops(True, "s += W, then out = s or constant * s", "raw_sum constant_times_sum"),
    *loops(
        True,
        "vector sum; if inside the loop; continue before any accumulation",
        "vector_sum if_in_loop continue_before_sum",
    ),
    *loops(True, "a wp.func returns the raw sum, the kernel uses it non-linearly", "function_returns_raw_sum"),
    *loops(
        False,
        "s * s, pow(s, 7), max(s - c, 0), f / s after the loop",
        "square_after_loop power_after_loop clamp_after_loop quotient_after_loop",
    ),
    *loops(False, "t * s after the loop with t read before it", "factor_times_sum"),
    *loops(False, "sum and non-linear use in the same wp.func", "function_returns_square"),
    *loops(False, "a second loop uses the first one's sum; if s > c after the loop", "second_loop if_after_loop"),
    *loops(
        False,
        "continue after an accumulation; break after a counter; s = s * s + W; fixed-point iteration",
        "continue_after_sum break_after_counter recurrence fixed_point",
    ),
    *loops(True, "s = s + W on a scalar or a whole vector", "plain_assignment vector_plain_assignment"),
    *loops(False, "v[0] = v[0] + W on a local vector", "component_assignment"),
    *loops(True, "v[0] += W on a local vector", "component_increment"),
    *loops(True, "static loops, non-linear use included", "static_loop"),
    Row("in_place_product", launched("copy_to x out", "multiply_in_place t out"), "y[i] *= a[i] in place", False),
    Row("in_place_square", launched("copy_to x out", "square_in_place out"), "y[i] = y[i] * y[i] in place", False),
    Row(
        "scratch_reused",
        launched("copy_to x a", "add_square_to a out", "copy_to t a", "add_square_to a out"),
        "a scratch array that a later launch overwrites",
        False,
    ),
    Row(
        "scratch_of_its_own",
        launched("copy_to x a", "add_square_to a out", "copy_to t b", "add_square_to b out"),
        "a scratch array for each launch",
        True,
    ),
    Row(
        "zeroed_between_launches",
        launched(SQUARES[0], lambda out: out.zero_(), SQUARES[1]),
        "array.zero_() between launches",
        False,
    ),
    Row(
        "filled_between_launches",
        launched(SQUARES[0], lambda out: out.fill_(1.0), SQUARES[1]),
        "array.fill_() between launches",
        False,
    ),
    Row("intermediate_without_gradient", WITHOUT_GRADIENT, "intermediate without requires_grad", False),
]


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row.name)
def test_verdict_still_holds(row):
    worst = errors(row.program).max()
    verdict, limit = ("right", "below 1e-7") if row.right else ("wrong", "above 1e-3")
    held = worst < 1e-7 if row.right else not worst < 1e-3  # a NaN is wrong
    assert held, (
        f"Warp {wp.config.version} changed what we know: the gradient of «{row.what}» was {verdict} "
        f"(relative error {limit}), now its relative error is {worst:.2e}."
    )


def test_factor_before_the_loop_has_gradient_zero():
    program = neighbour_program("factor_times_sum")
    np.testing.assert_array_equal(tape_gradient(program)[1], 0.0, "t * s after the loop: d/dt was exactly 0 in Warp")
    assert errors(program)[0] < 1e-7, "t * s after the loop: d/dx was right in Warp"


def test_intermediate_without_gradient_is_silently_zero():
    gradient = tape_gradient(WITHOUT_GRADIENT)[0]
    np.testing.assert_array_equal(gradient, 0.0, "an intermediate without requires_grad gave the gradient 0 in Warp")


def derivative_at(kernel: str, value: float) -> float:
    a, b = array([value]), array([0.0])
    with wp.Tape() as tape:
        launch(KERNELS[kernel], [a], b)
    tape.backward(grads={b: array([1.0], grad=False)})
    return float(a.grad.numpy()[0])


def test_length_has_derivative_zero_at_zero():
    assert derivative_at("length_to", 2.0) == pytest.approx(3**0.5)
    assert derivative_at("length_to", 0.0) == 0.0, "wp.length(0) had the adjoint 0 in Warp"


def test_guarded_root_needs_an_if():
    where, branch = "guarded_root_where", "guarded_root_if"
    assert derivative_at(where, 4.0) == derivative_at(branch, 4.0) == 0.25
    assert np.isnan(derivative_at(where, 0.0)), "wp.where(x > 0, sqrt(x), 0) had the derivative NaN at 0"
    assert derivative_at(branch, 0.0) == 0.0, "if x > 0: sqrt(x) had the derivative 0 at 0"
