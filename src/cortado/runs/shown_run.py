"""One run as pictures show it: what is in the picture, and each of its frames as a state that is drawn."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from hashlib import sha256

import numpy as np
from numpy.typing import NDArray

from cortado.pictures.filmed import FilmedRun
from cortado.pictures.page import Panel
from cortado.pictures.painter import colours_of, painter_on, stage_of
from cortado.pictures.plane_stage import PlaneStage
from cortado.pictures.scale import Scale
from cortado.pictures.scenery import State
from cortado.pictures.stage import Stage, upright
from cortado.runs.emitted import is_out, shown_places, those
from cortado.runs.solid_motion import SolidMotions, posed, sized, solid_motions
from cortado.runs.trajectory import Trajectory
from cortado.scene.camera_paths import Moment, View
from cortado.scene.picture import Picture
from cortado.scene.scene import Scene
from cortado.version import __version__

ENOUGH = 100
"""Frames that tell where solids come to."""


@dataclass(frozen=True)
class ShownRun:
    """A run, and what its particles are coloured by."""

    scene: Scene
    trajectory: Trajectory
    values: NDArray | None = None
    """(frames, n) what a scale colours particles by; None for the colours of phases."""

    @cached_property
    def stage(self) -> PlaneStage | Stage:
        """What is around its fluid, with a camera that sees all of it in every frame."""
        stride = max(len(self.trajectory) // ENOUGH, 1)
        poses = [self._pose(k) for k in range(0, len(self.trajectory), stride)] if self._motions else []
        return stage_of(
            sized(self.scene, self._motions),
            shown_places(self.scene, self.trajectory),
            [pose for pose in poses if pose is not None],
        )

    def panel(self, stage: PlaneStage | Stage, device: object, scale: Scale | None) -> Panel:
        """Its pictures by the number of the frame, on a stage that is its own but for the camera."""
        return FilmedRun(painter_on(stage, device), lambda k: self._state(k, stage, scale))

    @cached_property
    def times(self) -> NDArray[np.float64]:
        """(frames,) [s] of the states that are shown; see `Trajectory.due`."""
        return self.trajectory.due

    @property
    def fingerprint(self) -> str:
        """A checksum of what its pictures are made of."""
        trajectory, found = self.trajectory, sha256(f"{__version__} {self.scene.to_json()}".encode())
        for array in (trajectory.due, trajectory.positions[:1], trajectory.positions[-1:]):
            found.update(np.ascontiguousarray(array).tobytes())
        return found.hexdigest()

    def _state(self, k: int, stage: PlaneStage | Stage, scale: Scale | None) -> State:
        frame = self.trajectory[k].moved(float(self.times[k] - self.trajectory.times[k]))
        shown = those(self._out[k])
        colours = colours_of(self.scene, frame.mass_fractions, self.trajectory.particles)
        if scale is not None and self.values is not None:
            colours = scale.colours(self.values[k])
        fractions = None if frame.mass_fractions is None else frame.mass_fractions[shown]
        return State(frame.positions[shown], colours[shown], self._pose(k), self._view(k, stage), fractions)

    @cached_property
    def _motions(self) -> SolidMotions:
        known = self.trajectory.times
        return solid_motions(self.scene, self.trajectory.others).at(
            self.scene, known, np.arange(len(known)), self.times
        )

    @cached_property
    def _out(self) -> list[NDArray[np.bool_]]:
        """(frames, n) which particles have left the emitter."""
        emitted = (frame.others.get("emitted") for frame in self.trajectory)
        return [is_out(self.scene, one, self.trajectory.particles) for one in emitted]

    def _pose(self, k: int) -> Scene | None:
        return posed(self.scene, self._motions, k) if self._motions else None

    def _view(self, k: int, stage: PlaneStage | Stage) -> View | None:
        """Where a camera is that moves."""
        path = (self.scene.picture or Picture()).camera_path
        if path is None or isinstance(stage, PlaneStage):
            return None
        return path.view(stage.home_around if path.goes_around else stage.home, self._moment(k))

    def _moment(self, k: int) -> Moment:
        places = {table.name: table.middle() for table in self.scene.solid}
        places |= {name: motion.positions[k] for name, motion in self._motions.items()}
        domain = self.scene.container.domain(self.scene.dimension)
        places = {name: domain.wrapped(place) for name, place in places.items()}
        up = upright(np.asarray(self.scene.forces.gravity))[1]
        return Moment(k / max(len(self.trajectory) - 1, 1), float(self.times[k]), up, places)
