"""Finite differences as functions of their step h: where they equal the exact derivative, and where they saturate.

A central difference of step h is at most (distance of two unrelated states) / (2 h), so that a large one measures the
size of the attractor and not the derivative. Two predictions without a free parameter: it is right while h |dx/dg| is
well below the scale of nonlinearity, and |difference| 2 h / distance tends to 1 as 2 h |dx/dg| / distance grows.
"""

from __future__ import annotations

from functools import partial, reduce
from math import gcd
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np

from cortado.pictures.plots import DASHED, FAINT, INK
from cortado.reference import Simulation
from cortado.scene.tables import Several, Vector, count, quantity
from experiments.canvas import blank
from experiments.ensembles import perturbed, side_by_side
from experiments.estimates import Estimate, Line, geometric_mean, norms
from experiments.experiment import ExperimentType, Progress, SceneSettings
from experiments.palette import palette
from experiments.tables import Table

if TYPE_CHECKING:
    from matplotlib.figure import Figure

AGREES = 0.01
"""Relative error up to which a difference counts as equal to the exact derivative."""
SATURATED = 10.0
"""2 h |dx/dg| / distance from which on a difference counts as saturated."""
THIN: dict[str, Any] = {"markersize": 3.5, "linewidth": 1.4}


class StepSizeSettings(SceneSettings):
    """Settings of differences of several steps h, at several horizons."""

    direction: Vector[Annotated[float, quantity("m/s2")]]
    """Direction of the change of gravity."""
    differences: Several[Annotated[float, quantity("m/s2", gt=0.0)]]
    horizons: Several[Annotated[int, count(1, 10_000)]]
    """Numbers of time steps."""
    seeds: Annotated[int, count(2, 100)]
    """Number of first states; the distance is that of two of the runs."""
    perturbation: Annotated[float, quantity("spacings", gt=0.0)]
    """Perturbation of the first positions [spacings]."""


def measure(settings: StepSizeSettings, progress: Progress) -> Table:
    """Columns: seed, horizon, difference [m/s2], size = |difference quotient| [s2], exact = |dx/dg| [s2], error
    (relative), distance [m] between the states of this run and of that with the next seed."""
    every, longest = reduce(gcd, settings.horizons), max(settings.horizons)

    def tangent(seed: int, **way: Any) -> Any:
        simulation = Simulation(settings.scene, threads=1)
        start = {"initial_positions": perturbed(simulation, seed, settings.perturbation)}
        along = {"gravity": np.asarray(settings.direction)}
        return simulation.tangent(start, along, longest, record_every=every, **way)

    seeds = range(settings.seeds)
    ways: list[dict[str, Any]] = [{"method": "analytic"}]
    ways += [{"method": "finite_difference", "difference": h} for h in settings.differences]
    with progress(len(ways) * settings.seeds) as advance:
        runs = iter(side_by_side((partial(tangent, seed, **way) for seed in seeds for way in ways), advance))
    histories = [[next(runs) for _ in ways] for _ in seeds]
    parts = []
    for seed, (exact, *quotients) in enumerate(histories):
        other = histories[(seed + 1) % settings.seeds][0]
        sizes, distances = norms(exact.position_tangents), norms(exact.positions - other.positions)
        for difference, quotient in zip(settings.differences, quotients, strict=True):
            errors = norms(quotient.position_tangents - exact.position_tangents)
            for horizon in settings.horizons:
                frame = horizon // every
                parts.append(
                    {
                        "seed": seed,
                        "horizon": horizon,
                        "difference": difference,
                        "size": norms(quotient.position_tangents[frame : frame + 1])[0],
                        "exact": sizes[frame],
                        "error": errors[frame] / sizes[frame],
                        "distance": distances[frame],
                    }
                )
    return Table.joined(parts)


