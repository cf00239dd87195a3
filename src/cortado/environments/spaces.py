"""What Gymnasium asks of an environment: its spaces, actions that fit, and pictures."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from cortado.arrays import as_numbers, require_table
from cortado.environments.gym import gymnasium
from cortado.environments.scenes import Scenes
from cortado.errors import InputError, shown
from cortado.files.image_encoding import to_srgb
from cortado.runs.trajectory import Frame

METADATA: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 30}
WIDTH, HEIGHT = 320, 200
"""Of pictures."""


def spaces(scenes: Scenes) -> tuple[Any, Any]:
    """Of the observations and of the actions of one environment."""
    seen = scenes.observed().shape[1]
    actions = sum(len(one.axes) for one in scenes.task.actuators)
    everything = gymnasium.spaces.Box(-np.inf, np.inf, (seen,), np.float32)
    return everything, gymnasium.spaces.Box(-1.0, 1.0, (actions,), np.float32)


def checked_actions(what: str, given: Any, shape: tuple[int, ...]) -> NDArray[np.float64]:
    """Actions of a shape, cut off at -1 and 1; raises `InputError` for another shape and for what is not finite."""
    array = as_numbers(what, given)
    if array.shape != shape:
        raise InputError(f"{what} has shape {array.shape}, but must be {shape}.")
    if not np.isfinite(array).all():
        raise InputError(f"{what} has a value that is not finite, but must be numbers from -1 to 1.")
    return np.clip(array, -1.0, 1.0)


def checked_render_mode(mode: str | None) -> str | None:
    """Raises `InputError` for one that there is not."""
    if mode not in (None, *METADATA["render_modes"]):
        raise InputError(f'render_mode is {shown(mode)}, but must be None or "rgb_array".')
    return mode


def require_options(options: Any, *known: str) -> None:
    """Raises `InputError` for options of a reset that are no table, or that have others than the known ones."""
    require_table("options", options or {}, "{'reset_mask': array of bool}")
    for name in options or {}:
        if name not in known:
            wanted = f"have {', '.join(known)} alone" if known else "be left out, as all is drawn from the seed"
            raise InputError(f"options has {shown(name)}, but must {wanted}.")


def pictures(scenes: Scenes) -> list[NDArray[np.uint8]]:
    """(HEIGHT, WIDTH, 3) of each scene."""
    simulation, found = scenes.simulation, []
    fields = scenes.state.arrays.numpy(simulation.dimension)
    own = ("positions", "velocities", "mass_fractions")
    for b in range(len(scenes)):
        others = {name: array[b] for name, array in fields.items() if name not in own}
        fractions = fields["mass_fractions"][b] if len(simulation.scene.phase) > 1 else None
        frame = Frame(fields["positions"][b], fields["velocities"][b], fractions, 0.0, others=others)
        found.append(to_srgb(simulation.picture(frame, width=WIDTH, height=HEIGHT)))
    return found
