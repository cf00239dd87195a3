"""The derivative by the report's equations as printed, compared with the corrected one and with finite differences.

It measures the error of a single step, from states of the run, and the growth over many steps, beside that of the
corrected derivative.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np

from cortado.pictures.plots import DASHED, INK, PALETTE
from cortado.reference import History, Simulation
from cortado.scene.tables import Vector, count, quantity
from experiments.canvas import blank
from experiments.ensembles import perturbed, side_by_side
from experiments.estimates import Estimate, geometric_mean, growth_rate, norms
from experiments.experiment import ExperimentType, Progress, SceneSettings, Window
from experiments.tables import Table

if TYPE_CHECKING:
    from matplotlib.figure import Figure

NAMES = {
    "analytic": "exact",
    "finite_difference": "finite difference",
    "as_printed": "as printed",
    "as_printed_right_viscosity": "as printed, γ = 2 (d + 2) μ",
    "as_printed_predicted_density": "as printed, predicted density in (12)",
}
EXACT, DIFFERENCE, *PRINTED = NAMES


class WrongDerivationSettings(SceneSettings):
    """Settings of tangents by several methods, over many steps and over single ones."""

    direction: Vector[Annotated[float, quantity("m/s2")]]
    """Direction of the change of gravity."""
    steps: Annotated[int, count(2, 10_000)]
    record_every: Annotated[int, count(1, 1000)]
    """Steps between two rows, and between two states from which a single step is measured."""
    window: Window
    """Begin and end of the window in which growth rates are fitted."""
    seeds: Annotated[int, count(1, 100)]
    perturbation: Annotated[float, quantity("spacings", ge=0.0)]
    """Perturbation of the first positions [spacings]."""
    difference: Annotated[float, quantity("m/s2", gt=0.0)]
    """Step of the finite differences over many steps."""
    single_difference: Annotated[float, quantity(gt=0.0)]
    """Step of the finite differences over a single time step, relative to the size of the tangent."""


def measure(settings: WrongDerivationSettings, progress: Progress) -> Table:
    """Columns: seed, method, step, size = |dx/dg| [s2], error of it (relative), and single: the relative error of the
    velocities' derivative after one step along the exact tangent of that step."""
    tasks = [partial(_rows, settings, seed, method) for seed in range(settings.seeds) for method in NAMES]
    with progress(len(tasks)) as advance:
        return Table.joined(side_by_side(tasks, advance))


def _rows(settings: WrongDerivationSettings, seed: int, method: str) -> Table:
    simulation = Simulation(settings.scene, threads=1)
    start = {"initial_positions": perturbed(simulation, seed, settings.perturbation)}
    tangent = partial(
        simulation.tangent,
        start,
        {"gravity": np.asarray(settings.direction)},
        settings.steps,
        record_every=settings.record_every,
    )
    exact = tangent(method=EXACT)
    found = tangent(method=method, difference=settings.difference) if method != EXACT else exact
    assert exact.position_tangents is not None and found.position_tangents is not None
    sizes = norms(exact.position_tangents)[1:]
    return Table(
        {
            "seed": seed,
            "method": method,
            "step": exact.steps[1:],
            "size": norms(found.position_tangents)[1:],
            "error": norms(found.position_tangents - exact.position_tangents)[1:] / sizes,
            "single": [_single(settings, simulation, exact, frame, method) for frame in range(1, len(sizes) + 1)],
        }
    )


def _single(settings: WrongDerivationSettings, simulation: Simulation, run: History, frame: int, method: str) -> float:
    """The error of one step from a state of the run, along its tangent scaled to 1 m."""
    assert run.position_tangents is not None and run.velocity_tangents is not None
    state = {"initial_positions": run.positions[frame], "initial_velocities": run.velocities[frame]}
    scale = norms(run.position_tangents[frame].high[None])[0]
    along = {
        "initial_positions": run.position_tangents[frame].high / scale,
        "initial_velocities": run.velocity_tangents[frame].high / scale,
    }

    def after(**way: Any) -> np.ndarray:
        tangents = simulation.tangent(state, along, 1, **way).velocity_tangents
        assert tangents is not None
        return tangents.high[1]

    right = after(method=EXACT)
    wrong = after(method=method, difference=settings.single_difference) - right
    return float(np.linalg.norm(wrong) / np.linalg.norm(right))


