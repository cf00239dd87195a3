"""``cortado view``: a run, a scene that runs while one looks at it, or the search of a task, in the browser."""

import atexit
import gc
import time
from collections.abc import Callable, Mapping, Sequence
from functools import cache, partial
from pathlib import Path
from shutil import rmtree
from tempfile import mkdtemp
from typing import Any
from weakref import finalize

import numpy as np

from cortado.cli.view_window import (
    HEIGHT_UNITS,
    PULL,
    UNITS,
    Shown,
    Window,
    in_words,
    own_fields,
    pull_on_height,
    quantities_of,
    sizes_of,
)
from cortado.errors import CortadoError, InputError, unwarned
from cortado.files.image_encoding import to_srgb
from cortado.files.interruption import keeping
from cortado.files.terminal import say
from cortado.optimisation.inverse.solved_task import component_names
from cortado.optimisation.inverse.task import Setup, load_task, setup
from cortado.optimisation.optimise import optimise
from cortado.optimisation.transforms import TimeInterpolation
from cortado.particles.state import State
from cortado.pictures.pages import table
from cortado.pictures.painter import colours_of
from cortado.runs.run_folder import RunFolder
from cortado.runs.solid_motion import posed, sized, solid_motions
from cortado.runs.trajectory import Trajectory
from cortado.scene.parameter_values import OVER_TIME, Arrays
from cortado.scene.parameters import Role, names
from cortado.scene.restart import RestartState
from cortado.scene.scene import Scene, load_scene
from cortado.scene.stability import longest_step
from cortado.scene.toml import read_toml
from cortado.simulation import Simulation

STRIDE = 1.0 / 100.0
"""About how much time [s] of the fluid lies between two pictures."""
SHORTEST_PAUSE = 1.0 / 40.0
"""Shortest time [s] from one picture to the next, so that one sees the fluid move."""
LEAN = 2.0
"""Ends of the sliders of gravity, in sizes of the scene's gravity."""
AXES = "xyz"
FRAMES = 60
"""About how many frames of a run there are at most."""
MOST_ROWS = 12
"""Most numbers of a parameter that the table shows; of one with more, how far it went."""
OF_STEPS = {*names(Role.RUN), *names(Role.VIEW)} - {"rest_density"}
"""Parameters that a run from a state in between takes; the state has the others."""


SHORTEST_PLAY = 4.0
"""Time [s] that a run takes to play at speed 1, or as long as it lasted if that is longer."""


class RecordedView:
    """A view that shows the frames of a run."""

    def __init__(
        self,
        scene: Scene,
        trajectory: Trajectory,
        simulation: Callable[[], Simulation],
        port: int,
        units: Mapping[str, str] = HEIGHT_UNITS,
    ):
        """Open a view; ``simulation`` makes that of the scene when something has to be computed, ``units`` as of
        `Window`."""
        self.scene, self._simulation = scene, simulation
        own = own_fields(trajectory[0].others, trajectory.particles)
        large = sized(scene, solid_motions(scene, trajectory.others))
        self.window = Window(large, port, {**units, **dict.fromkeys(own, "")})
        gui, last = self.window.server.gui, len(trajectory) - 1
        self.playing = gui.add_checkbox("Play", last > 0)
        self.slider = gui.add_slider("Frame", 0, max(last, 1), 1, 0, disabled=not last)
        self.pace = gui.add_slider("Pace", 0.1, 4.0, 0.1, 1.0)
        self._time = gui.add_markdown("")
        self._moment, self._former = 0.0, time.monotonic()
        self.window.look_at(trajectory.positions[0])
        self.replace(trajectory)

    def replace(
        self, trajectory: Trajectory, controls: Mapping[str, Any] | None = None, pulls: Sequence[np.ndarray] = ()
    ) -> None:
        """Show another run of the same scene and number of frames, made under ``controls``. ``pulls`` (frames, n, d)
        are the derivatives of its loss; without them the loss is the height of the centre of mass."""
        self.trajectory, self._controls, self._pulls = trajectory, controls or {}, pulls
        self.show(self.slider.value)

    def tick(self) -> None:
        """Show the frame that is due now."""
        now = time.monotonic()
        passed, self._former = now - self._former, now
        last = len(self.trajectory) - 1
        if self.playing.value and last:
            length = max(float(self.trajectory.times[-1] - self.trajectory.times[0]), SHORTEST_PLAY)
            self._moment = (self._moment + passed * self.pace.value * last / length) % (last + 1)
            self.slider.value = min(int(self._moment), last)
        if self.slider.value != self._frame:
            if not self.playing.value:
                self._moment = float(self.slider.value)
            self.show(self.slider.value)
        self.window.refresh()
        time.sleep(1.0 / 30.0)

    def show(self, k: int) -> None:
        """Show frame k."""
        frame, self._frame = self.trajectory[k], k
        self._time.content = f"t = {frame.time:.4g} s"
        colours = colours_of(self.scene, frame.mass_fractions, self.trajectory.particles)
        state, controls = self.trajectory[: k + 1].last_state, self._controls_at(k)
        quantities = quantities_of(frame.velocities, self._simulation, state, controls)
        quantities |= own_fields(frame.others, self.trajectory.particles)
        recorded = {name: sizes_of(values) for name, values in frame.quantities.items()}
        quantities |= {name: partial(np.asarray, values) for name, values in recorded.items()}
        pull = (lambda: self._pulls[k]) if len(self._pulls) else pull_on_height(self._simulation, state, controls)
        self.window.place_solids(posed(self.scene, solid_motions(self.scene, self.trajectory.others), k))
        self.window.show(Shown(frame.positions, colours, quantities, pull))

    def _controls_at(self, k: int) -> dict[str, Any]:
        """Return the controls of the step after frame k."""
        step = self.trajectory.steps[k]
        return {
            name: value[min(step, len(value) - 1)] if name in OVER_TIME and np.ndim(value) == 2 else value
            for name, value in self._controls.items()
        }


