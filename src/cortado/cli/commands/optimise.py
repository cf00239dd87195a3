"""``cortado optimise``: solve the inverse problem of a task, resume the search, and judge the result."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from cortado.calls import counted
from cortado.cli.commands.optimise_report import (
    MOST_ERROR,
    Verdict,
    asked,
    for_machines,
    found_in_words,
    found_lines,
    found_rows,
    judge,
    sections,
    worst_in_words,
)
from cortado.cli.commands.options import HERE, Where
from cortado.errors import ComputationError, DivergedError, InputError
from cortado.executors import Executor
from cortado.files.disk import locked
from cortado.files.terminal import announce, keeping, say, track
from cortado.image_losses import psnr
from cortado.optimisation.inverse.solved_task import (
    TaskFigures,
    begin_shaded,
    knot_values,
    shaded_figures,
    task_figures,
)
from cortado.optimisation.inverse.task_files import Setup, Task, load_task, setup
from cortado.optimisation.optimise import Record, Result, optimise
from cortado.pictures.film import lacking
from cortado.pictures.pages import Section, write_report
from cortado.runs.run_folder import TO_RESUME, RunFolder

LITTLE = 2.0
"""Factor by which a loss must be smaller for a search to have come to something."""
LONG = 100
"""Steps from which on a fruitless search may have had meaningless gradients."""


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
    """Optimise a task, write the run folder, shaded ``pictures`` too if wished, and return a sentence that says where
    the results are. The samples of an ensemble are computed ``where`` is asked for."""
    task = load_task(task_file, overrides)
    if where.option and task.optimise.gradient.samples == 1:
        raise InputError(f"{where.option} is given, but must be left out, as optimise.gradient.samples is 1.")
    made = setup(task, device, precision)
    if resume:
        RunFolder.open(out, TO_RESUME)
    with where.executor(device, task.optimise.gradient.samples) as executor, locked(out):
        folder = _run_folder(made, out, resume, overwrite, command)
        with keeping(lambda: f"{_kept(folder)}; --resume goes on with them" if _kept(folder) else ""):
            return _solved(made, folder, resume, executor, pictures)


def _run_folder(made: Setup, out: Path, resume: bool, overwrite: bool, command: list[str]) -> RunFolder:
    """Make a run folder, or open the one that is there; a search may go on with other iterations and another check."""
    task, simulation = made.task, made.problem.simulation
    settings = search_settings(task, simulation.precision.name)
    noted: dict[str, Any] = {"kind": "optimise", "settings": settings, "device": str(simulation.device)}
    if resume:
        return RunFolder.resume(out, task.scene.to_json(), command, **noted)
    return RunFolder.create(out, task.scene.to_json(), command, overwrite=overwrite, **noted)


def search_settings(task: Task, precision: str) -> dict[str, Any]:
    """Return the settings that must be equal, beside the scene, where a search goes on."""
    return {
        "precision": precision,
        "problem": task.problem.model_dump(),
        "optimise": task.optimise.model_dump(exclude={"iterations", "check"}),
    }


def _kept(folder: RunFolder) -> str:
    """Say where the evaluations are; empty where there are none."""
    return f"the evaluations so far are in {folder.checkpoint}" if folder.read_metrics() else ""


def _solved(made: Setup, folder: RunFolder, resume: bool, executor: Executor, pictures: bool) -> str:
    """Search, judge, and write the results; return the sentence about them."""
    shades = pictures and _can_shade(made)
    if shades:
        begin_shaded(made)
    try:
        result = _search(made, folder, resume, executor)
    except DivergedError as error:
        evaluations = len(folder.read_metrics())
        ended = Section("What came out", [f"The search ended early, in evaluation {evaluations}."], [error])
        write_report(folder, made.task.scene.name, [asked(made), ended])
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
        shaded = shaded_figures(made, result, folder.figures) if shades else TaskFigures()
        figures = shaded + task_figures(made, result, folder.figures)
        rows = found_rows(made, estimate, knots, verdict.errors)
        write_report(folder, made.task.scene.name, sections(made, estimate, result, verdict, said, figures, rows))
        folder.write_result(**for_machines(result, estimate, verdict, knots))
    if verdict.failures:
        raise ComputationError(f"{' '.join(verdict.failures)} The results are in {folder.path}.")
    films = [f"figures/{Path(path).name}" for _, path in shaded.found if Path(path).suffix == ".mp4"]
    to_open = ", or ".join([*films[:1], "report.html"])
    return f"The results are in {folder.path}; open {to_open}."


def _can_shade(made: Setup) -> bool:
    """Test whether there can be shaded pictures and films; say so where a package is missing."""
    missing = lacking(made.task.scene)
    if missing:
        say(missing)
    return not missing


def _search(made: Setup, folder: RunFolder, resume: bool, executor: Executor) -> Result:
    settings = made.task.optimise
    known = len(folder.read_metrics()) if resume else 0
    history: list[Record] = []
    start, shown, updates, refused, left_out = made.start, 0, 0, 0, 0
    with track(len(made.searches) * settings.iterations, "optimise") as advance:

        def show(made: int, **fields: Any) -> None:
            """The progress after so many updates of this search; a search before it may have ended early."""
            nonlocal shown
            advance(k * settings.iterations + made - shown, **fields)
            shown = k * settings.iterations + made

        def keep(record: Record) -> None:
            made_updates = record.updates
            record = replace(
                record,
                iteration=len(history),
                updates=updates + record.updates,
                refused=refused + record.refused,
                left_out=left_out + record.left_out,
            )
            if record.iteration + 1 == known:
                whole = f"iteration {record.updates} of {len(made.searches) * settings.iterations}"
                announce(f"The search goes on from {whole}, after {record.iteration + 1} evaluations.")
            if record.iteration >= known:
                folder.append_metrics(
                    iteration=record.iteration,
                    loss=record.loss,
                    gradient_norm=record.gradient_norm,
                    refused=record.refused,
                    left_out=record.left_out,
                )
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
            refused, left_out = refused + result.refused, left_out + result.left_out
    whole: dict[str, Any] = {"updates": updates, "evaluations": len(history), "refused": refused, "left_out": left_out}
    return replace(result, history=tuple(history), **whole)


def _advice(made: Setup, result: Result, verdict: Verdict) -> list[str]:
    """Return advice where a search came to next to nothing, was misled, or may be in a wrong valley, and its bounds on
    which it ended."""
    met = [name for name, pair in made.bounds.items() if _on_bound(result.parameters[name], *pair)]
    found = [f"The search of {name} ended on its bounds: what is best may lie beyond them." for name in met]
    task, steps = made.task, made.task.problem.steps
    hardly, is_exact = verdict.reduction < LITTLE, task.optimise.gradient.name == "exact"
    search = 'optimise.optimiser = "line_search"'
    if is_exact and (result.misled or (hardly and steps >= LONG)):
        why = "The gradient disagrees with what steps of the search did." if result.misled else "The loss hardly fell."
        return [
            *found,
            f"{why} Over {steps} steps the exact gradient may mean nothing: cortado gradients check says up to which "
            f'step it is of use. Beyond it set optimise.gradient.name = "adjoint_viscosity" and {search}.',
        ]
    if result.misled:
        return [*found, f"The gradient disagrees with what steps of the search did: set {search}, or begin elsewhere."]
    if hardly:
        other = "small" if result.refused else "large, or as small"
        return [*found, f"The loss hardly fell: try an optimise.learning_rate that is 10 times as {other}."]
    if result.stays or max(verdict.errors.values(), default=0.0) > MOST_ERROR:
        more = ", fewer steps" + (" or more frames" if made.renderer else "")
        return [*found, f"If the search is in a wrong valley, try another start{more}, or set {search}."]
    return found


def _on_bound(value: Any, lower: Any, upper: Any) -> bool:
    """Test whether a number of a parameter's coordinates is as small or as large as it may be."""
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
    refused = f" and {result.refused} more that were refused" if result.refused else ""
    left_out = f", {counted(result.left_out, 'run')} of ensembles left out" if result.left_out else ""
    ends = f", from {verdict.first:.3g}{unit} to {result.loss:.3g}{unit}" if result.loss > 0.0 else unit
    text = f"The loss {fell}{ends} in {len(result.history)} evaluations{refused}{left_out}"
    return f"{'; '.join([text, *reached])}."
