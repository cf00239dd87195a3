"""How many explicit steps of diffusion a time step takes."""

import numpy as np

from cortado.discretise.calibration import diffusion_limit
from cortado.discretise.smoothing import smoothing_kernel
from cortado.errors import OutOfRangeError
from cortado.scene.scene import Scene
from cortado.sph.free_energy import MOBILITIES, FreeEnergy

MOST_SUBSTEPS = 10_000
"""Explicit steps of diffusion in a time step; beyond it the mobility is taken for a mistake."""


def stable_substeps(
    scene: Scene,
    free_energy: FreeEnergy,
    time_step: float,
    mobility: float,
    interface_width: float,
    rest_density: np.ndarray,
) -> int:
    """Those that are stable in a scene of several phases with a time step [s], a mobility [m2/s], an interface width
    [m] and rest densities (phases,) [kg/m3]; raises `OutOfRangeError` where there would be more than
    `MOST_SUBSTEPS`."""
    mixture, discretisation = scene.mixture, scene.discretisation
    limit = diffusion_limit(
        smoothing_kernel(discretisation.kernel),
        discretisation.spacing,
        discretisation.support_radius,
        scene.dimension,
        greatest_mobility=mobility * MOBILITIES[mixture.mobility_form].greatest(len(scene.phase)),
        interface_width=interface_width,
        curvature=mixture.strength * free_energy.curvature,
        density_ratio=float(np.max(rest_density) / np.min(rest_density)),
    )
    number = float(np.ceil(time_step / limit))
    if number > MOST_SUBSTEPS:
        raise OutOfRangeError(
            f"mobility is {mobility:g} m2/s, which takes {number:.3g} explicit steps of diffusion in a time step, but "
            f"must not take more than {MOST_SUBSTEPS}: lower it, interface_width or time_step."
        )
    return int(number)
