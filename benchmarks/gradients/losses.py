"""The losses of the leaderboard, each a distance from the last state of a hidden run: a new one is an entry in
`LOSSES`."""

from collections.abc import Callable
from typing import Any

import numpy as np

from cortado import Simulation
from cortado.image_losses import Pyramid
from cortado.losses import CentreOfMass, FinalPositions, Image, Loss, Snapshot
from cortado.scene.shape_tables import BoxContainer

PIXELS = 32
"""Of the shorter side of a picture."""


def centre_of_mass(simulation: Simulation, hidden: Snapshot) -> Loss:
    """Squared distance of the centres of all particles [m2]."""
    return CentreOfMass(hidden.positions.mean(axis=0))


def picture(simulation: Simulation, hidden: Snapshot) -> Loss:
    """Pyramid of the difference of two pictures, in the plane or from above."""
    return _picture(simulation, hidden, resolution=(2 * PIXELS, PIXELS))


def side_picture(simulation: Simulation, hidden: Snapshot) -> Loss:
    """The same through a camera that looks along the depth of the container and sees its whole front, so that the
    picture has the surface in it also where fluid covers the floor; in the plane it is `picture`."""
    if simulation.dimension == 2:
        return picture(simulation, hidden)
    container = simulation.scene.container
    assert isinstance(container, BoxContainer)
    lower, upper = np.array(container.lower), np.array(container.upper)
    middle, (width, height, depth) = (lower + upper) / 2.0, upper - lower
    camera = middle + [0.0, 0.0, depth / 2.0 + 1.4 * max(width, height)]
    return _picture(simulation, hidden, view="volume", position=camera, look_at=middle, resolution=(PIXELS, PIXELS))


def _picture(simulation: Simulation, hidden: Snapshot, **settings: Any) -> Loss:
    renderer = simulation.renderer(**settings)
    blank = Image(renderer, renderer.render(hidden.state.positions, hidden.state.mass_fractions, hidden.colours))
    return Image(renderer, blank.target, Pyramid())


def positions(simulation: Simulation, hidden: Snapshot) -> Loss:
    """Mean over particles of the squared distance to their places in the hidden run [m2]."""
    return FinalPositions(hidden.positions)


LOSSES: dict[str, Callable[[Simulation, Snapshot], Loss]] = {
    "centre-of-mass": centre_of_mass,
    "picture": picture,
    "side-picture": side_picture,
    "positions": positions,
}
