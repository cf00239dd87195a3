"""Predictive-corrective incompressible SPH (Solenthaler and Pajarola 2009; the report's Algorithms 1 and 3, put right).

`PcisphSteps.step` goes on until the density error is small; `PcisphSteps.replay` repeats a step with a known number of
iterations and keeps every intermediate value, for `cortado.solvers.pcisph.derivatives`.
"""

from collections.abc import Sequence
from typing import Any

import warp as wp

from cortado.device.arrays import Fields
from cortado.device.fields import POSITIONS, VELOCITIES
from cortado.device.launching import KernelLauncher, sum_and_maximum
from cortado.device.neighbourhood import Discretisation, neighbourhood_type
from cortado.device.neighbours import NeighbourSearch
from cortado.device.state import Layout, Parameters, State
from cortado.device.threads import Turn
from cortado.discretise.discrete_scene import Lattice
from cortado.lattice.calibration import SKIN
from cortado.solvers.containment import Containment, Walled
from cortado.solvers.pcisph.log import IterationLog
from cortado.solvers.pcisph.parts import Iterates, PcisphKernels, PressureSolve
from cortado.solvers.solver import Counts
from cortado.sph.emitter import Emitter, Nozzle
from cortado.sph.mixture import Mixture, Phases
from cortado.sph.parts import Force, StepContext


