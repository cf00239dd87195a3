"""Shaded pictures of a solved task: before, after, target and the search in motion."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from cortado.device.compiling import compile_meanwhile
from cortado.discretise.shapes import Points
from cortado.files.terminal import announce
from cortado.losses import Snapshot
from cortado.optimisation.inverse.setup import Setup
from cortado.optimisation.inverse.task_figures import TaskFigures
from cortado.optimisation.optimise import Result
from cortado.pictures.film import FilmedRun, Page, Panel, film
from cortado.pictures.image_files import write_picture
from cortado.pictures.labels import side_by_side
from cortado.pictures.painter import colours_of, painter
from cortado.pictures.report import Figures
from cortado.pictures.shown_run import is_out, those
from cortado.pictures.tracing.space import State
from cortado.runs.pace import Pace, pace_of
from cortado.scene.appearance import Picture
from cortado.scene.scene import Scene

EVALUATIONS = (1, 5, 20, 100)
"""Whose runs are shown, as far as the search went; 0 is the first guess."""
Run = Mapping[int, Snapshot]
"""States by the number of steps before them."""


def begin_shaded(made: Setup) -> None:
    """Compile what will draw them while the search goes on, which leaves a core to spare."""
    simulation = made.problem.simulation
    artist = painter(made.task.scene, simulation.positions, simulation.device)
    compile_meanwhile(artist, simulation.device)


def shaded_figures(made: Setup, result: Result, folder: Path) -> TaskFigures:
    """Draw them into a folder."""
    picture, device = made.task.scene.picture or Picture(), made.problem.simulation.device
    steps = np.unique(np.linspace(0, made.problem.steps, max(picture.searched_frames, 2)).astype(int)).tolist()

    def run(parameters: Mapping[str, Any]) -> Run:
        return made.problem.states(dict(parameters), steps)

    def found(u: dict[str, np.ndarray]) -> Run:
        return run(made.search.parameters(u))

    before, after = found(made.start), found(result.parameters)
    runs = {"first guess": before, "found": after}
    if made.task.problem.picture is None:  # else there is a picture to aim at, and no run
        runs["target"] = run(made.task.true_parameters)
    page = partial(_page, made, device=device)
    three = page(list(runs), list(runs.values()))
    path = folder / "found.png"
    write_picture(path, three.image(steps[-1]))
    compared: Figures = [(f"The end of the run: {', '.join(runs)}.", path)]
    shown = [k for k in EVALUATIONS if k < len(result.history)] or [0]
    searched = page([f"evaluation {k}" for k in shown], [found(result.history[k].parameters) for k in shown])
    path = folder / "search.png"
    write_picture(path, searched.image(steps[-1]))
    search: Figures = [("The end of the run as the search went on.", path)]
    if picture.film_frames == 0 or len(steps) < 2:
        return TaskFigures(compared=compared, search=search)
    pair = {name: runs[name] for name in (("found", "target") if "target" in runs else ("first guess", "found"))}
    two = page(list(pair), list(pair.values()))
    pace = step_pace(made.task.scene, steps)
    motion = film(folder / "found.mp4", two, steps, pace)
    announce(str(motion))
    sought = film(folder / "search.mp4", searched, steps, pace)
    search.insert(0, (f"The search in motion, {pace.in_words}.", sought.path))
    found_figures: Figures = [(f"The run, {pace.in_words}: {' and '.join(pair)}.", motion.path)]
    return TaskFigures(found=found_figures, compared=compared, search=search)


def step_pace(scene: Scene, steps: Sequence[int]) -> Pace:
    """That of films of states after so many steps."""
    if scene.solver.chooses:
        return Pace.unknown(len(steps))
    pace = pace_of(float(scene.solver.time_step) * np.asarray(steps), scene.picture or Picture())
    return replace(pace, of_search=True)


def _page(made: Setup, names: Sequence[str], runs: Sequence[Run], device: Any) -> Page:
    """The runs after a number of steps, side by side, each with its name."""
    scene, across = made.task.scene, len(runs) if len(runs) < 4 else 2
    picture, half = scene.picture or Picture(), len(runs) > 1
    size = {"width": picture.width // (1 + half), "height": picture.height // (1 + (len(runs) > across))}
    panel = picture.model_copy(update=size)
    places = [run[step].positions for run in runs for step in run]
    artist = painter(scene.model_copy(update={"picture": panel}), places, device)

    def composed(images: list[Points]) -> Points:
        return side_by_side(images, across, names)

    def drawn(run: Run) -> Panel:
        return FilmedRun(artist, partial(_state, made, run))

    return Page([drawn(run) for run in runs], composed)


def _state(made: Setup, run: Run, step: int) -> State:
    state = run[step]
    colours = colours_of(made.task.scene, state.mass_fractions, len(state.positions), state.colours)
    emitted = state.state["emitted"].numpy() if "emitted" in state.state.names else None
    out = those(is_out(made.task.scene, emitted, len(colours)))
    fractions = None if state.mass_fractions is None else state.mass_fractions[out]
    return State(state.positions[out], colours[out], fractions=fractions)
