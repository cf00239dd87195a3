"""What bounds the time steps of a run that chooses them, whatever the speed of the fluid."""

import numpy as np
from numpy.typing import NDArray

from cortado.errors import InputError
from cortado.scene.model import SceneTables
from cortado.scene.parameter_values import Arrays
from cortado.scene.stability import chosen_limits, gravity_limits, stability_limits


def greatest_step(scene: SceneTables, values: Arrays) -> float:
    """That no step of a run with these parameters is longer than, whatever its gravity [s]; raises `InputError` where
    nothing bounds them."""
    found = min(chosen_limits(scene, values).values())
    if not np.isfinite(found):
        raise InputError(
            "solver.greatest_time_step is missing, but must be given, as nothing else bounds the time step with these "
            "parameters where the fluid rests."
        )
    return found


def step_bounds(scene: SceneTables, values: Arrays, steps: int, least: float = 0.0) -> NDArray:
    """(steps,) that of each step [s]: a gravity that is given bounds each by its own row. Raises `InputError` where
    one, or one of a scheduled gravity, is below the ``least`` [s] that a precision bears."""
    bounds = np.full(max(steps, 1), greatest_step(scene, values))
    if "gravity" in values:
        limits = gravity_limits(scene, np.atleast_2d(values["gravity"])).values()
        bounds = np.minimum(bounds, np.minimum.reduce(list(limits)))
    strongest = stability_limits(scene, values)  # which a schedule has at some time
    if (shortest := min(float(bounds.min()), strongest["gravity"], strongest["depth"])) < least:
        raise InputError(
            f"The time step is chosen as {shortest:.3g} s at most, but must be at least {least:g} s in this precision: "
            "make solver.greatest_time_step, or what else bounds it, larger."
        )
    return bounds
