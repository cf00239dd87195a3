"""``cortado fit``: parameters with error bars from measured experiments."""

from pathlib import Path
from typing import Any

from cortado.cli.commands.fit_report import for_machines, sections
from cortado.errors import ComputationError
from cortado.files.output_files import locked
from cortado.files.terminal import announce, track
from cortado.optimisation.fitting.fit import Fit, Profile, fit
from cortado.optimisation.inverse.fit_task import FitTask, load_fit
from cortado.pictures.report import write_report
from cortado.runs.run_folder import RunFolder


def fit_task(
    task_file: Path,
    out: Path,
    overrides: list[str],
    device: str,
    precision: str,
    overwrite: bool,
    command: list[str],
) -> str:
    """Fit, write the run folder, and return a sentence that says where the results are."""
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
