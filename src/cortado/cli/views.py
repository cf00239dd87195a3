"""``cortado view``: a run, or a scene that runs while one looks at it, in the browser."""

import atexit
import gc
import time
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from cortado.cli.view_window import (
    UNITS,
    Shown,
    Window,
    own_fields,
    quantities_of,
    sizes_of,
)
from cortado.errors import CortadoError, InputError, unwarned
from cortado.files.interruption import keeping
from cortado.files.terminal import say
from cortado.pictures.painter import colours_of
from cortado.runs.run_folder import RunFolder
from cortado.runs.solid_motion import posed, sized, solid_motions
from cortado.runs.trajectory import Trajectory
from cortado.scene.restart import RestartState
from cortado.scene.scene import Scene, load_scene
from cortado.scene.stability import longest_step
from cortado.simulation import Simulation

STRIDE = 1.0 / 100.0
"""About how much time [s] of the fluid lies between two pictures."""
SHORTEST_PAUSE = 1.0 / 40.0
"""Shortest time [s] from one picture to the next, so that one sees the fluid move."""
LEAN = 2.0
"""Ends of the sliders of gravity, in sizes of the scene's gravity."""
AXES = "xyz"
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
    ):
        """Open a view; ``simulation`` makes that of the scene when something has to be computed."""
        self.scene, self.trajectory, self._simulation = scene, trajectory, simulation
        own = own_fields(trajectory[0].others, trajectory.particles)
        large = sized(scene, solid_motions(scene, trajectory.others))
        self.window = Window(large, port, {**UNITS, **dict.fromkeys(own, "")})
        gui, last = self.window.server.gui, len(trajectory) - 1
        self.playing = gui.add_checkbox("Play", last > 0)
        self.slider = gui.add_slider("Frame", 0, max(last, 1), 1, 0, disabled=not last)
        self.pace = gui.add_slider("Pace", 0.1, 4.0, 0.1, 1.0)
        self._time = gui.add_markdown("")
        self._moment, self._former = 0.0, time.monotonic()
        self.window.look_at(trajectory.positions[0])
        self.show(0)

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
        quantities = quantities_of(frame.velocities, self._simulation, self.trajectory[: k + 1].last_state, {})
        quantities |= own_fields(frame.others, self.trajectory.particles)
        recorded = {name: sizes_of(values) for name, values in frame.quantities.items()}
        quantities |= {name: partial(np.asarray, values) for name, values in recorded.items()}
        self.window.place_solids(posed(self.scene, solid_motions(self.scene, self.trajectory.others), k))
        self.window.show(Shown(frame.positions, colours, quantities))


class LiveView:
    """A view that runs a scene, a few steps at a time, from where it is."""

    def __init__(self, simulation: Simulation, port: int):
        scene, self.simulation = simulation.scene, simulation
        self.steps = max(round(STRIDE / longest_step(scene)), 1)
        """Between two pictures."""
        own = own_fields(simulation.initial.numpy(simulation.dimension), simulation.particles)
        units = {field.name: field.unit for field in simulation.initial.fields if field.name in own}
        self.window = Window(scene, port, {**UNITS, **units})
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
        scene, fields = self.simulation.scene, {name: np.asarray(field)[None] for name, field in state.fields.items()}
        self.window.place_solids(posed(scene, solid_motions(scene, fields), 0))
        self.window.show(Shown(state["positions"], colours, quantities))

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


def view(path: Path, overrides: list[str], device: str, precision: str | None, port: int) -> str:
    """Show a run folder, or run a scene, until Ctrl-C ends it."""
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


def opened(path: Path, overrides: list[str], device: str, precision: str | None, port: int) -> LiveView | RecordedView:
    """Open the view of a run folder, or of a scene file."""
    if not path.exists():
        raise InputError(f"{path} does not exist, but must be the folder of a run, or the file of a scene.")
    if not path.is_dir():
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
