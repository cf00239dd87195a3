"""A run that is there, in a window: play, stop, go to a frame."""

import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from cortado.cli.viewer.quantities import HEIGHT_UNITS, own_fields, pull_on_height, quantities_of, sizes_of
from cortado.cli.viewer.window import Shown, Window
from cortado.pictures.painter import colours_of
from cortado.runs.solid_motion import posed, sized, solid_motions
from cortado.runs.trajectory import Trajectory
from cortado.scene.parameter_values import OVER_TIME
from cortado.scene.scene import Scene
from cortado.simulation import Simulation

SHORTEST = 4.0
"""[s] that a run takes to play at speed 1, or as long as it lasted if that is longer."""


class RecordedView:
    """Shows the frames of a run."""

    def __init__(
        self,
        scene: Scene,
        trajectory: Trajectory,
        simulation: Callable[[], Simulation],
        port: int,
        units: Mapping[str, str] = HEIGHT_UNITS,
    ):
        """``simulation``: of the scene, asked for when something has to be computed; ``units`` as of `Window`."""
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
        """Show another run of the same scene with as many frames, made under ``controls``. ``pulls`` (frames, n, d) of
        its own loss; without them the loss is the height of the centre of mass."""
        self.trajectory, self._controls, self._pulls = trajectory, controls or {}, pulls
        self.show(self.slider.value)

    def tick(self) -> None:
        """Show what is due now."""
        now = time.monotonic()
        passed, self._former = now - self._former, now
        last = len(self.trajectory) - 1
        if self.playing.value and last:
            length = max(float(self.trajectory.times[-1] - self.trajectory.times[0]), SHORTEST)
            self._moment = (self._moment + passed * self.pace.value * last / length) % (last + 1)
            self.slider.value = min(int(self._moment), last)
        if self.slider.value != self._frame:
            if not self.playing.value:
                self._moment = float(self.slider.value)
            self.show(self.slider.value)
        self.window.refresh()
        time.sleep(1.0 / 30.0)

    def show(self, k: int) -> None:
        """Frame k."""
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
        """The controls of the step after frame k."""
        step = self.trajectory.steps[k]
        return {
            name: value[min(step, len(value) - 1)] if name in OVER_TIME and np.ndim(value) == 2 else value
            for name, value in self._controls.items()
        }
