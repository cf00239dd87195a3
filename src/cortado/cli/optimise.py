"""The commands ``cortado optimise``, for inverse problems, and ``cortado fit``, for estimates with error bars."""

from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from cortado.calls import counted
from cortado.cli.arguments import HERE, Where
from cortado.cli.optimise_report import Solved, question
from cortado.cli.run import RunRequest
from cortado.device.modules import compile_meanwhile
from cortado.errors import ComputationError, DivergedError, InputError
from cortado.executors import Executor
from cortado.files.disk import locked
from cortado.files.terminal import announce, keeping, say, track
from cortado.optimisation import solved_task
from cortado.optimisation.fitting.figures import profile_figure, residual_figure, video_figures
from cortado.optimisation.fitting.fit import NOISE_ALONE, Fit, Profile, fit, unit_of
from cortado.optimisation.optimise import Record, Result, optimise
from cortado.optimisation.task_files import Setup, Task, load_task, setup
from cortado.pictures.film import lacking
from cortado.pictures.pages import Section, write_report
from cortado.pictures.painter import painter
from cortado.runs.run_folder import TO_RESUME, RunFolder
from cortado.scene.scene import scene_in_words

COUNTED = (
    "The last column is what the error would be if every number that was measured were independent of all others: it "
    "shows how much correlation matters."
)


def optimise_task(task_file: Path, asked: RunRequest, where: Where = HERE) -> str:
    """``where`` says which processes compute the samples of ensembles."""
    task = load_task(task_file, asked.overrides)
    if where.option and task.optimise.gradient.samples == 1:
        raise InputError(f"{where.option} is given, but must be left out, as optimise.gradient.samples is 1.")
    made = setup(task, asked.device, asked.precision)
    if asked.resume:
        RunFolder.open(asked.out, TO_RESUME)
    with where.executor(asked.device, task.optimise.gradient.samples) as executor, locked(asked.out):
        folder = asked.folder(task.scene, made.problem.simulation, "optimise", search_settings(task, asked.precision))
        with keeping(lambda: f"{_kept(folder)}; --resume goes on with them" if _kept(folder) else ""):
            return _solved(made, folder, asked.resume, executor, asked.pictures)


def search_settings(task: Task, precision: str) -> dict[str, Any]:
    """Return the settings that must not change when a search is resumed."""
    search = task.optimise.model_dump(exclude={"iterations", "check"})
    return {"precision": precision, "problem": task.problem.model_dump(), "optimise": search}


def _kept(folder: RunFolder) -> str:
    return f"the evaluations so far are in {folder.checkpoint}" if folder.read_metrics() else ""


def _solved(made: Setup, folder: RunFolder, resume: bool, executor: Executor, pictures: bool) -> str:
    missing = lacking(made.task.scene) if pictures else None
    if missing:
        say(missing)
    shades, simulation = pictures and not missing, made.problem.simulation
    if shades:
        compile_meanwhile(painter(made.task.scene, simulation.positions, simulation.device), simulation.device)
    try:
        result = _search(made, folder, resume, executor)
    except DivergedError as error:
        evaluations = len(folder.read_metrics())
        ended = Section("What came out", [f"The search ended early, in evaluation {evaluations}."], [error])
        write_report(folder, made.task.scene.name, [question(made), ended])
        told = error.with_advice("; ".join(filter(None, [error.advice, _kept(folder)])))
        folder.write_result(evaluations=evaluations, failures=[str(told)])
        raise told from error
    found = Solved(made, result)
    announce("\n".join([found.summary, *found.lines, *found.advice]))
    with keeping(lambda: f"the search has ended, and is in {folder.checkpoint}; --resume draws its pictures"):
        shaded = solved_task.shaded_figures(made, result, folder.figures) if shades else solved_task.TaskFigures()
        figures = shaded + solved_task.task_figures(made, result, folder.figures)
        write_report(folder, made.task.scene.name, found.sections(figures))
        folder.write_result(**found.for_machines())
    if found.verdict.failures:
        raise ComputationError(f"{' '.join(found.verdict.failures)} The results are in {folder.path}.")
    films = [f"figures/{Path(path).name}" for _, path in shaded.found if Path(path).suffix == ".mp4"]
    to_open = ", or ".join([*films[:1], "report.html"])
    return f"The results are in {folder.path}; open {to_open}."


