"""``cortado optimise``: solve the inverse problem of a task, resume the search, and judge the result.

``cortado fit``: estimate parameters with error bars from measured experiments, and write a report.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from cortado.calls import counted
from cortado.cli.arguments import HERE, Where
from cortado.cli.optimise_report import (
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
from cortado.errors import ComputationError, DivergedError, InputError
from cortado.executors import Executor
from cortado.files.disk import locked
from cortado.files.terminal import announce, keeping, say, track
from cortado.image_losses import psnr
from cortado.optimisation.fitting.figures import profile_figure, residual_figure, video_figures
from cortado.optimisation.fitting.fit import NOISE_ALONE, Fit, Profile, fit, unit_of
from cortado.optimisation.optimise import Record, Result, optimise
from cortado.optimisation.solved_task import (
    FitTask,
    TaskFigures,
    begin_shaded,
    knot_values,
    load_fit,
    shaded_figures,
    task_figures,
)
from cortado.optimisation.task_files import Setup, Task, load_task, setup
from cortado.pictures.film import lacking
from cortado.pictures.pages import Section, write_report
from cortado.runs.run_folder import TO_RESUME, RunFolder
from cortado.scene.scene import scene_in_words

LITTLE = 2.0
"""Factor by which a search must reduce the loss to count as successful."""
LONG = 100
"""Number of steps from which on chaotic, useless gradients may explain an unsuccessful search."""


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
    """Optimise a task, write the run folder, and return a sentence that names the results; ``where`` computes
    ensembles."""
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
    """Create a run folder, or open the existing one; a resumed search may have other iterations and another check."""
    task, simulation = made.task, made.problem.simulation
    settings = search_settings(task, simulation.precision.name)
    noted: dict[str, Any] = {"kind": "optimise", "settings": settings, "device": str(simulation.device)}
    if resume:
        return RunFolder.resume(out, task.scene.to_json(), command, **noted)
    return RunFolder.create(out, task.scene.to_json(), command, overwrite=overwrite, **noted)


def search_settings(task: Task, precision: str) -> dict[str, Any]:
    """Return the settings which, like the scene, must be unchanged when a search is resumed."""
    return {
        "precision": precision,
        "problem": task.problem.model_dump(),
        "optimise": task.optimise.model_dump(exclude={"iterations", "check"}),
    }


def _kept(folder: RunFolder) -> str:
    """Say where the evaluations are stored; empty before the first evaluation."""
    return f"the evaluations so far are in {folder.checkpoint}" if folder.read_metrics() else ""


def _solved(made: Setup, folder: RunFolder, resume: bool, executor: Executor, pictures: bool) -> str:
    """Run the search, judge its result and write all files; return a sentence that names the results."""
    missing = lacking(made.task.scene) if pictures else None
    if missing:
        say(missing)
    shades = pictures and not missing
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


def _search(made: Setup, folder: RunFolder, resume: bool, executor: Executor) -> Result:
    settings = made.task.optimise
    known = len(folder.read_metrics()) if resume else 0
    history: list[Record] = []
    start, shown, updates, refused, left_out = made.start, 0, 0, 0, 0
    with track(len(made.searches) * settings.iterations, "optimise") as advance:

        def show(made: int, **fields: Any) -> None:
            """Update the progress bar after ``made`` updates of this search; an earlier search may have ended early."""
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
    """Return advice if a search reduced the loss too little, had wrong gradients, may be in a wrong local minimum, or
    ended on a bound."""
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
    """Test whether a coordinate of a parameter is on its lower or upper bound."""
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


COUNTED = (
    "The last column is what the error would be if every number that was measured were independent of all others: it "
    "shows how much correlation matters."
)
_START_HEAD = ("start", "where the search ended", "residuals, relative to the least")


def fit_task(
    task_file: Path, out: Path, overrides: list[str], device: str, precision: str, overwrite: bool, command: list[str]
) -> str:
    """Fit the parameters of a task, write the run folder, and return a sentence that names the results."""
    task = load_fit(task_file, overrides)
    experiments = [one.experiment(device, precision) for one in task.experiments]
    with locked(out):
        settings = {"precision": precision, "fit": task.fit.model_dump()}
        noted: dict[str, Any] = {"kind": "fit", "settings": settings, "device": device}
        folder = RunFolder.create(out, task.scene.to_json(), command, overwrite=overwrite, **noted)
        with track(2 * task.fit.iterations, "fit") as advance:
            given = task.fit
            fitted = fit(experiments, given.start, given.bounds, given.iterations, lambda: advance(1), given.starts)
        announce(str(fitted))
        profiles = _profiles(task, fitted)
        write_report(folder, task.scene.name, fit_sections(task, fitted, profiles, folder.figures))
        folder.write_result(**fit_for_machines(fitted, profiles))
    if not fitted.converged:
        raise ComputationError(
            f"The fit has not converged in {task.fit.iterations} trial points: increase fit.iterations, or start "
            f"nearer to the expected values. The results are in {folder.path}."
        )
    doubted = " They are in doubt, as said above." if fitted.in_doubt else ""
    return f"The results are in {folder.path}; open report.html.{doubted}"


def _profiles(task: FitTask, fitted: Fit) -> list[Profile]:
    if not task.fit.profiles:
        return []
    with track(len(fitted.labels), "profiles") as advance:
        found = []
        for label in fitted.labels:
            found.append(fitted.profile(label, task.fit.profiles))
            advance(1)
    return found


def fit_sections(task: FitTask, fitted: Fit, profiles: Sequence[Profile], folder: Path) -> list[Section]:
    head = ("", "unit", "start", "found", "standard error", "95 %, from", "to", "degrees of freedom", "counted error")
    noise = ("", "unit", "frames", "numbers", "residuals", "noise", "correlation time [s]", "independent frames")
    return [
        Section("What was asked", _asked(task, fitted)),
        Section("What was found", fitted.lines(), [*_apart(fitted), *fitted.doubts]),
        Section("In numbers", [NOISE_ALONE, COUNTED], head=head, rows=_rows(fitted)),
        Section("Measured and found", figures=video_figures(fitted, folder)),
        Section(
            "Residuals", figures=residual_figure(fitted, folder / "residuals.png"), head=noise, rows=_parts(fitted)
        ),
        Section("Profiles", figures=profile_figure(profiles, folder / "profiles.png")),
        Section("Correlations", head=("", *fitted.labels), rows=_correlations(fitted)),
        Section("The fit", [_effort(fitted)], head=_START_HEAD, rows=_starts(fitted)),
    ]


def _asked(task: FitTask, fitted: Fit) -> list[str]:
    particles = [one.simulation.particles for one in fitted.problem.experiments] if fitted.problem else []
    found = []
    for one, count in zip(task.experiments, particles, strict=True):
        what = ", ".join(f"{table.name} ({table.file})" for table in one.problem.measured)
        found.append(f"What was measured: {what}. The scene: {scene_in_words(one.scene, count)}")
    names = [name.replace("_", " ") for name in fitted.coordinates.names]
    return [f"Which {', '.join(names)} makes the simulation do what was measured?", *found]


def _apart(fitted: Fit) -> list[str]:
    return [
        f"{a} and {b} are hardly told apart: a change of both together changes little of what was measured (their "
        f"estimates have a correlation of {c:.3f})."
        for a, b, c in fitted.not_told_apart
    ]


def _rows(fitted: Fit) -> list[tuple[object, ...]]:
    counted_errors = np.sqrt(np.diag(fitted.naive_covariance)) * fitted.coordinates.slopes(fitted.u)
    each = zip(fitted.numbers(), fitted.degrees_of_freedom, counted_errors, strict=True)
    return [
        (
            *(one.label.replace("_", " "), unit_of(one.label), one.start, one.value, one.error, one.lower, one.upper),
            *(round(float(freedom), 1), float(error)),
        )
        for one, freedom, error in each
    ]


def _parts(fitted: Fit) -> list[tuple[object, ...]]:
    return [
        (
            one.label,
            one.part.observation.unit,
            *one.residuals.shape,
            one.spread,
            "" if one.part.observation.noise is None else one.part.observation.noise,
            one.correlation_time,
            round(one.frames, 1),
        )
        for one in fitted.parts
    ]


def _correlations(fitted: Fit) -> list[tuple[object, ...]]:
    if len(fitted.labels) < 2:
        return []
    return [(a, *(round(float(c), 3) for c in row)) for a, row in zip(fitted.labels, fitted.correlation, strict=True)]


def _starts(fitted: Fit) -> list[tuple[object, ...]]:
    if len(fitted.tried) < 2:
        return []
    least = min(one.misfit for one in fitted.tried)

    def in_words(u: np.ndarray) -> str:
        each = zip(fitted.labels, fitted.coordinates.numbers(u), strict=True)
        return ", ".join(f"{label.replace('_', ' ')} {number:.4g}" for label, number in each)

    return [(in_words(one.start), in_words(one.end), float(np.exp(one.misfit - least))) for one in fitted.tried]


def _effort(fitted: Fit) -> str:
    converged = "converged, but there is doubt," if fitted.doubts else "converged"
    ended = converged if fitted.converged else "ended after its last trial point"
    runs, tangents = counted(fitted.runs, "forward run"), counted(fitted.tangents, "run")
    lost = f", of which those at {counted(fitted.refused, 'point')} diverged" if fitted.refused else ""
    starts = counted(len(fitted.tried), "start")
    return f"The fit {ended} after {runs} and {tangents} along a tangent, from {starts}{lost}."


def fit_for_machines(fitted: Fit, profiles: Sequence[Profile]) -> dict[str, Any]:
    """Return the results of a fit by name, for result.json."""
    lower, upper = ({n: np.asarray(pair[k]) for n, pair in fitted.intervals().items()} for k in range(2))
    return {
        "parameters": {name: np.asarray(value) for name, value in fitted.values.items()},
        "standard_errors": {name: np.asarray(value) for name, value in fitted.standard_errors.items()},
        "lower_95": lower,
        "upper_95": upper,
        "labels": fitted.labels,
        "covariance": fitted.covariance,
        "not_told_apart": [list(one) for one in fitted.not_told_apart],
        "doubts": list(fitted.doubts),
        "converged": fitted.converged,
        "runs": fitted.runs,
        "tangents": fitted.tangents,
        "refused": fitted.refused,
        "bars": NOISE_ALONE,
        "starts": [
            {
                "start": fitted.coordinates.numbers(one.start),
                "end": fitted.coordinates.numbers(one.end),
                "misfit": one.misfit,
            }
            for one in fitted.tried
        ],
        "residuals": {one.label: one.spread for one in fitted.parts},
        "profiles": {one.label: {"values": one.values, "deviance": one.deviance} for one in profiles},
    }
