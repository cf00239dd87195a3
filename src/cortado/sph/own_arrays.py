"""The parameters of a user's function in kernels, also arrays, such as the weights of a network or a field on a grid.

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
from cortado.device.precision import Precision, TypesByName, struct_of
from cortado.device.reduction import sum_of
from cortado.particles.state import Layout, Parameters, components
from cortado.scene.parameters import Axis, Parameter
from cortado.sph.parts import Adjoints, StepContext

WIDTH = (1, 3)
MOST_NUMBERS = 2**24
"""Greatest total size of a force's arrays: float32 represents every index up to it exactly."""
ROWS, MOST_PARTIAL = {"cpu": 16, "cuda": 2**15}, 2**24

READ_AS = {"e": "_no", "member": "i // particles", "row": "_row"}


def theta_of(precision: Precision, ranks: Sequence[int]) -> Any:
    """Return the Warp vector type of parameters of these ranks, with at least one number."""
    return precision.fractions(max(sum(WIDTH[rank] for rank in ranks), 1))


@cache
def table_type(precision: Precision) -> Any:
    """Return the Warp struct of a force's arrays: w, w_dot, and the rows of w's adjoint, (numbers, members x rows)."""
    return struct_of("Table", precision, **dict.fromkeys(("values", "dots", "rows"), wp.array2d(dtype=precision.real)))


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


class OwnParameters:
    """A user's function's parameters by names of kernel arguments, with tangent and adjoint: times, numbers and
    vectors as one vector theta, and all arrays as one table, for each scene."""

    def __init__(self, parameters: Sequence[Parameter], layout: Layout, taped: bool):
        self._layout, own = layout, [one for one in parameters if one.axis is not Axis.ARRAY]
        self._numbers = Numbers(own, layout, taped)
        self._arrays = Numbers([one for one in parameters if one.axis is Axis.ARRAY], layout, taped)
        self._size, members = self._arrays.size, layout.members
        dtype = theta_of(layout.precision, [one.rank for one in own])
        options: dict[str, Any] = {"dtype": dtype, "device": layout.device}
        self._theta, self._theta_dot = wp.zeros(members, **options, requires_grad=taped), wp.zeros(members, **options)
        self._theta_bar = wp.zeros(layout.all_particles, **options)
        """(n,) each particle's term of the adjoint of theta in a step."""
        self._sum_theta = layout.sum_of(dtype) if own else None
        most = min(ROWS["cpu" if layout.device.is_cpu else "cuda"], layout.particles)
        self.rows = max(min(most, MOST_PARTIAL // (members * max(self._size, 1))), 1)
        self._table = self._new(values=self._zeros(members, self._size, requires_grad=taped))

    @property
    def threads(self) -> int | None:
        """Return the number of threads of the adjoint; None for one per particle."""
        return self._layout.members * self.rows if self._size else None

    def now(self, step: StepContext) -> dict[str, Any]:
        return self._told(step, "_table")

    def along(self, step: StepContext, parameters_dot: Parameters) -> dict[str, Any]:
        if self._size:
            self._arrays.pack(step, parameters_dot, self._along.dots)
        return {**self._told(step, "_along"), "theta_dot": self._packed(step, parameters_dot, self._theta_dot)}

    def back(self, step: StepContext) -> dict[str, Any]:
        return {**self._told(step, "_back"), "theta_bar": self._theta_bar, "rows": self.rows}

    def collect(self, step: StepContext, bar: Adjoints) -> None:
        """Add the adjoints of theta and of the table to those of the parameters."""
        if self._sum_theta is not None:
            self._numbers.add(step, self._flat(self._sum_theta(self._theta_bar)), bar.parameters)
        if self._size:
            total = self._sum(self._back.rows.flatten()).reshape((self._size, self._layout.members))
            self._arrays.add(step, total.transpose((1, 0)), bar.parameters)
            self._back.rows.zero_()

    def _told(self, step: StepContext, name: str) -> dict[str, Any]:
        found = {"theta": self._packed(step, step.parameters, self._theta)}
        if self._size:
            found["table"] = getattr(self, name)
            self._arrays.pack(step, step.parameters, found["table"].values)
        return found

    def _packed(self, step: StepContext, values: Parameters, theta: wp.array) -> wp.array:
        self._numbers.pack(step, values, self._flat(theta))
        return theta

    def _flat(self, theta: wp.array) -> wp.array:
        return components(theta, (len(theta), theta.dtype._length_))

    @cached_property
    def _along(self) -> Any:
        return self._new(values=self._table.values, dots=self._zeros(self._layout.members, self._size))

    @cached_property
    def _back(self) -> Any:
        return self._new(values=self._table.values, rows=self._zeros(self._size, self._layout.members * self.rows))

    @cached_property
    def _sum(self) -> Any:
        layout = self._layout
        return sum_of(layout.precision.real, self.rows, layout.device, self._size * layout.members)

    def _new(self, **arrays: wp.array) -> Any:
        made, none = table_type(self._layout.precision)(), self._zeros(0, 0)
        for name in ("values", "dots", "rows"):
            setattr(made, name, arrays.get(name, none))
        return made

    def _zeros(self, *shape: int, requires_grad: bool = False) -> wp.array:
        options = {"device": self._layout.device, "requires_grad": requires_grad}
        return wp.zeros(shape, dtype=self._layout.precision.real, **options)
