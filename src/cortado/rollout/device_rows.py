"""Parameters over time whose values are on the device, and stay there, as do the derivatives with respect to them."""

from collections.abc import Mapping
from functools import cache
from math import prod
from typing import Any

import numpy as np
import warp as wp

from cortado.device.launching import launch
from cortado.device.modules import kernel_module
from cortado.device.precision import Precision
from cortado.errors import InputError
from cortado.particles.arrays import components
from cortado.particles.state import Parameters
from cortado.rollout.parameter_space import ParameterSpace
from cortado.rollout.residual import OfLost
from cortado.rollout.scene_parameters import Simulated
from cortado.scene.parameter_values import Arrays, Values
from cortado.scene.parameters import Axis, Role


class DeviceRows:
    """Those of one simulation over a number of steps.

    They are Warp arrays in the simulation's precision and on its device, of the shapes that a parameter may have, (1,)
    in the place of (). Nobody looks at them: neither whether they are finite, nor how far a solid goes in a step.
    """

    def __init__(self, simulation: Simulated, space: ParameterSpace):
        self._simulation, self._space = simulation, space
        self._spread, self._fold = _kernels(simulation.precision)

    def split(self, given: Values | None, what: str = "parameter") -> tuple[Values, dict[str, wp.array]]:
        """Parameters by name as those to be looked at and those that stay where they are; raises `InputError` for an
        array of another shape, type or device."""
        if not isinstance(given, Mapping):
            return {} if given is None else given, {}
        rows = {name: array for name, array in given.items() if isinstance(array, wp.array) and self.takes(name)}
        for name, array in rows.items():
            own, shapes = self._simulation.initial.positions, self._space.shapes(name)
            real, shape = self._simulation.precision.real, () if array.shape == (1,) else array.shape
            if not {array.shape, shape}.intersection(shapes) or array.dtype is not real or array.device != own.device:
                found = f"a {array.dtype.__name__} array {array.shape} on {array.device}"
                wanted = f"{real.__name__} of shape {' or '.join(map(str, shapes))} on {own.device}"
                raise InputError(f"{what} {name} is {found}, but must be {wanted}.")
        return {name: value for name, value in given.items() if name not in rows}, rows

    def takes(self, name: str) -> bool:
        """Whether a parameter may stay on the device: one over time that steps depend on as it is, unless their length
        is chosen by it."""
        parameter = None if self._simulation.scene.solver.chooses else self._simulation.known.get(name)
        return parameter is not None and parameter.axis is Axis.STEP and parameter.role is Role.RUN

    def stand_ins(self, rows: Mapping[str, wp.array]) -> Arrays:
        """What stands for them on the host, by name: values that are no numbers, until `write` overwrites them."""
        return {name: np.full(self._space.shapes(name)[0], np.nan) for name in rows}

    def write(self, rows: Mapping[str, wp.array], parameters: Parameters) -> None:
        """Write them to the parameters of a rollout, or tangents to those of tangents."""
        for name, array in rows.items():
            own = wp.empty_like(parameters[name])
            numbers = _numbers(own)
            arguments = {"given": self._in_three(name, array), "rows": numbers}
            launch(self._spread, numbers.shape, numbers.device, **arguments)
            parameters.set({name: own})

    def adjoints(self, rows: Mapping[str, wp.array], found: Parameters, lost: OfLost) -> dict[str, wp.array]:
        """From the adjoints of the parameters to those of the rows, in their shapes, without numbers where scenes of a
        batch were ``lost``."""
        adjoints = {}
        for name, array in rows.items():
            bars, shape = _numbers(found[name]), self._in_three(name, array).shape
            of_steps = self._folded(bars, (bars.shape[0], *shape[1:]))
            for member, number in lost.items():
                of_steps[member].fill_(number)
            adjoints[name] = self._folded(of_steps, shape).reshape(array.shape)
        return adjoints

    def _folded(self, bars: wp.array, shape: tuple[int, ...]) -> wp.array:
        """What several entries of an axis share is added up."""
        sums = wp.empty(shape, dtype=bars.dtype, device=bars.device)
        launch(self._fold, shape, bars.device, bars=bars, sums=sums)
        return sums

    def _in_three(self, name: str, array: wp.array) -> wp.array:
        """With an axis each for scenes and for steps, of 1 where they share rows, and for components."""
        each = prod(self._space.shapes(name)[0])
        of_each = array.ndim == self._simulation.known[name].rank + 2  # else all scenes of a batch share them
        members = len(array) if of_each else 1
        return array.contiguous().reshape((members, array.size // (members * each), each))


def _numbers(array: wp.array) -> wp.array:
    """The memory of a parameter over time, (members, steps) vectors or numbers, as numbers (members, steps, k)."""
    return components(array, (*array.shape, wp.types.type_size(array.dtype)))


@cache
def _kernels(precision: Precision) -> tuple[Any, Any]:
    """What writes rows to all scenes and steps, and the transpose."""
    real = precision.real
    module = kernel_module(f"device_rows_{precision.name}")

    @wp.kernel(module=module, enable_backward=False)
    def spread(
        given: wp.array3d(dtype=real),
        # out
        rows: wp.array3d(dtype=real),
    ):
        b, n, c = wp.tid()
        rows[b, n, c] = real(0.0)
        if c < given.shape[2]:
            rows[b, n, c] = given[b % given.shape[0], n % given.shape[1], c]

    @wp.kernel(module=module, enable_backward=False)
    def fold(
        bars: wp.array3d(dtype=real),
        # out
        sums: wp.array3d(dtype=real),
    ):
        b, n, c = wp.tid()
        found = real(0.0)
        for member in range(b, bars.shape[0], sums.shape[0]):
            for step in range(n, bars.shape[1], sums.shape[1]):
                found += bars[member, step, c]
        sums[b, n, c] = found

    return spread, fold
