"""Checks parameters, converts them to the arrays of a rollout, and determines the number of steps of a run."""

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from functools import cached_property
from typing import Any

import numpy as np

from cortado.arrays import as_numbers, as_one_number, check_steps, is_same, require_names
from cortado.device.threads import WARP
from cortado.errors import InputError, OutOfRangeError, shown, warn
from cortado.particles.state import Parameters, State
from cortado.rollout import run_checks
from cortado.rollout.rollout import Rollout
from cortado.rollout.scene_parameters import DENSITY, SceneParameters, Simulated
from cortado.rollout.step_bounds import ROOM, begin_choosing, counted_steps, expected_steps, greatest_step
from cortado.rollout.step_sizes import ChosenSteps
from cortado.scene.courses import Steady
from cortado.scene.parameter_values import Arrays, Values, check_known, checked_value, entry, scene_values, stacked
from cortado.scene.parameters import Role
from cortado.scene.restart import Clock, RestartState
from cortado.scene.scene_warnings import viscosity_sentence
from cortado.scene.stability import divergence_advice

SAME = 1e-9
STATE_TIME = "time"
_VARIED = frozenset({"mobility", "viscosity"})
DIFFUSION = ("time_step", "mobility", "interface_width", "rest_density")


class ParameterSpace:
    """Converts parameters by name to the arrays of a rollout, and adjoints of the arrays to gradients.

    In a batch, the value of a parameter applies to all scenes or has a first axis for the scenes.
    """

    def __init__(self, simulation: Simulated, steps: int):
        self._simulation, self._batch, self._steps = simulation, simulation.batch, steps
        self._parameters_dot: tuple[Rollout, Parameters] | None = None
        self._known = simulation.known
        self._one = SceneParameters(simulation, steps)
        self._first_positions = run_checks.FirstPositions(simulation)
        self._told: set[str] = set()
        self._begun: tuple[Rollout, int, Arrays, frozenset[str]] | None = None
        self._judged: tuple[Arrays, float] | None = None
        self._have_checks = any(hasattr(maker, "check") for maker in simulation.forces)

    def checked(self, values: Values, what: str = "parameter") -> Arrays:
        """Return valid values as float64 arrays. With ``what`` "direction", negative values are valid."""
        if not isinstance(values, Mapping):
            raise InputError(f"{what}s are {shown(values)}, but must be a dictionary, such as {{'gravity': value}}.")
        for view, name in self._known.views.items():
            if view in values and name in values:
                raise InputError(f"{what} {name} is given, but must be left out, as {view} is given in its place.")
        found = {name: self._checked(name, value, what) for name, value in values.items()}
        if what != "direction":
            self._judge(found)
        return found

    def _judge(self, values: Arrays) -> None:
        """Check values for a run. Unchanged values and a weaker gravity than before are not checked again."""
        last, strongest = self._judged or ({}, 0.0)
        is_first = self._judged is None or last.keys() != values.keys()
        gravity = values.get("gravity")
        strength = 0.0 if gravity is None else float(np.einsum("...i,...i", gravity, gravity).max())
        weaker = {"gravity"} if strength <= strongest and not self._have_checks else set()
        changed = [
            name for name, value in values.items() if is_first or not (name in weaker or is_same(value, last[name]))
        ]
        if not (changed or is_first):
            return
        run_checks.check_sizes({name: values[name] for name in changed}, self._simulation.precision, self._known)
        for number, own in enumerate(self._different(values)):
            self._check(own, number)
        self._judged = {name: value.copy() for name, value in values.items()}, strength

    def checked_names(self, what: str, names: Iterable[str]) -> list[str]:
        found = require_names(what, names)
        for name in found:
            check_known(name, self._simulation.scene, what, self._known)
        return found

    def shapes(self, name: str) -> list[tuple[int, ...]]:
        check_known(name, self._simulation.scene, known=self._known)
        own = self._one.shapes(name)
        return [*own, *self._batched(own)]

    def members(self, values: Arrays) -> list[Arrays]:
        different = self._different(values)
        return different if len(different) > 1 else different * (self._batch or 1)

    def defaults(self) -> Arrays:
        """Return the scene's parameters. Parameters over time have a first axis for the steps."""
        found = {**scene_values(self._simulation, self._known), **self._one.scheduled({})}
        return {name: value for name, value in found.items() if self._known[name].role is not Role.CLOCK}

    def depends_on_time(self, values: Arrays) -> bool:
        courses = self._one.courses(values).values()
        still = [isinstance(course, Steady) and course.greatest() == 0.0 for course in courses]
        return self._simulation.scene.solver.chooses or not all(still)

    def colours(self, values: Arrays) -> np.ndarray:
        return values.get("colours", self._one.values["colours"])

    @WARP
    def begin(
        self,
        rollout: Rollout,
        values: Arrays,
        varied: Iterable[str] = (),
        states: Sequence[RestartState] = (),
        write: Callable[[State], None] | None = None,
    ) -> None:
        """Set the first state and parameters of a rollout. ``varied`` names the parameters to differentiate."""
        simulation, members = self._simulation, [self._one.upright(own) for own in self._different(values)]
        if write is not None and self._goes_on(rollout, values, varied, states):
            self._go_on(rollout, members, states, write)
            self._keep(rollout, values, varied, members)
            return
        if write is not None:
            self.check_restarts(states, values)
        sought = viscosity_sentence(simulation.scene, "the viscosity is a parameter") if "viscosity" in varied else None
        self._warn(sought)
        rollout.begin_evaluation()
        rollout.goes_on = bool(states)
        rollout.clocks = [state.clock for state in states] or [Clock()] * len(rollout.clocks)
        if write is not None:
            write(rollout.initial)
        elif not states:
            rollout.initial.assign(simulation.initial)
        firsts = [dict(state.fields) for state in states] or [self._one.first(own) for own in members]
        rollout.initial.set(self._together(firsts))
        if simulation.scene.solver.chooses:
            members = [{**own, "time_step": np.array(greatest_step(simulation.scene, own))} for own in members]
        if (simulation.scene.schedule.courses or self._known.courses) and len(members) < len(rollout.clocks):
            members = members * len(rollout.clocks)
        clocks = rollout.clocks if len(members) > 1 else rollout.clocks[:1]
        chosen = [
            self._one.run({**self._one.scheduled(own, clock), **own})
            for own, clock in zip(members, clocks, strict=True)
        ]
        courses = self._one.courses(members[0])
        self._warn(run_checks.path_sentence(simulation.scene, rollout.initial, members[0], chosen[0], courses))
        rollout.time_steps[:] = [one["time_step"] for one in chosen]
        origins = [run_checks.origin_of(simulation, one["rest_density"]) for one in chosen]
        shared = {one: one for one in origins}  # equal origins are one object, because a batch has hundreds
        rollout.origins = [shared[one] for one in origins] * (len(rollout.clocks) // len(origins))
        rollout.parameters.set(stacked(chosen))
        if not simulation.scene.solver.chooses:
            self._warn(run_checks.dry_sentence(simulation.scene, rollout))
        substeps = {simulation.substeps(**{name: one[name] for name in DIFFUSION}) for one in chosen}
        if len(substeps) > 1:
            found = f"{' and '.join(map(str, sorted(substeps)))} explicit steps of diffusion in a time step"
            wanted = f"must all take the same number: make {', '.join(DIFFUSION)} differ less"
            raise InputError(f"The scenes of the batch take {found}, but {wanted}.")
        several = len(simulation.scene.phase) > 1
        rollout.substeps = max(*substeps, 1) if "mobility" in varied and several else max(substeps)
        each = self._keep(rollout, values, varied, members)
        if simulation.scene.solver.chooses:
            begin_choosing(rollout, simulation.scene, self._one, each)

    def _keep(self, rollout: Rollout, values: Arrays, varied: Iterable[str], members: list[Arrays]) -> list[Arrays]:
        each, scene = members * (len(rollout.clocks) // len(members)), self._simulation.scene
        rollout.advice = lambda member: divergence_advice(scene, each[member], float(rollout.time_steps[member]))
        own = {name: value.copy() for name, value in values.items()}
        self._begun = rollout, rollout.evaluation, own, _VARIED.intersection(varied)
        return each

    def _goes_on(self, rollout: Rollout, values: Arrays, varied: Iterable[str], states: Sequence[RestartState]) -> bool:
        """Test if only the state and gravity have changed since the rollout last began."""
        if self._begun is None or self._begun[:2] != (rollout, rollout.evaluation) or not self._is_still:
            return False
        _, _, last, others = self._begun
        return (
            rollout.goes_on
            and last.keys() == values.keys()
            and all(name == "gravity" or is_same(value, last[name]) for name, value in values.items())
            and ("gravity" not in values or values["gravity"].shape == last["gravity"].shape)
            and others == _VARIED.intersection(varied)
            and [state.origin for state in states] == rollout.origins
        )

    def _go_on(
        self, rollout: Rollout, members: list[Arrays], states: Sequence[RestartState], write: Callable[[State], None]
    ) -> None:
        rollout.begin_evaluation()
        rollout.clocks = [state.clock for state in states]
        write(rollout.initial)
        if "gravity" in members[0] and not np.isnan(members[0]["gravity"].flat[0]):  # NaN stands in for a Warp array
            rows = np.empty((len(members), max(self._steps, 1), self._simulation.dimension))
            for own, member in zip(rows, members, strict=True):
                own[:] = member["gravity"]
            rollout.parameters.set({"gravity": rows})

    @cached_property
    def _is_still(self) -> bool:
        scene = self._simulation.scene
        return not (self.depends_on_time({}) or scene.emitter or any(table.moves for table in scene.solid))

    def _warn(self, sentence: str | None) -> None:
        if sentence and sentence not in self._told:
            self._told.add(sentence)
            warn(sentence)

    def check_restarts(self, states: Sequence[RestartState], values: Arrays) -> None:
        for name in self._known.state if states else ():
            if name in values:
                raise InputError(f"parameter {name} is given, but must be left out, as the given state has values.")
        simulation = self._simulation
        for state, own in zip(states, self.members(values), strict=False):
            origin = run_checks.origin_of(
                simulation, np.atleast_1d(own.get("rest_density", self._one.values["rest_density"]))
            )
            run_checks.check_state(state, origin, simulation)

    @WARP
    def direction(self, rollout: Rollout, values: Arrays, along: Arrays) -> tuple[State, Parameters]:
        """Return tangents of the first state and of parameters. The next call overwrites the second tangent."""
        if self._parameters_dot is None or self._parameters_dot[0] is not rollout:
            self._parameters_dot = rollout, rollout.solver.new_parameters(self._steps)
        dot, parameters = rollout.solver.new_state(), self._parameters_dot[1]
        self.set_direction(rollout, values, along, dot, parameters)
        return dot, parameters

    @WARP
    def set_direction(
        self,
        rollout: Rollout,
        values: Arrays,
        along: Arrays,
        dot: State,
        parameters: Parameters,
        time_dots: np.ndarray | None = None,
    ) -> None:
        """Write tangents to ``dot`` and ``parameters``. ``time_dots`` (members,) are tangents of first times."""
        members, times = self.members(values), np.zeros(len(rollout.clocks)) if time_dots is None else time_dots
        each = zip(members, self.members(along), rollout.clocks, times, strict=True)
        directions = [self._one.direction(*own) for own in each]
        if not rollout.goes_on:
            dot.set(self._together([first for first, _ in directions]))
        parameters.set(stacked([run for _, run in directions]))

    def time_adjoints(self, rollout: Rollout, values: Arrays, parameters: Parameters) -> np.ndarray:
        """Return the adjoints (members,) of the times of the first states."""
        run = self._read(parameters, {name for own in self._different(values) for name in self._one.changing(own)})
        members = enumerate(zip(self.members(values), rollout.clocks, strict=True))
        return np.array([self._one.time_adjoint(own, entry(run, b), clock) for b, (own, clock) in members])

    def state_adjoint(self, rollout: Rollout, values: Arrays, state: State, parameters: Parameters) -> Arrays:
        """Return the adjoint of the first state and its ``time``, in float64."""
        found = {name: bar.astype(np.float64) for name, bar in state.numpy(self._simulation.dimension).items()}
        times = self.time_adjoints(rollout, values, parameters)
        return {**found, STATE_TIME: times[0] if self._batch is None else times}

    def gradient(
        self, rollout: Rollout, values: Arrays, state: State, parameters: Parameters, elsewhere: Collection[str] = ()
    ) -> Arrays:
        """Return the gradient by name, without the parameters in ``elsewhere``."""
        dimension = self._simulation.dimension
        read = {self._known.views.get(name, name) for name in values}
        read |= set(self._known.over_time) if "time_step" in values else set()
        run = self._read(parameters, read.difference(elsewhere))
        fields = [f.name for f in state.fields if f.first in values or f.name == DENSITY]
        fields = [] if rollout.goes_on else fields
        first = {name: bar.astype(np.float64) for name, bar in state.numpy(dimension, only=fields).items()}
        if self._batch is None:
            return self._one.gradient(values, first, entry(run, 0), rollout.clocks[0])
        members = enumerate(zip(self.members(values), rollout.clocks, strict=True))
        found = stacked([self._one.gradient(own, entry(first, b), entry(run, b), clock) for b, (own, clock) in members])
        return {name: bar.reshape(self._batch, *self._row(name, values[name])) for name, bar in found.items()}

    def _read(self, parameters: Parameters, names: Collection[str]) -> Arrays:
        found = {name: parameters[name].numpy().astype(np.float64) for name in self._known.run if name in names}
        vectors = {name: found[name] for name in self._known.vectors if name in found}
        return found | {name: array[..., : self._simulation.dimension] for name, array in vectors.items()}

    def _checked(self, name: str, value: Any, what: str) -> np.ndarray:
        check_known(name, self._simulation.scene, what, self._known)
        own = self._one.shapes(name)
        array = checked_value(name, value, [*own, *self._batched(own)], what, self._known)
        if len(own) == 2 and array.shape == own[1] and self._batch == self._steps > 1:
            rows, *rest = own[1]
            found = f"has shape {array.shape}, whose first axis may count the steps or the scenes of the batch"
            raise InputError(f"{what} {name} {found}, but must be {(1, rows, *rest)} or {(rows, 1, *rest)}.")
        return array

    def _batched(self, own: list[tuple[int, ...]]) -> list[tuple[int, ...]]:
        if self._batch is None:
            return []
        if len(own) == 1:
            return [(self._batch, *own[0])]
        return [(self._batch, 1, *own[0]), (self._batch, *own[1]), (1, *own[1])]

    def _row(self, name: str, value: np.ndarray) -> tuple[int, ...]:
        return value.shape if value.shape in self._one.shapes(name) else value.shape[1:]

    def _different(self, values: Arrays) -> list[Arrays]:
        shared, each = {}, {}
        for name, value in values.items():
            own = self._one.shapes(name)
            if value.shape in own:
                shared[name] = value
            elif value.shape == (1, *own[-1]):
                shared[name] = value[0]
            else:
                each[name] = value[:, 0] if value.shape[1:] == (1, *own[0]) else value
        members = range(self._batch or 1) if each else range(1)
        return [shared | {name: value[b] for name, value in each.items()} for b in members]

    def _check(self, values: Arrays, number: int) -> None:
        simulation = self._simulation
        if self._steps == 0:
            return
        try:
            run_checks.check_places(values, simulation.scene, simulation.free_particles)
            crowded = self._first_positions.check(values, number)
            for maker in simulation.forces:
                if hasattr(maker, "check"):
                    maker.check(values, simulation)
        except InputError as error:
            place = "" if self._batch is None else f"In scene {number} of the batch, "
            raise OutOfRangeError(f"{place}{error}") from error
        unstable = (
            run_checks.unstable_sentence(self._one.upright(values), simulation.scene, self._told) if values else None
        )
        for sentence in filter(None, (crowded, unstable)):
            warn(sentence)

    def _together(self, fields: list[Arrays]) -> Arrays:
        return fields[0] if self._batch is None else stacked(fields * (self._batch // len(fields)))


def steps_of_run(simulation: Simulated, steps: int | None, time: float | None, values: Mapping[str, Any]) -> int:
    """Return the number of steps, or an upper bound for adaptive steps. ``time`` is in s."""
    if steps is None and time is None:
        raise InputError("steps is left out, but must be given, as no time is given.")
    if steps is not None and time is not None:
        raise InputError("time is given, but must be left out, as steps is given, too.")
    if time is None:
        assert steps is not None
        return check_steps(steps)
    if not 0.0 < (number := as_one_number("time", time)) < np.inf:
        raise InputError(f"time is {number:g}, but must be a number of seconds greater than 0.")
    if not simulation.scene.solver.chooses:
        given = values.get("time_step") if isinstance(values, Mapping) else None
        sizes = as_numbers("parameter time_step", simulation.scene.solver.time_step if given is None else given)
        shortest = float(sizes.min(initial=np.inf))
        return counted_steps(time, time / shortest * (1.0 - SAME)) if 0.0 < shortest < np.inf else 1
    if simulation.batch is not None:
        said = "time is given, but must be left out for a batch with adaptive time steps"
        raise InputError(f"{said}, as the scenes need different numbers of steps: give steps.")
    # with 0 steps, because rows for steps have no meaning with an unknown number of steps
    own = SceneParameters(simulation, 0).upright(ParameterSpace(simulation, 0).checked(values))
    return ROOM * expected_steps(simulation, time, own)


def end_after(rollout: Rollout, time: float | None) -> None:
    """End a rollout with adaptive steps at the first state that is at least ``time`` [s] after its start."""
    if time is not None and isinstance(rollout.step_sizes, ChosenSteps):
        rollout.step_sizes.end_after(time * (1.0 - SAME))
