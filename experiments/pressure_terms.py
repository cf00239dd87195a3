"""The report's Figure 7: the derivative of the pressure force with one of its two terms at a time.

It measures a tangent that is propagated with that term only, and the size of each term in one step along the exact
tangent.
"""

from typing import TYPE_CHECKING, Annotated, Any

import numpy as np

from cortado.pictures.plots import PALETTE
from cortado.reference import Terms
from cortado.scene.tables import OneOf, Several, count
from experiments.canvas import blank
from experiments.comparison import growth
from experiments.experiment import ExperimentType, Progress, SceneSettings
from experiments.gravity_tangents import COST, LABEL, along_gravity, row
from experiments.sources import ReferenceTangent
from experiments.tables import Table
from experiments.term_sizes import term_sizes

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FULL, HESSIAN, DENSITY = "both terms", "Hessian term alone", "density term alone"
TERMS = {FULL: Terms(), HESSIAN: Terms(density=False), DENSITY: Terms(hessian=False)}
PROPAGATED, ONE_STEP = "propagated", "in one step"


class PressureTerms(SceneSettings):
    """Settings."""

    steps: Annotated[int, count(8, 1_000_000)]
    """Steps of the run."""
    precisions: Several[Annotated[str, OneOf(COST)]]
    """Precisions of the reference engine."""
    impact: Annotated[int, count(0, 1_000_000)]
    """The step from which on growth is measured: when the fluid has hit the floor."""


def measure(settings: PressureTerms, progress: Progress) -> Table:
    scene, steps, rows = settings.scene, settings.steps, []
    last = settings.precisions[-1]
    with progress(len(TERMS) * (sum(COST[precision] for precision in settings.precisions) + COST[last])) as advance:
        for precision in settings.precisions:
            for name, terms in TERMS.items():
                history, distance = along_gravity(scene, steps, ReferenceTangent(precision, terms=terms))
                rows.append(row(history, distance, quantity=PROPAGATED, precision=precision, terms=name))
                advance(COST[precision])
        for name, norms in term_sizes(scene, steps, last, TERMS).items():
            keys = {"quantity": ONE_STEP, "precision": last, "terms": name}
            rows.append({**keys, "step": np.arange(steps), "norm": norms, "distance": np.nan})
            advance(COST[last])
    return Table.joined(rows)


def draw(table: Table, settings: PressureTerms) -> "Figure":
    figure = blank(12.5, 5.4)
    left, right = figure.subplots(1, 2)
    for axes, quantity in ((left, PROPAGATED), (right, ONE_STEP)):
        for dashes, precision in zip(("-", (0, (4, 3)), ":", "-."), reversed(settings.precisions), strict=False):
            for k, name in enumerate(TERMS):
                rows = table.where(quantity=quantity, precision=precision, terms=name)
                rows = rows.chosen(rows["norm"] > 0.0)
                style: dict[str, Any] = {"linestyle": dashes, "color": PALETTE[k], "label": f"{name}, {precision}"}
                if quantity == ONE_STEP and name == FULL:
                    style |= {"linewidth": 5.0, "alpha": 0.45}  # the density term lies on it
                axes.plot(rows["step"], rows["norm"], **style)
        axes.set(yscale="log", xlabel="step")
    left.set(title="The tangent, propagated with these terms", ylabel=LABEL)
    right.set(title=f"What they do to the exact tangent in one step, {settings.precisions[-1]}", ylabel="|da/dg|  [-]")
    left.legend(loc="upper left")
    figure.suptitle(settings.title, weight="bold")
    return figure


def verdict(table: Table, settings: PressureTerms) -> list[str]:
    sentences = []
    for precision in settings.precisions:
        ends, rates = {}, {}
        for name in TERMS:
            rows = table.where(quantity=PROPAGATED, precision=precision, terms=name)
            late = rows.chosen(rows["step"] >= settings.impact)
            ends[name], rates[name] = rows["norm"][-1], growth(late["step"], late["norm"])
        found = [f"{ends[name]:.3g} s² with the {name} ({rates[name]})" for name in (HESSIAN, DENSITY)]
        sentences.append(
            f"In {precision} a tangent of {settings.steps} steps ends at {ends[FULL]:.3g} s² with both terms "
            f"({rates[FULL]}), at {found[0]}, at {found[1]}: without the Hessian term it is "
            f"{ends[DENSITY] / ends[FULL]:.2g} times as large, without the density term "
            f"{ends[HESSIAN] / ends[FULL]:.2g} times."
        )
    sizes = {
        name: rows["norm"][rows["step"] >= settings.impact]
        for (name,), rows in table.where(quantity=ONE_STEP).groups("terms")
    }
    low, median, high = np.quantile(sizes[DENSITY] / sizes[HESSIAN], (0.25, 0.5, 0.75))
    sentences.append(
        f"In one step from the exact tangent, from step {settings.impact} on, the density term is {median:.2g} times "
        f"as large as the Hessian term (quartiles {low:.2g} to {high:.2g})."
    )
    return sentences


PRESSURE_TERMS = ExperimentType("pressure_terms", PressureTerms, measure, draw, verdict)
