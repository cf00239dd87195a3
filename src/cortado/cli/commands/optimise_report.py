"""What ``cortado optimise`` writes about a search: the report for people, and the results for programs."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from cortado.cli.commands.found import Rows
from cortado.cli.commands.verdict import Verdict
from cortado.optimisation.inverse.in_words import task_in_words
from cortado.optimisation.inverse.knots import KnotValues
from cortado.optimisation.inverse.setup import Setup
from cortado.optimisation.inverse.task_figures import TaskFigures
from cortado.optimisation.result import Result
from cortado.pictures.particle_view import scene_view
from cortado.pictures.report import Section
from cortado.scene.scene import scene_in_words

MOST_NUMBERS = 1000
"""Of a parameter whose estimate is in result.json; larger ones are in the checkpoint."""
VIEWED = 60
"""States of a run that the view in the report shows at most."""


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
    """The report, in the order in which one would tell it; ``told``: what was found, in words."""
    head = ("", "unit", "first guess", "found", "hidden", "error")
    return [
        asked(made),
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
    """What came out, by names."""
    found: dict[str, Any] = {
        "evaluations": len(result.history),
        "refused": result.refused,
        "left_out": result.left_out,
        "first_loss": verdict.first,
        "loss": result.loss,
        "loss_reduction": verdict.reduction,
        "parameter_error": verdict.errors,
        "parameters": {name: value for name, value in estimate.items() if np.size(value) <= MOST_NUMBERS},
        "knots": {name: one.for_machines() for name, one in knots.items()},
        "converged": result.converged,
        "message": result.message,
        "misled": result.misled,
        "stays": result.stays,
        "failures": verdict.failures,
    }
    return found if verdict.psnr is None else {**found, "psnr": verdict.psnr}
