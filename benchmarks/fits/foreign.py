"""What fits say of a film that another simulator and another renderer made."""

from pathlib import Path

import numpy as np

import cortado
from cortado.optimisation.fitting.figures import AGREE
from cortado.optimisation.fitting.fit import Fit, with_error
from cortado.optimisation.solved_task import load_fit
from cortado.pictures.plots import images

from .dissipation import viscosity_by_energy
from .film import column_of

TASK = Path(__file__).parents[2] / "examples/fit_video.toml"
PCISPH = ["solver={kind='pcisph', time_step=0.001, minimum_iterations=4, maximum_iterations=4}"]
SHORT = ["solver.time_step=0.0005", "problem.steps=400"]
FINER = ["discretisation.spacing=0.0025", "render.extinction=320"]
VARIANTS = {
    "PCISPH, 4 mm, 1 ms": PCISPH,
    "PCISPH, 2.5 mm, 1 ms": [*PCISPH, *FINER],
    "projection, 4 mm, 1 ms": [],
    "projection, 4 mm, 0.5 ms": SHORT,
    "projection, 2.5 mm, 1 ms": FINER,
    "projection, 2.5 mm, 0.5 ms": [*SHORT, *FINER],
}
"""By the solver, the spacing and the time step, what they have other than the task."""
DRAWN = ("PCISPH, 4 mm, 1 ms", "projection, 4 mm, 0.5 ms", "projection, 2.5 mm, 0.5 ms")
"""Whose residuals are drawn, in three frames each."""
DISSIPATED = 16.4
"""The viscosity [Pa s] by which the column of the film lost its energy; `viscosity_by_energy` finds it."""


def of_another_simulator(column: Path | None, out: Path) -> str:
    """A table in Markdown, and a picture of the residuals."""
    text = list[str]()
    if column is not None:
        times, x, v, spacing = column_of(column)
        text += [f"The column lost its energy as {viscosity_by_energy(times, x, v, spacing, 1300.0):.1f} Pa s do.", ""]
    fits = {name: fit_with(changes) for name, changes in VARIANTS.items()}
    text += [
        "| fitted with | viscosity, Pa s | bars from 16.4 | residuals, of light | doubts |",
        "|---|---|---|---|---|",
    ]
    text += [_row(name, fitted) for name, fitted in fits.items()]
    out.mkdir(parents=True, exist_ok=True)
    path = residuals_drawn({name: fits[name] for name in DRAWN}, out / "foreign.png")
    return "\n".join([*text, "", f"The residuals are drawn in {path}."])


def fit_with(changes: list[str]) -> Fit:
    """Of the task with changes of keys."""
    task = load_fit(TASK, changes)
    (one,) = task.experiments
    return cortado.fit(one.experiment("cpu", "float64"), task.fit.start, iterations=task.fit.iterations)


def residuals_drawn(fits: dict[str, Fit], path: Path) -> Path:
    """Found less measured of three frames, a row for each fit: a middle grey where both agree."""
    panels, titles = list[np.ndarray](), list[str]()
    for name, fitted in fits.items():
        (part,) = fitted.parts
        for k in np.linspace(0, len(part.residuals) - 1, 4).round().astype(int)[1:]:
            panels.append(np.clip(AGREE + part.residuals[k].reshape(32, 64, 3), 0.0, 1.0))
            titles.append(f"{name}, after {part.part.observation.times[k]:.2f} s")
    return images(panels, titles, path)


def _row(name: str, fitted: Fit) -> str:
    value, error = fitted.values["viscosity"], fitted.standard_errors["viscosity"]
    (part,) = fitted.parts
    cells = [name, with_error(value, error), f"{(value - DISSIPATED) / error:+.1f}", f"{part.spread:.3f}"]
    return f"| {' | '.join([*cells, ' '.join(fitted.cautions) or 'none'])} |"