def draw(table: Table, settings: WrongDerivationSettings) -> Figure:
    """Norms over the steps, and errors of single steps."""
    figure = blank(13.0, 5.4)
    sizes, singles = figure.subplots(1, 2)
    figure.suptitle(settings.title)
    for k, (method, name) in enumerate(NAMES.items()):
        style: dict[str, Any] = {"color": PALETTE[k], "label": name}
        if method == EXACT:
            style = {"color": INK, "label": name, "linewidth": 3.5, "alpha": 0.45}
        if method == DIFFERENCE:
            style |= DASHED
        rows = table.where(method=method)
        for seed in rows.values("seed"):
            one = rows.where(seed=seed)
            sizes.semilogy(one["step"], one["size"], **style)
            if method != EXACT:
                singles.semilogy(one["step"], one["single"], **style)
            style["label"] = None
    exact = table.where(method=EXACT)["size"]
    sizes.set_ylim(0.5 * exact.min(), 1e4 * exact.max())
    sizes.set(title="Over many steps", xlabel="step", ylabel="|dx / dg| [s²]")
    singles.set(title="One step from states of the run", xlabel="step", ylabel="relative error of dv")
    sizes.legend(fontsize=9)
    singles.legend(fontsize=9)
    return figure


def verdict(table: Table, settings: WrongDerivationSettings) -> list[str]:
    """The error, the growth rate, and the growth rate of the corrected derivative."""
    late = table.chosen(table["step"] >= settings.window[0])
    rates = {method: _rate(table.where(method=method), settings) for method in NAMES}
    right = np.median(late.where(method=DIFFERENCE)["single"])
    sentences = [
        f"One step of the exact derivative agrees with finite differences to {right:.0e} (median over the steps from "
        f"{settings.window[0]:g} on)."
    ]
    for method in PRINTED:
        rows = late.where(method=method)
        by_seed = Estimate.of([np.median(one["single"]) for _, one in rows.groups("seed")])
        last = rows.where(step=settings.steps)["size"] / late.where(method=EXACT, step=settings.steps)["size"]
        factor = geometric_mean(last)
        name = NAMES[method][0].upper() + NAMES[method][1:]
        times = f"{factor:.1g} times the exact one's" if np.isfinite(factor) else "beyond float64"
        sentences.append(
            f"{name}, one step is wrong by {_percent(by_seed)}; the size grows by {rates[method]} a step, and at step "
            f"{settings.steps} is {times}."
        )
    share = rates[EXACT].over(rates["as_printed"])
    sentences.append(
        f"Wrong derivation: in part: the printed equations are wrong and blow up ({rates['as_printed']} a step), but "
        f"the exact derivative grows too, by {rates[EXACT]} a step, {share} of that rate."
    )
    return sentences


def _rate(rows: Table, settings: WrongDerivationSettings) -> Estimate:
    """Growth within the window, or over all steps before the norm overflows where that is earlier."""
    first, last = settings.window
    finite = rows.chosen(np.isfinite(rows["size"]))
    inside = rows.chosen((rows["step"] >= first) & (rows["step"] <= last))
    chosen = inside if np.isfinite(inside["size"]).all() else finite
    return Estimate.of([growth_rate(one["step"], one["size"]) for _, one in chosen.groups("seed")])


def _percent(found: Estimate) -> str:
    return f"{Estimate(100.0 * found.value, 100.0 * found.error)} %"


WRONG_DERIVATION = ExperimentType("wrong_derivation", WrongDerivationSettings, measure, draw, verdict)
