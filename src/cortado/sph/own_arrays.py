"""Arrays as parameters of a user's function, such as the weights of a network or a field on a grid.

All arrays of a force are concatenated in a table w (members, numbers). The value read for a particle is w_k + e w_dot_k
with e = 0, so that the tangent along w_dot is the derivative with respect to e, which is treated as a number of the
particle. The adjoint of w needs no atomics: each thread goes through every ROWS-th particle of a scene and adds to a
separate row. The rows are summed in a fixed order.
"""

from collections.abc import Sequence
from functools import cache, cached_property
from math import prod
from types import SimpleNamespace
from typing import Any

import warp as wp

from cortado.device.modules import by_name, kernel_module, kind_of
from cortado.device.precision import Precision, TypesByName
from cortado.device.reduction import sum_of
from cortado.particles.state import Layout, Parameters, components
from cortado.scene.parameters import Axis, Parameter
from cortado.sph.parts import Adjoints, StepContext

WIDTH = (1, 3)
MOST_NUMBERS = 2**24
"""Greatest total size of a force's arrays: float32 represents every index up to it exactly."""
ROWS, MOST_PARTIAL = {"cpu": 16, "cuda": 2**15}, 2**24

READ_AS = {"e": "_no", "member": "i // particles", "row": "_row"}


@cache
def table_type(precision: Precision) -> Any:
    """Return the Warp struct of a force's arrays: w, w_dot, and the rows of w's adjoint, (numbers, members x rows)."""
    numbers = wp.array2d(dtype=precision.real)
    fields = {"__annotations__": dict.fromkeys(("values", "dots", "rows"), numbers), "__module__": __name__}
    return wp.struct(type(f"Table_{precision.name}", (), fields))


def arrays_module(precision: Precision, forward: bool, taped: bool = False) -> Any:
    return kernel_module(f"arrays_{kind_of(forward, taped)}_{precision.name}", forward and taped)


@cache
def reading(precision: Precision, taped: bool) -> SimpleNamespace:
    real, table = precision.real, table_type(precision)
    module = arrays_module(precision, True, taped)
    none, nothing = wp.constant(real(0.0)), wp.constant(real(float("nan")))

    @wp.func(module=module)
    def place(k: real, size: real) -> real:
        """Return an index into an axis of a size. A negative index counts from the end; one out of range gives NaN."""
        found = k
        if k < none:
            found = k + size
        if found < none or found >= size or found != wp.floor(found):
            found = nothing
        return found

    @wp.func(module=module)
    def read(e: real, w: table, member: int, row: int, k: real) -> real:
        found = nothing
        if k >= none:
            found = w.values[member, int(k)]
        return found

    if not taped:

        @wp.func_grad(read)
        def read_adjoint(e: real, w: table, member: int, row: int, k: real, bar: real):
            if k >= none and row >= 0:
                w.rows[int(k), row] = w.rows[int(k), row] + bar
            elif k >= none and w.dots.shape[0] > 0:
                wp.adjoint[e] += bar * w.dots[member, int(k)]

    return by_name(place, read)


