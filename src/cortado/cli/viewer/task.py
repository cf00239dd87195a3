"""The run of a task in a window, where its loss pulls the particles, and a button for the next step of its search."""

import time
from pathlib import Path
from shutil import rmtree
from tempfile import mkdtemp
from typing import Any
from weakref import finalize

import numpy as np

from cortado.cli.viewer.quantities import UNITS
from cortado.cli.viewer.recorded import RecordedView
from cortado.cli.viewer.window import PULL, in_words
from cortado.errors import CortadoError
from cortado.files.image_encoding import to_srgb
from cortado.optimisation.inverse.figures import component_names
from cortado.optimisation.inverse.setup import Setup
from cortado.optimisation.optimise import optimise
from cortado.optimisation.transforms import TimeInterpolation
from cortado.particles.state import State
from cortado.pictures.notebook import table
from cortado.runs.trajectory import Trajectory
from cortado.scene.parameter_values import Arrays
from cortado.scene.parameters import Role, names

FRAMES = 60
"""Of a run, at most about."""
MOST_ROWS = 12
"""Numbers of a parameter that the table shows; of one with more, how far it went."""
OF_STEPS = {*names(Role.RUN), *names(Role.VIEW)} - {"rest_density"}
"""Parameters that a run from a state in between takes; the state has the others."""


