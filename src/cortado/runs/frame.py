"""One recorded state of a run."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cortado.errors import InputError
from cortado.scene.quantities import check_quantity
from cortado.words import counted


@dataclass(frozen=True, eq=False)
class Frame:
    """One recorded state of a run, ``trajectory[k]``; n particles in d dimensions."""

    positions: NDArray[Any]
    """(n, d) [m]"""
    velocities: NDArray[Any]
    """(n, d) [m/s]"""
    mass_fractions: NDArray[Any] | None
    """(n, phases) [-]; None with one phase"""
    time: float
    """[s]"""
    quantities: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    """(n,) or (n, k) by name: those that were recorded, such as ``density``"""
    others: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    """further fields of the state by name, such as those that parts keep; see `Trajectory`"""

    def __getitem__(self, name: str) -> NDArray[Any]:
        """A quantity of the particles by its name, one that was recorded or the speed, or a field of the state.

        Raises:
            InputError: it was not recorded, or there is no such quantity.
        """
        fractions = {} if self.mass_fractions is None else {"mass_fractions": self.mass_fractions}
        fields = {"positions": self.positions, "velocities": self.velocities, **fractions, **self.others}
        return chosen(self.quantities, name, fields)

    def moved(self, duration: float) -> Frame:
        """About the state a short time [s] later, or earlier: every particle goes on along its velocity."""
        if duration == 0.0:
            return self
        return replace(self, positions=self.positions + duration * self.velocities, time=self.time + duration)

    def __repr__(self) -> str:
        return f"Frame({counted(len(self.positions), 'particle')}, t = {self.time:.4g} s)"


def chosen(quantities: Mapping[str, NDArray[Any]], name: str, fields: Mapping[str, NDArray[Any]]) -> NDArray[Any]:
    """A quantity that was recorded, the speed, or one of ``fields``; raises `InputError` for any other name."""
    check_quantity(name, others=tuple(fields))
    if name in fields:
        return fields[name]
    if name == "speed" and name not in quantities:
        return np.linalg.norm(fields["velocities"], axis=-1)
    if name not in quantities:
        found = f"{', '.join(quantities)} and the speed are" if quantities else "only the speed is"
        advice = f'record it, as in simulation.run(steps, record=["{name}"]), or ask simulation.quantity for it'
        raise InputError(f"{name} was not recorded, {found} there: {advice}.")
    return quantities[name]
