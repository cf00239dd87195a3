"""What a loss is, what it is given, and the sum of several at several steps."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

import numpy as np

from cortado.arrays import is_whole
from cortado.device.precision import FLOAT32, FLOAT64, Precision
from cortado.device.state import State
from cortado.errors import InputError, shown
from cortado.fixed import FixedDict, fixed
from cortado.words import counted


def precision_of(state: State) -> Precision:
    """Of the arrays of a state."""
    return FLOAT64 if state.positions.dtype == FLOAT64.vector else FLOAT32


@dataclass(frozen=True)
class Snapshot:
    """A state of a rollout, the last one as a rule, as NumPy arrays or as Warp arrays, in the scene's order."""

    state: State
    """Warp arrays (n,): positions [m], velocities [m / s], mass fractions [-], and what else the solver carries from
    step to step."""
    dimension: int
    colours: np.ndarray
    """(phases, 3) of the phases: red, green and blue, linear, from 0 to 1."""

    def __repr__(self) -> str:
        return f"Snapshot({counted(len(self.state.positions), 'particle')}, {self.precision.name})"

    @property
    def precision(self) -> Precision:
        """Of the Warp arrays."""
        return precision_of(self.state)

    @cached_property
    def positions(self) -> np.ndarray:
        """(n, d) [m], float64, read-only"""
        return _read_only(self.state.positions.numpy()[:, : self.dimension])

    @cached_property
    def velocities(self) -> np.ndarray:
        """(n, d) [m / s], float64, read-only"""
        return _read_only(self.state.velocities.numpy()[:, : self.dimension])

    @cached_property
    def mass_fractions(self) -> np.ndarray:
        """(n, phases) [-], float64, read-only"""
        return _read_only(self.state.mass_fractions.numpy())


def _read_only(values: np.ndarray) -> np.ndarray:
    """A copy in float64 that a loss cannot change by mistake for what is computed from it next."""
    found = values.astype(np.float64)
    found.flags.writeable = False
    return found


@dataclass(frozen=True, repr=False)
class SnapshotAdjoint:
    """Derivatives of a loss that also looks at the colours."""

    state: State
    """With respect to positions, velocities and mass fractions, as Warp arrays."""
    colours: np.ndarray
    """(phases, 3)"""


ADJOINT_FIELDS = ("positions", "velocities", "mass_fractions")
"""What the arrays of an adjoint are derivatives with respect to, in their order."""
Adjoint = State | SnapshotAdjoint | tuple[np.ndarray, ...]
"""Derivatives of a loss with respect to positions and velocities, (n, d) each, and, if there is a third array, mass
fractions (n, phases); or as Warp arrays."""


def by_field(bar: Adjoint, dimension: int) -> dict[str, np.ndarray]:
    """An adjoint as arrays by the fields of a state that they are derivatives with respect to, vectors (n, d)."""
    if isinstance(bar, SnapshotAdjoint):
        return bar.state.numpy(dimension)
    return bar.numpy(dimension) if isinstance(bar, State) else dict(zip(ADJOINT_FIELDS, bar, strict=False))


class Loss(Protocol):
    """A differentiable number of the end of a trajectory.

    A loss of your own may have a method ``adjoint(end)``, of the derivatives alone, in the place of
    `value_and_adjoint`.
    """

    def value(self, end: Snapshot) -> float:
        """The loss."""

    def value_and_adjoint(self, end: Snapshot) -> tuple[float, Adjoint]:
        """The loss and its derivatives, in one call as they often share work: a tuple of NumPy arrays, or a `State` of
        Warp arrays, which ``end.state.like()`` makes, all 0, and ``set({"positions": array})`` of it fills."""


@fixed
class Frames:
    """The sum of losses of several states on the way, by the number of steps before each."""

    def __init__(self, losses: Mapping[int, Loss]):
        """``losses`` {number of steps: loss}; 0 is the first state."""
        if not isinstance(losses, Mapping) or not losses:
            raise InputError(f"losses is {shown(losses)}, but must be a table with a loss for at least one frame.")
        for step in losses:
            if not is_whole(step) and not (isinstance(step, float) and float(step).is_integer()):
                raise InputError(f"losses has the frame {shown(step)}, but must have whole numbers of steps.")
        self.losses = FixedDict(losses)

    @property
    def fingerprint(self) -> str:
        """Tells one set of targets from another, for checkpoints."""
        return " ".join(f"{step}:{fingerprint(loss)}" for step, loss in sorted(self.losses.items()))


def fingerprint(loss: Any) -> str:
    """A text that tells one loss from another; of a loss without its own ``fingerprint`` only the type."""
    return getattr(loss, "fingerprint", type(loss).__qualname__)
