"""The results of ``cortado optimise`` and how well they meet the task's goals: as sentences, report and JSON."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from cortado.optimisation.optimise import Result
from cortado.optimisation.solved_task import KnotValues, TaskFigures, component_names
from cortado.optimisation.task_files import Setup, Task, task_in_words
from cortado.pictures.pages import MOST_NUMBERS, Section, written
from cortado.pictures.particle_view import scene_view
from cortado.scene.scene import scene_in_words

Rows = list[tuple[object, ...]]

MOST_ERROR = 0.3
"""Greatest relative error with which a parameter still counts as found."""


MOST_IN_RESULT = 1000
"""Greatest size of a parameter whose estimate is written to result.json; larger ones are only in the checkpoint."""
VIEWED = 60


@dataclass(frozen=True)
class Verdict:
    """The result of an optimisation compared with the goals in the table [optimise.check] of the task."""

    first: float
    reduction: float
    """Loss at the start / best loss; infinite if the best loss is 0."""
    errors: dict[str, float]
    """For each parameter the relative L2 distance of the estimate from the true value, or the absolute distance from
    0."""
    psnr: float | None
    """Peak signal-to-noise ratio of the last image [dB]; None if the task compares positions."""
    failures: list[str]


def judge(
    task: Task,
    result: Result,
    estimate: dict[str, np.ndarray] | None = None,
    noise: float | None = None,
    first: float | None = None,
) -> Verdict:
    """Judge a result by the task's [optimise.check].

    Args:
        estimate: the parameters, if the result has only coordinates.
        noise: the peak signal-to-noise ratio reached [dB].
        first: the loss at the start, if the history begins with another loss.
    """
    check, estimate = task.optimise.check, result.parameters if estimate is None else estimate
    first = result.history[0].loss if first is None else first
    reduction = first / result.loss if result.loss > 0.0 else math.inf
    true = task.true_parameters
    errors = {name: distance(value, true[name]) for name, value in estimate.items() if name in true}
    failures = []
    if reduction < check.loss_reduction:
        failures.append(f"The loss fell {reduction:.3g} times, but the task asks for {check.loss_reduction:g} times.")
    if noise is not None and noise < check.psnr:
        failures.append(f"The image is matched to {noise:.3g} dB, but the task asks for {check.psnr:g} dB.")
    failures += [
        f"The parameter {name} is {100 * error:.3g}% off, but the task asks for {100 * check.parameter_error:.3g}%."
        for name, error in errors.items()
        if error > check.parameter_error
    ]
    return Verdict(first, reduction, errors, noise, failures)


def found_in_words(error: float) -> str:
    if error > MOST_ERROR:
        why = "the search is too short, it ended in a wrong valley of the loss, or other values do as well"
        return f"not found, {100 * error:.3g}% off: {why}"
    return f"found with an error of {100 * error:.2g}%"


def distance(estimate: ArrayLike, true: ArrayLike) -> float:
    """Return |estimate - true| / |true|, or |estimate| if true is 0."""
    estimate, true = np.broadcast_arrays(estimate, true)
    return float(np.linalg.norm(estimate - true) / (np.linalg.norm(true) or 1.0))


def worst_in_words(made: Setup, name: str, estimate: np.ndarray, error: float) -> str:
    """Describe the worst of a parameter's few numbers, if its error exceeds twice the parameter's error."""
    true, names = made.true_parameter(name), component_names(made.task, name, estimate)
    if true is None or not 1 < len(names) == np.size(true) == np.size(estimate) <= MOST_NUMBERS or not np.all(true):
        return ""
    errors = [distance(*pair) for pair in zip(np.ravel(estimate), np.ravel(true), strict=True)]
    worst = int(np.argmax(errors))
    return f" ({names[worst]}: {100 * errors[worst]:.2g}%)" if errors[worst] > 2.0 * error else ""


def found_lines(made: Setup, estimate: Mapping[str, np.ndarray], knots: Mapping[str, KnotValues]) -> list[str]:
    """Return a line for each parameter, or for each of its knots; parameters with very many numbers have no line."""
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
    made: Setup, estimate: Mapping[str, np.ndarray], knots: Mapping[str, KnotValues], errors: Mapping[str, float]
) -> Rows:
    """Return table rows (parameter, unit, first guess, found, hidden, error): one for each number searched, each knot,
    and each parameter with very many numbers."""
    rows: Rows = []
    start = made.search.parameters(made.start)
    for name, value in estimate.items():
        unit, true = made.task.known[name].unit, made.true_parameter(name)
        if name in knots:
            own = knots[name]
            for k, time in enumerate(own.times):
                hidden, error = "", ""
                if own.true is not None:
                    hidden, error = written(own.true[k]), f"{distance(own.estimate[k], own.true[k]):.3%}"
                rows.append((_at(name, time), unit, own.start[k], own.estimate[k], hidden, error))
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


def _at(name: str, time: float) -> str:
    return f"{_words(name)} at {time:.4g} s"


def _words(name: str) -> str:
    return name.replace("_", " ")


def asked(made: Setup) -> Section:
    scene = scene_in_words(made.task.scene, made.problem.simulation.particles)
    return Section("What was asked", [*task_in_words(made.task), f"The scene: {scene}"])


def sections(
    made: Setup,
    estimate: dict[str, np.ndarray],
    result: Result,
    verdict: Verdict,
    told: list[str],
    figures: TaskFigures,
    rows: Rows,
) -> list[Section]:
    """Return the sections of the report of a search; ``told`` has sentences about the found parameters."""
    head = ("", "unit", "first guess", "found", "hidden", "error")
    return [
        asked(made),
        Section("What was found", told, verdict.failures, figures.found),
        Section("In numbers", head=head, rows=rows),
        Section("To turn and to play", view=_view(made, estimate)),
        Section("Before, found and target", figures=figures.compared),
        Section("Found against hidden", figures=figures.parameters),
        Section("The search", [result.message], figures=figures.search, rows=_rows(made, result, verdict)),
    ]


def _view(made: Setup, estimate: dict[str, np.ndarray]) -> str:
    """Return HTML that animates the found run, and the target if it is a run."""
    steps = np.unique(np.linspace(0, made.problem.steps, VIEWED).astype(int)).tolist()
    runs = {"found": estimate}
    if made.task.problem.picture is None:
        runs["target"] = made.task.true_parameters
    states = {name: made.problem.states(parameters, steps) for name, parameters in runs.items()}
    shown = {name: [found[step] for step in steps] for name, found in states.items()}
    return scene_view(made.task.scene, shown, np.array(steps) * made.task.scene.solver.time_step)


def _rows(made: Setup, result: Result, verdict: Verdict) -> Rows:
    rows: Rows = [
        ("particles", made.problem.simulation.particles, ""),
        ("steps", made.problem.steps, ""),
        ("gradients", repr(made.task.optimise.gradient.estimator()), ""),
        ("evaluations", len(result.history), ""),
        ("refused", result.refused, ""),
        ("runs of ensembles left out", result.left_out, ""),
        ("first loss", f"{verdict.first:.4g}", "" if made.renderer else "m²"),
        ("best loss", f"{result.loss:.4g}", "" if made.renderer else "m²"),
        ("loss reduction", f"{verdict.reduction:.4g}", "times"),
    ]
    if verdict.psnr is not None:
        rows.append(("image, PSNR", f"{verdict.psnr:.4g}", "dB"))
    return rows


def for_machines(
    result: Result, estimate: Mapping[str, np.ndarray], verdict: Verdict, knots: Mapping[str, KnotValues]
) -> dict[str, Any]:
    """Return the results of a search by name, for result.json."""
    found: dict[str, Any] = {
        "evaluations": len(result.history),
        "refused": result.refused,
        "left_out": result.left_out,
        "first_loss": verdict.first,
        "loss": result.loss,
        "loss_reduction": verdict.reduction,
        "parameter_error": verdict.errors,
        "parameters": {name: value for name, value in estimate.items() if np.size(value) <= MOST_IN_RESULT},
        "knots": {name: one.for_machines() for name, one in knots.items()},
        "converged": result.converged,
        "message": result.message,
        "misled": result.misled,
        "stays": result.stays,
        "failures": verdict.failures,
    }
    return found if verdict.psnr is None else {**found, "psnr": verdict.psnr}
