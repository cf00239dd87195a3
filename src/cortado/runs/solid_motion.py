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
    courses,
    moving,
    position_name,
    rotation_name,
    scale_name,
    solids_in,
    told,
    turn_name,
    velocity_name,
)
from cortado.scene.scene import Scene
from cortado.scene.solids import SolidTable


@dataclass(frozen=True, eq=False)
class SolidMotion:
    """The motion of one solid, in every frame."""

    positions: NDArray[Any]
    """(frames, d) positions of its middle [m]"""
    rotations: NDArray[Any]
    """(frames, 3) rotation vectors, in 2-D (frames,) angles, by which it is turned about its middle [rad]"""
    velocities: NDArray[Any] | None = None
    """(frames, d) velocities of the middle of a body that is free [m/s]; None for one with a given path."""
    angular_velocities: NDArray[Any] | None = None
    """(frames, 3), in 2-D (frames,), of a body that is free [rad/s]; None for others."""
    scale: float = 1.0
    """Scale of a solid with a given path, relative to the scene's."""

    def __getitem__(self, frames: slice | NDArray[np.intp]) -> Self:
        """Return the motion in some of the frames."""
        velocities, spins = (None if a is None else a[frames] for a in (self.velocities, self.angular_velocities))
        places, turns = self.positions[frames], self.rotations[frames]
        return replace(self, positions=places, rotations=turns, velocities=velocities, angular_velocities=spins)

    def carried(self, shifts: NDArray[Any]) -> Self:
        """Return a free body's motion a short time later in each frame, or earlier, ``shifts`` (frames,) [s]: it goes
        on at its velocities."""
        assert self.velocities is not None and self.angular_velocities is not None
        places, turns = self.positions + shifts[:, None] * self.velocities, (shifts * self.angular_velocities.T).T
        rotations = self.rotations + turns if turns.ndim == 1 else _product(turns, self.rotations)
        return replace(self, positions=places, rotations=rotations)

    def between(self, known: NDArray[Any], times: NDArray[Any], table: SolidTable) -> Self:
        """Return the motion at ``times`` (k,) [s] of a solid with a given path and frames at times ``known`` (frames,)
        [s]: as its ``table`` tells, but for changes by a run, which are interpolated."""
        shift, turn = courses(table)
        kept = self.positions - shift.at(known)
        places = np.stack([np.interp(times, known, x) for x in kept.T], axis=1) + shift.at(times)
        if self.rotations.ndim == 1:
            turns = np.interp(times, known, self.rotations - turn.at(known)) + turn.at(times)
        else:
            from scipy.spatial.transform import Rotation, Slerp

            begun = Rotation.from_rotvec(_product(-turn.at(known), self.rotations))
            turns = _product(turn.at(times), Slerp(known, begun)(times).as_rotvec())
        return replace(self, positions=places, rotations=turns)


class SolidMotions(dict[str, SolidMotion]):
    """The motions of the solids of a run that move, by their names."""

    def __missing__(self, name: object) -> SolidMotion:
        """Raise `InputError` for a solid that did not move."""
        known = f"moved {', '.join(self)}" if self else "moved none"
        raise InputError(f"solids has no {shown(name)}, as the run {known}.")

    def in_frames(self, frames: slice) -> "SolidMotions":
        """Return the motions in some of the frames."""
        return SolidMotions({name: motion[frames] for name, motion in self.items()})

    def at(self, scene: Scene, known: NDArray[Any], recorded: NDArray[np.intp], times: NDArray[Any]) -> "SolidMotions":
        """Return the motions at ``times`` (k,) [s], each near the frame of a number ``recorded`` (k,), in a run of a
        scene with frames at times ``known`` (frames,) [s]."""
        shifts, tables = times - known[recorded], {table.name: table for table in told(scene.solid)}
        if not shifts.any():
            return SolidMotions({name: motion[recorded] for name, motion in self.items()})
        return SolidMotions(
            {
                name: motion.between(known, times, tables[name]) if name in tables else motion[recorded].carried(shifts)
                for name, motion in self.items()
                if name in tables or motion.velocities is not None
            }
        )


def solid_motions(scene: Scene, fields: Mapping[str, NDArray[Any]]) -> SolidMotions:
    """Return the motions of the solids of a scene, by their names, from recorded fields (frames, 1, ...) of states."""
    return SolidMotions({table.name: _motion(table.name, fields, scene.dimension) for table in moved(scene, fields)})


def motions_in(fields: Mapping[str, NDArray[Any]], dimension: int) -> SolidMotions:
    """Return the motions of all solids that recorded fields (frames, 1, ...) of states have, by their names."""
    return SolidMotions({name: _motion(name, fields, dimension) for name in solids_in(fields)})


def moved(scene: Scene, fields: Mapping[str, NDArray[Any]]) -> list[Any]:
    """Return the solids of a scene that move, of which fields of states tell."""
    return [table for table in moving(scene.solid) if position_name(table.name) in fields]


def _motion(name: str, fields: Mapping[str, NDArray[Any]], dimension: int) -> SolidMotion:
    position, begun = (fields[of(name)][:, 0].astype(np.float64) for of in (position_name, rotation_name))
    if f"{name}.{AXES[0]}" in fields:  # of a body that is free
        axes = np.stack([fields[f"{name}.{axis}"][:, 0].astype(np.float64) for axis in AXES], axis=-1)
        moving: dict[str, Any] = {"velocities": fields[velocity_name(name)][:, 0]}
        moving["angular_velocities"] = fields[angular_velocity_name(name)][:, 0]
        return SolidMotion(position, _turned(axes + np.eye(dimension, 3), begun, dimension), **moving)
    turns = fields[turn_name(name)][:, 0].astype(np.float64)
    rotations = turns + begun if dimension == 2 else _product(turns, begun)
    return SolidMotion(position, rotations, scale=float([*fields[scale_name(name)][:, 0], 1.0][0]))


def _turned(axes: NDArray[Any], begun: NDArray[Any], dimension: int) -> NDArray[Any]:
    """Return the rotations of axes (frames, d, 3), columns in the frame of space, after those that a body began with;
    in 2-D angles, each the nearest to the one before."""
    if dimension == 2:
        return np.unwrap(np.arctan2(axes[:, 1, 0], axes[:, 0, 0])) + begun
    from scipy.spatial.transform import Rotation

    return _product(Rotation.from_matrix(axes).as_rotvec(), begun)


def _product(turns: NDArray[Any], begun: NDArray[Any]) -> NDArray[Any]:
    """Return the rotation vectors (frames, 3) of a first rotation and a turn after it."""
    from scipy.spatial.transform import Rotation

    return np.asarray((Rotation.from_rotvec(turns) * Rotation.from_rotvec(begun)).as_rotvec())


def sized(scene: Scene, motions: Mapping[str, SolidMotion]) -> Scene:
    """Return a scene with the solids that move as large as they are in a run."""
    tables = (table.stretched(motions[table.name].scale) if table.name in motions else table for table in scene.solid)
    return scene.model_copy(update={"solid": tuple(tables)})


def posed(scene: Scene, motions: Mapping[str, SolidMotion], frame: int) -> Scene:
    """Return a scene with the solids where they are in a frame, to be drawn."""
    tables = []
    for table in sized(scene, motions).solid:
        if motion := motions.get(table.name):
            rotation = tuple(np.atleast_1d(motion.rotations[frame]).tolist())
            table = table.model_copy(update={"position": tuple(motion.positions[frame].tolist()), "rotation": rotation})
        tables.append(table)
    return scene.model_copy(update={"solid": tuple(tables)})
