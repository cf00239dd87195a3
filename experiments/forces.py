"""The report's Figures 5 and 6: the norm of the gradient over the steps with forces left out, by finite differences
and analytic."""

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np

from cortado.pictures.plots import DASHED, PALETTE
from cortado.reference import Terms
from cortado.scene.tables import OneOf, Several, count, quantity
from experiments.canvas import blank
from experiments.comparison import growth
from experiments.experiment import ExperimentType, Progress, SceneSettings
from experiments.gravity_tangents import COST, LABEL, along_gravity, row
from experiments.scenes import varied
from experiments.sources import ReferenceTangent
from experiments.tables import Table

if TYPE_CHECKING:
    from matplotlib.figure import Figure

ANALYTIC = 0.0
"""The step of the analytic derivative: the limit of the differences."""
SAME = 0.1
"""Relative distance up to which a difference counts as equal to the derivative."""


@dataclass(frozen=True)
class Ablation:
    """Which forces and terms are left out."""

    changes: dict[str, Any] = field(default_factory=dict)
    """Replacements in the scene, which change the run itself."""
    terms: Terms | None = None
    """Terms that are kept in the derivative alone; None for all."""


NO_PRESSURE, NO_VISCOSITY = {"pressure": False}, {"viscosity": "none"}
FULL = "all forces"
ABLATIONS = {
    FULL: Ablation(),
    "no viscosity": Ablation({"forces": NO_VISCOSITY}),
    "no pressure": Ablation({"forces": NO_PRESSURE}),
    "neither": Ablation({"forces": NO_PRESSURE | NO_VISCOSITY}),
    "pressure without its derivative": Ablation(terms=Terms(pressure=False)),
}


class Forces(SceneSettings):
    """Settings."""

    steps: Annotated[int, count(8, 1_000_000)]
    """Steps of the run."""
    precision: Annotated[str, OneOf(COST)] = "float64"
    """Precision of the reference engine."""
    differences: Several[Annotated[float, quantity("m/s2", gt=0.0)]] = ()
    """Steps of finite differences [m / s2]; without any, the picture is of the analytic derivative."""
    impact: Annotated[int, count(0, 1_000_000)]
    """The step from which on growth is measured: when the fluid has hit the floor."""


def measure(settings: Forces, progress: Progress) -> Table:
    sources = {h: ReferenceTangent(settings.precision, "finite_difference", difference=h) for h in settings.differences}
    rows = []
    with progress(len(ABLATIONS) * (len(sources) + 1)) as advance:
        for name, ablation in ABLATIONS.items():
            scene = varied(settings.scene, **ablation.changes)
            analytic = ReferenceTangent(settings.precision, terms=ablation.terms)
            chosen = {ANALYTIC: analytic, **({} if ablation.terms else sources)}
            for step, source in chosen.items():
                rows.append(row(*along_gravity(scene, settings.steps, source), forces=name, difference=step))
                advance()
    return Table.joined(rows)


def draw(table: Table, settings: Forces) -> "Figure":
    shown = settings.differences or (ANALYTIC,)
    figure = blank(4.0 + 4.5 * len(shown), 5.2)
    panels = figure.subplots(1, len(shown), sharey=True, squeeze=False)[0]
    for axes, difference in zip(panels, shown, strict=True):
        for k, (name, ablation) in enumerate(ABLATIONS.items()):
            rows = table.where(forces=name, difference=difference)
            if len(rows):
                axes.plot(rows["step"], rows["norm"], **_style(k, ablation), label=name)
        if difference != ANALYTIC:
            rows = table.where(forces=FULL, difference=ANALYTIC)
            axes.plot(rows["step"], rows["norm"], **DASHED, color=PALETTE[0], label=f"{FULL}, analytic")
        axes.set(yscale="log", xlabel="step", title=_name(difference))
    drawn = table.chosen(np.isin(table["difference"], shown))["norm"]
    panels[0].set(ylabel=LABEL, ylim=(1e-3, 3.0 * drawn.max()))
    panels[-1].legend(loc="center left", bbox_to_anchor=(1.01, 0.5))
    figure.suptitle(settings.title, weight="bold")
    return figure


def _style(k: int, ablation: Ablation) -> dict[str, Any]:
    """Lines without pressure coincide, so that the first is wide and the others are dashed."""
    style: dict[str, Any] = {"color": PALETTE[k]}
    if ablation.changes == {"forces": NO_PRESSURE}:
        return style | {"linewidth": 6.0, "alpha": 0.45}
    return style | ({"linestyle": (3 * k, (3, 6))} if k > 2 else {})


def _name(difference: float) -> str:
    return "Analytic" if difference == ANALYTIC else f"Finite differences, step {difference:g} m/s²"


def verdict(table: Table, settings: Forces) -> list[str]:
    sentences = []
    for (name,), rows in table.where(difference=ANALYTIC).groups("forces"):
        late = rows.chosen(rows["step"] >= settings.impact)
        sentences.append(
            f"Analytic, {name}: {rows['norm'][-1]:.3g} s² after {settings.steps} steps; from step {settings.impact} on "
            f"the norm grows by {growth(late['step'], late['norm'])}."
        )
    sentences.append(
        "Without pressure nothing holds the fluid, not even the floor: the norm is that of free fall, √n t²/2, to "
        f"{_free_fall(table):.0e}."
    )
    for difference in settings.differences:
        found, exact = (table.where(forces=FULL, difference=h) for h in (difference, ANALYTIC))
        off = np.abs(found["norm"] - exact["norm"]) > SAME * exact["norm"]
        left = int(found["step"][off][0]) if off.any() else settings.steps
        late = found.chosen(found["step"] > settings.steps - settings.steps // 8)
        apart = 2.0 * difference * late["norm"] / late["distance"]
        end, factor = found["norm"][-1], exact["norm"][-1] / found["norm"][-1]
        sentences.append(
            f"Finite differences of step {difference:g} m/s², {FULL}: equal to the analytic norm within "
            f"{SAME:.0%} up to step {left}, {end:.3g} s² and {factor:.2g} times below it at the end; "
            f"over the last eighth of the steps the two runs are {apart.mean():.2f} ± {apart.std():.2f} of the "
            "distance between two unrelated states apart."
        )
    return sentences


def _free_fall(table: Table) -> float:
    """Greatest relative distance of the analytic norm without any force from that of free fall, k (k + 1) / 2 after k
    steps, both in units of the last one."""
    rows = table.where(forces="neither", difference=ANALYTIC)
    k, norms = rows["step"][1:], rows["norm"][1:]
    expected = k * (k + 1.0)
    return float(np.abs(norms / norms[-1] * expected[-1] / expected - 1.0).max())


FORCES = ExperimentType("forces", Forces, measure, draw, verdict)
