"""The pictures of a solved task: the loss, parameters, particles or images on the way, and a video."""

from importlib.util import find_spec
from pathlib import Path

import numpy as np

from cortado.figures import curve, images, loss_curve, parameters, particles
from cortado.inverse.setup import Setup
from cortado.io.report import Figures
from cortado.io.video import MOST_FRAMES, write_video
from cortado.optimisation.optimise import Result
from cortado.parameters.registry import BY_NAME, Axis
from cortado.parameters.tilt import Tilt
from cortado.parameters.values import OVER_TIME, UNITS

MOST_CURVES = 12
"""Parameters with more components get no picture of their own."""
IMAGES = 6
"""Images that show the course of the optimisation."""


def task_figures(made: Setup, result: Result, folder: Path) -> Figures:
    """Draw them into a folder; (caption, path) of each."""
    losses = [record.loss for record in result.history]
    label = "loss [m²]" if made.renderer is None else "loss"
    figures: Figures = [("The loss.", loss_curve(losses, folder / "loss.png", label=label))]
    if made.renderer is None:
        figures.append(_particles(made, result, folder))
    else:
        figures += _images(made, result, folder)
    for name in result.parameters:
        figures += _parameter(made, result, name, folder)
    return figures


def _particles(made: Setup, result: Result, folder: Path) -> tuple[str, Path]:
    before, after = (made.problem.end(made.search.parameters(u)).positions for u in (made.start, result.parameters))
    target = made.targets[made.problem.steps]
    path = particles([before, after, target], ["start", "estimate", "target"], folder / "particles.png")
    return "Where the fluid ends: with the first guess, with the estimate, and the target.", path


def _images(made: Setup, result: Result, folder: Path) -> Figures:
    last, target = max(made.targets.items())

    def image(u: dict[str, np.ndarray]) -> np.ndarray:
        return made.image(made.problem.states(made.search.parameters(u), [last])[last])

    path = images(
        [image(made.start), image(result.parameters), target], ["start", "estimate", "target"], folder / "images.png"
    )
    figures: Figures = [("The last image: with the first guess, with the estimate, and the target.", path)]
    iterations = np.unique(np.linspace(0, len(result.history) - 1, IMAGES).astype(int))
    shown = [image(result.history[k].parameters) for k in iterations]
    path = images(shown, [f"iteration {k}" for k in iterations], folder / "progress.png")
    figures.append(("The last image during the optimisation.", path))
    steps = made.problem.steps
    if steps > 0 and find_spec("av"):
        numbers = np.unique(np.linspace(0, steps, MOST_FRAMES).astype(int))
        states = made.problem.states(made.search.parameters(result.parameters), numbers.tolist())
        path = write_video(folder / "estimate.mp4", (made.image(states[k]) for k in numbers.tolist()), 20)
        figures.append(("The run with the estimated parameters.", path))
    return figures


def _parameter(made: Setup, result: Result, name: str, folder: Path) -> Figures:
    """The estimate of a parameter over the iterations; of one that changes over time, the last estimate over time."""
    estimate, true = made.search.parameters(result.parameters)[name], made.true_parameter(name)
    if name in OVER_TIME and np.ndim(estimate) == 2:
        axes = Tilt(made.task.scene.forces.gravity).towards if name == "tilt" else "xyz"
        series = {f"{axis}, estimate": column for axis, column in zip(axes, estimate.T, strict=False)}
        truth = () if true is None else tuple(np.broadcast_to(true, estimate.shape).T)
        path = folder / f"{name}.png"
        label = f"{name} [{UNITS[name]}]"
        curve(np.arange(len(estimate)), series, path, title=name, x_label="step", y_label=label, true=truth)
        return [(f"The parameter {name} over time.", path)]
    if true is None or max(np.size(estimate), true.size) > MOST_CURVES:
        return []
    values = [made.search.parameters(record.parameters)[name] for record in result.history]
    history = [np.broadcast_arrays(value, true)[0] for value in values]
    true = np.broadcast_to(true, history[0].shape)
    phases = [phase.name for phase in made.task.scene.phase]
    is_material = BY_NAME[name].axis is Axis.PHASE and BY_NAME[name].components is None
    names = phases if is_material and len(phases) > 1 else None
    path = parameters(history, true, folder / f"{name}.png", names=names, title=name, unit=UNITS[name])
    return [(f"The parameter {name} during the optimisation, and its true value.", path)]
