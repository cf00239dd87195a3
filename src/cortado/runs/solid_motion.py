"""Where solids that move are in the frames of a run."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from cortado.errors import InputError, shown
from cortado.scene.motions import (
    AXES,
    angular_velocity_name,
    moving,
    position_name,
    rotation_name,
    scale_name,
    solids_in,
    turn_name,
    velocity_name,
)
from cortado.scene.scene import Scene


@dataclass(frozen=True, eq=False)
class SolidMotion:
    """One solid, in every frame."""

    positions: NDArray[Any]
    """(frames, d) of its middle [m]"""
    rotations: NDArray[Any]
    """(frames, 3) rotation vectors, in 2-D (frames,) angles, by which it is turned about its middle [rad]"""
    velocities: NDArray[Any] | None = None
    """(frames, d) of the middle of a body that is free [m/s]; None for one that is told where to go."""
    angular_velocities: NDArray[Any] | None = None
    """(frames, 3), in 2-D (frames,), of a body that is free [rad/s]; None for others."""
    scale: float = 1.0
    """How many times as large as in the scene one is that is told where to go."""

    def __getitem__(self, frames: slice) -> Self:
        """In some of the frames."""
        velocities, spins = (None if a is None else a[frames] for a in (self.velocities, self.angular_velocities))
        places, turns = self.positions[frames], self.rotations[frames]
        return replace(self, positions=places, rotations=turns, velocities=velocities, angular_velocities=spins)

    def at(self, known: NDArray[Any], times: NDArray[Any]) -> Self:
        """The motion at ``times`` (k,) [s], between its frames at times ``known`` (frames,) [s]; without velocities."""
        places = np.stack([np.interp(times, known, x) for x in self.positions.T], axis=1)
        if self.rotations.ndim == 1:
            turns = np.interp(times, known, self.rotations)
        else:
            from scipy.spatial.transform import Rotation, Slerp

            turns = Slerp(known, Rotation.from_rotvec(self.rotations))(times).as_rotvec()
        return replace(self, positions=places, rotations=turns, velocities=None, angular_velocities=None)


class SolidMotions(dict[str, SolidMotion]):
    """Of the solids of a run that move, by their names."""

    def __missing__(self, name: object) -> SolidMotion:
        """Raises `InputError`."""
        known = f"moved {', '.join(self)}" if self else "moved none"
        raise InputError(f"solids has no {shown(name)}, as the run {known}.")

    def in_frames(self, frames: slice) -> "SolidMotions":
        """In some of the frames."""
        return SolidMotions({name: motion[frames] for name, motion in self.items()})

    def at(self, known: NDArray[Any], times: NDArray[Any]) -> "SolidMotions":
        """At ``times`` [s], between frames at times ``known`` [s]."""
        if np.array_equal(known, times):
            return self
        return SolidMotions({name: motion.at(known, times) for name, motion in self.items()})


def solid_motions(scene: Scene, fields: Mapping[str, NDArray[Any]]) -> SolidMotions:
    """Of the solids of a scene that move, by their names, from recorded fields (frames, 1, ...) of states."""
    return SolidMotions({table.name: _motion(table.name, fields, scene.dimension) for table in moved(scene, fields)})


def motions_in(fields: Mapping[str, NDArray[Any]], dimension: int) -> SolidMotions:
    """Of all solids of which recorded fields (frames, 1, ...) of states tell, by their names."""
    return SolidMotions({name: _motion(name, fields, dimension) for name in solids_in(fields)})


def moved(scene: Scene, fields: Mapping[str, NDArray[Any]]) -> list[Any]:
    """The solids of a scene that move, of which fields of states tell."""
    return [table for table in moving(scene.solid) if position_name(table.name) in fields]


def _motion(name: str, fields: Mapping[str, NDArray[Any]], dimension: int) -> SolidMotion:
    position, begun = (fields[of(name)][:, 0].astype(np.float64) for of in (position_name, rotation_name))
    if f"{name}.{AXES[0]}" in fields:  # of a body that is free
        axes = np.stack([fields[f"{name}.{axis}"][:, 0].astype(np.float64) for axis in AXES], axis=-1)
        moving: dict[str, Any] = {"velocities": fields[velocity_name(name)][:, 0]}
        moving["angular_velocities"] = fields[angular_velocity_name(name)][:, 0]
        return SolidMotion(position, _turned(axes + np.eye(dimension, 3), begun, dimension), **moving)
    turns = fields[turn_name(name)][:, 0].astype(np.float64)
    scale = [*fields.get(scale_name(name), np.zeros((0, 1)))[:, 0], 1.0][0]  # earlier versions kept none
    rotations = turns + begun if dimension == 2 else _product(turns, begun)
    return SolidMotion(position, rotations, scale=float(scale))


def _turned(axes: NDArray[Any], begun: NDArray[Any], dimension: int) -> NDArray[Any]:
    """The rotations of axes (frames, d, 3), columns in the frame of space, after those that a body began with; in 2-D
    angles, each the nearest to the one before."""
    if dimension == 2:
        return np.unwrap(np.arctan2(axes[:, 1, 0], axes[:, 0, 0])) + begun
    from scipy.spatial.transform import Rotation

    return _product(Rotation.from_matrix(axes).as_rotvec(), begun)


def _product(turns: NDArray[Any], begun: NDArray[Any]) -> NDArray[Any]:
    """(frames, 3) the rotation vectors of a first rotation and a turn after it."""
    from scipy.spatial.transform import Rotation

    return np.asarray((Rotation.from_rotvec(turns) * Rotation.from_rotvec(begun)).as_rotvec())


def sized(scene: Scene, motions: Mapping[str, SolidMotion]) -> Scene:
    """A scene with the solids that move as large as they are in a run."""
    tables = (table.stretched(motions[table.name].scale) if table.name in motions else table for table in scene.solid)
    return scene.model_copy(update={"solid": tuple(tables)})


def posed(scene: Scene, motions: Mapping[str, SolidMotion], frame: int) -> Scene:
    """The same where they are in a frame, to be drawn."""
    tables = [
        _posed(table, motions[table.name], frame) if table.name in motions else table
        for table in sized(scene, motions).solid
    ]
    return scene.model_copy(update={"solid": tuple(tables)})


def _posed(table: Any, motion: SolidMotion, frame: int) -> Any:
    rotation = tuple(np.atleast_1d(motion.rotations[frame]).tolist())
    return table.model_copy(update={"position": tuple(motion.positions[frame].tolist()), "rotation": rotation})
