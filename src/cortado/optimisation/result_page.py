"""What a notebook shows of a search: where the fluid ends, at first, as found and as wanted; parameters; the losses."""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from cortado.errors import CortadoError
from cortado.losses import FinalPositions, Frames, Image, Snapshot
from cortado.pictures.notebook import as_words, picture, table
from cortado.pictures.plots import images, loss_curve, particles
from cortado.pictures.solid_lines import solid_outline
from cortado.problem import Problem
from cortado.scene.parameters.values import UNITS

MOST_NUMBERS = 6
"""Of a parameter that the table shows; of more the smallest and the greatest."""
HEAD = ("parameter", "unit", "first guess", "found")


def result_page(
    found: object, message: str, problem: Any, start: Mapping[str, Any], best: Mapping[str, Any], losses: Any
) -> str:
    """HTML of the result of a search from a start to the best parameters, with how it ended and all its losses. Of a
    `Problem`, or of one in other coordinates, two runs are made to see their ends; there is no picture of runs that
    diverge."""
    if hasattr(problem, "coordinates"):
        problem, (start, best) = problem.problem, [problem.parameters(u) for u in (start, best)]
    is_ours = isinstance(problem, Problem) and problem.simulation.batch is None
    rows = [_row(name, UNITS.get(name, "") if is_ours else "", start[name], value) for name, value in best.items()]
    parts = [table(HEAD, rows), picture(found, lambda path: loss_curve(losses, path))]
    if is_ours:
        with suppress(CortadoError):  # the first guess may be a run that diverges
            parts.insert(0, picture(found, lambda path: _draw_ends(problem, [start, best], path)))
    return as_words(found) + f"<p>{escape(message)}</p>" + "".join(parts)


def _draw_ends(problem: Problem, points: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Where runs with the first guess and with what was found end, or how they look, and the target if it is known."""
    own = Problem(
        problem.simulation, problem.steps, problem.loss, state=problem.state
    )  # the user's keeps its last evaluation
    step, loss = max(own.loss.losses.items()) if isinstance(own.loss, Frames) else (own.steps, own.loss)
    ends: list[Snapshot] = [own.states(point, [step])[step] for point in points]
    titles = [f"first guess, after {step} steps", "found"]
    if isinstance(loss, Image):
        images([*map(loss.image, ends), loss.target], [*titles, "target"], path)
        return
    sets = [end.positions for end in ends]
    if isinstance(loss, FinalPositions):
        sets, titles = [*sets, loss.target], [*titles, "target"]
    scene = problem.simulation.scene
    particles(sets, titles, path, container=scene.container.extent(), lines=[solid_outline(scene)] * len(sets))


def _row(name: str, unit: str, first: Any, found: Any) -> tuple[str, ...]:
    return name.replace("_", " "), unit or "-", _written(first), _written(found)


def _written(value: Any) -> str:
    """A number, a few of them, or how many there are and how large."""
    numbers = np.ravel(value)
    if len(numbers) > MOST_NUMBERS:
        return f"{np.shape(value)} numbers, {numbers.min():.4g} to {numbers.max():.4g}"
    return ", ".join(f"{number:.4g}" for number in numbers)
