"""The results of ``cortado optimise`` as text, report and JSON, with a verdict on the goals of the task."""

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from cortado.calls import counted
from cortado.image_losses import psnr
from cortado.optimisation.optimise import Result
from cortado.optimisation.solved_task import TaskFigures, component_names, knot_values
from cortado.optimisation.task_files import Setup, Task, task_in_words
from cortado.pictures.pages import MOST_NUMBERS, Section, written
from cortado.pictures.particle_view import scene_view
from cortado.scene.parameter_values import Arrays
from cortado.scene.scene import scene_in_words

Rows = list[tuple[object, ...]]
MOST_ERROR = 0.3
"""Relative error above which a parameter counts as not found."""


@dataclass(frozen=True)
class Verdict:
    first: float
    reduction: float
    """First loss divided by the best loss, or infinity if the best loss is 0."""
    errors: dict[str, float]
    """Relative L2 error of each parameter's estimate. The error is absolute where the true value is 0."""
    psnr: float | None
    """Peak signal-to-noise ratio of the last image [dB], or None for a task without images."""
    failures: list[str]


def judge(
    task: Task, result: Result, estimate: Arrays | None = None, noise: float | None = None, first: float | None = None
) -> Verdict:
    """``estimate`` has the found parameters, if ``result`` does not have them. ``noise`` is the peak signal-to-noise
    ratio of the last image [dB]. ``first`` is the initial loss, if the history does not start with it."""
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


def _words(name: str) -> str:
    return name.replace("_", " ")


def question(made: Setup) -> Section:
    scene = scene_in_words(made.task.scene, made.problem.simulation.particles)
    return Section("What was asked", [*task_in_words(made.task), f"The scene: {scene}"])


