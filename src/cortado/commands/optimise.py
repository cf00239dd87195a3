"""``cortado optimise``: find the hidden parameters of a task, resume it, and judge the result."""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from cortado.errors import ComputationError, DivergedError
from cortado.figures import loss_curve, parameters, particles
from cortado.losses import FinalPositions
from cortado.optimisation import Record, Result, optimise
from cortado.problem import UNITS, Problem
from cortado.progress import track
from cortado.report import write_report
from cortado.run_folder import RunFolder
from cortado.simulation import Simulation
from cortado.task import Task, load_task

Rows = list[tuple[str, object]]
MOST_CURVES = 12
"""Parameters with more components get no picture of their own."""


@dataclass(frozen=True)
class Verdict:
    """What an optimisation reached, against what the task asks for."""

    reduction: float
    """First loss / best loss; infinite where the best is 0."""
    errors: dict[str, float]
    """By parameter: distance (L2) from the hidden one, relative to its size unless that is 0."""
    failures: list[str]
    """Sentences about what was not reached."""


def optimise_task(
    task_file: Path,
    out: Path,
    overrides: list[str],
    device: str,
    precision: str,
    resume: bool,
    overwrite: bool,
    command: list[str],
) -> str:
    """Optimise, write the run folder, and return a sentence that says where the results are."""
    task = load_task(task_file, overrides)
    simulation = Simulation(task.scene, device, precision)
    target = Problem(simulation, task.problem.steps, FinalPositions(simulation.positions)).end(task.problem.target)
    problem = Problem(simulation, task.problem.steps, FinalPositions(target.positions))
    text, name = task.scene.to_json(), str(simulation.device)
    if resume:
        folder = RunFolder.resume(out, text, command, device=name)
    else:
        folder = RunFolder.create(out, text, command, device=name, overwrite=overwrite)
    try:
        result = _search(task, problem, folder, resume)
    except DivergedError as error:
        advice = f"{error.advice}, or a smaller learning rate; the evaluations so far are in {folder.checkpoint}"
        raise DivergedError(error.step, error.particle, advice) from error
    verdict = judge(task, result)
    _write_pictures(task, problem, result, verdict, folder, target.positions)
    if verdict.failures:
        raise ComputationError(f"{' '.join(verdict.failures)} The results are in {folder.path}.")
    return f"{_summary(result, verdict)} The results are in {folder.path}; open report.html."


def judge(task: Task, result: Result) -> Verdict:
    """Hold a result against the task's [optimise.check]."""
    check = task.optimise.check
    reduction = result.history[0].loss / result.loss if result.loss > 0.0 else math.inf
    errors = {name: _distance(found, task.problem.target[name]) for name, found in result.parameters.items()}
    failures = []
    if reduction < check.loss_reduction:
        failures.append(f"The loss fell {reduction:.3g} times, but the task asks for {check.loss_reduction:g} times.")
    failures += [
        f"The parameter {name} is {100 * error:.3g}% off, but the task asks for {100 * check.parameter_error:.3g}%."
        for name, error in errors.items()
        if error > check.parameter_error
    ]
    return Verdict(reduction, errors, failures)


def _distance(found: ArrayLike, hidden: ArrayLike) -> float:
    """|found - hidden| / |hidden|, each repeated over the steps where only the other one changes with time."""
    found, hidden = np.broadcast_arrays(found, hidden)
    return float(np.linalg.norm(found - hidden) / (np.linalg.norm(hidden) or 1.0))


def _search(task: Task, problem: Problem, folder: RunFolder, resume: bool) -> Result:
    settings = task.optimise
    known = len(folder.read_metrics()) if resume else 0
    with track(settings.iterations + 1, "optimise") as advance:

        def note(record: Record) -> None:
            if record.iteration >= known:
                folder.append_metrics(iteration=record.iteration, loss=record.loss, gradient_norm=record.gradient_norm)
            advance(loss=record.loss)

        return optimise(
            problem,
            settings.start,
            settings.algorithm(),
            settings.iterations,
            checkpoint=folder.checkpoint,
            resume=resume,
            on_iteration=note,
        )


def _summary(result: Result, verdict: Verdict) -> str:
    found = ", ".join(f"{name} within {100 * error:.3g}% of the hidden one" for name, error in verdict.errors.items())
    return f"The loss fell {verdict.reduction:.3g} times in {len(result.history) - 1} iterations; {found}."


def _write_pictures(
    task: Task, problem: Problem, result: Result, verdict: Verdict, folder: RunFolder, target: np.ndarray
) -> None:
    losses = [record.loss for record in result.history]
    figures = [("The loss.", loss_curve(losses, folder.figures / "loss.png", label="loss [m²]"))]
    for name, found in result.parameters.items():
        hidden = task.problem.target[name]
        if max(np.size(found), hidden.size) <= MOST_CURVES:
            history = [np.broadcast_arrays(record.parameters[name], hidden)[0] for record in result.history]
            hidden = np.broadcast_to(hidden, history[0].shape)
            path = parameters(history, hidden, folder.figures / f"{name}.png", title=name, unit=UNITS[name])
            figures.append((f"The parameter {name} during the optimisation, and the hidden one.", path))
    before = problem.end(task.optimise.start).positions
    after = problem.end(result.parameters).positions
    path = particles([before, after, target], ["start", "found", "target"], folder.figures / "particles.png")
    figures.append(("Where the fluid ends: with the first guess, with the parameters found, and the target.", path))
    rows: Rows = [
        ("particles", problem.simulation.particles),
        ("steps", problem.steps),
        ("iterations", len(losses) - 1),
        ("first loss [m2]", f"{losses[0]:.4g}"),
        ("best loss [m2]", f"{result.loss:.4g}"),
        ("loss reduction", f"{verdict.reduction:.4g}"),
    ]
    for name, found in result.parameters.items():
        rows.append((f"{name}, found", np.array2string(np.asarray(found), precision=6, threshold=20)))
        rows.append((f"{name}, hidden", np.array2string(task.problem.target[name], precision=6, threshold=20)))
        rows.append((f"{name}, relative error", f"{verdict.errors[name]:.3%}"))
    write_report(folder, task.scene.name, rows, figures)
