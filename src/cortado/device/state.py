"""What a step depends on, as Warp arrays by name: the state before it, and the parameters."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
import warp as wp

from cortado.device.arrays import Arrays, padded, zeros
from cortado.device.fields import Entry, StateField
from cortado.device.precision import Precision
from cortado.parameters.registry import BY_NAME, Axis, Role, names
from cortado.parameters.values import OVER_TIME


class State(Arrays):
    """All that a step depends on besides parameters, by the names of the fields that the solver declares. Also the type
    of its derivatives.

    Every state has ``positions`` (n,) vectors [m], ``velocities`` (n,) vectors [m / s] and ``mass_fractions`` (n,) of
    as many numbers as there are phases [-], in the scene's order of particles.
    """

    def __init__(self, fields: tuple[StateField, ...], arrays: Mapping[str, wp.array]):
        super().__init__(arrays)
        self.fields = fields

    @property
    def positions(self) -> wp.array:
        """(n,) vectors [m]."""
        return self["positions"]

    @property
    def velocities(self) -> wp.array:
        """(n,) vectors [m / s]."""
        return self["velocities"]

    @property
    def mass_fractions(self) -> wp.array:
        """(n,) of as many numbers as there are phases [-]."""
        return self["mass_fractions"]

    def like(self) -> Self:
        """One of the same fields and sizes, all 0."""
        return type(self)(self.fields, {name: wp.zeros_like(self[name], requires_grad=False) for name in self.names})

    def following(self) -> Self:
        """A later state of the same run that is still to be written: what no step changes is the same array."""
        new = {f.name: self[f.name] if f.is_constant else wp.empty_like(self[f.name]) for f in self.fields}
        return type(self)(self.fields, new)

    def copy(self) -> Self:
        """The same in arrays of its own."""
        new = self.like()
        new.assign(self)
        return new

    def set(self, values: Mapping[str, Any]) -> None:
        """Write fields by name: vectors (n, d), numbers (n,), fractions (n, phases)."""
        for field in self.fields:
            if field.name in values:
                given = np.asarray(values[field.name])
                self[field.name].assign(padded(given) if field.entry is Entry.VECTOR else given)

    def numpy(self, dimension: int, constants: bool = True) -> dict[str, np.ndarray]:
        """Every field as a new array: vectors (n, dimension), numbers (n,), fractions (n, phases); ``constants``: also
        what no step changes."""
        arrays = {f: self[f.name].numpy() for f in self.fields if constants or not f.is_constant}
        return {f.name: (a[:, :dimension] if f.entry is Entry.VECTOR else a).copy() for f, a in arrays.items()}


class Parameters(Arrays):
    """What steps depend on besides the state, by the names of the registry. Also the type of its derivatives.

    A parameter over time is (steps,) vectors, one of phases (phases,) numbers, any other (1,) number.
    """

    def set(self, values: Mapping[str, Any]) -> None:
        """Write some by name: a vector (d,) for every step, or vectors (steps, d); numbers or arrays of them."""
        for name, value in values.items():
            array, given = self[name], np.asarray(value, dtype=np.float64)
            if name in OVER_TIME:
                table = np.zeros((len(array), 3))
                table[:, : given.shape[-1]] = given
                array.assign(table)
            else:
                array.assign(np.broadcast_to(given, array.shape))


@dataclass(frozen=True)
class Layout:
    """How large the arrays of one solver are, and where they are. Several scenes in one launch, or solids, would be an
    axis more here; kernels have one thread for each particle, whichever scene it belongs to."""

    particles: int
    phases: int
    precision: Precision
    device: Any

    def state(self, fields: tuple[StateField, ...], requires_grad: bool = False) -> State:
        """A state of these fields, all 0."""
        precision = self.precision
        dtypes = {
            Entry.NUMBER: precision.real,
            Entry.VECTOR: precision.vector,
            Entry.FRACTIONS: precision.fractions(self.phases),
            Entry.DOUBLE: wp.float64,
        }
        sizes = {Axis.PARTICLE: self.particles, Axis.SCALAR: 1}
        kinds = {field.name: (sizes[field.axis], dtypes[field.entry]) for field in fields}
        return State(fields, zeros(kinds, self.device, requires_grad))

    def parameters(self, steps: int, requires_grad: bool = False) -> Parameters:
        """Parameters of a run of so many steps, all 0."""
        real, vector = self.precision.real, self.precision.vector
        of_axis = {Axis.STEP: (max(steps, 1), vector), Axis.PHASE: (self.phases, real)}
        kinds = {name: of_axis.get(BY_NAME[name].axis, (1, real)) for name in names(Role.RUN)}
        return Parameters(zeros(kinds, self.device, requires_grad))
