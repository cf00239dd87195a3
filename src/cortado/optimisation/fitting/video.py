"""Pictures of an experiment, as the renderer shows the fluid."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from cortado.arrays import as_numbers, require_methods
from cortado.device.threads import WARP
from cortado.errors import InputError
from cortado.fixed import fixed
from cortado.losses import Snapshot
from cortado.optimisation.fitting.observation import CLOCK, Direction, Measurement, clock_of
from cortado.render import Renderer
from cortado.render.calibration import Calibration


@fixed
class Video:
    """Frames of a video, beside pictures of the simulation."""

    unit = "of light"

    def __init__(
        self,
        renderer: Renderer,
        times: Any,
        frames: Any,
        mask: Any = None,
        noise: float | None = None,
        calibrate: tuple[str, ...] | list[str] = (),
        clock: float = 0.0,
    ):
        """``renderer`` such as `Simulation.renderer` makes, with the camera where it was aimed; ``times`` (frames,)
        [s] after the start of the run; ``frames`` (frames, rows, columns, 3) linear light from 0 to 1, as
        `cortado.pictures.read_picture` reads it; ``mask`` (rows, columns), true where pixels count; ``noise``, standard
        deviation of a number of a frame, if it is known; ``calibrate``, what of the view is searched beside the
        parameters: "translation", "rotation", "field_of_view" or "width", "extinction", and "start", the ``clock`` [s]
        that is added to the times.
        """
        require_methods("renderer", renderer, ("render", "tangent", "seen_by"), "a renderer such as of a Simulation")
        pictures = as_numbers("frames", frames)
        if pictures.shape[1:] != renderer.shape:
            raise InputError(f"frames has shape {pictures.shape}, but must be (frames, *{renderer.shape}).")
        rows, columns, _ = renderer.shape
        inside = np.ones((rows, columns), dtype=bool) if mask is None else np.asarray(mask, dtype=bool)
        if inside.shape != (rows, columns) or not inside.any():
            raise InputError(f"mask has shape {inside.shape}, but must be {(rows, columns)} and true somewhere.")
        self.renderer, self.mask = renderer, inside
        own = Measurement.of(times, pictures[:, inside].reshape(len(pictures), -1), noise, clock)
        self.times, self.measured, self.noise = own.times, own.measured, own.noise
        self.calibration = Calibration(renderer.view, tuple(name for name in calibrate if name != CLOCK))
        self._clock = clock_of(calibrate, clock)
        self._seen: dict[str, tuple[bytes, Renderer]] = {}

    @property
    def start(self) -> Mapping[str, np.ndarray]:
        """The camera as it was aimed, and its clock, as far as they are calibrated."""
        return {**self.calibration.start, **self._clock}

    @property
    def unseen(self) -> Mapping[str, np.ndarray]:
        """By name, true for the numbers of the camera that no picture shows."""
        return self.calibration.unseen

    def picture(self, at: Snapshot, own: Mapping[str, np.ndarray]) -> np.ndarray:
        """(rows, columns, 3) of a state, with values of what is calibrated."""
        return self._renderer(own).render(at.state.positions, at.state.mass_fractions, at.colours)

    def value(self, at: Snapshot, own: Mapping[str, np.ndarray]) -> np.ndarray:
        return self.picture(at, own)[self.mask].ravel()

    @WARP
    def tangents(self, at: Snapshot, own: Mapping[str, np.ndarray], along: Sequence[Direction]) -> np.ndarray:
        self.picture(at, own)
        renderer, found = self._renderer(own), []
        for one in along:
            given = one.fields["positions"], one.fields["mass_fractions"], one.parameters.get("colours")
            found.append(renderer.tangent(*given, self.calibration.tangent(own, one.own))[self.mask].ravel())
        return np.stack(found, axis=1)

    def _renderer(self, own: Mapping[str, np.ndarray]) -> Renderer:
        """That of the view with these values; the last one is kept."""
        if not self.calibration.names:
            return self.renderer
        key = b"".join(np.asarray(own[name]).tobytes() for name in self.calibration.names)
        if self._seen.get("last", (b"",))[0] != key:
            self._seen["last"] = key, self.renderer.seen_by(self.calibration.view(own))
        return self._seen["last"][1]