def _search(made: Setup, folder: RunFolder, resume: bool, executor: Executor) -> Result:
    settings = made.task.optimise
    known = len(folder.read_metrics()) if resume else 0
    history: list[Record] = []
    start, shown, updates, refused, left_out = made.start, 0, 0, 0, 0
    with track(len(made.searches) * settings.iterations, "optimise") as advance:

        def show(made: int, **fields: Any) -> None:
            nonlocal shown
            advance(k * settings.iterations + made - shown, **fields)
            shown = k * settings.iterations + made

        def keep(record: Record) -> None:
            made_updates, number = record.updates, len(history)
            noted: dict[str, Any] = {"refused": refused + record.refused, "left_out": left_out + record.left_out}
            record = replace(record, iteration=number, updates=updates + record.updates, **noted)
            if number + 1 == known:
                whole = f"iteration {record.updates} of {len(made.searches) * settings.iterations}"
                announce(f"The search goes on from {whole}, after {known} evaluations.")
            if number >= known:
                norm = record.gradient_norm
                folder.append_metrics(iteration=number, loss=record.loss, gradient_norm=norm, **noted)
            history.append(record)
            show(made_updates, loss=record.loss, evaluations=len(history))

        for k, search in enumerate(made.searches):
            place = folder.checkpoint / str(k) if k else folder.checkpoint
            own: dict[str, Any] = {"gradient": settings.gradient.estimator(executor), "on_iteration": keep}
            own |= {"bounds": made.bounds, "checkpoint": place, "resume": resume}
            result = optimise(search, start, settings.algorithm(), settings.iterations, **own)
            if result.updates > result.history[-1].updates:
                show(result.updates)
            start, updates = result.last_parameters, updates + result.updates
            refused, left_out = refused + result.refused, left_out + result.left_out
    whole: dict[str, Any] = {"updates": updates, "evaluations": len(history), "refused": refused, "left_out": left_out}
    return replace(result, history=tuple(history), **whole)


def fit_task(task_file: Path, asked: RunRequest) -> str:
    task = solved_task.load_fit(task_file, asked.overrides)
    experiments = [one.experiment(asked.device, asked.precision) for one in task.experiments]
    with locked(asked.out):
        settings = {"precision": asked.precision, "fit": task.fit.model_dump()}
        noted: dict[str, Any] = {"kind": "fit", "settings": settings, "device": asked.device}
        folder = RunFolder.create(asked.out, task.scene.to_json(), asked.command, overwrite=asked.overwrite, **noted)
        with track(2 * task.fit.iterations, "fit") as advance:
            given = task.fit
            fitted = fit(experiments, given.start, given.bounds, given.iterations, lambda: advance(1), given.starts)
        announce(str(fitted))
        profiles, labels = list[Profile](), fitted.labels if given.profiles else []
        with track(len(labels), "profiles") if labels else nullcontext(lambda _: None) as advance:
            for label in labels:
                profiles.append(fitted.profile(label, given.profiles))
                advance(1)
        write_report(folder, task.scene.name, fit_sections(task, fitted, profiles, folder.figures))
        folder.write_result(**fit_for_machines(fitted, profiles))
    if not fitted.converged:
        found = f"The fit has not converged in {task.fit.iterations} trial points"
        advice = "increase fit.iterations, or start nearer to the expected values"
        raise ComputationError(f"{found}: {advice}. The results are in {folder.path}.")
    doubted = " They are in doubt, as said above." if fitted.in_doubt else ""
    return f"The results are in {folder.path}; open report.html.{doubted}"


