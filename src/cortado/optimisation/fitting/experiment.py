"""An experiment: a simulation of it, and what was measured."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from cortado.arrays import check_steps, require_table
from cortado.errors import InputError, shown
from cortado.fixed import FixedDict, fixed
from cortado.losses import FinalPositions, Snapshot
from cortado.optimisation.fitting.observation import Again, Direction, Frames, Observation
from cortado.particles.state import State
from cortado.problem import Problem
from cortado.rollout.rollout import Observer
from cortado.scene.parameters.values import Arrays, Values
from cortado.scene.restart import RestartState
from cortado.simulation import Simulation


@fixed
class Experiment:
    """A simulation of an experiment, and what was measured of it, by names of one's own."""

    def __init__(
        self,
        simulation: Simulation,
        observations: Mapping[str, Observation],
        steps: int | None = None,
        state: RestartState | None = None,
    ):
        """``observations`` such as ``{"camera": measured.Video(...)}``; ``steps`` up to the last frame if left out;
        ``state`` where the run begins, as that of a `Problem`."""
        require_table("observations", observations, "{'camera': measured.Video(...)}")
        if not isinstance(simulation, Simulation):
            raise InputError(f"simulation is {shown(simulation)}, but must be a cortado.Simulation.")
        if not observations:
            raise InputError("observations is empty, but must have what was measured.")
        for name, one in observations.items():
            if not hasattr(one, "measured"):
                raise InputError(f"observations {name} is {shown(one)}, but must be one such as a measured.Video.")
            seen = getattr(getattr(one, "renderer", None), "inputs", {}).get("positions", simulation.positions.shape)
            if seen != simulation.positions.shape:
                found = f"sees positions {seen}, but must see {simulation.positions.shape}, those of the simulation"
                raise InputError(f"observations {name} {found}.")
        if simulation.scene.solver.chooses:
            raise InputError('solver.time_step is "auto", but must be a number of seconds, as frames are at times.')
        step = float(simulation.scene.solver.time_step)
        last = max(float(one.times[-1]) for one in observations.values())
        steps = int(np.ceil(last / step - 1e-6)) if steps is None else check_steps(steps)
        self.simulation, self.observations = simulation, FixedDict(observations)
        self.problem = Problem(simulation, steps, FinalPositions(simulation.positions), state=state)
        self._frames = {name: Frames.of(one.times, step, steps) for name, one in observations.items()}
        self._steps = sorted(set().union(*(frames.needed for frames in self._frames.values())))

    def __repr__(self) -> str:
        return f"Experiment({self.simulation!r}, {', '.join(self.observations)})"

    @property
    def start(self) -> dict[str, np.ndarray]:
        """The observations' own parameters, such as "camera.rotation", as a fit starts."""
        return {f"{name}.{key}": v for name, one in self.observations.items() for key, v in one.start.items()}

    @property
    def unseen(self) -> dict[str, np.ndarray]:
        """By the names of `start`, true for numbers that nothing that was measured depends on; an observation of one's
        own need not say any."""
        each = self.observations.items()
        return {f"{name}.{key}": mask for name, one in each for key, mask in getattr(one, "unseen", {}).items()}

    def measured_again(self, measured: Mapping[str, np.ndarray]) -> "Experiment":
        """The same experiment, in the same arrays, with other numbers measured, (frames, m) by name."""
        found = object.__new__(Experiment)
        again = {n: Again(one, measured[n]) if n in measured else one for n, one in self.observations.items()}
        found.__dict__ |= {**self.__dict__, "observations": FixedDict(again)}
        return found

    def predicted(self, parameters: Values) -> dict[str, np.ndarray]:
        """By the name of each observation, what the simulation says of it, (frames, m)."""
        return self._read(self.problem.states(self._shared(parameters), self._steps), parameters)

    def linearised(
        self, parameters: Values, directions: Sequence[Values]
    ) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
        """The same, and its derivatives along directions, (frames, m, directions), by forward mode."""
        values, moves = self._shared(parameters), [self._shared(direction) for direction in directions]
        ends, dots = self._along(values, [moved for moved in moves if moved])
        still, found = self._still(ends), dict[str, Any]()
        along = [(one, moved, next(dots) if moved else still) for one, moved in zip(directions, moves, strict=True)]
        for name, one in self.observations.items():
            own, slopes = self._own(name, parameters), {}
            for step in self._frames[name].needed:
                each = [
                    Direction(dots[step], moved, self._own(name, direction), self._quantities(ends[step], *rest))
                    for direction, moved, dots in along
                    for rest in [(dots[step], values, moved)]
                ]
                slopes[step] = one.tangents(ends[step], own, each)
            found[name] = self._frames[name].between(slopes)
        return self._read(ends, parameters), found

    def _along(self, values: Values, moves: Sequence[Values]) -> tuple[dict[int, Any], Iterator[dict[int, Arrays]]]:
        """States by the number of steps before them, and along each of some directions their tangents, by fields."""
        wanted, dimension, dots = set(self._steps), self.simulation.dimension, [dict[int, Arrays]() for _ in moves]

        def observer(kept: dict[int, Arrays]) -> Observer:
            def observe(step: int, dot: State) -> None:
                if step in wanted:
                    kept[step] = {name: a.astype(np.float64) for name, a in dot.numpy(dimension).items()}

            return observe

        each = zip(moves, map(observer, dots), strict=True)
        return self.problem.several_tangents(values, each, self._steps), iter(dots)

    def _still(self, ends: Mapping[int, Snapshot]) -> dict[int, Arrays]:
        """Tangents of states where only an observation's own parameters change, such as those of a camera."""
        return {step: end.state.like().numpy(self.simulation.dimension) for step, end in ends.items()}

    def _quantities(self, at: Snapshot, dot: Arrays, values: Values, moved: Values) -> Callable[..., Arrays]:
        """What gives tangents of quantities of a state along its own tangent."""

        def tangents(names: Iterable[str]) -> Arrays:
            if not moved:
                return {name: np.zeros_like(at[name]) for name in names}
            return self.problem.along(at, names, dot, values, moved)

        return tangents

    def _read(self, ends: Mapping[int, Snapshot], parameters: Values) -> dict[str, np.ndarray]:
        found = {}
        for name, one in self.observations.items():
            own = self._own(name, parameters)
            read = {step: one.value(ends[step], own) for step in self._frames[name].needed}
            found[name] = self._frames[name].between(read)
            if found[name].shape != one.measured.shape:
                raise InputError(
                    f"{name} measured {one.measured.shape} numbers, but the simulation has {found[name].shape}."
                )
        return found

    def _shared(self, values: Values) -> dict[str, Any]:
        """Those of the simulation."""
        own = self.start
        return {name: value for name, value in values.items() if name not in own}

    def _own(self, observation: str, values: Values) -> dict[str, np.ndarray]:
        """Those of an observation, by its own names for them."""
        return {
            key: np.asarray(values[f"{observation}.{key}"], dtype=np.float64)
            for key in self.observations[observation].start
            if f"{observation}.{key}" in values
        }
