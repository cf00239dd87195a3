"""Steps of a batch of scenes, on a CPU in parts that cores take side by side.

A launch with few particles is a captured graph, and runs on one core. With more it is cut for the cores, without a
graph, which costs more than it saves until there are many. A batch between the two is cut into smaller batches here.
"""

from collections.abc import Callable
from itertools import pairwise

import warp as wp

from cortado.device.launching import LEAST_PART
from cortado.device.threads import MOST_CORES, WARP, in_parallel, usable_cores
from cortado.errors import DivergedError
from cortado.particles.state import State
from cortado.rollout.device_states import DeviceState
from cortado.rollout.stepper import Stepper
from cortado.scene.parameter_values import Arrays
from cortado.simulation import Simulation

MOST_PARTS = 16
"""Parts of a batch at most: one that would need more has launches large enough to be cut."""


def parts_of(simulation: Simulation) -> int:
    """Return into how many parts a batch is best cut, so that each has a graph: 1 where it has one as a whole, on a
    GPU, and where there would be too many."""
    scenes, cores = simulation.batch or 1, min(usable_cores(), MOST_CORES)
    together = (2 * LEAST_PART - 1) // simulation.particles
    if not simulation.device.is_cpu or cores == 1 or not together or scenes <= together:
        return 1
    parts = -(-scenes // together)
    if parts > cores:
        parts = -(-parts // cores) * cores
    return parts if parts <= min(scenes, MOST_PARTS) else 1


class SideBySide:
    """So many steps of a batch of scenes, taken in parts, each a batch by itself; scenes have the bits of a whole."""

    def __init__(self, simulation: Simulation, make: Callable[[int], Simulation], parts: int, steps: int):
        """Cut the batch of a simulation; ``make`` makes the same one for another number of scenes."""
        scenes = simulation.batch or 1
        self._ranges = list(pairwise(scenes * k // parts for k in range(parts + 1)))
        self._simulations = [simulation] if parts == 1 else [make(last - first) for first, last in self._ranges]
        self.steppers = [Stepper(one, steps) for one in self._simulations]
        """Of each part."""

    @property
    def lost(self) -> dict[int, DivergedError]:
        """The scenes that lost a particle in the last steps, by number."""
        each = zip(self._ranges, self.steppers, strict=True)
        return {first + b: error for (first, _), one in each for b, error in one.rollout.lost.items()}

    def begin(self, rows: Arrays) -> None:
        """Take steps from the first state, so that others can `follow`; ``rows`` are all that is given over time."""
        for (first, last), one, simulation in zip(self._ranges, self.steppers, self._simulations, strict=True):
            one.advance(simulation.on_device(), {name: row[first:last] for name, row in rows.items()})

    def follow(self, state: DeviceState, rows: Arrays) -> DeviceState:
        """Return the state after the steps; see `Stepper.follow`."""
        if len(self.steppers) == 1:
            return self.steppers[0].follow(state, rows)
        found: dict[int, DeviceState] = {}

        def take(k: int) -> None:
            first, last = self._ranges[k]
            scenes = state.scenes[first:last]
            self._simulations[k].judged_states.update(scenes)
            own = {name: row[first:last] for name, row in rows.items()}
            found[k] = self.steppers[k].follow(DeviceState(_cut(state.arrays, first, last), scenes), own)

        in_parallel(take, range(len(self.steppers)), min(usable_cores(), MOST_CORES, len(self.steppers)))
        return _together(state.arrays, [found[k] for k in range(len(self.steppers))])


def _cut(arrays: State, first: int, last: int) -> State:
    """Return some scenes of a batch as views."""
    assert arrays.batch is not None
    sizes = {name: len(arrays[name]) // arrays.batch for name in arrays.names}
    own = {name: arrays[name][first * size : last * size] for name, size in sizes.items()}
    return State(arrays.fields, own, last - first)


@WARP
def _together(like: State, parts: list[DeviceState]) -> DeviceState:
    """Return the states of all parts in arrays of their own."""
    whole = {name: wp.empty_like(like[name]) for name in like.names}
    for name, array in whole.items():
        begin = 0
        for part in parts:
            wp.copy(array, part.arrays[name], dest_offset=begin)
            begin += len(part.arrays[name])
    return DeviceState(State(like.fields, whole, like.batch), tuple(one for part in parts for one in part.scenes))
