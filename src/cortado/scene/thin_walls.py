"""What to say of solids that are too thin to hold fluid."""

from collections.abc import Iterator

import numpy as np

from cortado.discretise.room import Room
from cortado.discretise.surface_points import surface_feet
from cortado.scene.model import DiscretisationTable, SceneTables
from cortado.scene.room import resting_room
from cortado.scene.sentences import point_in_words

ONE_LAYER, TWO_LAYERS = 1.1, 1.5
"""In spacings: how thick walls are at least that hold fluid, where they have one layer of particles, and two as fluid
sees further than two spacings. With either solver, and steps however short, water 25 to 120 spacings deep, at rest, on
a shelf or in a cup, went through those of 0.75, in space 1.0, and of 1.0 to 1.25, within 10 to 90 steps."""
DEPTHS = np.arange(1, 9) / 8.0
"""Of that thickness: beneath the surface there is to be no room for fluid so deep."""
MARGIN = 1e-3
"""Of it, too: what is so little thinner is thick enough."""
SHARE = 0.01
"""Of the surface: where no more is too thin, nothing is said."""


def holding_thickness(cut: DiscretisationTable) -> float:
    """How thick walls are at least that hold fluid [m]."""
    return (ONE_LAYER if cut.support <= 2.0 else TWO_LAYERS) * cut.spacing


def thin_sentences(scene: SceneTables) -> Iterator[str]:
    """One of each solid that has fluid on both sides where it is too thin to hold any."""
    least, spacing = holding_thickness(scene.discretisation), scene.discretisation.spacing
    for table in scene.solid if scene.forces.pressure else ():
        solid, resting = table.solid(), resting_room(scene)
        room = Room(resting.region, (solid,), resting.periods) if table.moves else resting
        feet, away = surface_feet(solid, spacing)
        feet, away = (part[room.contains(feet + MARGIN * least * away, 0.0)] for part in (feet, away))
        depths = (1.0 - MARGIN) * least * DEPTHS
        thin = np.any([room.contains(feet - depth * away, -MARGIN * depth) for depth in depths], axis=0)
        if np.count_nonzero(thin) > SHARE * len(thin):
            place = point_in_words(feet[thin][0].round(4))
            yield (
                f"the solid {table.name!r} is thinner than {least:.3g} m, {least / spacing:g} times the spacing, at "
                f"{np.mean(thin):.0%} of its surface, for example at {place}: fluid that presses on it may go "
                "through. Make it thicker, or the spacing smaller."
            )
