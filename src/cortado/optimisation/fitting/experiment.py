"""The class `Experiment`, a simulation together with measurements."""

import warnings
from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from cortado.arrays import as_numbers, check_steps, require_table
from cortado.calls import FixedDict, fixed
from cortado.errors import CortadoWarning, InputError, shown
from cortado.losses import FinalPositions, Snapshot
from cortado.optimisation.fitting.observations import CLOCK, Again, Direction, Frames, Observation
from cortado.particles.state import State
from cortado.problem import Problem
from cortado.runs.probes import warn_of_places
from cortado.scene.parameter_values import Arrays, Values
from cortado.scene.restart import RestartState
from cortado.scene.stability import is_implicit
from cortado.simulation import Simulation

ROOM = 16
"""If a fitted clock shifts frames beyond the end of a run, the run gets a multiple of this number of steps more."""


@fixed
class Experiment:
    """A simulation of an experiment, with measurements by user-defined names.

    Example::

        experiment = cortado.measured.Experiment(simulation, {"camera": video})
        fit = cortado.fit(experiment, {"viscosity": 0.1})
    """

    def __init__(
        self,
        simulation: Simulation,
        observations: Mapping[str, Observation],
        steps: int | None = None,
        state: RestartState | None = None,
    ):
        """Store a ``simulation`` and its ``observations``, such as ``{"camera": measured.Video(...)}``. ``steps`` is
        the number of steps, by default up to the last frame. ``state`` is the initial state, as in `Problem`."""
        require_table("observations", observations, "{'camera': measured.Video(...)}")
        if not isinstance(simulation, Simulation):
            raise InputError(f"simulation is {shown(simulation)}, but must be a cortado.Simulation.")
        if not observations:
            raise InputError("observations is empty, but must have at least one measurement.")
        for name, one in observations.items():
            if not hasattr(one, "measured"):
                raise InputError(f"observations {name} is {shown(one)}, but must be an observation such as Video.")
            seen = getattr(getattr(one, "renderer", None), "inputs", {}).get("positions", simulation.positions.shape)
            if seen != simulation.positions.shape:
                found = f"renders positions {seen}, but the simulation has positions {simulation.positions.shape}"
                raise InputError(f"observations {name} {found}.")
        if simulation.scene.solver.chooses:
            raise InputError('solver.time_step is "auto", but must be a number of seconds in an experiment.')
        step = float(simulation.scene.solver.time_step)
        last = max(float(one.times[-1]) for one in observations.values())
        steps = int(np.ceil(last / step - 1e-6)) if steps is None else check_steps(steps)
        self.simulation, self.observations = simulation, FixedDict(observations)
        warn_of_places(simulation, {name: getattr(one, "sensor", None) for name, one in observations.items()})
        self.problem = Problem(simulation, steps, FinalPositions(simulation.positions), state=state)
        for one in observations.values():
            Frames.of(one.times, step, steps)  # raises for times beyond the run
        self._state = state
        self._time_step, self._problems = step, {(is_implicit(simulation.scene), steps): self.problem}

    def __repr__(self) -> str:
        return f"Experiment({self.simulation!r}, {', '.join(self.observations)})"

    @property
    def start(self) -> Arrays:
        """Return the initial values of the observations' parameters, such as "camera.rotation"."""
        return {f"{name}.{key}": v for name, one in self.observations.items() for key, v in one.start.items()}

    @property
    def unseen(self) -> Arrays:
        """Return masks by name of a parameter in `start`. A mask is true for components without any effect."""
        each = self.observations.items()
        return {f"{name}.{key}": mask for name, one in each for key, mask in getattr(one, "unseen", {}).items()}

    @property
    def clocks(self) -> dict[str, tuple[float, float]]:
        """Return the bounds of each clock [s]. A fit may shift a clock by half of the duration of the measurement."""
        found = {}
        for name, one in self.observations.items():
            if CLOCK in one.start:
                start, half = float(one.start[CLOCK]), 0.5 * float(one.times[-1] - one.times[0])
                found[f"{name}.{CLOCK}"] = (start - half, start + half)
        return found

    def simulated_by(self, simulation: Simulation) -> "Experiment":
        """Return this experiment with a new simulation, which must have the same number of particles."""
        return Experiment(simulation, self.observations, self.problem.steps, self._state)

    def measured_again(self, measured: Mapping[str, np.ndarray]) -> "Experiment":
        """Return this experiment with new measured numbers (frames, m) by observation name."""
        found = object.__new__(Experiment)
        again = {n: Again(one, measured[n]) if n in measured else one for n, one in self.observations.items()}
        found.__dict__ |= {**self.__dict__, "observations": FixedDict(again)}
        return found

    def predicted(self, parameters: Values) -> Arrays:
        """Return the predicted numbers of each observation (frames, m), by name."""
        (frames, wanted), values = self._frames(parameters), self._shared(parameters)
        return self._read(self._problem(values, wanted).states(values, wanted), frames, parameters)

    def linearised(self, parameters: Values, directions: Sequence[Values]) -> tuple[Arrays, Arrays]:
        """Return predictions (frames, m) and derivatives along directions (frames, m, directions), by forward mode."""
        values, moves = self._shared(parameters), [self._shared(direction) for direction in directions]
        frames, wanted = self._frames(parameters)
        problem = self._problem(values, wanted)
        dimension, steps = self.simulation.dimension, set(wanted)
        tangents = [dict[int, Arrays]() for _ in moves]

        def observe(kept: dict[int, Arrays], step: int, dot: State) -> None:
            if step in steps:
                kept[step] = {name: a.astype(np.float64) for name, a in dot.numpy(dimension).items()}

        each = [(moved, partial(observe, kept)) for moved, kept in zip(moves, tangents, strict=True) if moved]
        ends = problem.several_tangents(values, each, wanted)
        # states do not change if only an observation's parameters change, such as a camera's
        still = {step: end.state.like().numpy(dimension) for step, end in ends.items()}
        found = dict[str, np.ndarray]()
        along = [(one, moved, kept or still) for one, moved, kept in zip(directions, moves, tangents, strict=True)]

        def direction(name: str, step: int, given: Values, moved: Values, dots: Mapping[int, Arrays]) -> Direction:
            at, dot = ends[step], dots[step]

            def quantities(names: Iterable[str]) -> Arrays:
                if not moved:
                    return {name: np.zeros_like(at[name]) for name in names}
                return problem.along(at, names, dot, values, moved)

            return Direction(dot, moved, self._own(name, given), quantities)

        for name, one in self.observations.items():
            own, slopes = self._own(name, parameters), {}
            for step in frames[name].needed:
                slopes[step] = one.tangents(ends[step], own, [direction(name, step, *each) for each in along])
            found[name] = frames[name].between(slopes)
            if CLOCK in one.start:
                read = {step: one.value(ends[step], own) for step in frames[name].around}
                late = np.array([float(direction.get(f"{name}.{CLOCK}", 0.0)) for direction in directions])
                found[name] = found[name] + frames[name].rates(read, self._time_step)[..., None] * late
        return self._read(ends, frames, parameters), found

    def _frames(self, parameters: Values) -> tuple[dict[str, Frames], list[int]]:
        """Return the frames of each observation, and the numbers of the steps whose states the frames need."""
        found, wanted = dict[str, Frames](), set[int]()
        for name, one in self.observations.items():
            begun = one.start.get(CLOCK, 0.0)
            late = float(parameters.get(f"{name}.{CLOCK}", begun) - begun) if CLOCK in one.start else 0.0
            times = np.maximum(one.times + late, 0.0)
            found[name] = Frames.of(times, self._time_step, int(np.ceil(times[-1] / self._time_step)))
            wanted |= found[name].needed | (found[name].around if CLOCK in one.start else set())
        return found, sorted(wanted)

    def _problem(self, values: Values, wanted: Sequence[int]) -> Problem:
        """Return a problem that covers the ``wanted`` steps. The viscosity may need an implicit scheme."""
        scene, steps = self.simulation.scene, self.problem.steps
        if wanted[-1] > steps:
            steps += -(-(wanted[-1] - steps) // ROOM) * ROOM
        of_scheme = ("viscosity", "rest_density", "time_step")
        given = {name: as_numbers(name, values[name]) for name in of_scheme if name in values}
        fits = all(array.size in (1, len(scene.phase)) for array in given.values())
        key = is_implicit(scene, given if fits else {}), steps
        if key not in self._problems:
            own, simulation = self.problem, self.simulation
            if key[0] != is_implicit(scene):
                with warnings.catch_warnings():  # about the scene's viscosity, which no run uses
                    warnings.simplefilter("ignore", CortadoWarning)
                    simulation = simulation.replaced(f"forces.viscous_solve={'implicit' if key[0] else 'explicit'}")
            self._problems[key] = Problem(simulation, steps, own.loss, state=own.state)
        return self._problems[key]

    def _read(self, ends: Mapping[int, Snapshot], frames: Mapping[str, Frames], parameters: Values) -> Arrays:
        found = {}
        for name, one in self.observations.items():
            own = self._own(name, parameters)
            found[name] = frames[name].between({step: one.value(ends[step], own) for step in frames[name].needed})
            if found[name].shape != one.measured.shape:
                said = f"{name} has measured numbers of shape {one.measured.shape}"
                raise InputError(f"{said}, but the simulation predicts shape {found[name].shape}.")
        return found

    def _shared(self, values: Values) -> dict[str, Any]:
        own = self.start
        return {name: value for name, value in values.items() if name not in own}

    def _own(self, observation: str, values: Values) -> Arrays:
        given = {key: values.get(f"{observation}.{key}") for key in self.observations[observation].start}
        return {key: np.asarray(value, dtype=np.float64) for key, value in given.items() if value is not None}