class TaskView:
    """Shows the run with the present parameters of a search, and goes on with the search one step at a time."""

    def __init__(self, made: Setup, port: int):
        self.made, simulation = made, made.problem.simulation
        self._every = max(made.problem.steps // FRAMES, 1)
        unit = "1/m" if made.renderer else "m²/m"
        self._log = Path(mkdtemp(prefix="cortado-view-"))
        """The folder of the replay log, with which the search goes on. It is deleted with this object."""
        finalize(self, rmtree, self._log, ignore_errors=True)
        self._coordinates: Arrays = made.start
        self._estimator = made.task.optimise.gradient.estimator()
        self.taken = 0
        """Steps of the search."""
        self.loss, pulls = self._judged(made.start)
        run = self._run(made.start)
        self.played = RecordedView(made.task.scene, run, lambda: simulation, port, {**UNITS, PULL: unit})
        self.window = self.played.window
        self.played.replace(run, self._controls(), pulls)
        gui = self.window.server.gui
        self._show_target()
        self.button = gui.add_button("One gradient step")
        self.told = gui.add_html("")
        self._wished = False
        self.button.on_click(lambda _: setattr(self, "_wished", True))  # in a thread of viser's, which computes nothing
        self._tell(f"The first guess: the loss is {self.loss:.4g}{self._unit}.", made.start)

    def tick(self) -> None:
        """Play, or take a step of the search if the button was pressed."""
        if self._wished:
            self._wished = False
            self.button.disabled, self.button.label = True, "One gradient step: computing ..."
            try:
                self.step()
            except CortadoError as error:
                self._tell(str(error), self._coordinates)
            finally:
                self.button.disabled, self.button.label = False, "One gradient step"
        self.played.tick()

    def step(self) -> None:
        """The next step of the search that `cortado optimise` makes, and the run with the new parameters."""
        made, before, begun = self.made, self._coordinates, time.monotonic()
        found = optimise(
            made.search,
            made.start,
            made.task.optimise.algorithm(),
            self.taken + 1,
            bounds=made.bounds,
            gradient=self._estimator,
            checkpoint=self._log,
            resume=True,
        )
        loss, pulls = self._judged(found.last_parameters)
        run, former = self._run(found.last_parameters), self.loss
        self._coordinates, self.loss, self.taken = found.last_parameters, loss, self.taken + 1
        self.played.replace(run, self._controls(), pulls)
        self._show_image()
        took = time.monotonic() - begun
        change = f"from {former:.4g} to {self.loss:.4g}{self._unit}"
        sentence = f"Step {self.taken}: the loss went {change}, in {took:.2g} s."
        self._tell(sentence, before)

    @property
    def _unit(self) -> str:
        return "" if self.made.renderer else " m²"

    def _run(self, coordinates: Arrays) -> Trajectory:
        return self.made.problem.run(self.made.search.parameters(coordinates), self._every)

    def _judged(self, coordinates: Arrays) -> tuple[float, list[np.ndarray]]:
        """The loss, and its pull (n, d) on the particles of each frame, by the estimator that the search uses; of an
        ensemble the mean."""
        made, dimension = self.made, self.made.problem.simulation.dimension
        steps = made.problem.steps
        totals: dict[int, np.ndarray] = {}
        samples: dict[int, int] = {}

        def note(step: int, bar: State) -> None:
            if step % self._every == 0 or step == steps:
                pull = -bar.numpy(dimension, only=["positions"])["positions"].astype(np.float64)
                totals[step] = totals.get(step, 0.0) + pull
                samples[step] = samples.get(step, 0) + 1

        loss = made.search.estimate(coordinates, self._estimator, note).loss
        return loss, [totals[step] / samples[step] for step in sorted(totals)]

    def _controls(self) -> dict[str, Any]:
        """What steps of the present run depend on."""
        parameters = self.made.search.parameters(self._coordinates)
        return {name: value for name, value in parameters.items() if name in OF_STEPS}

    def _show_target(self) -> None:
        """Grey points where particles shall be in the end; or pictures beside one another, as they shall look and as
        they do."""
        step, target = max(self.made.targets.items())
        gui = self.window.server.gui
        if self.made.renderer is None:
            shown = gui.add_checkbox("Target: where the fluid shall end", False)
            cloud = self.window.add_still("/target", target)
            shown.on_update(lambda _: setattr(cloud, "visible", shown.value))
            return
        gui.add_image(to_srgb(target), label=f"Target, after {step} steps")
        self._image = gui.add_image(to_srgb(target), label="Now")
        self._show_image()

    def _show_image(self) -> None:
        if self.made.renderer is None:
            return
        step = max(self.made.targets)
        states = self.made.problem.states(self.made.search.parameters(self._coordinates), [step])
        self._image.image = to_srgb(self.made.image(states[step]))

    def _tell(self, sentence: str, before: Arrays) -> None:
        """A sentence, and a table of the parameters before and now."""
        rows = table(("", "unit", "before", "now", "hidden"), self._rows(before))
        style = "font-size: .8em; padding: 0 .8em; font-variant-numeric: tabular-nums"
        self.told.content = in_words(sentence) + f'<div style="{style}">{rows}</div>'

    def _rows(self, before: Arrays) -> list[tuple[str, ...]]:
        """Of each number that is searched, and of a parameter with very many of them one row."""
        rows: list[tuple[str, ...]] = []
        search, task = self.made.search, self.made.task
        old, new = search.parameters(before), search.parameters(self._coordinates)
        for name, value in new.items():
            unit, hidden = task.known[name].unit, self.made.true_parameter(name)
            was, now, knots = np.asarray(old[name]), np.asarray(value), ""
            interpolation = search.coordinates.get(name)
            if isinstance(interpolation, TimeInterpolation):
                was, now, knots = before[name], self._coordinates[name], " at knot"
                hidden = None if hidden is None or hidden.ndim < 2 else interpolation.coordinate(hidden)
            if now.size > MOST_ROWS:
                change = f"changed by up to {np.abs(now - was).max():.3g}"
                rows.append((name.replace("_", " "), unit, f"{now.size} numbers", change, ""))
                continue
            labels = component_names(task, name, now)
            labels = [f"{label}{knots} {k}" for k in range(len(now)) for label in labels] if knots else labels
            columns = [was, now, np.nan if hidden is None else hidden]
            written = [_written(np.broadcast_to(column, now.shape)) for column in columns]
            rows += [(label, unit, *cells) for label, *cells in zip(labels, *written, strict=False)]
        return rows


def _written(values: np.ndarray) -> list[str]:
    """Numbers in words, 0 for round-off; nothing for what is not a number."""
    least = 1e-9 * np.abs(values).max()
    return ["" if np.isnan(a) else f"{a if abs(a) > least else 0.0:.4g}" for a in values.ravel()]
