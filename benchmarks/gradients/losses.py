"""The losses of the leaderboard, each a distance from the last state of a hidden run: a new one is an entry in
`LOSSES`."""

from collections.abc import Callable

from cortado import Simulation
from cortado.losses import CentreOfMass, FinalPositions, Image, Loss, Snapshot
from cortado.losses.image_losses import Pyramid

PIXELS = 32
"""Of the shorter side of a picture."""


def centre_of_mass(simulation: Simulation, hidden: Snapshot) -> Loss:
    """Squared distance of the centres of all particles [m2]."""
    return CentreOfMass(hidden.positions.mean(axis=0))


def picture(simulation: Simulation, hidden: Snapshot) -> Loss:
    """Pyramid of the difference of two pictures, in the plane or from above."""
    renderer = simulation.renderer(resolution=(2 * PIXELS, PIXELS))
    blank = Image(renderer, renderer.render(hidden.state.positions, hidden.state.mass_fractions, hidden.colours))
    return Image(renderer, blank.target, Pyramid())


def positions(simulation: Simulation, hidden: Snapshot) -> Loss:
    """Mean over particles of the squared distance to their places in the hidden run [m2]."""
    return FinalPositions(hidden.positions)


LOSSES: dict[str, Callable[[Simulation, Snapshot], Loss]] = {
    "centre-of-mass": centre_of_mass,
    "picture": picture,
    "positions": positions,
}
