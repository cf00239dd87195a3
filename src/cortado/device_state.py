"""States on the device of a simulation, whose arrays other programs take and give by DLPack."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from cortado.device.state import State
from cortado.errors import InputError, shown
from cortado.parameters.scene_parameters import DENSITY, Simulated
from cortado.restart import RestartState
from cortado.words import Brief

PLACED = ("positions", "mass_fractions", DENSITY)
"""Fields of which it is judged whether they belong to the scene, and not only whether they are numbers."""


@dataclass(frozen=True, eq=False, repr=False)
class DeviceState(Brief):
    """A state, or those of all scenes of a batch, that stay on the device: `Stepping.on_device` makes one, and steps
    from it lead to others, each with arrays of its own.

    ``state["positions"]`` is a Warp array that shares its memory with what takes it by DLPack, such as
    ``torch.from_dlpack`` and ``jax.dlpack.from_dlpack``; nobody may write to it. It has the precision of the
    simulation, and vectors have three components in 2-D too.
    """

    arrays: State
    """All fields."""
    scenes: tuple[RestartState, ...]
    """The clock and the origin of each scene of a batch, without fields."""

    def __getitem__(self, name: str) -> wp.array:
        """A field by name: vectors (n, 3), fractions (n, phases), numbers (n,), in a batch (batch, n, ...)."""
        if name not in self.arrays.names:
            raise InputError(f"state has no {shown(name)}, but has {', '.join(self.arrays.names)}.")
        return self.arrays.numbers(name)


def write(what: str, given: Mapping[str, Any], to: State) -> None:
    """Copy arrays that speak DLPack to fields of a state; raises `InputError` for names that it does not have, and for
    arrays of another shape or type, or of another device."""
    for name, value in given.items():
        if name not in to.names:
            raise InputError(f"{what} has {shown(name)}, but must have only {', '.join(to.names)} in this scene.")
        own = to.numbers(name)
        array = _taken(f"{what} {name}", value)
        found = array.device, array.dtype, array.shape
        if found != (own.device, own.dtype, own.shape):
            one, other = (f"a {a.dtype.__name__} array {a.shape} on {a.device}" for a in (array, own))
            raise InputError(f"{what} {name} is {one}, but must be {other}.")
        wp.copy(own, array)


def _taken(what: str, value: Any) -> wp.array:
    if isinstance(value, np.ndarray):
        return wp.array(value, device="cpu")  # NumPy gives no arrays that are read-only by DLPack
    if not hasattr(value, "__dlpack__"):
        raise InputError(f"{what} is {shown(value)}, but must be an array that speaks DLPack, such as a torch.Tensor.")
    try:
        return value if isinstance(value, wp.array) else wp.from_dlpack(value)
    except (BufferError, RuntimeError, TypeError, AttributeError) as error:
        raise InputError(f"{what} cannot be taken by DLPack: {error}") from error


def read(state: State) -> dict[str, wp.array]:
    """Copies of the fields of a state, as arrays of numbers that others take by DLPack."""
    own = state.copy()
    return {name: own.numbers(name) for name in own.names}


def without_members(state: State, lost: Any) -> None:
    """Write NaN to the fields of scenes of a batch that were lost."""
    for b in lost:
        for array in state.member(b).arrays() if state.batch is not None else state.arrays():
            array.fill_(np.nan)


def moments(states: list[RestartState], simulation: Simulated) -> tuple[RestartState, ...]:
    """The clocks and origins of states that were judged."""
    found = tuple(RestartState({}, state.clock, state.origin) for state in states)
    simulation.judged_states.update(found)
    return found
