"""Quantities of particles by name, with derivatives, for a state and the parameters of the next step."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from cortado.device.launching import CapturedGraph
from cortado.device.threads import in_turn
from cortado.errors import InputError
from cortado.particles.state import Fields, State, padded
from cortado.rollout.rollout import Rollout
from cortado.runs.body_sensors import spring_loads
from cortado.runs.particle_sums import in_the_scene
from cortado.runs.quantity_formulas import SIX, Bars, QuantityFormula, formulas
from cortado.scene.parameter_values import Arrays
from cortado.scene.parameters import LOAD, check_quantity, is_load
from cortado.scene.scene import Scene
from cortado.scene.shape_tables import Container
from cortado.scene.solids import SolidTable
from cortado.solvers.particle_derivatives import ParticleAdjoint, ParticleTangent
from cortado.solvers.particles import ParticleSolver
from cortado.solvers.solver import Counts, Solver, WithinBar
from cortado.sph.parts import StepContext, orders_of

Given = Mapping[str, NDArray]
Evaluator = Callable[[], "QuantityEvaluator"]
STRESS = "pressure"


@dataclass(frozen=True, eq=False)
class Moment:
    """A state, and the parameters of the step after it. A moment computes quantities on first use."""

    state: State
    parameters: Mapping[str, NDArray]
    """Parameters of the step by name, with a first axis for the scenes of a batch."""
    substeps: int
    row: int
    """Number of the step in its run, from 0. For the last state, the number of steps of the run."""
    evaluator: "Evaluator"
    wanted: set[str] = field(default_factory=set)
    """Names of the quantities that were read so far. All moments of a run share one set of names."""
    counts: list[Counts] = field(default_factory=list)
    """Iteration counts of the step. The list is empty if the run has not taken the step."""
    _values: Arrays = field(default_factory=dict)

    @classmethod
    def of(
        cls, rollout: Rollout, step: int, state: State, evaluator: "Evaluator", wanted: set[str] | None = None
    ) -> "Moment":
        parameters = row_of(rollout, rollout.parameters.written, step)
        size = rollout.step_sizes.of_step(min(step, max(rollout.steps - 1, 0)))
        if size is not None:
            parameters["time_step"] = size
        return cls(state, parameters, rollout.substeps, step, evaluator, set() if wanted is None else wanted)

    def value(self, name: str) -> NDArray:
        """Return a quantity as a read-only float64 array. A batch adds a first axis for the scenes."""
        if name not in self._values:
            self.wanted.add(name)
            names = filter(_needs_the_step, self.wanted) if _needs_the_step(name) else [name]
            for own, found in self.evaluator().values(names, self).items():
                found.flags.writeable = False
                self._values[own] = found
        return self._values[name]

    def know(self, values: Arrays) -> None:
        self._values.update(values)


def _needs_the_step(name: str) -> bool:
    return name in (STRESS, "wall_force") or is_load(name)


class QuantityEvaluator:
    """Computes quantities in the arrays of a solver, so that no run may use the solver meanwhile. Results have the
    particles in the order of the scene. A batch adds a first axis for the scenes."""

    def __init__(self, solver: Solver, scene: Scene, circulation_factor: float):
        if not isinstance(solver, ParticleSolver):
            raise InputError("The solver of this scene is not a ParticleSolver, so that quantities cannot be computed.")
        self.solver, self.turn, self.dimension = solver, solver.turn, scene.dimension
        self.lattice = solver.lattice
        self.solids: tuple[SolidTable, ...] = scene.solid
        self.container: Container = scene.container
        self._formulas = {**formulas(solver, circulation_factor), **spring_loads(solver)}
        self._counts: Counts = ()
        self._graphs: dict[tuple[int, Counts], CapturedGraph] = {}
        self._rounds: list[int] = []

    def within(self, names: Iterable[str]) -> dict[str, QuantityFormula]:
        return {name: self._formulas[name] for name in self._checked(names)}

    @in_turn
    def values(self, names: Iterable[str], moment: Moment) -> Arrays:
        wanted = self._checked(names)
        step, p = self._begin(wanted, moment, replay=False)
        return {name: self._shown(name, self._formulas[name].value(step, p)) for name in wanted}

    @in_turn
    def tangents(self, names: Iterable[str], moment: Moment, dot: Given, parameters_dot: Given) -> Arrays:
        wanted, solver = self._checked(names), self.solver
        step, p = self._begin(wanted, moment, replay=True)
        state_dot, along = solver.new_state(), solver.new_parameters(1)
        state_dot.set(dot)
        along.set(parameters_dot)
        tangent: Any = ParticleTangent(solver, along) if p is None else solver.tangent(along)
        p_dot, stress_dot = solver.numbers(), solver.numbers()
        if p is None:
            tangent.sort(step, state_dot)
        else:
            tangent.step(self._counts, state_dot, self._rollout.parameters)
            if STRESS in wanted:
                stress_dot.assign(np.asarray(tangent.stresses(self._rounds)))
            p_dot.assign(tangent.pressures(self._rounds))
        given = step, p, tangent.dot, p_dot, stress_dot
        return {name: self._shown(name, self._formulas[name].tangent(*given)) for name in wanted}

    @in_turn
    def adjoint(self, bars: Mapping[str, NDArray], moment: Moment) -> tuple[Arrays, Arrays]:
        wanted, solver = self._checked(bars), self.solver
        if wanted == [STRESS]:
            return self._from_stress(bars[STRESS], moment)
        step, p = self._begin(wanted, moment, replay=True)
        solved = any(map(_needs_the_step, wanted))
        adjoint: Any = self._pressure_adjoint if solved else self._field_adjoint
        adjoint.begin()
        fields = Fields.zeros(solver.layout.all_particles, solver.discretisation.precision, solver.device)
        own = Bars(replace(adjoint.bar, fields=fields), solver.numbers(), solver.numbers(), solver.vectors())
        for name in wanted:
            self._formulas[name].adjoint(step, p, self._sorted(name, bars[name]), own)
        state_bar = solver.new_state()
        if solved:
            within = WithinBar(fields, own.p, own.stress if STRESS in wanted else None, own.v_star)
            adjoint.from_within(self._counts, within, state_bar, self._rollout.parameters)
        else:
            adjoint.density.begin()
            adjoint.bar.fields.assign(fields)
            adjoint.mix(step, state_bar)
            adjoint.sort(step, state_bar, **{f.name: adjoint.carried_bar[f.name] for f in solver.carried_fields})
        return self._found(adjoint, state_bar)

    def _from_stress(self, stress_bar: NDArray, moment: Moment) -> tuple[Arrays, Arrays]:
        solver, (given, _, state_bar), adjoint = self.solver, self._of_stress, self._pressure_adjoint
        self._set(moment)
        if not moment.counts:
            self._solve(False)
        counts, *_ = moment.counts or [self._counts]
        given.assign(stress_bar.reshape(-1))
        adjoint.begin()
        solver.step_number.fill_(0)
        self._graphs = {k: graph for k, graph in self._graphs.items() if k[0] == solver.generation}
        graph = CapturedGraph(partial(self._go_back, counts), solver.launch)
        self._graphs.setdefault((solver.generation, counts), graph)()
        return self._found(adjoint, state_bar)

    def _go_back(self, counts: Counts) -> None:
        solver, parameters, (given, own, state_bar) = self.solver, self._rollout.parameters, self._of_stress
        solver.reserve(counts)
        solver.replay(self._rollout.initial, parameters, counts)
        solver.context(parameters).launch(orders_of(own.stress).sort, a_scene=given, a=own.stress)
        self._pressure_adjoint.from_within(counts, own, state_bar, parameters)

    @cached_property
    def _of_stress(self) -> tuple[wp.array, WithinBar, State]:
        solver, numbers = self.solver, self.solver.numbers
        fields = Fields.zeros(solver.layout.all_particles, solver.discretisation.precision, solver.device)
        return numbers(), WithinBar(fields, numbers(), numbers(), solver.vectors()), solver.new_state()

    def _found(self, adjoint: Any, state_bar: State) -> tuple[Arrays, Arrays]:
        parameters, state = adjoint.collect(), state_bar.numpy(self.dimension)
        found = {name: parameters[name].numpy().astype(np.float64) for name in parameters.names}
        return {name: array.astype(np.float64) for name, array in state.items()}, found

    def _checked(self, names: Iterable[str]) -> list[str]:
        wanted = list(names)
        for name in wanted:
            if not is_load(name):
                check_quantity(name)
            elif name not in self._formulas:
                solids = ", ".join(self.solver.system.solids) or "no solids"
                raise InputError(f"{name!r} is a load on {name.removesuffix(LOAD)!r}, but the scene has {solids}.")
        return wanted

    def _begin(self, names: Iterable[str], moment: Moment, replay: bool) -> tuple[StepContext, wp.array | None]:
        self._set(moment)
        if any(map(_needs_the_step, names)):
            return self._solve(replay)
        solver, rollout = self.solver, self._rollout
        solver.reset()
        context = solver.sort(rollout.initial, rollout.parameters)
        while solver.make_room():
            context = solver.sort(rollout.initial, rollout.parameters)
        return context, None

    def _set(self, moment: Moment) -> None:
        rollout = self._rollout
        rollout.begin_evaluation()
        rollout.initial.assign(moment.state)
        rollout.parameters.set(moment.parameters)
        rollout.substeps = moment.substeps
        self.solver.set_substeps(moment.substeps)

    def _solve(self, replay: bool) -> tuple[StepContext, wp.array]:
        solver, rollout = self.solver, self._rollout
        rollout.forward(keep=False)
        found = solver.pressures()
        if found is None:
            raise InputError("The solver of this scene computes no pressure, so that no pressure can be read.")
        pressures = wp.clone(found)  # as a replay overwrites what was found
        self._counts = rollout.log.seek(0)
        rounds = rollout.diagnostics[solver.loops[0].iterations_name][0]
        self._rounds = [int(k) for k in np.atleast_1d(rounds)]
        if replay:
            solver.step_number.fill_(0)
            solver.replay(rollout.initial, rollout.parameters, self._counts)
        return solver.context(rollout.parameters), pressures

    @cached_property
    def _rollout(self) -> Rollout:
        return Rollout(self.solver, 1)

    @cached_property
    def _field_adjoint(self) -> ParticleAdjoint:
        return ParticleAdjoint(self.solver, 1)

    @cached_property
    def _pressure_adjoint(self) -> Any:
        return self.solver.adjoint(1)

    @property
    def _order(self) -> NDArray:
        return self.solver.search.order.numpy()[: self.solver.layout.all_particles]

    def _shown(self, name: str, values: wp.array) -> NDArray:
        own = values.numpy().astype(np.float64)
        if is_load(name):
            return self._load(own)
        found = np.empty(own.shape)
        found[self._order] = own
        return self._by_scene(found[:, 2] if name == "vorticity" and self.dimension == 2 else found)

    def of_scene(self, name: str, values: NDArray) -> NDArray:
        """Return a quantity with the particles in the order of the scene, or a load (6,)."""
        found = values.astype(np.float64)
        found.flags.writeable = False
        return self._load(found) if is_load(name) else self._by_scene(found)

    def _load(self, six: NDArray) -> NDArray:
        found = in_the_scene(six, self.dimension)
        return found[0] if self.solver.layout.batch is None else found

    def _by_scene(self, found: NDArray) -> NDArray:
        own, batch = found if found.ndim == 1 else found[:, : self.dimension], self.solver.layout.batch
        return own if batch is None else own.reshape(batch, -1, *own.shape[1:])

    def _sorted(self, name: str, values: NDArray) -> wp.array:
        given, layout = np.asarray(values, dtype=np.float64), self.solver.layout
        if is_load(name):
            six = np.zeros((layout.members, 6))
            six[:, [0, 1, 5] if self.dimension == 2 else slice(None)] = given.reshape(layout.members, -1)
            return wp.array(six, dtype=SIX, device=layout.device)
        flat = given if layout.batch is None else given.reshape(-1, *given.shape[2:])
        if name == "vorticity" and self.dimension == 2:
            flat = np.pad(flat[:, None], ((0, 0), (2, 0)))
        kind = layout.precision.real if flat.ndim == 1 else layout.precision.vector
        sorted_ = flat[self._order] if flat.ndim == 1 else padded(flat[self._order])
        return wp.array(sorted_, dtype=kind, device=layout.device)


def row_of(rollout: Rollout, values: Mapping[str, NDArray], row: int) -> Arrays:
    """Return the values of the parameters of a run in one time step. The first step has the ``row`` 0. After the last
    step, values stay constant, but paths of solids are extrapolated."""
    found = {}
    for name, value in values.items():
        shares = _shares_of_rows(rollout, name, row, value) or {}
        rows = [share * value[:, k : k + 1] for k, share in shares.items()]
        found[name] = np.sum(rows, axis=0) if rows else np.asarray(value)
    return found


def add_to_row(rollout: Rollout, name: str, bar: NDArray, row: int, total: NDArray) -> None:
    """Add the adjoint ``bar`` of a parameter in one time step to its ``total`` over all steps, the transpose of
    `row_of`."""
    shares = _shares_of_rows(rollout, name, row, total)
    if shares is None:
        total += bar
        return
    for k, share in shares.items():
        total[:, k : k + 1] += share * bar


def _shares_of_rows(rollout: Rollout, name: str, row: int, values: NDArray) -> dict[int, float] | None:
    """Return the weights of time steps in the value of `row_of`, or None for a parameter constant in time."""
    known = rollout.solver.layout.known
    if name not in known.over_time:
        return None
    rows = values.shape[1]
    if row < rows:
        return {row: 1.0}
    return {rows - 1: 2.0, rows - 2: -1.0} if known[name].grows and rows > 1 else {rows - 1: 1.0}