@cache
def packing_kernels(precision: Precision, taped: bool) -> SimpleNamespace:
    """Make the kernels that write a parameter's values in a step into a table, and add a table's adjoint to that of the
    parameter. Values are (members, steps x size), or the same in all steps (members, size)."""
    typed = TypesByName(wp.array2d(dtype=precision.real), {wp.int32: "step"})

    @wp.kernel(module=arrays_module(precision, True, taped))
    @typed.arrays
    def pack(first: int, size: int, step, values, table):
        member, k = wp.tid() // size, wp.tid() % size
        row = wp.min(step[member], values.shape[1] // size - 1)
        table[member, first + k] = values[member, row * size + k]

    @wp.kernel(module=arrays_module(precision, False), enable_backward=False)
    @typed.arrays
    def add(first: int, size: int, step, table, values):
        member, k = wp.tid() // size, wp.tid() % size
        column = wp.min(step[member], values.shape[1] // size - 1) * size + k
        values[member, column] = values[member, column] + table[member, first + k]

    return by_name(pack, add)


class Numbers:
    """The numbers of some parameters, one parameter after the other in a table (members, numbers)."""

    def __init__(self, parameters: Sequence[Parameter], layout: Layout, taped: bool):
        self._kernels = packing_kernels(layout.precision, taped) if parameters else None
        self._members = layout.members
        sizes = [prod(one.shape) if one.axis is Axis.ARRAY else WIDTH[one.rank] for one in parameters]
        self._places = [(one.name, sum(sizes[:k]), sizes[k]) for k, one in enumerate(parameters)]
        self.size = sum(sizes)

    def pack(self, step: StepContext, values: Parameters, table: wp.array) -> None:
        self._launch("pack", step, values, table)

    def add(self, step: StepContext, table: wp.array, bar: Parameters) -> None:
        self._launch("add", step, bar, table)

    def _launch(self, kernel: str, step: StepContext, values: Parameters, table: wp.array) -> None:
        for name, first, size in self._places:
            count = values[name].size * getattr(values[name].dtype, "_length_", 1)
            numbers = components(values[name], (self._members, count // self._members))
            given = {"first": first, "size": size, "values": numbers, "table": table}
            step.launch(getattr(self._kernels, kernel), threads=self._members * size, **given)


class Tables:
    """A table for each scene with all arrays of a user's function, with tangent and adjoint."""

    def __init__(self, parameters: Sequence[Parameter], layout: Layout, taped: bool):
        self._layout = layout
        self._arrays = Numbers([one for one in parameters if one.axis is Axis.ARRAY], layout, taped)
        self._size = self._arrays.size
        most = min(ROWS["cpu" if layout.device.is_cpu else "cuda"], layout.particles)
        self.rows = max(min(most, MOST_PARTIAL // (layout.members * max(self._size, 1))), 1)
        self._table = self._new(values=self._numbers(layout.members, self._size, requires_grad=taped))

    @property
    def threads(self) -> int | None:
        """Return the number of threads of the adjoint; None for one per particle."""
        return self._layout.members * self.rows if self._size else None

    def now(self, step: StepContext) -> dict[str, Any]:
        return self._packed(step, self._table) if self._size else {}

    def along(self, step: StepContext, parameters_dot: Parameters) -> dict[str, Any]:
        if not self._size:
            return {}
        self._arrays.pack(step, parameters_dot, self._along.dots)
        return self._packed(step, self._along)

    def back(self, step: StepContext) -> dict[str, Any]:
        return {**self._packed(step, self._back), "rows": self.rows} if self._size else {}

    def collect(self, step: StepContext, bar: Adjoints) -> None:
        if self._size:
            total = self._sum(self._back.rows.flatten()).reshape((self._size, self._layout.members))
            self._arrays.add(step, total.transpose((1, 0)), bar.parameters)
            self._back.rows.zero_()

    def _packed(self, step: StepContext, table: Any) -> dict[str, Any]:
        self._arrays.pack(step, step.parameters, table.values)
        return {"table": table}

    @cached_property
    def _along(self) -> Any:
        return self._new(values=self._table.values, dots=self._numbers(self._layout.members, self._size))

    @cached_property
    def _back(self) -> Any:
        return self._new(values=self._table.values, rows=self._numbers(self._size, self._layout.members * self.rows))

    @cached_property
    def _sum(self) -> Any:
        layout = self._layout
        return sum_of(layout.precision.real, self.rows, layout.device, self._size * layout.members)

    def _new(self, **arrays: wp.array) -> Any:
        made, none = table_type(self._layout.precision)(), self._numbers(0, 0)
        for name in ("values", "dots", "rows"):
            setattr(made, name, arrays.get(name, none))
        return made

    def _numbers(self, *shape: int, requires_grad: bool = False) -> wp.array:
        options = {"device": self._layout.device, "requires_grad": requires_grad}
        return wp.zeros(shape, dtype=self._layout.precision.real, **options)
