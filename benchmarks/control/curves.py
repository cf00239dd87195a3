"""What searches found: curves of the loss over simulated steps, last pictures, and a table of medians."""

from contextlib import suppress
from pathlib import Path

import numpy as np

from cortado import DivergedError, InputError, Problem
from cortado.files.image_encoding import to_srgb
from cortado.losses import Image
from cortado.pictures.plots import DASHED, FAINT, INK, PALETTE, drawing

from .catalogue import task
from .contenders import CONTENDERS
from .objective import first_positions
from .records import Record

POINTS = 400
"""Of a curve."""
QUARTILES = (25, 50, 75)
SHARES = (0.5, 0.2, 0.1, 0.05, 0.02, 0.01)
"""Of the first loss, to which searches lower it."""


def curves(records: list[Record]) -> tuple[np.ndarray, np.ndarray]:
    """(POINTS,) simulated steps and (3, POINTS) quartiles over runs of the least loss until then."""
    steps = np.linspace(max(one.steps[0] for one in records), max(one.run.budget for one in records), POINTS)
    found = [one.so_far[np.searchsorted(one.steps, steps * (1.0 + 1e-12), side="right") - 1] for one in records]
    return steps, np.percentile(found, QUARTILES, axis=0)


def by_contender(records: list[Record]) -> dict[str, list[Record]]:
    """In the order of `CONTENDERS`, those that have runs."""
    found = {name: [one for one in records if one.run.contender == name] for name in CONTENDERS}
    return {name: runs for name, runs in found.items() if runs}


def draw(name: str, size: str, records: list[Record], folder: Path) -> None:
    """``NAME_SIZE.png`` with the curves, and ``NAME_SIZE_pictures.png`` with the last pictures of median runs;
    one that diverges on this device, though not on that which found it, has none."""
    if not records:
        raise InputError(f"There are no runs of {name} {size} to draw; leave out --figures to compute them.")
    problem = task(name, size).problem(records[0].run.device, records[0].run.precision)
    _draw_curves(name, size, problem, records, folder / f"{name}_{size}.png")
    _draw_pictures(name, size, problem, records, folder / f"{name}_{size}_pictures.png")


def _draw_curves(name: str, size: str, problem: Problem, records: list[Record], path: Path) -> None:
    chosen = task(name, size)
    known = -np.inf
    with suppress(DivergedError):
        known = problem.value(chosen.controls.parameters(chosen.known))
    least = min(min(one.so_far) for one in records)
    with drawing(path, 9.0, 5.2) as figure:
        axes = figure.subplots()
        for number, (who, runs) in enumerate(by_contender(records).items()):
            steps, (low, middle, high) = curves(runs)
            colour = PALETTE[number % len(PALETTE)]
            axes.plot(steps, middle, color=colour, label=who)
            axes.fill_between(steps, low, high, color=colour, alpha=0.15, linewidth=0.0)
        if known > 0.2 * least:
            axes.axhline(known, color=INK, label="known solution", **DASHED)
        if least > 0.0:
            axes.set_yscale("log")
        axes.set(xlabel="simulated steps", ylabel="least loss until then", title=f"{name}, {size}")
        axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))


def _draw_pictures(name: str, size: str, problem: Problem, records: list[Record], path: Path) -> None:
    chosen = task(name, size)
    parameters = {"no search": chosen.controls.parameters(chosen.baseline)}
    parameters["known solution"] = chosen.controls.parameters(chosen.known)
    for who, runs in by_contender(records).items():
        median = sorted(runs, key=lambda one: one.so_far[-1])[len(runs) // 2]
        first = first_positions(problem, median.run.seed)
        parameters[who] = chosen.controls.parameters(np.array(median.best)) | first
    pictures = {}
    for who, one in parameters.items():
        with suppress(DivergedError):
            pictures[who] = picture(problem, one)
    if isinstance(problem.loss, Image):
        pictures = {"target": problem.loss.target, **pictures}
    columns = 5
    rows = -(-len(pictures) // columns)
    shape = next(iter(pictures.values())).shape
    with drawing(path, 2.2 * columns, rows * (2.2 * shape[0] / shape[1] + 0.45)) as figure:
        panels = figure.subplots(rows, columns, squeeze=False).ravel()
        for axes in panels:
            axes.set(xticks=[], yticks=[])
            axes.set_visible(False)
        for axes, (who, image) in zip(panels, pictures.items(), strict=False):
            axes.set_visible(True)
            axes.imshow(to_srgb(np.clip(image, 0.0, 1.0)), interpolation="nearest")
            axes.set_title(who, fontsize=10)
            for spine in axes.spines.values():
                spine.set(visible=True, color=FAINT)


def picture(problem: Problem, parameters: dict[str, np.ndarray]) -> np.ndarray:
    """(rows, columns, 3) of the last state."""
    end = problem.end(parameters)
    return problem.simulation.renderer().render(end.state.positions, end.state.mass_fractions, end.colours)


def medians(records: list[Record]) -> str:
    """A table for a document: for each task and contender the median of the least loss, with its quartiles, and the
    medians of the score."""
    lines = [
        "| task | contender | runs | least loss, median (quartiles) | diverged | score |",
        "|---|---|---|---|---|---|",
    ]
    for name in dict.fromkeys(one.run.task for one in records):
        for who, runs in by_contender([one for one in records if one.run.task == name]).items():
            low, middle, high = np.percentile([one.so_far[-1] for one in runs], QUARTILES)
            scores = [one.score for one in runs if one.score]
            said = [f"{what} {np.median([one[what] for one in scores]):.3g}" for what in (scores[0] if scores else {})]
            spread = f"{middle:.3g} ({low:.3g} to {high:.3g})"
            lines.append(
                f"| {name} | {who} | {len(runs)} | {spread} | {sum(one.diverged for one in runs)} | {', '.join(said)} |"
            )
    return "\n".join(lines)


def reached(records: list[Record]) -> str:
    """A table for a document: for each task, and each of `SHARES` of its first loss that a contender reaches, the
    medians of the simulated steps until then; more than the budget where half of the runs do not reach it."""
    names = list(by_contender(records))
    lines = [f"| task | first loss | loss | {' | '.join(names)} |", "|---" * (3 + len(names)) + "|"]
    for name in dict.fromkeys(one.run.task for one in records):
        of_task = [one for one in records if one.run.task == name]
        first = float(np.median([one.so_far[0] for one in of_task]))
        for loss in first * np.array(SHARES):
            cells = {who: _steps_to(loss, runs) for who, runs in by_contender(of_task).items()}
            if not all(cell.startswith(">") for cell in cells.values()):
                row = " | ".join(cells.get(who, "-") for who in names)
                lines.append(f"| {name} | {first:.3g} | {loss:.3g} | {row} |")
    return "\n".join(lines)


def _steps_to(loss: float, runs: list[Record]) -> str:
    """The median over runs of the simulated steps until the loss is so low, in words."""
    each = [
        next((at for at, so_far in zip(one.steps, one.so_far, strict=True) if so_far <= loss), np.inf) for one in runs
    ]
    median = np.median(each)
    return f"{median:,.0f}" if np.isfinite(median) else f"> {max(one.run.budget for one in runs):,.0f}"
