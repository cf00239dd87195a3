"""``cortado fit``: parameters with error bars from measured experiments, and the report of them."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cortado.calls import counted
from cortado.errors import ComputationError
from cortado.files.disk import locked
from cortado.files.terminal import announce, track
from cortado.optimisation.fitting.figures import profile_figure, residual_figure, video_figures
from cortado.optimisation.fitting.fit import NOISE_ALONE, Fit, Profile, fit, unit_of
from cortado.optimisation.inverse.solved_task import FitTask, load_fit
from cortado.pictures.pages import Section, write_report
from cortado.runs.run_folder import RunFolder
from cortado.scene.scene import scene_in_words

COUNTED = (
    "The last column is what the error would be if every number that was measured were independent of all others: it "
    "shows how much correlation matters."
)
_START_HEAD = ("start", "where the search ended", "residuals, relative to the least")


def fit_task(
    task_file: Path,
    out: Path,
    overrides: list[str],
    device: str,
    precision: str,
    overwrite: bool,
    command: list[str],
) -> str:
    """Fit the parameters of a task, write the run folder, and return a sentence that says where the results are."""
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
        write_report(folder, task.scene.name, sections(task, fitted, profiles, folder.figures))
        folder.write_result(**for_machines(fitted, profiles))
    if not fitted.converged:
        raise ComputationError(
            f"The fit has not converged in {task.fit.iterations} trial points: give fit.iterations more, or a start "
            f"nearer to what you expect. The results are in {folder.path}."
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


def sections(task: FitTask, fitted: Fit, profiles: Sequence[Profile], folder: Path) -> list[Section]:
    """Return the sections of the report of a fit, in the order in which one would tell it."""
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


def for_machines(fitted: Fit, profiles: Sequence[Profile]) -> dict[str, Any]:
    """Return the results of a fit by names."""
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
