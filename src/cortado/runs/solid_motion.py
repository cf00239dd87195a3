"""Where solids that move are in the frames of a run."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from cortado.scene.motions import moving, position_name, rotation_name, turn_name
from cortado.scene.scene import Scene


@dataclass(frozen=True, eq=False)
class SolidMotion:
    """One solid, in every frame."""

    positions: NDArray[Any]
    """(frames, d) of its middle [m]"""
    rotations: NDArray[Any]
    """(frames, 3) rotation vectors, in 2-D (frames,) angles, by which it is turned about its middle [rad]"""

    def __getitem__(self, frames: slice) -> Self:
        """In some of the frames."""
        return type(self)(self.positions[frames], self.rotations[frames])


def solid_motions(scene: Scene, fields: Mapping[str, NDArray[Any]]) -> dict[str, SolidMotion]:
    """Of the solids of a scene that move, by their names, from recorded fields (frames, 1, ...) of states."""
    return {table.name: _motion(table, fields, scene.dimension) for table in moved(scene, fields)}


def moved(scene: Scene, fields: Mapping[str, NDArray[Any]]) -> list[Any]:
    """The solids of a scene that move, of which fields of states tell."""
    return [table for table in moving(scene.solid) if position_name(table.name) in fields]


def _motion(table: Any, fields: Mapping[str, NDArray[Any]], dimension: int) -> SolidMotion:
    names = (name(table.name) for name in (position_name, turn_name, rotation_name))
    positions, turns, begun = (fields[name][:, 0].astype(np.float64) for name in names)
    if dimension == 2:
        return SolidMotion(positions, turns + begun)
    from scipy.spatial.transform import Rotation

    return SolidMotion(positions, (Rotation.from_rotvec(turns) * Rotation.from_rotvec(begun)).as_rotvec())


def posed(scene: Scene, motions: Mapping[str, SolidMotion], frame: int) -> Scene:
    """A scene to be drawn, with the solids that move where they are in a frame."""
    tables = [_posed(table, motions[table.name], frame) if table.name in motions else table for table in scene.solid]
    return scene.model_copy(update={"solid": tuple(tables)})


def _posed(table: Any, motion: SolidMotion, frame: int) -> Any:
    rotation = tuple(np.atleast_1d(motion.rotations[frame]).tolist())
    return table.model_copy(update={"position": tuple(motion.positions[frame].tolist()), "rotation": rotation})
