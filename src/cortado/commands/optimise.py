"""``cortado optimise``: solve the inverse problem of a task, resume the search, and judge the result."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from cortado.commands.executor import HERE, Where
from cortado.commands.found import Rows, distance, found_lines, found_rows, worst_in_words
from cortado.errors import ComputationError, DivergedError, InputError
from cortado.executors import Executor
from cortado.inverse.chapters import Chapters
from cortado.inverse.figures import task_figures
from cortado.inverse.in_words import task_in_words
from cortado.inverse.knots import KnotValues, knot_values
from cortado.inverse.setup import Setup, setup
from cortado.inverse.shaded import shaded_figures
from cortado.inverse.task import Task, load_task
from cortado.io.folder_lock import locked
from cortado.io.interruption import keeping
from cortado.io.progress import announce, track
from cortado.io.report import Section, write_report
from cortado.io.run_folder import TO_RESUME, RunFolder
from cortado.io.terminal import say
from cortado.losses.image_losses import psnr
from cortado.optimisation.optimise import Record, Result, optimise
from cortado.scene.in_words import scene_in_words
from cortado.shading.film import lacking
from cortado.shading.scene_view import scene_view

MOST_NUMBERS = 1000
"""Of a parameter whose estimate is in result.json; larger ones are in the checkpoint."""
MOST_ERROR = 0.3
"""Of a parameter, relative, up to which it counts as found."""
LITTLE = 2.0
"""How many times smaller a loss must be for a search to have come to something."""
LONG = 100
"""Steps from which on a search that came to nothing may have had meaningless gradients."""
VIEWED = 60
"""States of a run that the view in the report shows at most."""


@dataclass(frozen=True)
class Verdict:
    """How near an optimisation came to what the task asks for."""

    first: float
    """Loss of the start."""
    reduction: float
    """Loss of the start / best loss; infinite where the best is 0."""
    errors: dict[str, float]
    """By parameter: distance (L2) of the estimate from the true value, relative to its size unless that is 0."""
    psnr: float | None
    """Of the last image [dB]; None where positions are compared."""
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
    where: Where = HERE,
    pictures: bool = False,
) -> str:
    """Optimise, write the run folder, shaded ``pictures`` too if wished, and return a sentence that says where the
    results are. The samples of an ensemble are computed ``where`` is asked for."""
    task = load_task(task_file, overrides)
    if where.option and task.optimise.gradient.samples == 1:
        raise InputError(f"{where.option} is given, but must be left out, as optimise.gradient.samples is 1.")
    made = setup(task, device, precision)
    if resume:
        RunFolder.open(out, TO_RESUME)
    with where.executor(device) as executor, locked(out):
        folder = _run_folder(made, out, resume, overwrite, command)
        with keeping(lambda: f"{_kept(folder)}; --resume goes on with them" if _kept(folder) else ""):
            return _solved(made, folder, resume, executor, pictures)


def _run_folder(made: Setup, out: Path, resume: bool, overwrite: bool, command: list[str]) -> RunFolder:
    """A new one, or the one that is there; a search goes on with other iterations and another check if so wished."""
    task, simulation = made.task, made.problem.simulation
    settings = search_settings(task, simulation.precision.name)
    noted: dict[str, Any] = {"kind": "optimise", "settings": settings, "device": str(simulation.device)}
    if resume:
        return RunFolder.resume(out, task.scene.to_json(), command, **noted)
    return RunFolder.create(out, task.scene.to_json(), command, overwrite=overwrite, **noted)


def search_settings(task: Task, precision: str) -> dict[str, Any]:
    """What must be the same, beside the scene, where a search goes on."""
    return {
        "precision": precision,
        "problem": task.problem.model_dump(),
        "optimise": task.optimise.model_dump(exclude={"iterations", "check"}),
    }


def _kept(folder: RunFolder) -> str:
    """Where the evaluations are; empty where there are none."""
    return f"the evaluations so far are in {folder.checkpoint}" if folder.read_metrics() else ""


def _solved(made: Setup, folder: RunFolder, resume: bool, executor: Executor, pictures: bool) -> str:
    """Search, judge, and write what came out; returns the sentence about it."""
    try:
        result = _search(made, folder, resume, executor)
    except DivergedError as error:
        evaluations = len(folder.read_metrics())
        ended = Section("What came out", [f"The search ended early, in evaluation {evaluations}."], [error])
        write_report(folder, made.task.scene.name, [_asked(made), ended])
        told = error.with_advice("; ".join(filter(None, [error.advice, _kept(folder)])))
        folder.write_result(evaluations=evaluations, failures=[str(told)])
        raise told from error
    estimate = made.search.parameters(result.parameters)
    noise = None
    if made.renderer is not None:
        last, target = max(made.targets.items())
        noise = psnr(made.image(made.problem.states(estimate, [last])[last]), target)
    first = made.search.value(made.start) if len(made.searches) > 1 else result.history[0].loss
    verdict = judge(made.task, result, estimate, noise, first)
    knots = knot_values(made, result.parameters, estimate)
    summary, advice = _summary(made, estimate, result, verdict), _advice(made, result, verdict)
    said = [summary, *advice]
    announce("\n".join([summary, *found_lines(made, estimate, knots), *advice]))
    with keeping(lambda: f"the search has ended, and is in {folder.checkpoint}; --resume draws its pictures"):
        shaded = _shaded(made, result, folder.figures, pictures)
        figures = shaded + task_figures(made, result, folder.figures)
        rows = found_rows(made, estimate, knots, verdict.errors)
        write_report(folder, made.task.scene.name, _sections(made, estimate, result, verdict, said, figures, rows))
        folder.write_result(**_for_machines(result, estimate, verdict, knots))
    if verdict.failures:
        raise ComputationError(f"{' '.join(verdict.failures)} The results are in {folder.path}.")
    films = [f"figures/{Path(path).name}" for _, path in shaded.found if Path(path).suffix == ".mp4"]
    to_open = ", or ".join([*films[:1], "report.html"])
    return f"The results are in {folder.path}; open {to_open}."


def _shaded(made: Setup, result: Result, folder: Path, wished: bool) -> Chapters:
    """Shaded pictures and films, where they are wished; none, and a sentence, where a package is missing."""
    missing = lacking(made.task.scene) if wished else None
    if missing:
        say(missing)
    return shaded_figures(made, result, folder) if wished and not missing else Chapters()


def judge(
    task: Task,
    result: Result,
    estimate: dict[str, np.ndarray] | None = None,
    noise: float | None = None,
    first: float | None = None,
) -> Verdict:
    """Hold a result against the task's [optimise.check].

    ``estimate``: its parameters, where the result has coordinates; ``noise``: the peak signal-to-noise ratio that was
    reached [dB]; ``first``: the loss of the start, where the history begins with another loss.
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


