"""The grid of the coarse correction, without Warp."""

from cortado.device.grid import Grid
from cortado.scene.discrete_scene import DiscreteScene
from cortado.scene.scene import Scene

SPACING = 2.0
"""Distance of nodes, in spacings of particles."""


def coarse_grid(scene: Scene, discrete: DiscreteScene, particles: int) -> Grid:
    """The nodes for so many particles: about everything that can be reached; what goes further wraps around."""
    reach, most = SPACING * scene.discretisation.spacing, max(4 * particles, 512)
    return Grid.around(discrete.near.lower, discrete.near.upper, discrete.periods, reach, most)
