"""Round-off: up to which step the tangent of a run in each precision agrees with that of the most precise run.

If the arithmetic of the derivative amplified errors of rounding, a tangent in low precision would differ from the exact
one even along the same trajectory. This is tested by taking every step in low precision from the states of the most
precise run. If it is the trajectories that diverge, it differs only along its own trajectory, and after a time of
(digits of the precision) / (growth rate).
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np

from cortado.pictures.plots import DASHED, FAINT, INK, PALETTE
from cortado.reference import Digits, History, Simulation
from cortado.scene.tables import OneOf, Several, Vector, count, quantity
from experiments.canvas import blank
from experiments.ensembles import perturbed, side_by_side
from experiments.estimates import Estimate, Line, growth_rate, norms
from experiments.experiment import ExperimentType, Progress, SceneSettings, Window
from experiments.tables import Table

if TYPE_CHECKING:
    from matplotlib.figure import Figure

ROUND_OFF_UNIT = {"float32": 2.0**-24, "float64": 2.0**-53, "float80": 2.0**-64, "float128": 2.0**-113}
"""Half the distance from 1 to the next number."""


class RoundOffSettings(SceneSettings):
    """Settings of tangents in several precisions."""

    direction: Vector[Annotated[float, quantity("m/s2")]]
    """Direction of the change of gravity."""
    precisions: Several[Annotated[str, OneOf(ROUND_OFF_UNIT)]]
    reference: Annotated[str, OneOf(ROUND_OFF_UNIT)]
    """The precision of the reference run."""
    steps: Annotated[int, count(2, 10_000)]
    record_every: Annotated[int, count(1, 1000)]
    """Steps between two rows."""
    threshold: Annotated[float, quantity(gt=0.0, le=1.0)]
    """Relative error beyond which a tangent counts as different from the reference."""
    window: Window
    """Begin and end of the window in which the growth rate is fitted."""
    seeds: Annotated[int, count(1, 100)]
    perturbation: Annotated[float, quantity("spacings", ge=0.0)]
    """Perturbation of the first positions [spacings]."""


def measure(settings: RoundOffSettings, progress: Progress) -> Table:
    """Columns: seed, precision, step, size = |dx/dg| [s2] of the reference, own: relative error of the tangent of the
    precision's own run, same: of that along the reference's states, apart [m]: distance of the two runs."""
    parts = []
    with progress(settings.seeds * (1 + len(settings.precisions))) as advance:
        for seed in range(settings.seeds):
            simulation = Simulation(settings.scene, settings.reference)
            start = perturbed(simulation, seed, settings.perturbation).astype(np.float32).astype(np.float64)
            reference = _tangent(settings, simulation, start)
            advance()
            tasks = [partial(_rows, settings, seed, name, start, reference) for name in settings.precisions]
            parts += side_by_side(tasks, advance)
    return Table.joined(parts)


def _tangent(settings: RoundOffSettings, simulation: Simulation, start: np.ndarray) -> History:
    along = {"gravity": np.asarray(settings.direction)}
    return simulation.tangent({"initial_positions": start}, along, settings.steps)


def _rows(settings: RoundOffSettings, seed: int, precision: str, start: np.ndarray, reference: History) -> Table:
    simulation = Simulation(settings.scene, precision, threads=1)
    own = _tangent(settings, simulation, start)
    assert own.position_tangents is not None and reference.position_tangents is not None
    chosen = slice(settings.record_every, None, settings.record_every)
    sizes = norms(reference.position_tangents.high)[chosen]
    along = _along(settings, simulation, reference)
    return Table(
        {
            "seed": seed,
            "precision": precision,
            "step": reference.steps[chosen],
            "size": sizes,
            "own": norms(own.position_tangents - reference.position_tangents)[chosen] / sizes,
            "same": along[chosen] / sizes,
            "apart": norms(own.positions - reference.positions)[chosen],
        }
    )


def _along(settings: RoundOffSettings, simulation: Simulation, reference: History) -> np.ndarray:
    """Distances (steps + 1,) from the reference's tangent of one whose every step starts from a state of the
    reference."""
    assert reference.position_tangents is not None
    gravity = np.asarray(settings.direction)
    x_dot = v_dot = Digits.of(np.zeros(simulation.positions.shape))
    distances = np.zeros(settings.steps + 1)
    for step in range(settings.steps):
        state = {"initial_positions": reference.positions[step], "initial_velocities": reference.velocities[step]}
        along = {"initial_positions": x_dot, "initial_velocities": v_dot, "gravity": gravity}
        after = simulation.tangent(state, along, 1)
        assert after.position_tangents is not None and after.velocity_tangents is not None
        x_dot, v_dot = after.position_tangents[1], after.velocity_tangents[1]
        distances[step + 1] = np.linalg.norm(x_dot - reference.position_tangents[step + 1])
    return distances


def draw(table: Table, settings: RoundOffSettings) -> Figure:
    """Errors over the steps, and horizons over the digits."""
    figure = blank(13.0, 5.4)
    errors, horizons = figure.subplots(1, 2, width_ratios=(3, 2))
    figure.suptitle(settings.title)
    for k, precision in enumerate(settings.precisions):
        for seed, rows in table.where(precision=precision).groups("seed"):
            label = precision if seed == (0,) else None
            errors.semilogy(rows["step"], rows["own"], color=PALETTE[k], linewidth=1.4, label=label)
            errors.semilogy(rows["step"], rows["same"], color=PALETTE[k], **DASHED)
    errors.axhline(settings.threshold, color=FAINT, linewidth=0.8)
    errors.plot([], [], color=FAINT, label="along its own run")
    errors.plot([], [], color=FAINT, label=f"along the {settings.reference} run", **DASHED)
    errors.set(title="Error of the tangent", xlabel="step", ylabel="relative error", ylim=(1e-20, 1e2))
    errors.legend(fontsize=9, loc="center right")
    found = _horizons(table, settings)
    rate = _rate(table, settings)
    digits = {name: -np.log(ROUND_OFF_UNIT[name]) for name in settings.precisions}
    for k, precision in enumerate(settings.precisions):
        reached = [step for name, step in found if name == precision]
        horizons.plot([digits[precision]] * len(reached), reached, "o", color=PALETTE[k])
        horizons.annotate(precision, (digits[precision], max(reached, default=0)), (-8, 6), textcoords="offset points")
    if found:
        first = settings.precisions[0]
        origin = np.mean([step for name, step in found if name == first])
        x = np.array([min(digits.values()), max(digits.values())])
        predicted = origin + (x - digits[first]) / rate.value
        horizons.plot(x, predicted, color=INK, label=f"slope 1 / λ, λ = {rate} a step", **DASHED)
        horizons.legend(fontsize=9, loc="lower right")
    horizons.margins(0.12)
    horizons.set(title="Where it leaves the reference", xlabel="digits of the precision, ln(1 / u)", ylabel="step")
    return figure


def verdict(table: Table, settings: RoundOffSettings) -> list[str]:
    """The step at which each precision differs from the reference, the predicted one, and the error along one
    trajectory."""
    found, rate = _horizons(table, settings), _rate(table, settings)
    sentences = []
    grown = table["size"][table["step"] == table["step"].max()].max()
    for precision in settings.precisions:
        reached = [step for name, step in found if name == precision]
        where = f"at step {Estimate.of(reached)}" if reached else f"not within {settings.steps} steps"
        same = max(rows["same"][-1] for _, rows in table.where(precision=precision).groups("seed"))
        sentences.append(
            f"The {precision} tangent is off by {settings.threshold:.0%} {where}; along the states of the "
            f"{settings.reference} run it is off by {same:.0e} at step {settings.steps}, where the derivative has "
            f"grown to {grown:.0e} s²."
        )
    if len({name for name, _ in found}) < 2:
        return sentences
    digits = [-np.log(ROUND_OFF_UNIT[name]) for name, _ in found]
    line = Line.through(digits, [step for _, step in found])
    ratio = line.slope.over(Estimate(1.0 / rate.value, rate.error / rate.value**2))
    greatest = max(rows["same"].max() / ROUND_OFF_UNIT[name] for (name,), rows in table.groups("precision"))
    sentences.append(
        f"Horizons grow by {line.slope} steps for each factor e of precision; the growth rate, {rate} a step, predicts "
        f"{1.0 / rate.value:.3g}: {ratio} times that."
    )
    sentences.append(
        f"Round-off: in part: false as an error of the derivative, which along one trajectory never exceeds "
        f"{greatest:.0e} units of round-off; true as what parts the trajectories of two precisions."
    )
    return sentences


def _horizons(table: Table, settings: RoundOffSettings) -> list[tuple[Any, Any]]:
    """(precision, first step above the threshold) for every run that exceeds it."""
    found = []
    for (_, precision), rows in table.groups("seed", "precision"):
        above = rows["step"][rows["own"] > settings.threshold]
        found += [(precision, float(above[0]))] if len(above) else []
    return found


def _rate(table: Table, settings: RoundOffSettings) -> Estimate:
    """Of the reference's tangent."""
    first, last = settings.window
    inside = table.where(precision=settings.precisions[0])
    inside = inside.chosen((inside["step"] >= first) & (inside["step"] <= last))
    return Estimate.of([growth_rate(rows["step"], rows["size"]) for _, rows in inside.groups("seed")])


ROUND_OFF = ExperimentType("round_off", RoundOffSettings, measure, draw, verdict)