class LiveView:
    """A view that runs a scene, a few steps at a time, from where it is."""

    def __init__(self, simulation: Simulation, port: int):
        scene, self.simulation = simulation.scene, simulation
        self.steps = max(round(STRIDE / longest_step(scene)), 1)
        """Between two pictures."""
        own = own_fields(simulation.initial.numpy(simulation.dimension), simulation.particles)
        units = {field.name: field.unit for field in simulation.initial.fields if field.name in own}
        self.window = Window(scene, port, {**HEIGHT_UNITS, **units})
        gui = self.window.server.gui
        self.running = gui.add_checkbox("Run", True)
        reset = gui.add_button("Begin again")
        self._told = gui.add_markdown("")
        self.gravity = self._sliders("Gravity", "m/s²", scene.forces.gravity, self._most_gravity())
        outlet = () if scene.emitter is None else scene.emitter.outlet
        self.nozzle = self._sliders("Nozzle", "m", outlet, self._reach())
        self._wish_to_begin = False
        reset.on_click(lambda _: setattr(self, "_wish_to_begin", True))
        self.window.look_at(simulation.positions)
        self._begin()

    def tick(self) -> None:
        """Take a few steps, with gravity and the nozzle as the sliders are now; none while it stands still."""
        if self._wish_to_begin:
            self._begin()
        if not self.running.value:
            self.window.refresh()
            time.sleep(SHORTEST_PAUSE)
            return
        begun = time.monotonic()
        try:
            with unwarned():  # there would be one for each picture
                found = self.simulation.run(self.steps, self._controls(), self.steps, self._state)
        except CortadoError as error:
            self.running.value = False
            self._told.content = f"{error} Begin again."
            return
        self._show(found.last_state)
        time.sleep(max(SHORTEST_PAUSE - (time.monotonic() - begun), 0.0))

    def _begin(self) -> None:
        """Show the first state, with the sliders where the scene has them."""
        self._wish_to_begin = False
        self._nozzle = None if self.simulation.scene.emitter is None else np.array(self.simulation.scene.emitter.outlet)
        for sliders, values in ((self.gravity, self.simulation.scene.forces.gravity), (self.nozzle, self._nozzle)):
            for slider, value in zip(sliders, () if values is None else values, strict=False):
                slider.value = float(value)
        first = self.simulation.rollout(1)
        frame = {**self.simulation.frame(first.initial), **self.simulation.constants(first)}
        self._show(RestartState(frame))

    def _show(self, state: RestartState) -> None:
        self._state = state
        self._told.content = f"t = {state.clock.time:.4g} s"
        colours = colours_of(self.simulation.scene, state.fields.get("mass_fractions"), self.simulation.particles)
        controls = {"gravity": self._gravity()}
        if self._nozzle is not None:
            controls["nozzle_path"] = self._nozzle
        quantities = quantities_of(state["velocities"], lambda: self.simulation, state, controls)
        quantities |= own_fields(state.fields, self.simulation.particles)
        pull = pull_on_height(lambda: self.simulation, state, controls)
        scene, fields = self.simulation.scene, {name: np.asarray(field)[None] for name, field in state.fields.items()}
        self.window.place_solids(posed(scene, solid_motions(scene, fields), 0))
        self.window.show(Shown(state["positions"], colours, quantities, pull))

    def _gravity(self) -> np.ndarray:
        """Return gravity (d,) as the sliders set it."""
        return np.array([slider.value for slider in self.gravity])

    def _controls(self) -> dict[str, np.ndarray]:
        """Return the controls of the next steps: gravity, and a path of the nozzle from where it is to where it shall
        be."""
        controls = {"gravity": self._gravity()}
        if self._nozzle is not None:
            wished = np.array([slider.value for slider in self.nozzle])
            share = np.arange(1, self.steps + 1)[:, None] / self.steps
            controls["nozzle_path"] = self._nozzle + share * (wished - self._nozzle)
            self._nozzle = wished
        return controls

    def _sliders(self, title: str, unit: str, values: Any, ends: Any) -> list[Any]:
        """Make a slider for each component, between ends (2, d)."""
        gui, found = self.window.server.gui, []
        for axis, value, least, greatest in zip(AXES, values, *ends, strict=False):
            step = float(f"{(greatest - least) / 200.0:.1g}")
            slider = gui.add_slider(f"{title} {axis} [{unit}]", float(least), float(greatest), step, float(value))
            found.append(slider)
        return found

    def _most_gravity(self) -> np.ndarray:
        gravity = np.array(self.simulation.scene.forces.gravity)
        most = LEAN * (float(np.linalg.norm(gravity)) or 9.81) * np.ones(len(gravity))
        return np.stack([-most, most])

    def _reach(self) -> np.ndarray:
        """Return the ends of the places where a nozzle may be: above the container, at its height."""
        scene = self.simulation.scene
        if scene.emitter is None:
            return np.zeros((2, 0))
        outlet, ends = np.array(scene.emitter.outlet), scene.container.extent()
        if ends is None:
            return outlet + np.array([[-1.0], [1.0]]) * scene.emitter.length
        inner = np.array([[1.0], [-1.0]]) * scene.emitter.radius + np.array(ends)
        reach = np.stack([np.minimum(inner[0], outlet), np.maximum(inner[1], outlet)])
        axis = int(np.abs(scene.emitter.direction).argmax())
        reach[:, axis] = outlet[axis] + np.array([-0.5, 0.5]) * scene.emitter.radius
        return reach


