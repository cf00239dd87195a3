"""The parameters of a function of one's own as one vector, theta: time, numbers and vectors, one behind the other."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import warp as wp

from cortado.device.precision import Precision
from cortado.particles.state import Layout, Parameters
from cortado.scene.parameters.parameter import Parameter
from cortado.sph.integration import integration_module
from cortado.sph.parts import Adjoints, StepContext

WIDTH = (1, 3)
"""How many numbers of theta a parameter takes, by its rank."""


@dataclass(frozen=True)
class PackingKernels:
    """By the rank of a parameter: of its value in a step into theta, and of the adjoint of theta into its own."""

    pack: tuple[Any, Any]
    add: tuple[Any, Any]


@cache
def packing_kernels(precision: Precision, taped: bool) -> PackingKernels:
    """Parameters are (members, steps), or (members, 1) where they are constant."""
    real, vector = precision.real, precision.vector
    forward, backward = integration_module(precision, True, taped), integration_module(precision, False)

    @wp.kernel(module=forward)
    def pack_number(
        first: int,
        step: wp.array(dtype=wp.int32),
        values: wp.array2d(dtype=real),
        # out
        theta: wp.array2d(dtype=real),
    ):
        member = wp.tid()
        theta[member, first] = values[member, wp.min(step[member], values.shape[1] - 1)]

    @wp.kernel(module=forward)
    def pack_vector(
        first: int,
        step: wp.array(dtype=wp.int32),
        values: wp.array2d(dtype=vector),
        # out
        theta: wp.array2d(dtype=real),
    ):
        member = wp.tid()
        value = values[member, wp.min(step[member], values.shape[1] - 1)]
        theta[member, first] = value[0]
        theta[member, first + 1] = value[1]
        theta[member, first + 2] = value[2]

    @wp.kernel(module=backward, enable_backward=False)
    def add_number(
        first: int,
        step: wp.array(dtype=wp.int32),
        total: wp.array2d(dtype=real),
        # in and out
        values_bar: wp.array2d(dtype=real),
    ):
        member = wp.tid()
        row = wp.min(step[member], values_bar.shape[1] - 1)
        values_bar[member, row] = values_bar[member, row] + total[member, first]

    @wp.kernel(module=backward, enable_backward=False)
    def add_vector(
        first: int,
        step: wp.array(dtype=wp.int32),
        total: wp.array2d(dtype=real),
        # in and out
        values_bar: wp.array2d(dtype=vector),
    ):
        member = wp.tid()
        row = wp.min(step[member], values_bar.shape[1] - 1)
        bar = vector(total[member, first], total[member, first + 1], total[member, first + 2])
        values_bar[member, row] = values_bar[member, row] + bar

    return PackingKernels((pack_number, pack_vector), (add_number, add_vector))


class Packed:
    """Theta of every scene, its tangent, and its adjoint, for the force of one solver."""

    def __init__(self, parameters: Sequence[Parameter], layout: Layout, taped: bool):
        self._parameters, self._layout = tuple(parameters), layout
        self._kernels = packing_kernels(layout.precision, taped)
        self.dtype = theta_of(layout.precision, [p.rank for p in self._parameters])
        """A Warp vector."""
        self._size = self.dtype._length_
        self._flat, self._flat_dot = self._numbers(taped), self._numbers(False)
        self._theta, self._theta_dot = self._vectors(self._flat), self._vectors(self._flat_dot)
        self.shares = wp.zeros(layout.all_particles, dtype=self.dtype, device=layout.device)
        """(n,) for what every particle adds to the adjoint of theta in a step."""
        self._sum = layout.sum_of(self.dtype) if self._parameters else None

    def theta(self, step: StepContext) -> wp.array:
        """(members,) in a step."""
        return self._pack(step, step.parameters, self._flat, self._theta)

    def theta_dot(self, step: StepContext, parameters_dot: Parameters) -> wp.array:
        """(members,) its tangent."""
        return self._pack(step, parameters_dot, self._flat_dot, self._theta_dot)

    def collect(self, step: StepContext, bar: Adjoints) -> None:
        """Add up the `shares`, into the adjoints of the parameters."""
        if self._sum is None:
            return
        total = self._sum(self.shares)
        flat = self._view(total, self._layout.precision.real, (self._layout.members, self._size))
        for first, parameter in self._places():
            values_bar = self._rows(bar.parameters[parameter.name])
            given = {"first": first, "total": flat, "values_bar": values_bar}
            step.launch(self._kernels.add[parameter.rank], **given, threads=self._layout.members)

    def _pack(self, step: StepContext, values: Parameters, flat: wp.array, vectors: wp.array) -> wp.array:
        for first, parameter in self._places():
            given = {"first": first, "values": self._rows(values[parameter.name]), "theta": flat}
            step.launch(self._kernels.pack[parameter.rank], **given, threads=self._layout.members)
        return vectors

    def _places(self) -> list[tuple[int, Parameter]]:
        """Where in theta each parameter begins."""
        places, first = [], 0
        for parameter in self._parameters:
            places.append((first, parameter))
            first += WIDTH[parameter.rank]
        return places

    def _rows(self, array: wp.array) -> wp.array:
        """A parameter with an axis of steps, which has one entry where it is constant."""
        return array if array.ndim == 2 else array.reshape((self._layout.members, 1))

    def _numbers(self, requires_grad: bool) -> wp.array:
        layout = self._layout
        options = {"device": layout.device, "requires_grad": requires_grad}
        return wp.zeros((layout.members, self._size), dtype=layout.precision.real, **options)

    def _vectors(self, flat: wp.array) -> wp.array:
        """The same memory as vectors, that of its adjoint included."""
        shape = (self._layout.members,)
        vectors = self._view(flat, self.dtype, shape)
        if flat.requires_grad:
            vectors.grad = self._view(flat.grad, self.dtype, shape)
        return vectors

    @staticmethod
    def _view(array: wp.array, dtype: Any, shape: tuple[int, ...]) -> wp.array:
        view = wp.array(ptr=array.ptr, dtype=dtype, shape=shape, device=array.device)
        view._ref = array  # keeps the memory
        return view


def theta_of(precision: Precision, ranks: Sequence[int]) -> Any:
    """The Warp vector of as many numbers as parameters of these ranks have; of one, where there are none."""
    return precision.fractions(max(sum(WIDTH[rank] for rank in ranks), 1))
