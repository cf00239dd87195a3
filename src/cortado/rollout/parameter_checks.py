"""Whether parameters make sense for a scene: numbers that a precision holds, places inside of the container, and time
steps below the limit of stability."""

from typing import Any

import numpy as np

from cortado.device.precision import Precision
from cortado.discretise.room import TOLERANCE, Room
from cortado.errors import InputError, OutOfRangeError
from cortado.scene.model import room_of
from cortado.scene.parameter_values import Arrays, Known
from cortado.scene.parameters import Range
from cortado.scene.scene import Scene
from cortado.scene.stability import broken_limits

CROWDED = 0.5
"""Of the room that their fluid fills: particles with less for all of them cannot be pushed apart."""


def check_sizes(values: Arrays, precision: Precision, known: Known) -> None:
    """Numbers are no larger than the precision bears, nor smaller where they must be positive; else it raises
    `OutOfRangeError`."""
    for name, value in values.items():
        size = np.abs(value)
        if size.max(initial=0.0) > precision.greatest:
            wanted = f"at most {precision.greatest:g} in {precision.name}"
            raise OutOfRangeError(f"parameter {name} has a value of size {size.max():g}, but must be {wanted}.")
        if known[name].range is Range.POSITIVE and size.min(initial=1.0) < 1.0 / precision.greatest:
            wanted = f"at least {1.0 / precision.greatest:g} in {precision.name}"
            raise OutOfRangeError(f"parameter {name} is {size.min():g}, but must be {wanted}.")


def check_places(values: Arrays, scene: Scene, free: int) -> None:
    """Fluid starts inside of the container, and the opening of the emitter stays there; raises `InputError`. Only the
    first ``free`` particles do not wait in the emitter, where they may be outside."""
    spacing = scene.discretisation.spacing
    if "initial_positions" in values and scene.forces.pressure:
        positions = values["initial_positions"]
        for particle in outside(room_of(scene), positions[:free], spacing)[:1]:
            place = place_in_words(positions[particle])
            raise InputError(
                f"parameter initial_positions has particle {particle} at {place}, outside the container or in a solid."
            )
        _check_room(positions[:free], spacing)
    if scene.solver.chooses and np.ndim(values.get("nozzle_path", 0.0)) == 2:
        raise InputError(
            "parameter nozzle_path has a row for each step, but must be one place where time steps are chosen: move "
            "the nozzle by the table [schedule], whose times do not depend on the steps."
        )
    if "nozzle_path" in values and scene.emitter is not None:
        path, opening = np.atleast_2d(values["nozzle_path"]), scene.emitter.opening(spacing) - scene.emitter.outlet
        places = (path[:, None] + opening).reshape(-1, scene.dimension)
        for step in outside(room_of(scene), places, spacing)[:1] // len(opening):
            raise InputError(
                f"parameter nozzle_path is at {place_in_words(path[step])} in step {step + 1}, but must be where all "
                "of the opening is inside the container."
            )


def unstable_sentence(values: Arrays, scene: Scene, told: set[str]) -> str | None:
    """What to say of a time step beyond limits of stability under these parameters, of which the least counts that was
    not told; None if there is nothing. All of them are told then."""
    if scene.solver.time_step == "auto":
        return None
    time_step = float(values.get("time_step", scene.solver.time_step))
    broken = [(name, limit) for name, limit in broken_limits(scene, values, time_step) if name not in told]
    if not broken:
        return None
    told.update(name for name, _ in broken)
    name, limit = broken[0]
    found = f"time_step is {time_step:g} s, but the limit of stability with these parameters is about {limit:.3g} s"
    return f"{found}, which comes from {name}."


def _check_room(positions: np.ndarray, spacing: float) -> None:
    """Positions (n, d) [m] are not crowded into a small part of the room that their fluid needs."""
    room = np.prod(np.ptp(positions, axis=0) + spacing) if len(positions) else np.inf
    needed = len(positions) * spacing ** positions.shape[-1]
    if room < CROWDED * needed:
        unit = "m2" if positions.shape[-1] == 2 else "m3"
        raise InputError(
            f"parameter initial_positions has all particles within {room:.3g} {unit}, but must leave them about the "
            f"{needed:.3g} {unit} that their fluid fills."
        )


def outside(room: Room, points: Any, spacing: float) -> np.ndarray:
    """The numbers of the points (n, d) [m] that are outside of a room, along whose periods nothing is."""
    return np.flatnonzero(~room.contains(points, TOLERANCE * spacing))


def place_in_words(point: np.ndarray) -> str:
    return f"({', '.join(f'{x:g}' for x in point)}) m"