def draw(table: Table, settings: StepSizeSettings) -> Figure:
    """Sizes over the horizon, errors over the step h, and both scaled so that they lie on one curve."""
    figure = blank(15.0, 5.4)
    sizes, errors, law = figure.subplots(1, 3)
    figure.suptitle(settings.title)
    horizons, differences = table.values("horizon"), table.values("difference")
    for difference, shade in zip(differences, palette(len(differences)), strict=True):
        found = [geometric_mean(table.where(difference=difference, horizon=horizon)["size"]) for horizon in horizons]
        sizes.semilogy(horizons, found, "o-", color=shade, label=f"step {difference:.0e}", **THIN)
        rows = table.where(difference=difference)
        law.loglog(_strength(rows), _saturation(rows), "o", markersize=3.5, color=shade, alpha=0.7)
    exact = [geometric_mean(table.where(horizon=horizon)["exact"]) for horizon in horizons]
    sizes.semilogy(horizons, exact, color=INK, label="exact", **DASHED)
    sizes.set(title="Size over the horizon", xlabel="steps", ylabel="|dx / dg| [s²]")
    sizes.legend(fontsize=8)
    for horizon, shade in zip(horizons, palette(len(horizons)), strict=True):
        of_seeds = [table.where(difference=size, horizon=horizon)["error"] for size in differences]
        values = [geometric_mean(one) for one in of_seeds]
        errors.loglog(differences, values, "o-", color=shade, label=f"{horizon} steps", **THIN)
    errors.axhline(AGREES, **DASHED, color=FAINT)
    errors.set(title="Error over the step", xlabel="step h [m/s²]", ylabel="relative error")
    errors.legend(fontsize=8)
    x = np.geomspace(_strength(table).min(), _strength(table).max(), 200)
    law.loglog(x, np.minimum(x, 1.0), color=INK, label="the smaller of x and 1", **DASHED)
    law.set(title="Saturation", xlabel="x = 2 h |dx / dg| / D", ylabel="2 h |difference quotient| / D")
    law.legend(fontsize=9, loc="lower right", title="D: distance of unrelated states", title_fontsize=9)
    return figure


def verdict(table: Table, settings: StepSizeSettings) -> list[str]:
    """Whether exact derivatives are the limit of differences, up to which step h, and whether large steps saturate."""
    best = [rows["error"].min() for _, rows in table.groups("seed", "horizon")]
    last = max(settings.horizons)
    longest = [rows["error"].min() for _, rows in table.where(horizon=last).groups("seed")]
    ends, sizes = [], []
    for _, rows in table.groups("seed", "horizon"):
        agreeing = rows["difference"][rows["error"] <= AGREES]
        if len(agreeing) > 0 and agreeing.max() < max(settings.differences):
            ends.append(agreeing.max())
            sizes.append(rows["exact"][0])
    sentences = [
        f"The exact derivative is the limit of finite differences: with the best step they agree to "
        f"{np.median(best):.1g} (median of {len(best)}), at {last} steps to {np.max(longest):.1g} at worst."
    ]
    if len(ends) >= 3:
        reach = np.array(ends) * np.array(sizes)
        slope = Line.through(np.log(sizes), np.log(ends)).slope
        sentences.append(
            f"The largest step that agrees within {AGREES:.0%} falls as |dx/dg| to the power {slope} (-1 expected): it "
            f"moves the particles by {geometric_mean(reach):.0e} m in all, times or over "
            f"{np.exp(np.log(reach).std()):.0f}."
        )
    saturated = table.chosen(_strength(table) > SATURATED)
    if len(saturated) >= 3:
        slope = Line.through(np.log(saturated["difference"]), np.log(saturated["size"])).slope
        by_seed = [geometric_mean(_saturation(rows)) for _, rows in saturated.groups("seed")]
        factor = Estimate.of(by_seed)
        flat = table.where(difference=max(settings.differences), horizon=last)
        ratio = geometric_mean(flat["exact"] / flat["size"])
        sentences.append(
            f"Beyond, differences saturate: their size goes as the step to the power {slope} (-1 expected), and is "
            f"{factor} times D / (2 h) (1 expected), D the distance of two unrelated states. At {last} steps the exact "
            f"derivative is {ratio:.1g} times the difference of step {max(settings.differences):g}."
        )
        holds = abs(slope.value + 1.0) < 0.1 and 0.5 < factor.value < 2.0
        sentences.append(
            f"FD step size: {'true' if holds else 'not confirmed'}: flat finite differences come from their step, not "
            f"from a bounded derivative."
        )
    return sentences


def _strength(table: Table) -> np.ndarray:
    return 2.0 * table["difference"] * table["exact"] / table["distance"]


def _saturation(table: Table) -> np.ndarray:
    return 2.0 * table["difference"] * table["size"] / table["distance"]


STEP_SIZE = ExperimentType("step_size", StepSizeSettings, measure, draw, verdict)
