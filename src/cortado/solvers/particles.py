"""The base class of particle solvers: everything in a step except the pressure iterations."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NoReturn, Self

import numpy as np
import warp as wp
from numpy.typing import NDArray

from cortado.calls import Staying
from cortado.device.launching import HostCopy, KernelLauncher
from cortado.device.threads import Turn, gradient_parts
from cortado.discretise.shapes import Points
from cortado.discretise.smoothing import SKIN
from cortado.errors import MissingDerivativeError
from cortado.particles.neighbourhood import Discretisation, neighbourhood_type
from cortado.particles.neighbours import NeighbourSearch
from cortado.particles.sheets import Sheets
from cortado.particles.state import POSITIONS, VELOCITIES, Fields, Layout, Parameters, State, StateField, check_fields
from cortado.scene.discrete_scene import Lattice
from cortado.solvers.containment import Containment
from cortado.solvers.loop import IterationLog, Loop, convergence_kernels
from cortado.solvers.obstacles import FlatFaces, NamedSolid, Walled
from cortado.solvers.solver import Counts, StepAdjoint, StepTangent
from cortado.sph.density import Density, WallAction, WallSums, wall_slope_term
from cortado.sph.free_solids import FreeSolidsPart
from cortado.sph.parts import Carried, Force, Part, PartMaker, StepContext, integration_kernels


@dataclass(frozen=True)
class ParticleSystem:
    """A scene discretised into particles on a device."""

    called: str
    discretisation: Discretisation
    layout: Layout
    lattice: Lattice
    search: NeighbourSearch
    forces: Sequence[Force]
    parts: Sequence[PartMaker]
    waiting: int
    """Index of the first particle that an emitter or a drain may move."""
    walled: Walled
    mirrors: tuple[Points, Points]
    """Coordinates of flat walls that mirror the fluid, lower (3,) and upper (3,) [m]; infinite without a wall."""
    faces: FlatFaces
    solids: Mapping[str, NamedSolid]
    sheets: Sheets | None
    of_one_lane: Callable[[], "ParticleSystem"]
    """Function that makes a system with kernels for ``warp.Tape``."""


class ParticleSolver(Staying):
    """The base class of particle solvers. Every step reuses the arrays of the solver.

    `Solver` documents the methods. A subclass defines `step`, `replay` and `write_state`. A subclass with loops also
    defines `reserve`. A subclass with derivatives also defines `tangent`, `adjoint` and `differentiable`.
    """

    carried_fields: tuple[StateField, ...] = ()
    topic = "density"
    density_power = 2
    """Power of the number density by which the pressure force divides the pressure."""
    shares: tuple[str, ...] = ()
    """Parameters of the solver with adjoints that are sums over particles."""

    def __init__(self, system: ParticleSystem, requires_grad: bool = False):
        discretisation, search, layout = system.discretisation, system.search, system.layout
        precision, particles, device = layout.precision, layout.all_particles, layout.device
        if requires_grad and not discretisation.taped:
            raise TypeError("a tape needs the kernels of system.of_one_lane(): make the solver from this system.")
        self.system, self.discretisation, self.lattice, self.search = system, discretisation, system.lattice, search
        self.layout, self.device, self.forces = layout, device, tuple(system.forces)
        self.launch = KernelLauncher(particles, device, record_tape=requires_grad)
        self.turn = Turn(device)
        self.density, self.integration = self.new_density(), integration_kernels(precision, requires_grad)
        self.parts = (
            *(maker.part(layout, requires_grad) for maker in system.parts),
            *(force for force in self.forces if isinstance(force, Part)),
        )
        self.free = [body for part in self.parts if isinstance(part, FreeSolidsPart) for body in part.bodies]
        self.substeps = 0
        self.carried = Carried(self.carried_fields, layout, requires_grad)
        of_parts = (field for part in self.parts for field in part.fields)
        self.state_fields = (POSITIONS, VELOCITIES, *of_parts, *self.carried_fields)
        check_fields(self.state_fields, layout.known)
        self.fields = Fields.zeros(particles, precision, device, requires_grad)
        self._requires_grad = requires_grad
        self.fractions = self.new_fractions()
        if layout.phases == 1:
            self.fractions.fill_(1.0)
        self.accelerations = [self.vectors() for _ in range(len(self.forces) + 1)]
        """Partial sums of accelerations. Array t is the sum over the first t forces."""
        self.loops: tuple[Loop, ...] = ()
        self.step_number = wp.zeros(layout.members, dtype=wp.int32, device=device)
        self.containment = Containment(system.walled, layout, self.launch, system.waiting, search.moving)
        self._neighbourhood: Any = None
        self._context: StepContext | None = None
        self.generation = 0
        self.resize(search.capacity)

    def new_density(self) -> Density:
        return Density(self.discretisation, self.topic)

    def wall_push(self) -> WallAction:
        """Return the sums over walls that determine the pressure force on walls."""
        return WallSums(wall_slope_term(self.discretisation), self.layout)

    def image_loads(self) -> Any:
        """Return additional forces on mirroring walls, or None without mirroring walls."""
        return None

    def kick_of(self, carried: Carried) -> wp.array | None:
        """Return the velocity changes by the previous step's pressure in ``carried``, or None if not stored."""
        return None

    def vectors(self) -> wp.array:
        return self._array(self.discretisation.precision.vector)

    def numbers(self) -> wp.array:
        return self._array(self.discretisation.precision.real)

    def new_fractions(self) -> wp.array:
        return self._array(self.discretisation.precision.fractions(self.layout.phases))

    def _array(self, dtype: Any) -> wp.array:
        return wp.zeros(self.layout.all_particles, dtype=dtype, device=self.device, requires_grad=self._requires_grad)

    def resize(self, capacity: int) -> None:
        if capacity != self.search.capacity:
            self.search.allocate(capacity)
            self.generation += 1
        self._neighbourhood, self._context = _neighbourhood(self.system), None

    def new_state(self, requires_grad: bool = False) -> State:
        return self.layout.state(self.state_fields, requires_grad)

    def new_parameters(self, steps: int, requires_grad: bool = False) -> Parameters:
        return self.layout.parameters(steps, requires_grad)

    def new_log(self, steps: int) -> IterationLog:
        solves = [force.solve for force in self.forces if hasattr(force, "solve")]
        return IterationLog(steps, self.loops, solves, self.layout)

    def set_substeps(self, substeps: int) -> None:
        if substeps != self.substeps:
            for part in self.parts:
                part.set_substeps(substeps)
            self.substeps = substeps
            self.generation += 1

    @property
    def copies(self) -> tuple[HostCopy, ...]:
        return self.search.needed_copy, self.containment.bad_step_copy

    def make_room(self) -> bool:
        needed, capacity = self.search.needed, self.search.capacity
        if needed <= capacity:
            return False
        self.resize(min(needed + needed // 8 + 1, 2 * capacity))
        self.search.forget_needed()
        return True

    def match(self, other: Self) -> None:
        self.resize(other.search.capacity)
        self.set_substeps(other.substeps)

    def follow(self, other: Self) -> None:
        wp.copy(self.step_number, other.step_number)
        for own, given in zip(self.loops, other.loops, strict=True):
            wp.copy(own.rounds, given.rounds)

    def reserve(self, counts: Counts) -> None:
        """Do nothing, because a solver without iterations needs no further arrays."""

    def reset(self, step: int = 0) -> None:
        for loop in self.loops:
            loop.reset()
        self.step_number.fill_(step)
        self.containment.reset(step)

    # ---- what a step is made of ----------------------------------------------------------------------------------

    def context(self, parameters: Parameters) -> StepContext:
        if self._context is None or self._context.parameters is not parameters:
            order, step, particles = self.search.order, self.step_number, self.layout.particles
            own = self.launch, particles, self._neighbourhood, order, step, self.lattice.cell, self.fields
            self._context = StepContext(*own, self.fractions, parameters, self.free, self.kick_of(self.carried))
        return self._context

    def sort(self, state: State, parameters: Parameters) -> StepContext:
        """Begin a step: sort the particles, list their neighbours and compute densities."""
        context = self.context(parameters)
        for part in self.parts:
            part.begin(context, state)
        self.search.sort(state.positions)
        scene = {"x_scene": state.positions, "v_scene": state.velocities, "m_scene": state["reference_density"]}
        context.launch(self.integration.sort, **scene)
        self.carried.sort(context, state)
        for part in self.parts:
            part.sort(context, state)
        self.search.fill(self._neighbourhood, self.fields["x"], self.containment.bad_step)
        if self.system.sheets is not None:
            known = {"s": self._neighbourhood, "x": self.fields["x"]}
            self.system.sheets.hide(self.launch, self.discretisation, self.search, **known)
        self.density.measure(context)
        context.join()
        for part in self.parts:
            part.settle(context)
        return context

    def accelerate(self, context: StepContext) -> wp.array:
        """Return an array of shape (n,) with the sum of all explicit accelerations of sorted particles [m / s2]."""
        for t, force in enumerate(self.forces):
            force.accelerate(context, self.accelerations[t], self.accelerations[t + 1])
        return self.accelerations[-1]

    def unsort(self, context: StepContext, x: wp.array, v: wp.array, new_state: State, **carried: wp.array) -> None:
        """Write the new state from positions, velocities and ``carried`` fields of sorted particles."""
        free, ends = new_state, []
        for part in reversed(self.parts):
            ends.append((part, free))
            free = part.target(free)
        context.launch(self.integration.unsort, x=x, v=v, x_scene=free.positions, v_scene=free.velocities)
        self.carried.unsort(context, carried, new_state)
        for part, moved in reversed(ends):
            part.end(context, new_state, moved)

    def end_step(self, x: wp.array, v: wp.array, new_state: State, log: IterationLog) -> None:
        """Find lost particles, record the loops, and count the step. Particles are sorted."""
        f, containment = self.fields, self.containment
        before = {"order": self.search.order, "x_before": f["x"], "rho_0": f["rho_0"]}
        containment.look({**before, "x_free": x, "v_free": v}, new_state)
        kernels, each = convergence_kernels(self.discretisation.precision), {"threads": self.layout.members}
        for solve, record in log.solves:
            counts = {"count": solve.count, "iterations": record.arrays[0]}
            self.launch(kernels.note, counts, step=self.step_number, **each)
        for loop, record in log.loops:
            loop.note(record, containment, self.step_number, is_last=loop is self.loops[-1])
        if not self.loops:
            bad = {"bad": containment.bad_particle, "bad_step": containment.bad_step}
            self.launch(kernels.count_step, bad, step=self.step_number, **each)

    def densities(self, state: State, parameters: Parameters, step: int = 0) -> NDArray:
        """Return an array of shape (n,) with densities [kg / m3] in scene order, for a batch one scene after the other.
        Moving solids are at their poses at the end of step ``step``. Arrays of the solver are overwritten."""
        self.reset(step)
        self.sort(state, parameters)
        while self.make_room():
            self.sort(state, parameters)
        found = np.empty(self.layout.all_particles)
        found[self.search.order.numpy()[: len(found)]] = self.fields["m"].numpy() * self.fields["n"].numpy()
        return found

    def pressures(self) -> wp.array | None:
        """Return an array (n,) with sorted particles' pressures on walls [Pa], or None without pressure."""
        return None

    def stresses(self) -> wp.array | None:
        """Return an array of shape (n,) with sorted particles' pressures for pressure sensors [Pa]."""
        return self.pressures()

    # ---- derivatives ---------------------------------------------------------------------------------------------

    def tangent(self, parameters_dot: Parameters) -> StepTangent:
        self._lacks("forward mode", "take differences of `Problem.value`")

    def adjoint(self, steps: int) -> StepAdjoint:
        self._lacks("reverse mode", "try gradients.Tape, or gradients.RandomizedSmoothing, which only runs forward")

    def differentiable(self) -> Self:
        self._lacks("tape", "try gradients.RandomizedSmoothing, which only runs forward")

    def _lacks(self, what: str, advice: str) -> NoReturn:
        raise MissingDerivativeError(f"{self.system.called} has no {what}: {advice}, or another solver.")

    def gradient_memory(self, log: IterationLog) -> dict[str, float]:
        iterations = sum(int(record.counts.max(initial=0)) for _, record in log.loops)
        return gradient_parts(self.layout.all_particles, iterations, self.discretisation.precision.bytes)


def _neighbourhood(system: ParticleSystem) -> Any:
    search, lattice, precision, periods = system.search, system.lattice, system.layout.precision, system.walled.periods
    s = neighbourhood_type(precision)()
    s.particles = system.layout.particles
    s.neighbours, s.fluid_count = search.neighbours, search.fluid_count
    s.filling, s.count, s.all_count = search.filling, search.count, search.all_count
    for name, array in search.walls.items():
        setattr(s, name, array)
    s.support, s.per_support, s.reach = lattice.support, 1.0 / lattice.support, (1.0 + SKIN) * lattice.support
    s.normalisation = lattice.normalisation
    s.self_weight, s.volume, s.response_scale = lattice.self_weight, lattice.volume, lattice.response**-0.5
    s.laplacian_correction = lattice.laplacian_correction
    s.mirror_lower, s.mirror_upper = (precision.vector(*ends) for ends in system.mirrors)
    faces, kinds = system.faces, {"places": precision.vector, "frames": precision.matrix, "sizes": precision.vector}
    s.faces = len(faces.solids)
    for name, kind in {"solids": wp.int32, **kinds}.items():
        setattr(s, f"face_{name}", wp.array(getattr(faces, name), dtype=kind, device=system.layout.device))
    for name, array in {} if search.moving is None else search.moving.named.items():
        setattr(s, name, array)
    s.period = precision.vector_of(periods)
    s.frequency = precision.vector_of([1.0 / length if length else 0.0 for length in periods])
    for name, entry in s._cls.vars.items():
        if isinstance(entry.type, wp.array) and getattr(s, name) is None:  # a tape looks at each
            none = wp.empty((0,) * entry.type.ndim, dtype=entry.type.dtype, device=system.layout.device)
            setattr(s, name, none)
    return s
