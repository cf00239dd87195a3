"""The parameters that a search found beside those that were hidden, in numbers: lines and rows of a table."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike

from cortado.optimisation.inverse.figures import component_names
from cortado.optimisation.inverse.knots import KnotValues
from cortado.optimisation.inverse.setup import Setup
from cortado.pictures.report import MOST_NUMBERS, written

Rows = list[tuple[object, ...]]


def distance(estimate: ArrayLike, true: ArrayLike) -> float:
    """|estimate - true| / |true|, each repeated over the steps where only the other one changes with time."""
    estimate, true = np.broadcast_arrays(estimate, true)
    return float(np.linalg.norm(estimate - true) / (np.linalg.norm(true) or 1.0))


def found_lines(made: Setup, estimate: Mapping[str, np.ndarray], knots: Mapping[str, KnotValues]) -> list[str]:
    """One for each parameter, or for each of its knots; none for a parameter of very many numbers."""
    lines = []
    for name, value in estimate.items():
        if name in knots:
            own = knots[name]
            trues = [None] * len(own.times) if own.true is None else own.true
            found = zip((_at(name, time) for time in own.times), own.estimate, trues, strict=True)
        elif np.size(value) <= MOST_NUMBERS:
            found = zip([_words(name)], [value], [made.true_parameter(name)], strict=True)
        else:
            continue
        for label, one, true in found:
            unit = f" {made.task.known[name].unit}".rstrip()
            hidden = "" if true is None else f"; true {written(true)}{unit}"
            lines.append(f"  {label}: {written(one)}{unit}{hidden}")
    return lines


def found_rows(
    made: Setup,
    estimate: Mapping[str, np.ndarray],
    knots: Mapping[str, KnotValues],
    errors: Mapping[str, float],
) -> Rows:
    """(parameter, unit, first guess, found, hidden, error) of each number that was searched, of each knot, and of
    parameters with very many numbers; ``errors`` by parameter."""
    rows: Rows = []
    start = made.search.parameters(made.start)
    for name, value in estimate.items():
        unit, true = made.task.known[name].unit, made.true_parameter(name)
        if name in knots:
            rows += _knot_rows(name, unit, knots[name])
            continue
        known = [np.asarray(start[name]), np.asarray(value), *([] if true is None else [true])]
        error = f"{errors[name]:.3%}" if name in errors else ""
        columns = np.broadcast_arrays(*known)
        names = component_names(made.task, name, columns[0])
        if len(names) != columns[0].size or len(names) > MOST_NUMBERS:
            rows.append((_words(name), unit, *known[:2], "" if true is None else true, error))
            continue
        for k, label in enumerate(names):
            numbers = [column.ravel()[k] for column in columns]
            off = [""] if true is None else [f"{distance(*numbers[1:]):.3%}"]
            rows.append((label, unit, *numbers, *([] if true is not None else [""]), *off))
    return rows


def worst_in_words(made: Setup, name: str, estimate: np.ndarray, error: float) -> str:
    """Which number of a few is farther off than twice the error of all of them together, and how far; empty where none
    is, or where the true ones are not known or 0."""
    true, names = made.true_parameter(name), component_names(made.task, name, estimate)
    if true is None or not 1 < len(names) == np.size(true) == np.size(estimate) <= MOST_NUMBERS or not np.all(true):
        return ""
    errors = [distance(*pair) for pair in zip(np.ravel(estimate), np.ravel(true), strict=True)]
    worst = int(np.argmax(errors))
    return f" ({names[worst]}: {100 * errors[worst]:.2g}%)" if errors[worst] > 2.0 * error else ""


def _knot_rows(name: str, unit: str, knots: KnotValues) -> Rows:
    rows: Rows = []
    for k, time in enumerate(knots.times):
        hidden, error = "", ""
        if knots.true is not None:
            hidden, error = written(knots.true[k]), f"{distance(knots.estimate[k], knots.true[k]):.3%}"
        rows.append((_at(name, time), unit, knots.start[k], knots.estimate[k], hidden, error))
    return rows


def _at(name: str, time: float) -> str:
    return f"{_words(name)} at {time:.4g} s"


def _words(name: str) -> str:
    return name.replace("_", " ")