def fit_sections(task: solved_task.FitTask, fitted: Fit, profiles: Sequence[Profile], folder: Path) -> list[Section]:
    particles, measured = [one.simulation.particles for one in fitted.problem.experiments] if fitted.problem else [], []
    for experiment, count in zip(task.experiments, particles, strict=True):
        what = ", ".join(f"{table.name} ({table.file})" for table in experiment.problem.measured)
        measured.append(f"What was measured: {what}. The scene: {scene_in_words(experiment.scene, count)}")
    names = ", ".join(name.replace("_", " ") for name in fitted.coordinates.names)
    apart = [
        f"{a} and {b} are hardly told apart: a change of both together changes little of what was measured (their "
        f"estimates have a correlation of {c:.3f})."
        for a, b, c in fitted.not_told_apart
    ]
    head = ("", "unit", "start", "found", "standard error", "95 %, from", "to", "degrees of freedom", "counted error")
    counted_errors = np.sqrt(np.diag(fitted.naive_covariance)) * fitted.coordinates.slopes(fitted.u)
    rows = list[tuple[object, ...]]()
    for one, freedom, error in zip(fitted.numbers(), fitted.degrees_of_freedom, counted_errors, strict=True):
        own = (unit_of(one.label), one.start, one.value, one.error, one.lower, one.upper)
        rows.append((one.label.replace("_", " "), *own, round(float(freedom), 1), float(error)))
    noise_head = ("", "unit", "frames", "numbers", "residuals", "noise", "correlation time [s]", "independent frames")
    noise: list[tuple[object, ...]] = []
    for part in fitted.parts:
        of, known = part.part.observation, (part.correlation_time, round(part.frames, 1))
        given = "" if of.noise is None else of.noise
        noise.append((part.label, of.unit, *part.residuals.shape, part.spread, given, *known))
    each = zip(fitted.labels, fitted.correlation, strict=True) if len(fitted.labels) > 1 else ()
    correlations = [(label, *(round(float(c), 3) for c in row)) for label, row in each]
    return [
        Section("What was asked", [f"Which {names} makes the simulation do what was measured?", *measured]),
        Section("What was found", fitted.lines(), [*apart, *fitted.doubts]),
        Section("In numbers", [NOISE_ALONE, COUNTED], head=head, rows=rows),
        Section("Measured and found", figures=video_figures(fitted, folder)),
        Section("Residuals", figures=residual_figure(fitted, folder / "residuals.png"), head=noise_head, rows=noise),
        Section("Profiles", figures=profile_figure(profiles, folder / "profiles.png")),
        Section("Correlations", head=("", *fitted.labels), rows=correlations),
        _effort(fitted),
    ]


def _effort(fitted: Fit) -> Section:
    converged = "converged, but there is doubt," if fitted.doubts else "converged"
    ended = converged if fitted.converged else "ended after its last trial point"
    runs, tangents = counted(fitted.runs, "forward run"), counted(fitted.tangents, "run")
    lost = f", of which those at {counted(fitted.refused, 'point')} diverged" if fitted.refused else ""
    starts, least = counted(len(fitted.tried), "start"), min(one.misfit for one in fitted.tried)
    told = f"The fit {ended} after {runs} and {tangents} along a tangent, from {starts}{lost}."

    def in_words(u: np.ndarray) -> str:
        each = zip(fitted.labels, fitted.coordinates.numbers(u), strict=True)
        return ", ".join(f"{label.replace('_', ' ')} {number:.4g}" for label, number in each)

    rows = [(in_words(one.start), in_words(one.end), float(np.exp(one.misfit - least))) for one in fitted.tried]
    head = ("start", "where the search ended", "residuals, relative to the least")
    return Section("The fit", [told], head=head, rows=rows if len(rows) > 1 else [])


def fit_for_machines(fitted: Fit, profiles: Sequence[Profile]) -> dict[str, Any]:
    lower, upper = ({n: np.asarray(pair[k]) for n, pair in fitted.intervals().items()} for k in range(2))
    numbers = fitted.coordinates.numbers
    return {
        "parameters": {name: np.asarray(value) for name, value in fitted.values.items()},
        "standard_errors": {name: np.asarray(value) for name, value in fitted.standard_errors.items()},
        "lower_95": lower,
        "upper_95": upper,
        "labels": fitted.labels,
        "covariance": fitted.covariance,
        "not_told_apart": [list(one) for one in fitted.not_told_apart],
        "doubts": list(fitted.doubts),
        **{name: getattr(fitted, name) for name in ("converged", "runs", "tangents", "refused")},
        "bars": NOISE_ALONE,
        "starts": [{"start": numbers(t.start), "end": numbers(t.end), "misfit": t.misfit} for t in fitted.tried],
        "residuals": {one.label: one.spread for one in fitted.parts},
        "profiles": {one.label: {"values": one.values, "deviance": one.deviance} for one in profiles},
    }
