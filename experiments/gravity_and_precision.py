"""The report's Figure 4: the norm of the gradient against gravity, by finite differences and analytic, in every
precision."""

from typing import TYPE_CHECKING, Annotated

import numpy as np

from cortado.pictures.plots import DASHED, FAINT, PALETTE
from cortado.scene.tables import OneOf, Several, count, quantity
from experiments.canvas import blank
from experiments.experiment import ExperimentType, Progress, SceneSettings
from experiments.gravity_tangents import COST, LABEL, along_gravity
from experiments.sources import ReferenceTangent
from experiments.tables import Table

if TYPE_CHECKING:
    from matplotlib.figure import Figure

DIFFERENCES, ANALYTIC = "finite differences", "analytic"


class GravityAndPrecision(SceneSettings):
    """Settings."""

    steps: Annotated[int, count(1, 1_000_000)]
    """Number of steps after which the gradient is measured."""
    gravities: Several[Annotated[float, quantity("m/s2", gt=0.0)]]
    """Sizes of gravity, in the direction of the scene's [m / s2]."""
    precisions: Several[Annotated[str, OneOf(COST)]]
    """Precisions; the last one is the reference for the others."""
    difference: Annotated[float, quantity("m/s2", gt=0.0)]
    """Step of the finite differences [m / s2]."""


def measure(settings: GravityAndPrecision, progress: Progress) -> Table:
    rows = []
    with progress(2 * len(settings.gravities) * sum(COST[precision] for precision in settings.precisions)) as advance:
        for precision in settings.precisions:
            sources = {
                DIFFERENCES: ReferenceTangent(precision, "finite_difference", difference=settings.difference),
                ANALYTIC: ReferenceTangent(precision),
            }
            for gravity in settings.gravities:
                for method, source in sources.items():
                    history, distance = along_gravity(settings.scene, settings.steps, source, gravity)
                    assert history.position_norms is not None
                    norm = history.position_norms[-1]
                    keys = {"method": method, "precision": precision, "gravity": gravity}
                    rows.append({**keys, "norm": norm, "distance": distance})
                    advance(COST[precision])
    return Table.joined(rows)


def draw(table: Table, settings: GravityAndPrecision) -> "Figure":
    figure = blank(12.0, 5.2)
    panels = figure.subplots(1, 2, sharey=True)
    for axes, method in zip(panels, (DIFFERENCES, ANALYTIC), strict=True):
        for k, precision in enumerate(settings.precisions):
            rows = table.where(method=method, precision=precision)
            style = {"marker": "osD^"[k], "markersize": 9 - 2 * k, "color": PALETTE[k], "label": precision}
            axes.plot(rows["gravity"], rows["norm"], **style)
        axes.set(yscale="log", xlabel="gravity [m/s²]")
    panels[0].set(title=f"Finite differences, step {settings.difference:g} m/s²", ylabel=LABEL)
    panels[1].set_title("Analytic")
    rows = table.where(method=DIFFERENCES, precision=settings.precisions[-1])
    level = rows["distance"] / (2.0 * settings.difference)
    panels[0].plot(rows["gravity"], level, **DASHED, color=FAINT, label="two unrelated states / (2 step)")
    panels[0].legend(loc="upper left")
    figure.suptitle(f"{settings.title} (after {settings.steps} steps)", weight="bold")
    return figure


def verdict(table: Table, settings: GravityAndPrecision) -> list[str]:
    *others, truth = settings.precisions
    differences, exact = (table.where(method=m, precision=truth) for m in (DIFFERENCES, ANALYTIC))
    gravity = exact["gravity"]
    spread = max((_distance(table, DIFFERENCES, p, truth).max() for p in others), default=0.0)
    share = differences["norm"][-3:] * 2.0 * settings.difference / differences["distance"][-3:]
    sentences = [
        f"Finite differences of step {settings.difference:g} m/s² lie between {differences['norm'].min():.3g} and "
        f"{differences['norm'].max():.3g} s² for all gravities, and precisions agree to {spread:.1g}.",
        f"They are that flat because they saturate: at the three strongest gravities the two runs are "
        f"{share.mean():.2f} ± {share.std():.2f} of the distance between two unrelated states apart.",
        f"The analytic gradient grows from {exact['norm'].min():.3g} to {exact['norm'].max():.3g} s² between "
        f"{gravity[0]:g} and {gravity[-1]:g} m/s², {np.log(exact['norm'][-1] / exact['norm'][0]):.1f} e-folds.",
    ]
    for precision in others:
        off = _distance(table, ANALYTIC, precision, truth)
        sentences.append(
            f"The analytic gradient in {precision} is {off[0]:.1g} off that in {truth}, relative, at "
            f"{gravity[0]:g} m/s², and at most {off.max():.1g}, at {gravity[off.argmax()]:g} m/s²."
        )
    return sentences


def _distance(table: Table, method: str, precision: str, truth: str) -> np.ndarray:
    """Relative distance of the norms in two precisions, for each gravity."""
    found, expected = (table.where(method=method, precision=p)["norm"] for p in (precision, truth))
    return np.abs(found / expected - 1.0)


GRAVITY_AND_PRECISION = ExperimentType("gravity_and_precision", GravityAndPrecision, measure, draw, verdict)
