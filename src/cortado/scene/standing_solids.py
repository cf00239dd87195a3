"""What to say of solids that stand on a wall of the container and move along it."""

from collections.abc import Iterator
from itertools import product

import numpy as np

from cortado.discretise.solids.surface_points import surface_feet
from cortado.scene.containers import BoxContainer
from cortado.scene.model import SceneTables
from cortado.scene.solids import SolidTable

THROUGH = 1.5
"""In spacings: how far a solid reaches through a wall at least for fluid to rest in the corner between them. Water 15
deep moves with 0.13 m/s beside one that ends on the floor, with 0.10 if it goes on for 0.5 spacings, and with 0.05 for
1 to 5."""
FACING = 0.9
"""The part along an axis of the normal of a face that counts as one across it."""


def standing_sentences(scene: SceneTables) -> Iterator[str]:
    """One of each flat wall of the container that a solid moves along and ends on."""
    box = scene.container
    if not isinstance(box, BoxContainer):
        return
    spacing, ends = scene.discretisation.spacing, box.extent()
    for table in scene.solid:
        if table.motion != "path" or table.side == "inside":
            continue
        feet, away = surface_feet(table.solid(), spacing)
        for axis, upper in product(range(scene.dimension), (False, True)):
            sign = 1.0 if upper else -1.0
            through = sign * (feet[:, axis] - ends[upper][axis])
            on_it = (sign * away[:, axis] > FACING) & (through > -0.5 * spacing) & (through < 0.75 * spacing)
            if not box.periodic[axis] and np.count_nonzero(on_it) > 2 and _stays(table, axis, spacing):
                way = "xyz"[axis]
                yield (
                    f"the solid {table.name!r} moves along the wall of the container at {way} = "
                    f"{ends[upper][axis]:g} m and ends on it, which stirs fluid in the corner between them: let it "
                    f"reach through the wall by {THROUGH * spacing:.3g} m or more."
                )


def _stays(table: SolidTable, axis: int, spacing: float) -> bool:
    """Whether a path keeps its middle as far from a wall across an axis."""
    if table.rotations is not None or table.angular_velocity is not None:
        return False
    if table.positions is not None:
        return bool(np.ptp(np.array(table.positions)[:, axis]) < 0.5 * spacing)
    return table.velocity is None or table.velocity[axis] == 0.0
