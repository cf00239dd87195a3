"""Values that nobody means: numbers, texts, lists and tables."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np

Random = np.random.Generator

NUMBERS: tuple[Any, ...] = (
    0, -1, 1, 2, 3, 0.0, -0.0, 0.5, -0.5, 1e-3, 1e3, 1e6, 1e-9, 1e-30, 1e-300, 5e-324, 1e30, 1e38, 3.5e38, 1e300,
    1.7976931348623157e308, math.inf, -math.inf, math.nan, 2**31 - 1, 2**31, 2**32, 2**63 - 1, 2**63, 10**20, 10**400,
    -(2**63), 0.1 + 0.2, 255, 256, 65536,
)  # fmt: skip
TEXTS = (
    "", " ", "0", "0.1", "nan", "true", "none", "null", "water ", "Water", "wäter", "水", "\U0001f30a", "e\u0301",
    "\u202ewater", "\u200b", "\x1b[31mred\x1b[0m", "a\nb", "a\tb", "a\rb", "\x00", "\x07", "\x7f", "'", '"', "\\",
    "../../etc/passwd", "/dev/zero", "/dev/full", "/", ".", "~", "%s%s%n", "{0}", "$(id)", "<b>&amp;</b>",
    "[red]x[/red]", "a" * 300, "a" * 100_000, "é" * 5000, "-1", "--help", "1e5", "box", "cubic_spline", "heart",
    "random",
)  # fmt: skip


def number(random: Random) -> Any:
    """A number at some edge, or of some size."""
    if random.random() < 0.7:
        return NUMBERS[int(random.integers(len(NUMBERS)))]
    return float(random.choice([-1.0, 1.0]) * 10.0 ** random.uniform(-12, 12))


def text(random: Random) -> str:
    """A text: empty, long, in another script, with control characters, or with a meaning somewhere else."""
    return TEXTS[random.integers(len(TEXTS))]


def array(random: Random) -> list[Any]:
    """A list of any length and depth."""
    kind = random.integers(6)
    if kind == 0:
        return []
    if kind == 1:
        return [value(random) for _ in range(random.integers(1, 5))]
    if kind == 2:
        return [0.0] * int(random.choice([1, 2, 3, 4, 100, 100_000]))
    if kind == 3:
        return [[1.0, 2.0], [1.0]]
    if kind == 4:
        return _nested(int(random.choice([2, 5, 50])))
    return [number(random) for _ in range(random.integers(1, 5))]


def table(random: Random) -> dict[str, Any]:
    """A table of what comes."""
    return {text(random): value(random) for _ in range(random.integers(0, 3))}


def value(random: Random) -> Any:
    """Anything that a file may hold."""
    makers: tuple[Callable[[Random], Any], ...] = (number, number, text, array, table, lambda r: bool(r.integers(2)))
    return makers[random.integers(len(makers))](random)


def _nested(depth: int) -> list[Any]:
    found: list[Any] = [1.0]
    for _ in range(depth):
        found = [found]
    return found