class PcisphSteps:
    """The steps of one set of particles on one device, forward; their arrays are reused by every step.

    The methods that `Solver` has are explained there.
    """

    def __init__(
        self,
        discretisation: Discretisation,
        lattice: Lattice,
        search: NeighbourSearch,
        forces: Sequence[Force],
        pressure: PressureSolve | None,
        periods: Sequence[float],
        phases: Phases,
        nozzle: Nozzle | None,
        walled: Walled,
        requires_grad: bool = False,
    ):
        """``pressure`` None leaves the pressure out; ``periods`` (3,) [m], 0 along an axis that is not periodic."""
        precision, particles, device = discretisation.precision, search.particles, search.device
        self.discretisation, self.lattice, self.search = discretisation, lattice, search
        self.particles, self.device = particles, device
        self.forces, self.pressure, self.periods = tuple(forces), pressure, tuple(periods)
        self.launch = KernelLauncher(particles, device, record_tape=requires_grad)
        self.turn = Turn(device)
        """Whose arrays these are now."""
        self.mixture = Mixture(phases, precision, particles, device, requires_grad)
        self.kernels = PcisphKernels.of(discretisation)
        self._sum = sum_and_maximum(particles, precision, device)

        def vectors() -> wp.array:
            return wp.zeros(particles, dtype=precision.vector, device=device, requires_grad=requires_grad)

        def count() -> wp.array:
            return wp.zeros(1, dtype=wp.int32, device=device)

        self._layout = Layout(particles, phases.count, precision, device)
        self.emitter = Emitter(nozzle, self._layout, requires_grad) if nozzle else None
        parts = [self.mixture, *([self.emitter] if self.emitter else [])]
        self.state_fields = (POSITIONS, VELOCITIES, *(field for part in parts for field in part.fields))
        """What a state consists of."""
        self.fields = Fields.zeros(particles, precision, device, requires_grad)

        def numbers() -> wp.array:
            return wp.zeros(particles, dtype=precision.real, device=device, requires_grad=requires_grad)

        self.wall_relaxation, self.contrast = numbers(), numbers()
        self.pressure_relaxation = numbers() if phases.count > 1 else self.wall_relaxation
        """(n,) what delta is multiplied with [-]: beside walls, and with several phases among lighter neighbours."""
        self.accelerations = [vectors() for _ in range(len(self.forces) + 1)]
        """``accelerations[t]``: of the first t forces; the first is 0 and never written."""
        self.iterates = Iterates(particles, precision, device, requires_grad)
        self._errors = wp.zeros(particles, dtype=precision.pair, device=device)
        self._error_sums = wp.zeros(1, dtype=precision.pair, device=device)
        self.step_number = count()
        self._iteration, self._active = count(), count()
        self.containment = Containment(walled, precision, self.launch, nozzle.first if nozzle else particles)
        self._neighbourhood: Any = None
        self._context: StepContext | None = None
        self.generation = 0
        """How often arrays, or the work of a step, were replaced; what was captured before is stale."""
        self.resize(search.capacity)

    def resize(self, capacity: int) -> None:
        """Make room for neighbour lists of that length."""
        if capacity != self.search.capacity:
            self.search.allocate(capacity)
            self.generation += 1
        search, lattice, precision = self.search, self.lattice, self.discretisation.precision
        s = neighbourhood_type(precision)()
        s.neighbours, s.fluid_count, s.filling, s.count = (
            search.neighbours,
            search.fluid_count,
            search.filling,
            search.count,
        )
        s.wall_positions, s.wall_weights = search.wall_positions, search.wall_weights
        s.support, s.reach = lattice.support, (1.0 + SKIN) * lattice.support
        s.normalisation = lattice.normalisation
        s.self_weight, s.volume, s.response_scale = lattice.self_weight, lattice.volume, lattice.response**-0.5
        s.laplacian_correction = lattice.laplacian_correction
        s.periodic = int(any(self.periods))
        s.period = precision.vector(*self.periods)
        s.frequency = precision.vector(*(1.0 / length if length else 0.0 for length in self.periods))
        self._neighbourhood, self._context = s, None

    def new_state(self, requires_grad: bool = False) -> State:
        """A state of this solver's particles, all 0."""
        return self._layout.state(self.state_fields, requires_grad)

    def new_parameters(self, steps: int, requires_grad: bool = False) -> Parameters:
        """Parameters of a run of so many steps, all 0."""
        return self._layout.parameters(steps, requires_grad)

    def new_log(self, steps: int) -> IterationLog:
        return IterationLog(steps, self.pressure, self.discretisation.precision, self.device)

    def set_substeps(self, substeps: int) -> None:
        if substeps != self.mixture.substeps:
            self.mixture.reserve(substeps)
            self.generation += 1

    def make_room(self) -> bool:
        needed, capacity = self.search.needed, self.search.capacity
        if needed <= capacity:
            return False
        self.resize(min(needed + needed // 8 + 1, 2 * capacity))
        self.search.forget_needed()
        return True

    def reset(self) -> None:
        self._iteration.zero_()
        self.step_number.zero_()
        self.containment.reset()

    # ---- forward -------------------------------------------------------------------------------------------------

    def step(self, state: State, new_state: State, parameters: Parameters, log: IterationLog) -> None:
        context = self._begin(state, parameters)
        if self.pressure is not None:
            self._solve_pressure(self.pressure, context)
        self.write_state((0,), parameters, new_state)
        f, it, containment = self.fields, self.iterates, self.containment
        containment.look(self.search.order, f["x"], f["rho_0"], it.x_star[0], it.v_star[0], new_state)
        self.launch(
            self.kernels.convergence.finish,
            particles=self.search.particles,
            sums=self._error_sums,
            bad=containment.bad_particle,
            step=self.step_number,
            iteration=self._iteration,
            bad_step=containment.bad_step,
            iterations=log.iterations,
            errors=log.errors,
            threads=1,
        )

    def reserve(self, counts: Counts) -> None:
        self.iterates.reserve(*counts)

    def replay(self, state: State, parameters: Parameters, counts: Counts) -> None:
        self.reserve(counts)
        context = self._begin(state, parameters)
        for k in range(*counts):
            self._iterate(k, k + 1, context)

    def write_state(self, counts: Counts, parameters: Parameters, new_state: State) -> None:
        """The last prediction, in the scene's order, but for particles that the emitter prescribes."""
        (iterations,) = counts
        it, context = self.iterates, self.context(parameters)
        free = self.emitter.free if self.emitter else new_state
        self.launch(
            self.kernels.integration.unsort,
            order=self.search.order,
            x=it.x_star[iterations],
            v=it.v_star[iterations],
            x_scene=free.positions,
            v_scene=free.velocities,
        )
        self.mixture.result(context, new_state.mass_fractions)
        if self.emitter:
            self.emitter.prescribe(context, new_state)

    def context(self, parameters: Parameters) -> StepContext:
        """The present step as its parts see it."""
        if self._context is None or self._context.parameters is not parameters:
            order, step = self.search.order, self.step_number
            self._context = StepContext(self.launch, self._neighbourhood, order, step, self.fields, parameters)
        return self._context

    def _begin(self, state: State, parameters: Parameters) -> StepContext:
        """Neighbours, density, mixture, explicit forces, and the first prediction."""
        f, it, kernels, context = self.fields, self.iterates, self.kernels, self.context(parameters)
        if self.emitter:
            self.emitter.begin(context, state)
        self.search.sort(state.positions)
        scene = {"x_scene": state.positions, "v_scene": state.velocities, "m_scene": state["reference_density"]}
        context.launch(kernels.integration.sort, **scene)
        self.search.fill(self._neighbourhood, f["x"])
        context.launch(kernels.density.forward)
        self.mixture.diffuse(context, state.mass_fractions)
        context.launch(kernels.walls.forward, y=self.wall_relaxation)
        if self.mixture.phases.count > 1:
            context.launch(
                kernels.contrast.forward, wall_y=self.wall_relaxation, t=self.contrast, y=self.pressure_relaxation
            )
        for t, force in enumerate(self.forces):
            force.accelerate(context, self.accelerations[t], self.accelerations[t + 1])
        first = {"x_star": it.x_star[0], "v_star": it.v_star[0]}
        context.launch(kernels.integration.predict, acceleration=self.accelerations[-1], **first)
        return context

    def _solve_pressure(self, solve: PressureSolve, context: StepContext) -> None:
        """Iterate in one slot until the density error is small enough; the device decides."""
        for k in range(solve.minimum_iterations):
            self._iterate(k, 0, context)
        self._decide(solve, solve.minimum_iterations)
        if solve.maximum_iterations > solve.minimum_iterations:

            def once_more() -> None:
                self._iterate(1, 0, context)
                self._decide(solve, 1)

            wp.capture_while(self._active, once_more)

    def _decide(self, solve: PressureSolve, done: int) -> None:
        self._error_sums = self._sum(self._errors)
        self.launch(
            self.kernels.convergence.decide,
            done=done,
            most=solve.maximum_iterations,
            particles=self.search.particles,
            tolerance=solve.tolerance,
            greatest_tolerance=solve.greatest_tolerance,
            sums=self._error_sums,
            iteration=self._iteration,
            active=self._active,
            threads=1,
        )

    def _iterate(self, k: int, slot: int, context: StepContext) -> None:
        """Iteration k, from the predicted state of the slot before to that of ``slot`` (0: the only one)."""
        it, kernels, before = self.iterates, self.kernels, max(slot - 1, 0)
        context.launch(
            kernels.pressure.forward,
            stiffness=self.lattice.stiffness,
            y=self.pressure_relaxation,
            x_star=it.x_star[before],
            p_in=it.p[0] if k == 0 else it.p[max(slot - 1, 1)],
            p_out=it.p[max(slot, 1)],
            c=it.c[before],
            error=self._errors,
        )
        new = {"x_star": it.x_star[slot], "v_star": it.v_star[slot]}
        context.launch(kernels.force.forward, acceleration=self.accelerations[-1], c=it.c[before], **new)
