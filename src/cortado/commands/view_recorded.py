"""A run that is there, in a window: play, stop, go to a frame."""

import time

import numpy as np

from cortado.commands.view_window import Quantity, Window
from cortado.io.trajectory import Trajectory
from cortado.rollout import Rollout
from cortado.scene.scene import Scene
from cortado.shading.painter import colours_of
from cortado.simulation import Simulation
from cortado.solvers.particles import ParticleSolver

UNITS = {"speed": "m/s", "density": "kg/m³"}
"""Of what particles may be coloured by."""
SHORTEST = 4.0
"""[s] that a run takes to play at speed 1, or as long as it lasted if that is longer."""


class RecordedView:
    """Shows the frames of a run."""

    def __init__(self, scene: Scene, trajectory: Trajectory, device: str, port: int):
        self.scene, self.trajectory, self._device = scene, trajectory, device
        self._simulation: Simulation | None = None
        self.window = Window(scene, port, UNITS)
        gui, last = self.window.server.gui, len(trajectory) - 1
        self.playing = gui.add_checkbox("Play", last > 0)
        self.slider = gui.add_slider("Frame", 0, max(last, 1), 1, 0, disabled=not last)
        self.pace = gui.add_slider("Pace", 0.1, 4.0, 0.1, 1.0)
        self._time = gui.add_markdown("")
        self._moment, self._former = 0.0, time.monotonic()
        self.slider.on_update(lambda event: self._go(event))
        self.window.look_at(trajectory.positions[0])
        self.show(0)

    def tick(self) -> None:
        """Show what is due now."""
        now = time.monotonic()
        passed, self._former = now - self._former, now
        last = len(self.trajectory) - 1
        if self.playing.value and last:
            length = max(float(self.trajectory.times[-1] - self.trajectory.times[0]), SHORTEST)
            self._moment = (self._moment + passed * self.pace.value * last / length) % (last + 1)
            self.slider.value = min(int(self._moment), last)
            self.show(self.slider.value)
        time.sleep(1.0 / 30.0)

    def show(self, k: int) -> None:
        """Frame k."""
        frame = self.trajectory[k]
        self._time.content = f"t = {frame.time:.4g} s"
        colours = colours_of(self.scene, frame.mass_fractions, self.trajectory.particles)
        self.window.show(frame.positions, colours, quantities_of(frame.velocities, lambda: self._densities(k)))

    def _go(self, event: object) -> None:
        """The user has moved the slider; what the view itself moves has no client."""
        if getattr(event, "client", None) is not None and not self.playing.value:
            self._moment = float(self.slider.value)
            self.show(self.slider.value)

    def _densities(self, k: int) -> np.ndarray:
        if self._simulation is None:
            self._simulation = Simulation(self.scene, self._device)
        rollout = self._simulation.rollout(1, state=self.trajectory[: k + 1].last_state)
        return densities(rollout)


def quantities_of(velocities: np.ndarray, density: Quantity) -> dict[str, Quantity]:
    """What particles with velocities (n, d) [m/s] may be coloured by."""
    return {"speed": lambda: np.linalg.norm(velocities, axis=1), "density": density}


def densities(rollout: Rollout) -> np.ndarray:
    """(n,) of the first state of a rollout [kg/m3]; zeros of a solver without particles."""
    if not isinstance(rollout.solver, ParticleSolver):
        return np.zeros(len(rollout.initial.positions))
    return rollout.solver.densities(rollout.initial, rollout.parameters)
