"""The report's Figure 3: the gradient of an image's loss by autograd and by finite differences, over the horizon."""

from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np

from cortado.gradients import Exact, Tape
from cortado.losses import FinalPositions, Image
from cortado.pictures.plots import PALETTE
from cortado.problem import Problem
from cortado.render.renderer import scene_renderer
from cortado.scene.tables import Several, Vector, count, quantity
from cortado.simulation import Simulation
from experiments.canvas import blank
from experiments.comparison import growth
from experiments.experiment import DeviceSettings, ExperimentType, Progress, SceneSettings
from experiments.sources import ByEstimator, FiniteDifference, Source, Warp
from experiments.tables import Table

if TYPE_CHECKING:
    from matplotlib.figure import Figure

TAPE, ADJOINT = "autograd (Warp's tape)", "adjoint by gathers"
SAME = 0.1
"""Relative distance up to which a difference counts as equal to the gradient."""


class ImageHorizon(DeviceSettings, SceneSettings):
    """Settings."""

    horizons: Several[Annotated[int, count(1, 1_000_000)]]
    """Numbers of steps, growing."""
    true_gravity: Vector[Annotated[float, quantity("m/s2")]]
    """(d,) the true gravity, whose picture is the target [m / s2]; the gradient is taken at the scene's own."""
    differences: Several[Annotated[float, quantity("m/s2", gt=0.0)]]
    """Steps of finite differences [m / s2]."""
    precision: Literal["float32", "float64"] = "float32"
    """Precision of the simulation."""


def measure(settings: ImageHorizon, progress: Progress) -> Table:
    simulation = Simulation(settings.scene, settings.device, settings.precision)
    gravity = {"gravity": np.array(settings.scene.forces.gravity)}
    rows = []
    with progress(sum(settings.horizons) * len(_sources(settings))) as advance:
        for horizon in settings.horizons:
            problem = _problem(simulation, horizon, settings)
            for name, source in _sources(settings).items():
                found = source(problem, gravity)
                components = dict(zip("xyz", found.gradient["gravity"], strict=False))
                rows.append({"source": name, "horizon": horizon, "loss": found.loss, **components})
                advance(horizon)
    return Table.joined(rows)


def _sources(settings: ImageHorizon) -> dict[str, Source]:
    differences = {_name(step): FiniteDifference(step, Warp()) for step in settings.differences}
    return {TAPE: ByEstimator(Tape()), ADJOINT: ByEstimator(Exact()), **differences}


def _name(step: float) -> str:
    return f"finite differences, step {step:g} m/s²"


def _problem(simulation: Simulation, horizon: int, settings: ImageHorizon) -> Problem:
    """The squared difference from the picture that the true gravity makes after so many steps."""
    renderer = scene_renderer(simulation)
    end = Problem(simulation, horizon, FinalPositions(simulation.positions)).end(
        {"gravity": np.array(settings.true_gravity)}
    )
    target = renderer.render(end.state.positions, end.state.mass_fractions, end.colours)
    return Problem(simulation, horizon, Image(renderer, target))


def _gradients(table: Table, source: str) -> np.ndarray:
    """(horizons, d)"""
    rows = table.where(source=source)
    return np.stack([rows[axis] for axis in "xyz" if axis in rows.columns], axis=1)


def _norms(table: Table, source: str) -> np.ndarray:
    return np.linalg.norm(_gradients(table, source), axis=1)


def draw(table: Table, settings: ImageHorizon) -> "Figure":
    figure = blank(11.0, 5.2)
    axes = figure.subplots()
    for k, source in enumerate(_sources(settings)):
        style: dict[str, Any] = {"marker": "o", "markersize": 4, "color": PALETTE[k], "label": source}
        if source == ADJOINT:
            style |= {"linestyle": (0, (4, 3)), "linewidth": 3.0}
        axes.plot(settings.horizons, _norms(table, source), **style)
    axes.set(yscale="log", xlabel="steps", ylabel="|dL/dg|  [s²/m]")
    axes.set_title(f"{settings.title} ({settings.precision})", weight="bold")
    axes.legend(loc="center left", bbox_to_anchor=(1.01, 0.5))
    return figure


def verdict(table: Table, settings: ImageHorizon) -> list[str]:
    horizons, tape, exact = np.array(settings.horizons), _gradients(table, TAPE), _gradients(table, ADJOINT)
    norms = np.linalg.norm(exact, axis=1)
    off = np.linalg.norm(tape - exact, axis=1) / norms
    fine = _gradients(table, _name(min(settings.differences)))
    near = np.linalg.norm(exact - fine, axis=1) <= SAME * norms
    left = int(horizons[~near][0]) if not near.all() else None
    sentences = [
        f"Autograd and the adjoint by gathers, which share no code, agree to {np.median(off):.1e} (median; at most "
        f"{off.max():.1e}) in {settings.precision}: what grows is no fault of automatic differentiation.",
        f"Finite differences of step {min(settings.differences):g} m/s² are within {SAME:.0%} of the gradient "
        + (f"until they leave it at {left} steps." if left else f"at all horizons up to {horizons[-1]} steps."),
    ]
    if left:
        late = horizons >= left
        rate = growth(horizons[late], norms[late])
        grown = f", {rate}" if np.isfinite(rate.rate) else ""
        sentences.append(
            f"From there to {horizons[-1]} steps the gradient grows from {norms[late][0]:.3g} to {norms[-1]:.3g} "
            f"s²/m{grown}."
        )
    for step in settings.differences:
        found = _norms(table, _name(step))
        half = horizons >= 0.5 * horizons[-1]
        sentences.append(
            f"Finite differences of step {step:g} m/s² lie between {found[half].min():.3g} and "
            f"{found[half].max():.3g} s²/m from half the longest horizon on, {norms[-1] / found[-1]:.2g} times below "
            "the gradient at the end."
        )
    return sentences


IMAGE_HORIZON = ExperimentType("image_horizon", ImageHorizon, measure, draw, verdict)