def _search(made: Setup, folder: RunFolder, resume: bool, executor: Executor) -> Result:
    settings = made.task.optimise
    known = len(folder.read_metrics()) if resume else 0
    history: list[Record] = []
    start, shown, updates = made.start, 0, 0
    with track(len(made.searches) * settings.iterations, "optimise") as advance:

        def show(made: int, **fields: Any) -> None:
            """The progress after so many updates of this search; a search before it may have ended early."""
            nonlocal shown
            advance(k * settings.iterations + made - shown, **fields)
            shown = k * settings.iterations + made

        def keep(record: Record) -> None:
            made_updates = record.updates
            record = replace(record, iteration=len(history), updates=updates + record.updates)
            if record.iteration + 1 == known:
                announce(_resumed(record, len(made.searches) * settings.iterations))
            if record.iteration >= known:
                folder.append_metrics(iteration=record.iteration, loss=record.loss, gradient_norm=record.gradient_norm)
            history.append(record)
            show(made_updates, loss=record.loss, evaluations=len(history))

        for k, search in enumerate(made.searches):
            result = optimise(
                search,
                start,
                settings.algorithm(),
                settings.iterations,
                bounds=made.bounds,
                gradient=settings.gradient.estimator(executor),
                checkpoint=folder.checkpoint / str(k) if k else folder.checkpoint,
                resume=resume,
                on_iteration=keep,
            )
            if result.updates > result.history[-1].updates:
                show(result.updates)
            start, updates = result.last_parameters, updates + result.updates
    return replace(result, history=tuple(history), updates=updates, evaluations=len(history))


def _resumed(last: Record, iterations: int) -> str:
    """Where a search goes on, given the last evaluation that is known."""
    return f"The search goes on from iteration {last.updates} of {iterations}, after {last.iteration + 1} evaluations."


