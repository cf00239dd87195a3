"""Adjoints that Warp's tape gets silently wrong, compared with right ones over the horizon.

The same step is put on the tape in several ways: with sums in functions, as in Cortado; with loops in the kernel whose
sums are used linearly, which must be just as right; and with a loop whose sum is not. All are compared with the
gradient of the C++ engine, which shares no code with them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

import numpy as np

from cortado import gradients, losses, reference
from cortado.pictures.plots import DASHED, INK, PALETTE
from cortado.problem import Problem
from cortado.scene.tables import Several, count, quantity
from cortado.simulation import Simulation
from experiments.canvas import blank
from experiments.ensembles import perturbed
from experiments.estimates import Estimate, geometric_mean, growth_rate
from experiments.experiment import DeviceSettings, ExperimentType, Progress, SceneSettings
from experiments.one_kernel_loops import OneKernelTape
from experiments.tables import Table

if TYPE_CHECKING:
    from matplotlib.figure import Figure

RIGHT, LINEAR, CLAMP, WALLS = "sums in functions", "linear after the loop", "clamp after it", "wall relaxation after it"
WAYS: dict[str, gradients.GradientEstimator] = {
    RIGHT: gradients.Tape(),
    LINEAR: OneKernelTape(("density", "force")),
    CLAMP: OneKernelTape(("pressure",)),
    WALLS: OneKernelTape(("wall_relaxation",)),
}
STYLES: dict[str, dict[str, Any]] = {
    RIGHT: {"color": PALETTE[0], "linewidth": 5.0, "alpha": 0.4, "markersize": 9},
    LINEAR: {"color": PALETTE[0]},
    CLAMP: {"color": PALETTE[6]},
    WALLS: {"color": PALETTE[1]},
}
PARAMETERS = ("gravity", "initial_positions")


class WrongAdjointsSettings(SceneSettings, DeviceSettings):
    """Settings. The loss is the distance from the first state, which is one in the middle of a splash."""

    start: Annotated[int, count(0, 10_000)]
    """Time steps before the first state."""
    horizons: Several[Annotated[int, count(1, 10_000)]]
    """Numbers of time steps after it."""
    seeds: Annotated[int, count(1, 100)]
    perturbation: Annotated[float, quantity("spacings", ge=0.0)]
    """Perturbation of the positions before the first step [spacings]."""


def measure(settings: WrongAdjointsSettings, progress: Progress) -> Table:
    """Columns: seed, horizon, way, parameter, size of the gradient, exact size, error (relative)."""
    engine, simulation = reference.Simulation(settings.scene), Simulation(settings.scene, settings.device, "float64")
    rows = []
    with progress(settings.seeds * len(settings.horizons) * len(WAYS)) as advance:
        for seed in range(settings.seeds):
            state = _state(settings, engine, seed)
            target = state["initial_positions"]
            for horizon in settings.horizons:
                at = {"gravity": np.array(settings.scene.forces.gravity), **state}
                exact = engine.gradient(at, horizon, reference.FinalPositions(target)).parameters
                problem = Problem(simulation, horizon, losses.FinalPositions(target))
                for way, estimator in WAYS.items():
                    _, gradient = problem.value_and_gradient(at, estimator)
                    for parameter in PARAMETERS:
                        right = exact[parameter].high
                        size = np.linalg.norm(right)
                        rows.append(
                            {
                                "seed": seed,
                                "horizon": horizon,
                                "way": way,
                                "parameter": parameter,
                                "size": np.linalg.norm(gradient[parameter]),
                                "exact": size,
                                "error": np.linalg.norm(gradient[parameter] - right) / size,
                            }
                        )
                    advance()
    return Table.joined(rows)


def _state(settings: WrongAdjointsSettings, engine: reference.Simulation, seed: int) -> dict[str, np.ndarray]:
    start = perturbed(engine, seed, settings.perturbation)
    if settings.start == 0:
        return {"initial_positions": start, "initial_velocities": engine.velocities}
    run = engine.run(settings.start, {"initial_positions": start}, record_every=settings.start)
    return {"initial_positions": run.positions.high[-1], "initial_velocities": run.velocities.high[-1]}


def draw(table: Table, settings: WrongAdjointsSettings) -> Figure:
    """Errors for each parameter, and sizes."""
    figure = blank(15.0, 5.4)
    *errors, sizes = figure.subplots(1, 3)
    figure.suptitle(settings.title)
    horizons = table.values("horizon")
    for axes, parameter in zip(errors, PARAMETERS, strict=True):
        for way in WAYS:
            found = [geometric_mean(table.where(parameter=parameter, way=way, horizon=h)["error"]) for h in horizons]
            axes.loglog(horizons, found, **{"marker": "o", "markersize": 4, "label": way, **STYLES[way]})
        axes.set(title=f"Gradient by {parameter.replace('_', ' ')}", xlabel="steps", ylabel="relative error")
    errors[0].legend(fontsize=9)
    for way in WAYS:
        rows = table.where(parameter="gravity", way=way)
        found = [geometric_mean(rows.where(horizon=horizon)["size"]) for horizon in horizons]
        sizes.loglog(horizons, found, **{"marker": "o", "markersize": 4, **STYLES[way]})
    exact = [geometric_mean(table.where(parameter="gravity", horizon=horizon)["exact"]) for horizon in horizons]
    sizes.loglog(horizons, exact, color=INK, label="C++ engine", **DASHED)
    sizes.set(title="Size of the gradient by gravity", xlabel="steps", ylabel="|dL / dg| [m s²]")
    sizes.legend(fontsize=9)
    return figure


def verdict(table: Table, settings: WrongAdjointsSettings) -> list[str]:
    """The error of each way after one step and at the end, and whether its gradient grows faster than the right one."""
    last = max(settings.horizons)
    sentences = []
    for way in WAYS:
        for parameter in PARAMETERS:
            rows = table.where(way=way, parameter=parameter)
            text = ", ".join(
                f"{geometric_mean(rows.where(horizon=horizon)['error']):.1g} after {horizon}"
                for horizon in (min(settings.horizons), sorted(settings.horizons)[len(settings.horizons) // 2], last)
            )
            name = f"{way[0].upper()}{way[1:]}"
            sentences.append(f"{name}, by {parameter.replace('_', ' ')}: relative error {text} steps.")
    rates = {way: _rate(table.where(way=way, parameter="gravity")) for way in (RIGHT, CLAMP)}
    least = table.where(way=CLAMP)["error"].min()
    sentences.append(
        f"Wrong adjoints: in part: a sum and the clamp of the pressure in one kernel are wrong by at least {least:.0%} "
        f"from the first step on, and their gradient by gravity grows by {rates[CLAMP]} a step; but the right one, "
        f"which is that of the engine, grows too, by {rates[RIGHT]}."
    )
    return sentences


def _rate(rows: Table) -> Estimate:
    """Growth of the gradient's norm over the longer half of the horizons."""
    half = np.median(rows["horizon"])
    late = rows.chosen(rows["horizon"] >= half)
    return Estimate.of([growth_rate(one["horizon"], one["size"]) for _, one in late.groups("seed")])


WRONG_ADJOINTS = ExperimentType("wrong_adjoints", WrongAdjointsSettings, measure, draw, verdict)
