"""The report's Figures 1 and 2: an optimisation task from ``examples/``, its loss and its pictures on the way."""

from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from pydantic import ValidationInfo, field_validator

from cortado.errors import InputError
from cortado.files.image_encoding import to_srgb
from cortado.image_losses import psnr
from cortado.optimisation.optimise import Record, optimise
from cortado.optimisation.task_files import Setup, load_task, setup
from cortado.pictures.plots import PALETTE, whole_numbers
from cortado.scene.tables import Several, Text
from experiments.canvas import blank
from experiments.experiment import DeviceSettings, ExperimentType, Progress
from experiments.tables import Table

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PICTURES = 4
"""Pictures on the way, the first and the last of them included."""
TARGET = "target"


class TaskSettings(DeviceSettings):
    """Settings."""

    task: Text
    """The task's file, relative to this one; its loss must be one of images."""
    overrides: Several[Text] = ()
    """Replacements in it, such as "optimise.iterations=20"."""
    precision: Literal["float32", "float64"] = "float32"
    """Of the simulation."""

    @field_validator("task")
    @classmethod
    def _resolve(cls, task: str, info: ValidationInfo) -> str:
        return str(((info.context or {}).get("folder", Path()) / task).resolve())

    def identity(self) -> dict[str, Any]:
        made = load_task(self.task, self.overrides)
        return {**super().identity(), "task": f"{made.scene.computed_json()} {made.problem} {made.optimise}"}


def measure(settings: TaskSettings, progress: Progress) -> Table:
    """Rows of losses, with no picture and no pixel, and of the pixels of pictures, with no loss."""
    made = setup(load_task(settings.task, settings.overrides), settings.device, settings.precision)
    if made.renderer is None:
        raise InputError(f'{settings.task}: problem.loss is "positions", but must be "image" to be drawn.')
    history = _search(made, progress)
    last, target = max(made.targets.items())
    pictures = {TARGET: target}
    for k in np.unique(np.linspace(0, len(history) - 1, PICTURES).astype(int)).tolist():
        states = made.problem.states(made.search.parameters(history[k].parameters), [last])
        pictures[f"iteration {k}"] = made.image(states[last])
    none = dict.fromkeys(("row", "column", "red", "green", "blue"), np.nan)
    losses = {"iteration": np.arange(len(history)), "loss": [record.loss for record in history]}
    return Table.joined([{"picture": "", **losses, **none}, *(_pixels(name, made) for name, made in pictures.items())])


def _search(made: Setup, progress: Progress) -> list[Record]:
    settings, history, start = made.task.optimise, [], made.start
    with progress(len(made.searches) * (settings.iterations + 1)) as advance:

        def note(record: Record) -> None:
            history.append(record)
            advance(loss=record.loss)

        for search in made.searches:
            found = optimise(
                search,
                start,
                settings.algorithm(),
                settings.iterations,
                bounds=made.bounds,
                gradient=settings.gradient.estimator(),
                on_iteration=note,
            )
            start = found.last_parameters
    return history


def _pixels(name: str, image: np.ndarray) -> dict[str, Any]:
    rows, columns = np.indices(image.shape[:2])
    colours = {colour: np.round(image[..., k].ravel(), 4) for k, colour in enumerate(("red", "green", "blue"))}
    return {"picture": name, "iteration": -1, "loss": np.nan, "row": rows.ravel(), "column": columns.ravel(), **colours}


def _pictures(table: Table) -> dict[str, np.ndarray]:
    """(rows, columns, 3) by name, the target at the end."""
    found = {}
    for (name,), rows in table.groups("picture"):
        if name:
            image = np.zeros((int(rows["row"].max()) + 1, int(rows["column"].max()) + 1, 3))
            colours = np.stack([rows[colour] for colour in ("red", "green", "blue")], axis=1)
            image[rows["row"].astype(int), rows["column"].astype(int)] = colours
            found[name] = image
    found[TARGET] = found.pop(TARGET)
    return found


def draw(table: Table, settings: TaskSettings) -> "Figure":
    pictures, losses = _pictures(table), table.where(picture="")
    figure = blank(3.0 * len(pictures), 6.8)
    grid = figure.add_gridspec(2, len(pictures))
    for k, (name, image) in enumerate(pictures.items()):
        axes = figure.add_subplot(grid[0, k])
        axes.imshow(to_srgb(image))
        axes.set_title(name)
        axes.set_axis_off()
    axes = figure.add_subplot(grid[1, :])
    axes.plot(losses["iteration"], losses["loss"], color=PALETTE[0])
    axes.set(yscale="log", xlabel="iteration", ylabel="loss")
    whole_numbers(axes.xaxis)
    figure.suptitle(settings.title, weight="bold")
    return figure


def verdict(table: Table, settings: TaskSettings) -> list[str]:
    losses, pictures = table.where(picture="")["loss"], _pictures(table)
    *way, target = pictures.values()
    searches = load_task(settings.task, settings.overrides).optimise.extinction_schedule
    begun = len(losses) // len(searches) * (len(searches) - 1)
    found = [f"The picture comes from {psnr(way[0], target):.1f} to {psnr(way[-1], target):.1f} dB of the target."]
    if len(searches) > 1:
        found.append(
            f"{len(searches)} searches through thicker and thicker fluid; in the last the loss falls from "
            f"{losses[begun]:.3g} to {losses[begun:].min():.3g} in {len(losses) - begun - 1} iterations."
        )
    else:
        found.append(
            f"The loss falls {losses[0] / losses.min():.3g} times, from {losses[0]:.3g} to {losses.min():.3g}, in "
            f"{len(losses) - 1} iterations; {np.mean(np.diff(losses) < 0):.0%} of them lower it."
        )
    return found


TASK = ExperimentType("task", TaskSettings, measure, draw, verdict)
