"""Forces of a user's own: what is computed is what Python makes of the function, or the function is refused."""

import importlib
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

import cortado
from fuzz.cases import Case
from fuzz.files import PLANE
from fuzz.oddities import Random

STEP = PLANE["solver"]["time_step"]  # type: ignore[index]
OPERATORS = ("+", "+", "-", "*", "*", "/", "%", "//", "**")
LEAVES = ("v[0]", "v[0]", "v[1]", "v[1]", "k", "k", "GAIN", "0.37", "-1.25", "2")
WRAPPINGS = (*("{}",) * 8, "-{}", "abs({})", "round({})", "int({})", "float({})", "helper({})")
DEPTH = 2
NUDGE, LARGE, JUMP = 1e-7, 1e3, 1e-3
"""By how much arguments are moved to see whether a value jumps there; values [m/s2] that are not compared."""
CLOSE = 1e-8
"""Part of the larger of two numbers by which they may differ."""
HEAD = """
import functools

import warp as wp

GAIN = {gain}


{helper}
def helper(a: wp.float64):
    return wp.float64(GAIN) * a + wp.float64(1.0)


def decorated(function):
    @functools.wraps(function)
    def other(x, v, t, k):
        return 2.0 * function(x, v, t, k)

    return other


"""
FORMS = {
    "plain": "def force(x, v, t, k):\n    return wp.vec3({a}, {b}, 0.0)\n",
    "in lines": "def force(x, v, t, k):\n    a = {a}\n    if {c}:\n        a = {b}\n    return wp.vec3(a, {b}, 0.0)\n",
    "with a loop": "def force(x, v, t, k):\n    a = {a}\n    for n in range(3):\n        a += 0.1 * n * {b}\n"
    "    return wp.vec3(a, 0.0, 0.0)\n",
    "a lambda": "force = lambda x, v, t, k: wp.vec3({a}, {b}, 0.0)\n",
    "decorated": "@decorated\ndef force(x, v, t, k):\n    return wp.vec3({a}, {b}, 0.0)\n",
    "a default": "def force(x, v, t, k, m={gain}):\n    return wp.vec3({a} * m, {b}, 0.0)\n",
    "made": "def make(m):\n    def force(x, v, t, k):\n        return wp.vec3({a} * m, {b}, 0.0)\n    return force\n\n"
    "force = make({gain})\n",
    "two of a name": "def force(x, v, t, k):\n    return wp.vec3(0.0, 0.0, 0.0)\n\n\nbefore = force\n\n\n"
    "def force(x, v, t, k):\n    return wp.vec3({a}, {b}, 0.0)\n",
}
AFTER = ("", "", "", "edit the file", "change GAIN", "change GAIN late")


def expression(random: Random, depth: int = DEPTH) -> str:
    """A number, in Python."""
    if depth == 0 or random.random() < 0.15:
        return str(random.choice(LEAVES))
    one, other = (expression(random, depth - 1) for _ in range(2))
    kind = random.random()
    if kind < 0.8:
        found = f"({one} {random.choice(OPERATORS)} {other})"
    elif kind < 0.9:
        found = f"{random.choice(['min', 'max'])}({one}, {other})"
    elif kind < 0.98:
        found = f"({one} if {condition(random, depth - 1)} else {other})"
    else:
        found = f"({one} {random.choice(['and', 'or'])} {other})"
    return str(random.choice(WRAPPINGS)).format(found)


def condition(random: Random, depth: int) -> str:
    """A truth, in Python."""
    parts = [expression(random, max(depth, 0)) for _ in range(3)]
    signs = [str(random.choice(["<", "<=", ">", ">=", "==", "!="])) for _ in range(2)]
    return " ".join([parts[0], signs[0], parts[1], *([signs[1], parts[2]] if random.random() < 0.3 else [])])


def compile_function(case: Case) -> None:
    """A random function is the force on a few particles for a step."""
    form, after = str(case.random.choice(sorted(FORMS))), str(case.random.choice(AFTER))
    a, b, c = expression(case.random), expression(case.random), condition(case.random, 1)
    gain = round(float(case.random.uniform(0.5, 3.0)), 3)
    helper = "@wp.func" if case.random.random() < 0.7 else ""
    text = HEAD.format(gain=gain, helper=helper) + FORMS[form].format(a=a, b=b, c=c, gain=gain)
    module, speed = f"fuzzed_{case.number}", case.random.uniform(-2.0, 2.0, 2).round(3).tolist()
    path = case.folder / f"{module}.py"
    path.write_text(text)
    case.notes += [form, after or "as it is"]

    def compute(_: Path) -> None:
        sys.path.insert(0, str(case.folder))
        made = importlib.import_module(module)
        wanted = python_force(text, speed)
        if after == "edit the file":
            path.write_text(text.replace("wp.vec3(", "0.5 * wp.vec3("))
        if after == "change GAIN":
            made.GAIN = 5.0
            wanted = python_force(text, speed, 5.0)
        force = cortado.forces.Body(made.force, name="own", k=0.7)
        if after == "change GAIN late":
            made.GAIN = 5.0
        found = computed_force(force, speed)
        if wanted is not None and not np.allclose(found, wanted, rtol=CLOSE, atol=CLOSE, equal_nan=True):
            print(f"computed {found.tolist()}, but Python has {wanted.tolist()}")
            raise SystemExit(3)

    if case.read(compute, path, codes=(0, 1, 2, 3)).code == 3:
        case.complaints.append("a function was compiled to something else than Python makes of it")


def python_force(text: str, speed: list[float], gain: float | None = None) -> Any:
    """(2,) what Python makes of it [m/s2]; None where it has no value, a large one, or jumps."""
    names: dict[str, Any] = {"wp": SimpleNamespace(vec3=lambda *parts: parts, func=lambda own: own, float64=float)}
    exec(text.replace("import warp as wp\n", ""), names)
    names["GAIN"] = names["GAIN"] if gain is None else gain
    found = []
    for nudge in (0.0, NUDGE, -NUDGE):
        try:
            value = names["force"]([0.0] * 3, [one + nudge for one in (*speed, 0.0)], 0.0, 0.7 + nudge)
            found.append(np.array(value[:2], dtype=float))
        except (ArithmeticError, TypeError, ValueError):  # no value, or a complex one
            return None
    smooth = np.isfinite(found).all() and np.abs(found).max() < LARGE and np.ptp(found, axis=0).max() < JUMP
    return found[0] if smooth else None


def computed_force(force: Any, speed: list[float]) -> np.ndarray:
    """(2,) what a step makes of it [m/s2], of a particle that nothing else moves."""
    block = {"shape": "box", "lower": [0.0, 0.0], "upper": [0.05, 0.05], "phase": "water", "velocity": speed}
    tables = {**PLANE, "fluid": [block], "container": {"shape": "none"}, "solver": {"time_step": STEP}}
    scene = cortado.Scene(**{**tables, "forces": {"gravity": [0.0, 0.0], "pressure": False}})
    end = cortado.Simulation(scene, precision="float64", forces=[force]).run(1)
    return (end.velocities[-1, 0] - end.velocities[0, 0]) / STEP
