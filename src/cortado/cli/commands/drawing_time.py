"""How long a picture of a scene takes to draw, measured before the scene is run."""

import time

from cortado.errors import ComputationError
from cortado.pictures.painter import colours_of, painter
from cortado.simulation import Simulation


def seconds_of_picture(simulation: Simulation) -> float | None:
    """How long one takes of the first state, with all cores that a film has; None where nothing is seen of the fluid
    then."""
    scene, positions = simulation.scene, simulation.positions[: simulation.free_particles or None]
    colours = colours_of(scene, simulation.mass_fractions, simulation.particles)[: len(positions)]
    draws = painter(scene, positions, simulation.device)
    try:
        draws.image(positions, colours)  # compiles, and draws what does not change
        begun = time.perf_counter()
        draws.image(positions, colours)
        return time.perf_counter() - begun
    except ComputationError:
        return None