def _for_machines(
    result: Result, estimate: Mapping[str, np.ndarray], verdict: Verdict, knots: Mapping[str, KnotValues]
) -> dict[str, Any]:
    """What came out, by names."""
    found: dict[str, Any] = {
        "evaluations": len(result.history),
        "first_loss": verdict.first,
        "loss": result.loss,
        "loss_reduction": verdict.reduction,
        "parameter_error": verdict.errors,
        "parameters": {name: value for name, value in estimate.items() if np.size(value) <= MOST_NUMBERS},
        "knots": {name: one.for_machines() for name, one in knots.items()},
        "converged": result.converged,
        "message": result.message,
        "failures": verdict.failures,
    }
    return found if verdict.psnr is None else {**found, "psnr": verdict.psnr}


def _advice(made: Setup, result: Result, verdict: Verdict) -> list[str]:
    """What to try where a search came to next to nothing, and which of its bounds it ended on."""
    met = [name for name, pair in made.bounds.items() if _on_bound(result.parameters[name], *pair)]
    found = [f"The search of {name} ended on its bounds: what is best may lie beyond them." for name in met]
    task, steps = made.task, made.task.problem.steps
    if verdict.reduction >= LITTLE:
        return found
    if steps < LONG or task.optimise.gradient.name != "exact":
        return [*found, "The loss hardly fell: try an optimise.learning_rate that is 10 times as large, or as small."]
    return [
        *found,
        f"The loss hardly fell. Over {steps} steps the exact gradient may mean nothing: cortado gradients check says "
        'up to which step it is of use. Beyond it set optimise.gradient.name = "adjoint_viscosity" and '
        'optimise.optimiser = "line_search".',
    ]


def _on_bound(value: Any, lower: Any, upper: Any) -> bool:
    """Whether a number of a parameter's coordinates is as small or as large as it may be."""
    least, most = np.asarray(-np.inf if lower is None else lower), np.asarray(np.inf if upper is None else upper)
    return bool(((value <= least) | (value >= most)).any())


def _summary(made: Setup, estimate: Mapping[str, np.ndarray], result: Result, verdict: Verdict) -> str:
    reached = [
        f"{name} is {found_in_words(error)}{worst_in_words(made, name, estimate[name], error)}"
        for name, error in verdict.errors.items()
    ]
    if verdict.psnr is not None:
        reached.append(f"the image is matched to {verdict.psnr:.3g} dB")
    fell = f"fell {verdict.reduction:.3g} times" if result.loss > 0.0 else f"went from {verdict.first:.3g} to 0"
    unit = "" if made.renderer else " m²"
    ends = f", from {verdict.first:.3g}{unit} to {result.loss:.3g}{unit}" if result.loss > 0.0 else unit
    text = f"The loss {fell}{ends} in {len(result.history)} evaluations"
    return f"{'; '.join([text, *reached])}."


def found_in_words(error: float) -> str:
    """How well a parameter is found, by its distance from the true value relative to it."""
    if error > MOST_ERROR:
        why = "the search is too short, it ended in a wrong valley of the loss, or other values do as well"
        return f"not found, {100 * error:.3g}% off: {why}"
    return f"found with an error of {100 * error:.2g}%"


def _asked(made: Setup) -> Section:
    scene = scene_in_words(made.task.scene, made.problem.simulation.particles)
    return Section("What was asked", [*task_in_words(made.task), f"The scene: {scene}"])


def _sections(
    made: Setup,
    estimate: dict[str, np.ndarray],
    result: Result,
    verdict: Verdict,
    told: list[str],
    figures: Chapters,
    rows: Rows,
) -> list[Section]:
    """The report, in the order in which one would tell it; ``told``: what was found, in words."""
    head = ("", "unit", "first guess", "found", "hidden", "error")
    return [
        _asked(made),
        Section(
            "What was found",
            told,
            verdict.failures,
            figures.found,
        ),
        Section("In numbers", head=head, rows=rows),
        Section("To turn and to play", view=_view(made, estimate)),
        Section("Before, found and target", figures=figures.compared),
        Section("Found against hidden", figures=figures.parameters),
        Section("The search", [result.message], figures=figures.search, rows=_rows(made, result, verdict)),
    ]


def _view(made: Setup, estimate: dict[str, np.ndarray]) -> str:
    """What was found, and the target where it is a run, in motion."""
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
        ("first loss", f"{verdict.first:.4g}", "" if made.renderer else "m²"),
        ("best loss", f"{result.loss:.4g}", "" if made.renderer else "m²"),
        ("loss reduction", f"{verdict.reduction:.4g}", "times"),
    ]
    if verdict.psnr is not None:
        rows.append(("image, PSNR", f"{verdict.psnr:.4g}", "dB"))
    return rows
