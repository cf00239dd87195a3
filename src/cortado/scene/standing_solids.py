"""What to say of solids that stand on a wall of the container and move along it."""

from collections.abc import Iterator
from itertools import product

import numpy as np

from cortado.discretise.surface_points import surface_feet
from cortado.scene.containers import BoxContainer
from cortado.scene.model import SceneTables
from cortado.scene.motions import Steady, courses, told
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
    for table in told(scene.solid):
        axes = [axis for axis in range(scene.dimension) if not box.periodic[axis] and _stays(table, axis, spacing)]
        if table.side == "inside" or not axes:
            continue
        feet, away = surface_feet(table.solid(), spacing)
        for axis, upper in product(axes, (False, True)):
            sign = 1.0 if upper else -1.0
            through = sign * (feet[:, axis] - ends[upper][axis])
            on_it = (sign * away[:, axis] > FACING) & (through > -0.5 * spacing) & (through < 0.75 * spacing)
            if np.count_nonzero(on_it) > 2:
                yield (
                    f"the solid {table.name!r} moves along the wall of the container at {'xyz'[axis]} = "
                    f"{ends[upper][axis]:g} m and ends on it, which stirs fluid in the corner between them: let it "
                    f"reach through the wall by {THROUGH * spacing:.3g} m or more."
                )


def _stays(table: SolidTable, axis: int, spacing: float) -> bool:
    """Whether a path does not turn a solid, and keeps its middle as far from a wall across an axis."""
    shifts, turns = courses(table)
    if turns.greatest() > 0.0:
        return False
    if isinstance(shifts, Steady):
        return bool(shifts.rate[axis] == 0.0)
    return bool(np.ptp(shifts.values[:, axis]) < 0.5 * spacing)
