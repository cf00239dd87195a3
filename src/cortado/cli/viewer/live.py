"""A scene that runs while one looks at it: gravity and the nozzle follow sliders."""

import time
import warnings
from typing import Any

import numpy as np

from cortado.cli.viewer.quantities import HEIGHT_UNITS, own_fields, pull_on_height, quantities_of
from cortado.cli.viewer.window import Shown, Window
from cortado.errors import CortadoError, CortadoWarning
from cortado.pictures.painter import colours_of
from cortado.runs.solid_motion import posed, solid_motions
from cortado.scene.restart import RestartState
from cortado.scene.stability import longest_step
from cortado.simulation import Simulation

SHOWN = 1.0 / 100.0
"""[s] of fluid between two pictures, about."""
SHORTEST = 1.0 / 40.0
"""[s] from one picture to the next at least, so that one sees the fluid move."""
LEAN = 2.0
"""How far sliders of gravity go, in sizes of the scene's gravity."""
AXES = "xyz"


class LiveView:
    """Runs a scene, a few steps at a time, from where it is."""

    def __init__(self, simulation: Simulation, port: int):
        scene, self.simulation = simulation.scene, simulation
        self.steps = max(round(SHOWN / longest_step(scene)), 1)
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
        """A few steps, with gravity and the nozzle as the sliders are now; none while it stands still."""
        if self._wish_to_begin:
            self._begin()
        if not self.running.value:
            self.window.refresh()
            time.sleep(SHORTEST)
            return
        begun = time.monotonic()
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", CortadoWarning)  # there would be one for each picture
                found = self.simulation.run(self.steps, self._controls(), self.steps, self._state)
        except CortadoError as error:
            self.running.value = False
            self._told.content = f"{error} Begin again."
            return
        self._show(found.last_state)
        time.sleep(max(SHORTEST - (time.monotonic() - begun), 0.0))

    def _begin(self) -> None:
        """The first state."""
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
        """(d,) as the sliders are."""
        return np.array([slider.value for slider in self.gravity])

    def _controls(self) -> dict[str, np.ndarray]:
        """Gravity, and a path of the nozzle from where it is to where it shall be."""
        controls = {"gravity": self._gravity()}
        if self._nozzle is not None:
            wished = np.array([slider.value for slider in self.nozzle])
            share = np.arange(1, self.steps + 1)[:, None] / self.steps
            controls["nozzle_path"] = self._nozzle + share * (wished - self._nozzle)
            self._nozzle = wished
        return controls

    def _sliders(self, title: str, unit: str, values: Any, ends: Any) -> list[Any]:
        """One for each component, between ends (2, d)."""
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
        """Where a nozzle may be: above the container, at its height."""
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
