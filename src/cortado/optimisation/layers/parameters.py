"""Parameters of a layer: their shapes, one for all evaluations or one for each, and their derivatives in these."""

from collections.abc import Mapping

import numpy as np
import warp as wp

from cortado.errors import InputError
from cortado.optimisation.layers.layer import PARAMETER, Array, Named, Shapes, named, on_host, part
from cortado.rollout.device_rows import DeviceRows
from cortado.rollout.parameter_space import ParameterSpace
from cortado.scene.parameter_values import Arrays
from cortado.simulation import Simulation


class LayerParameters:
    """The parameters of a layer over a number of steps, as its arrays have them and as problems take them.

    ``each``: whether the simulation is a batch of evaluations of a layer, with an entry for each of them in all arrays;
    a batch that a user made has parameters in all shapes of `docs/batches.md`.
    """

    def __init__(self, simulation: Simulation, steps: int, each: bool):
        self._simulation, self._each = simulation, each
        self._space = ParameterSpace(simulation, steps)
        self._rows = DeviceRows(simulation, self._space)

    def check(self, given: Shapes, with_state: bool) -> None:
        """Raises `InputError` for arrays that no parameters have."""
        for name, shape in part(given, PARAMETER).items():
            shapes = self._space.shapes(name)
            if with_state and name in self._simulation.known.state:
                raise InputError(f"parameter {name} is given, but must be left out with a state, which has its own.")
            if shape not in shapes:
                raise InputError(f"parameter {name} has shape {shape}, but must be {' or '.join(map(str, shapes))}.")

    def values(self, given: Named) -> Arrays:
        """As problems take them, in float64."""
        own = part(given, PARAMETER)
        return {name: self._shaped(name, on_host(array).astype(np.float64)) for name, array in own.items()}

    def on_device(self, given: Named) -> dict[str, Array]:
        """As steppers take them: those over time that are on the device stay there."""
        own = part(given, PARAMETER)
        stay = {name: array for name, array in own.items() if isinstance(array, wp.array) and self._rows.takes(name)}
        others = {PARAMETER + name: array for name, array in own.items() if name not in stay}
        return {**self.values(others), **{name: self._shaped(name, array) for name, array in stay.items()}}

    def _shaped(self, name: str, array: Array) -> Array:
        """Of each evaluation, one that is the same in all steps gets an axis for them."""
        shapes = self._space.shapes(name)
        if self._each and name in self._simulation.known.over_time and array.ndim == len(shapes[0]) + 1:
            return array.reshape((array.shape[0], 1, *array.shape[1:]))
        is_number = isinstance(array, np.ndarray) and array.shape == (1,) and (1,) not in shapes
        return array.reshape(()) if is_number else array

    def adjoints(self, found: Mapping[str, Array], values: Arrays) -> Named:
        """Derivatives with respect to values, of a batch with a first axis for the scenes, in their shapes; those on
        the device have them."""
        shared = {name: _shared(bar, values[name].shape) for name, bar in found.items() if isinstance(bar, np.ndarray)}
        return named(PARAMETER, {**found, **shared})


def _shared(bar: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """A derivative with a first axis for the scenes, added up where the value is the same for all."""
    return bar.reshape(shape) if bar.size == int(np.prod(shape)) else bar.sum(axis=0).reshape(shape)