class Solved:
    def __init__(self, made: Setup, result: Result):
        self.made, self.result, self.estimate = made, result, made.search.parameters(result.parameters)
        noise = None
        if made.renderer is not None:
            last, target = max(made.targets.items())
            noise = psnr(made.image(made.problem.states(self.estimate, [last])[last]), target)
        first = made.search.value(made.start) if len(made.searches) > 1 else result.history[0].loss
        self.verdict = judge(made.task, result, self.estimate, noise, first)
        self.knots = knot_values(made, result.parameters, self.estimate)

    @property
    def summary(self) -> str:
        made, result, verdict = self.made, self.result, self.verdict
        reached = [f"{name} is {found_in_words(e)}{self._worst(name, e)}" for name, e in verdict.errors.items()]
        if verdict.psnr is not None:
            reached.append(f"the image is matched to {verdict.psnr:.3g} dB")
        fell = f"fell {verdict.reduction:.3g} times" if result.loss > 0.0 else f"went from {verdict.first:.3g} to 0"
        unit = "" if made.renderer else " m²"
        refused = f" and {result.refused} more that were refused" if result.refused else ""
        left_out = f", {counted(result.left_out, 'run')} of ensembles left out" if result.left_out else ""
        ends = f", from {verdict.first:.3g}{unit} to {result.loss:.3g}{unit}" if result.loss > 0.0 else unit
        text = f"The loss {fell}{ends} in {len(result.history)} evaluations{refused}{left_out}"
        return f"{'; '.join([text, *reached])}."

    def _worst(self, name: str, error: float) -> str:
        """Describe the component with the greatest error, if it is more than twice the parameter's ``error``."""
        estimate, true = self.estimate[name], self.made.task.true_parameters.get(name)
        names = component_names(self.made.task, name, estimate)
        if true is None or not 1 < len(names) == np.size(true) == np.size(estimate) <= MOST_NUMBERS or not np.all(true):
            return ""
        errors = [distance(*pair) for pair in zip(np.ravel(estimate), np.ravel(true), strict=True)]
        worst = int(np.argmax(errors))
        return f" ({names[worst]}: {100 * errors[worst]:.2g}%)" if errors[worst] > 2.0 * error else ""

    @property
    def advice(self) -> list[str]:
        made, result, task, steps = self.made, self.result, self.made.task, self.made.task.problem.steps
        found = []
        for name, (lower, upper) in made.bounds.items():
            least = np.asarray(-np.inf if lower is None else lower)
            most = np.asarray(np.inf if upper is None else upper)
            if ((result.parameters[name] <= least) | (result.parameters[name] >= most)).any():
                found.append(f"The search of {name} ended on its bounds: what is best may lie beyond them.")
        hardly, is_exact = self.verdict.reduction < 2.0, task.optimise.gradient.name == "exact"
        search = 'optimise.optimiser = "line_search"'
        disagrees = "The gradient disagrees with what steps of the search did"
        if is_exact and (result.misled or (hardly and steps >= 100)):
            found.append(
                f"{disagrees if result.misled else 'The loss hardly fell'}. Over {steps} steps the exact gradient may "
                "mean nothing: cortado gradients check says up to which step it is of use. Beyond it set "
                f'optimise.gradient.name = "adjoint_viscosity" and {search}.'
            )
        elif result.misled:
            found.append(f"{disagrees}: set {search}, or begin elsewhere.")
        elif hardly:
            other = "small" if result.refused else "large, or as small"
            found.append(f"The loss hardly fell: try an optimise.learning_rate that is 10 times as {other}.")
        elif result.stays or max(self.verdict.errors.values(), default=0.0) > MOST_ERROR:
            more = ", fewer steps" + (" or more frames" if made.renderer else "")
            found.append(f"If the search is in a wrong valley, try another start{more}, or set {search}.")
        return found

    def _at_knots(self, name: str) -> Iterator[tuple[str, Any, Any, Any]]:
        """Yield the label, the first guess, the estimate and the true value (or None) of a parameter at each knot."""
        own = self.knots[name]
        for k, time in enumerate(own.times):
            true = None if own.true is None else own.true[k]
            yield f"{_words(name)} at {time:.4g} s", own.start[k], own.estimate[k], true

    @property
    def lines(self) -> list[str]:
        """Parameters with very many components are left out."""
        lines = []
        for name, value in self.estimate.items():
            found: Iterable[Any] = [(_words(name), None, value, self.made.task.true_parameters.get(name))]
            if name in self.knots:
                found = self._at_knots(name)
            elif np.size(value) > MOST_NUMBERS:
                continue
            unit = f" {self.made.task.known[name].unit}".rstrip()
            for label, _, one, true in found:
                hidden = "" if true is None else f"; true {written(true)}{unit}"
                lines.append(f"  {label}: {written(one)}{unit}{hidden}")
        return lines

    @property
    def rows(self) -> Rows:
        rows, errors, start = Rows(), self.verdict.errors, self.made.search.parameters(self.made.start)
        for name, value in self.estimate.items():
            unit, true = self.made.task.known[name].unit, self.made.task.true_parameters.get(name)
            if name in self.knots:
                for label, first, found, hidden in self._at_knots(name):
                    known = ("", "") if hidden is None else (written(hidden), f"{distance(found, hidden):.3%}")
                    rows.append((label, unit, first, found, *known))
                continue
            columns = np.broadcast_arrays(start[name], value, *([] if true is None else [true]))
            names = component_names(self.made.task, name, columns[0])
            if len(names) != columns[0].size or len(names) > MOST_NUMBERS:
                error = f"{errors[name]:.3%}" if name in errors else ""
                whole = np.asarray(start[name]), np.asarray(value), "" if true is None else true
                rows.append((_words(name), unit, *whole, error))
                continue
            for label, first, found, *hidden in zip(names, *map(np.ravel, columns), strict=True):
                known = (*hidden, f"{distance(found, *hidden):.3%}") if hidden else ("", "")
                rows.append((label, unit, first, found, *known))
        return rows

    def sections(self, figures: TaskFigures) -> list[Section]:
        made, result, verdict, task = self.made, self.result, self.verdict, self.made.task
        steps, unit = made.problem.steps, "" if made.renderer else "m²"
        viewed = np.unique(np.linspace(0, steps, 60).astype(int)).tolist()
        runs = {"found": self.estimate, **({"target": task.true_parameters} if task.problem.picture is None else {})}
        states = {name: made.problem.states(parameters, viewed) for name, parameters in runs.items()}
        shown = {name: [found[step] for step in viewed] for name, found in states.items()}
        effort: Rows = [
            ("particles", made.problem.simulation.particles, ""),
            ("steps", steps, ""),
            ("gradients", repr(task.optimise.gradient.estimator()), ""),
            ("evaluations", len(result.history), ""),
            ("refused", result.refused, ""),
            ("runs of ensembles left out", result.left_out, ""),
            ("first loss", f"{verdict.first:.4g}", unit),
            ("best loss", f"{result.loss:.4g}", unit),
            ("loss reduction", f"{verdict.reduction:.4g}", "times"),
            *([] if verdict.psnr is None else [("image, PSNR", f"{verdict.psnr:.4g}", "dB")]),
        ]
        view = scene_view(task.scene, shown, np.array(viewed) * task.scene.solver.time_step)
        head = ("", "unit", "first guess", "found", "hidden", "error")
        return [
            question(made),
            Section("What was found", [self.summary, *self.advice], verdict.failures, figures.found),
            Section("In numbers", head=head, rows=self.rows),
            Section("To turn and to play", view=view),
            Section("Before, found and target", figures=figures.compared),
            Section("Found against hidden", figures=figures.parameters),
            Section("The search", [result.message], figures=figures.search, rows=effort),
        ]

    def for_machines(self) -> dict[str, Any]:
        result, verdict, small = self.result, self.verdict, 1000  # the checkpoint has all of them
        return {
            "evaluations": len(result.history),
            "refused": result.refused,
            "left_out": result.left_out,
            "first_loss": verdict.first,
            "loss": result.loss,
            "loss_reduction": verdict.reduction,
            "parameter_error": verdict.errors,
            "parameters": {name: value for name, value in self.estimate.items() if np.size(value) <= small},
            "knots": {name: one.for_machines() for name, one in self.knots.items()},
            **{name: getattr(result, name) for name in ("converged", "message", "misled", "stays")},
            "failures": verdict.failures,
            **({} if verdict.psnr is None else {"psnr": verdict.psnr}),
        }
