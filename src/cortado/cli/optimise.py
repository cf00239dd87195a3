"""The commands ``cortado optimise``, for inverse problems, and ``cortado fit``, for estimates with error bars."""

import math
from collections.abc import Iterable, Iterator, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from cortado.calls import counted
from cortado.cli.arguments import HERE, Where
from cortado.cli.run import RunRequest
from cortado.device.modules import compile_meanwhile
from cortado.errors import ComputationError, DivergedError, InputError
from cortado.executors import Executor
from cortado.files.disk import locked
from cortado.files.terminal import announce, keeping, say, track
from cortado.image_losses import psnr
from cortado.optimisation import solved_task
from cortado.optimisation.fitting.figures import profile_figure, residual_figure, video_figures
from cortado.optimisation.fitting.fit import NOISE_ALONE, Fit, Profile, fit, unit_of
from cortado.optimisation.optimise import Record, Result, optimise
from cortado.optimisation.solved_task import TaskFigures, component_names, knot_values
from cortado.optimisation.task_files import Setup, Task, load_task, setup, task_in_words
from cortado.pictures.film import lacking
from cortado.pictures.pages import MOST_NUMBERS, Section, scene_view, write_report, written
from cortado.pictures.painter import painter
from cortado.runs.run_folder import TO_RESUME, RunFolder
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
    """Relative L2 error of each parameter's estimate. If the true value is 0, the error is absolute."""
    psnr: float | None
    """Peak signal-to-noise ratio of the last image [dB], or None for a task without images."""
    failures: list[str]


def judge(
    task: Task, result: Result, estimate: Arrays | None = None, noise: float | None = None, first: float | None = None
) -> Verdict:
    """``estimate`` contains the found parameters if ``result`` does not contain parameters. ``noise`` is the peak
    signal-to-noise ratio of the last image [dB]. ``first`` is the initial loss, for a history that starts later."""
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
        why = "the search is too short, it ended in a wrong local minimum of the loss, or other values do as well"
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
            found.append(f"If the search is in a wrong local minimum, try another start{more}, or set {search}.")
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
