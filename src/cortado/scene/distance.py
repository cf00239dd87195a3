"""How far from the origin a scene may be in a precision."""

import numpy as np

from cortado.device.precision import Precision
from cortado.errors import InputError
from cortado.scene.discrete_scene import DiscreteScene
from cortado.scene.scene import Scene


def check_distance(scene: Scene, discrete: DiscreteScene, precision: Precision) -> None:
    """Far from the origin, positions are rounded to coarse steps; raises `InputError`."""
    spacing = scene.discretisation.spacing
    furthest = max(np.abs(discrete.near.lower).max(), np.abs(discrete.near.upper).max()) / spacing
    if furthest > precision.furthest:
        raise InputError(
            f"The scene reaches {furthest:.3g} spacings of {spacing:g} m from the origin, but must be within "
            f"{precision.furthest:g} in {precision.name}, which rounds positions there to steps of "
            f"{furthest * np.finfo(precision.numpy).eps:.1g} spacings: move it to the origin, or use another precision."
        )
