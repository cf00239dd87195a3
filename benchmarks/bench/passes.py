"""The passes of a step and of its adjoint, each launch timed by itself.

A launch is timed where it occurs, by repeating it. That is sound where it reads and writes other arrays, as all do that
`Solver.replay` makes; what only `Solver.step` launches is timed there.
"""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from benchmarks.bench.floor import least_bytes, sums_over_neighbours
from benchmarks.bench.timing import LaunchTimer
from cortado.device.launching import watched
from cortado.gradients import Exact
from cortado.particles.neighbours import NeighbourSearch
from cortado.particles.particle_kernels import MADE
from cortado.rollout.rollout import Rollout

LOG_ROWS = 100_000
"""Steps that a log has room for while the launch that counts steps is repeated."""
PASSES = {
    "cell_sort": "sort by cell",
    "fill": "neighbour list",
    "sum_and_maximum": "error sums",
    "convergence": "error sums",
    "wall": "wall relaxation",
    "integration": "the rest",
    "mixture": "the rest",
    "order": "the rest",
    "lost": "the rest",
    "sum": "the rest",
}
"""The pass of a step that a group of kernels belongs to; other groups, such as forces, are passes of their own name."""
AGAIN = "the step again"
"""What the way back does first."""

Key = tuple[str, Any]


@dataclass(frozen=True)
class Pass:
    """A pass of a step."""

    name: str
    launches: int
    """In one step."""
    seconds: float
    """Of all its launches in one step."""
    bytes: int
    """That they must read and write at least."""
    pairs: int
    """Pairs of neighbours that they go through."""


@dataclass(frozen=True)
class _Launch:
    seconds: float
    bytes: int
    pairs: int


class PassTimer:
    """Times the launches of steps; use `step_passes` first."""

    def __init__(self, rollout: Rollout, search: NeighbourSearch, repeats: int):
        """``rollout`` has gone forward, so that the lists of its solver's ``search`` are long enough."""
        self._rollout, self._solver = rollout, rollout.solver
        self._time = LaunchTimer(self._solver.launch, repeats)
        self._launches: dict[Key, _Launch] = {}
        self._solver.reset()
        self._solver.replay(rollout.initial, rollout.parameters, rollout.log.seek(0))
        self.listed = int(search.count.numpy().sum())
        """Entries of all lists of neighbours of the first state."""
        self.pairs = self.listed - int(search.filling.numpy().sum())
        """The same without those that fill lists up."""

    def step_passes(self) -> list[Pass]:
        """The passes of the first step of the rollout."""
        rollout, solver = self._rollout, self._solver
        counts, new_state = rollout.log.seek(0), rollout.initial.following()

        def replay() -> None:
            solver.replay(rollout.initial, rollout.parameters, counts)
            solver.write_state(counts, rollout.parameters, new_state)

        log = solver.new_log(LOG_ROWS)
        self._watch(replay)
        solver.reset()
        launches = self._watch(lambda: solver.step(rollout.initial, new_state, rollout.parameters, log))
        solver.reset()
        return self._passes(launches, _name)

    def adjoint_passes(self) -> list[Pass]:
        """The passes of the way back through that step; the step itself, which is taken again, is one of them."""
        rollout, solver = self._rollout, self._solver
        forward, counts = set(self._launches), rollout.log.seek(0)
        derivative, bar = Exact().derivative(rollout), solver.new_state()
        bar.positions.fill_(1.0)
        solver.reserve(counts)
        derivative.begin()
        launches = self._watch(lambda: derivative.step(rollout.initial, counts, bar))
        return self._passes(launches, lambda key: AGAIN if key in forward else f"{_name(key)} adjoint")

    def _watch(self, work: Callable[[], None]) -> Counter[Key]:
        """Do some work; returns how often each launch occurred in it. New ones are timed the first time."""
        launches: Counter[Key] = Counter()

        def watch(name: str, threads: Any, arguments: Sequence[Any], launch: Callable[[], None]) -> None:
            key = name, threads
            launches[key] += 1
            launch()
            if key not in self._launches:
                pairs = self.pairs if sums_over_neighbours(arguments) else 0
                size = least_bytes(arguments, threads, self._solver.layout.all_particles, self.listed)
                self._launches[key] = _Launch(self._time(launch), size, pairs)

        with watched(watch):
            work()
        return launches

    def _passes(self, launches: Counter[Key], name: Callable[[Key], str]) -> list[Pass]:
        """In the order in which they first occur, the rest last."""
        groups: dict[str, list[tuple[int, _Launch]]] = {}
        for key, number in launches.items():
            groups.setdefault(name(key), []).append((number, self._launches[key]))
        passes = [
            Pass(
                group,
                sum(number for number, _ in members),
                sum(number * one.seconds for number, one in members),
                sum(number * one.bytes for number, one in members),
                sum(number * one.pairs for number, one in members),
            )
            for group, members in groups.items()
        ]
        return sorted(passes, key=lambda one: one.name.startswith("the rest"))


def _name(key: Key) -> str:
    """The pass of a kernel, by the name of what made it: ``gravity_kernels.<locals>.accelerate`` is "gravity", and
    ``made_gravity_adjoint`` is too."""
    if key[0].startswith(MADE):
        group = key[0].removeprefix(MADE).removesuffix("_adjoint").removesuffix("_tangent")
    else:
        group = key[0].partition("__locals__")[0].strip("_").removesuffix("_kernels").removesuffix("_kernel")
    return PASSES.get(group, group.replace("_", " "))
