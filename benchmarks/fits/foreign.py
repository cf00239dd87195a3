"""What fits say of a film that another simulator and another renderer made."""

from pathlib import Path

import numpy as np

import cortado
from cortado.optimisation.fitting.fitted import Fit, with_error
from cortado.optimisation.inverse.fit_task import load_fit
from cortado.pictures.figures import images

from .dissipation import viscosity_by_energy
from .film import column_of

TASK = Path(__file__).parents[2] / "examples/fit_video.toml"
PCISPH = ["solver.kind=pcisph", "solver.minimum_iterations=4", "solver.maximum_iterations=4"]
VARIANTS = {
    "projection, 4 mm, steps of 0.5 ms": ["solver.time_step=0.0005", "problem.steps=400"],
    "projection, 4 mm, steps of 1 ms": [],
    "projection, 2.5 mm, steps of 1 ms": ["discretisation.spacing=0.0025", "render.extinction=320"],
    "PCISPH, 4 mm, steps of 1 ms": PCISPH,
    "PCISPH, 2.5 mm, steps of 1 ms": [*PCISPH, "discretisation.spacing=0.0025", "render.extinction=320"],
}
"""By what they are, what they have other than the task."""
DISSIPATED = 16.4
"""The viscosity [Pa s] by which the column of the film lost its energy; `viscosity_by_energy` finds it."""
FRAMES = 3
"""Of the residuals that are drawn, of each variant."""


def of_another_simulator(column: Path | None, out: Path) -> str:
    """A table in Markdown, and a picture of the residuals."""
    text, panels, titles = list[str](), list[np.ndarray](), list[str]()
    if column is not None:
        times, x, v, spacing = column_of(column)
        text += [f"The column lost its energy as {viscosity_by_energy(times, x, v, spacing, 1300.0):.1f} Pa s do.", ""]
    text += [
        "| fitted with | viscosity, Pa s | bars from 16.4 | residuals, of light | doubts |",
        "|---|---|---|---|---|",
    ]
    for name, changes in VARIANTS.items():
        (one,) = (task := load_fit(TASK, changes)).experiments
        fitted = cortado.fit(one.experiment("cpu", "float64"), task.fit.start, iterations=task.fit.iterations)
        text.append(_row(name, fitted))
        (part,) = fitted.parts
        chosen = np.linspace(0, len(part.residuals) - 1, FRAMES).round().astype(int)
        panels += [np.clip(0.2 + part.residuals[k].reshape(32, 64, 3), 0.0, 1.0) for k in chosen]
        titles += [f"{name}, at {part.part.observation.times[k]:.2f} s" for k in chosen]
    out.mkdir(parents=True, exist_ok=True)
    text += ["", f"The residuals are drawn in {images(panels, titles, out / 'foreign.png')}."]
    return "\n".join(text)


def _row(name: str, fitted: Fit) -> str:
    value, error = fitted.values["viscosity"], fitted.standard_errors["viscosity"]
    (part,) = fitted.parts
    cells = [name, with_error(value, error), f"{(value - DISSIPATED) / error:+.1f}", f"{part.spread:.3f}"]
    return f"| {' | '.join([*cells, ' '.join(fitted.cautions) or 'none'])} |"
