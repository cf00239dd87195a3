"""Fields of particles that a solver carries from step to step: a pressure that the next step begins with, say.

A state has them in the scene's order of particles, a step works on sorted ones. The adjoint of sorting is the way back.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

import warp as wp

from cortado.device.fields import StateField
from cortado.device.reduction import type_name
from cortado.device.state import Layout, State
from cortado.sph.parts import StepContext


@dataclass(frozen=True)
class OrderKernels:
    """Kernels between the scene's order and the sorted one."""

    sort: Any
    unsort: Any


@cache
def order_kernels(dtype: Any) -> OrderKernels:
    """The kernels for entries of a Warp type."""
    module = wp.get_module(f"cortado_order_{type_name(dtype)}")

    @wp.kernel(module=module)
    def sort(
        order: wp.array(dtype=wp.int32),
        a_scene: wp.array(dtype=dtype),
        # out
        a: wp.array(dtype=dtype),
    ):
        i = wp.tid()
        a[i] = a_scene[order[i]]

    @wp.kernel(module=module)
    def unsort(
        order: wp.array(dtype=wp.int32),
        a: wp.array(dtype=dtype),
        # out
        a_scene: wp.array(dtype=dtype),
    ):
        i = wp.tid()
        a_scene[order[i]] = a[i]

    return OrderKernels(sort, unsort)


class Carried:
    """Sorted fields of a step, or their tangents or adjoints."""

    def __init__(self, fields: Iterable[StateField], layout: Layout, requires_grad: bool = False):
        self._arrays = layout.state(tuple(fields), requires_grad)

    def __getitem__(self, name: str) -> wp.array:
        """(n,) sorted, as they were at the start of the step."""
        return self._arrays[name]

    def sort(self, step: StepContext, state: State) -> None:
        """Take them from a state."""
        for name in self._arrays.names:
            a = self._arrays[name]
            step.launch(order_kernels(a.dtype).sort, a_scene=state[name], a=a)

    def unsort(self, step: StepContext, values: Mapping[str, wp.array], state: State) -> None:
        """Write sorted values, one for each field, to a state."""
        if values.keys() != set(self._arrays.names):
            raise TypeError(f"the step carries {', '.join(self._arrays.names)}, but was given {', '.join(values)}.")
        for name, a in values.items():
            step.launch(order_kernels(a.dtype).unsort, a=a, a_scene=state[name])