class TaskView:
    """A view that shows the run with the present parameters of a search, and takes the search's steps one at a time."""

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
        """Take the next step of the search that `cortado optimise` makes, and show the run with the new parameters."""
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
        """Return the loss, and its pull (n, d) on the particles of each frame, by the search's estimator; of an
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
        """Return the parameters on which steps of the present run depend."""
        parameters = self.made.search.parameters(self._coordinates)
        return {name: value for name, value in parameters.items() if name in OF_STEPS}

    def _show_target(self) -> None:
        """Show grey points where particles shall be in the end; or pictures beside one another, the target and the
        run's."""
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
        """Show a sentence, and a table of the parameters before and now."""
        rows = table(("", "unit", "before", "now", "hidden"), self._rows(before))
        style = "font-size: .8em; padding: 0 .8em; font-variant-numeric: tabular-nums"
        self.told.content = in_words(sentence) + f'<div style="{style}">{rows}</div>'

    def _rows(self, before: Arrays) -> list[tuple[str, ...]]:
        """Return a row for each number that is searched, and one for a parameter with very many of them."""
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
    """Write a number in words, 0 for round-off; nothing for a value that is not a number."""
    least = 1e-9 * np.abs(values).max()
    return ["" if np.isnan(a) else f"{a if abs(a) > least else 0.0:.4g}" for a in values.ravel()]


def view(path: Path, overrides: list[str], device: str, precision: str | None, port: int) -> str:
    """Show a run folder, or run a task or a scene, until Ctrl-C ends it."""
    shown = opened(path, overrides, device, precision, port)
    say(f"{shown.window.address} shows it; Ctrl-C ends it.")
    atexit.register(gc.freeze)  # Python would look through all that is there once more, which takes as long as the rest
    try:
        with keeping(lambda: ""):
            while True:
                shown.tick()
    except KeyboardInterrupt:
        return ""
    finally:
        shown.window.close()


def opened(
    path: Path, overrides: list[str], device: str, precision: str | None, port: int
) -> LiveView | RecordedView | TaskView:
    """Open the view of a run folder, of a task file, or of a scene file."""
    if not path.exists():
        raise InputError(f"{path} does not exist, but must be the folder of a run, or the file of a scene or a task.")
    if not path.is_dir():
        if {"problem", "optimise"} & set(read_toml(path, overrides)):
            made = setup(load_task(path, overrides), device, precision or "float32")
            say("The run with the first guess, and its gradient, are computed first.")
            return TaskView(made, port)
        return LiveView(Simulation(load_scene(path, overrides), device, precision or "float32"), port)
    for option, value in (("set", overrides), ("precision", precision)):
        if value:
            raise InputError(f"--{option} is given, but must be left out, as the run is there already.")
    folder = RunFolder.open(path)
    if not folder.trajectory.exists():
        raise InputError(f"{path} has no trajectory, but must be the folder of `cortado run`, or a scene file.")
    folder.require_meshes()
    scene = folder.read_scene()
    simulation = cache(lambda: Simulation(scene, device))
    return RecordedView(scene, Trajectory.load(folder.trajectory), simulation, port)
