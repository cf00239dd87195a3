"""Fields of particles that a solver carries from step to step: a pressure that the next step begins with, say.

A state has them in the scene's order of particles, a step works on sorted ones. The adjoint of sorting is the way back.
"""

from collections.abc import Iterable, Mapping

import warp as wp

from cortado.device.modules import kernel_module, kind_of
from cortado.device.reduction import type_name
from cortado.particles.fields import StateField
from cortado.particles.state import Layout, State
from cortado.scene.parameters.parameter import Axis
from cortado.sph.order import OrderKernels, order_kernels
from cortado.sph.parts import StepContext


class Carried:
    """Sorted fields of a step, or their tangents or adjoints."""

    def __init__(self, fields: Iterable[StateField], layout: Layout, requires_grad: bool = False):
        """Raises `TypeError` for a field that has not an entry for each particle."""
        fields = tuple(fields)
        for field in fields:
            if field.axis is not Axis.PARTICLE:
                raise TypeError(
                    f"field {field.name!r} has one entry, but must have one for each particle to be sorted."
                )
        self._arrays = layout.state(fields, requires_grad)

    def __getitem__(self, name: str) -> wp.array:
        """(n,) sorted, as they were at the start of the step."""
        return self._arrays[name]

    def sort(self, step: StepContext, state: State) -> None:
        """Take them from a state."""
        for name in self._arrays.names:
            a = self._arrays[name]
            step.launch(_kernels(a).sort, a_scene=state[name], a=a)

    def unsort(self, step: StepContext, values: Mapping[str, wp.array], state: State) -> None:
        """Write sorted values, one for each field, to a state."""
        if values.keys() != set(self._arrays.names):
            raise TypeError(f"the step carries {', '.join(self._arrays.names)}, but was given {', '.join(values)}.")
        for name, a in values.items():
            step.launch(_kernels(a).unsort, a=a, a_scene=state[name])


def _kernels(a: wp.array) -> OrderKernels:
    module = kernel_module(f"order_{kind_of(True, a.requires_grad)}_{type_name(a.dtype)}", a.requires_grad)
    return order_kernels(a.dtype, module)
