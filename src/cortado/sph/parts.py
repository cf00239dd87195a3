"""The parts of a step, such as forces, the mixture and the nozzle: what they are given, and when they act.

A part reads the sorted particles and the parameters, and adds to adjoints: nothing that it is given is overwritten.

Besides accelerating particles a part may keep fields from step to step, and work at the beginning and at the end of a
step. The mixture, the emitter, and forces that remember are parts; a solver knows only their list.

A step goes through its parts in their order at each of the times below, forward and in forward mode, and in the reverse
order in reverse mode. A method that a part has not does nothing. Kernels find at the `begin` of a part the parameters
and the number of the step, and at `sort` also the order of particles and x, v and m. From `settle` on they find
neighbours and n as well, and at `end` everything that a step knows.

A derivative takes a step again from its state, but not its end. So what a tangent or an adjoint needs of a step has to
stand in arrays that `begin`, `sort` or `settle` write.

A solver too carries fields of particles from step to step, such as the pressure that the next step begins with. A state
has them in the scene's order of particles, a step works on sorted ones. The adjoint of sorting is the way back.

Last come the kernels of the integration in time, semi-implicit Euler, and of sorting, with derivatives.
"""

from collections.abc import Iterable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import cache, cached_property
from types import SimpleNamespace
from typing import Any, Protocol

import warp as wp

from cortado.device.launching import KernelLauncher, Named
from cortado.device.modules import by_name, kernel_module, kind_of
from cortado.device.precision import Precision, TypesByName
from cortado.device.reduction import add, type_name
from cortado.discretise.walls import WallLayers
from cortado.errors import MissingDerivativeError
from cortado.particles.neighbourhood import Discretisation
from cortado.particles.particle_kernels import particle_kernel
from cortado.particles.state import Arrays, Fields, Layout, Parameters, State, StateField, zeros
from cortado.particles.wall_terms import SolidShares
from cortado.scene.discrete_scene import Lattice
from cortado.scene.parameter_values import argument
from cortado.scene.parameters import Axis
from cortado.scene.scene import Scene


@dataclass(frozen=True)
class StepContext:
    """A step as its parts see it. Kernels find in it, by name, the fields of the particles, the parameters, ``s`` (what
    lies around each particle) and ``order`` (sorted -> scene). They find ``step`` (members,), the number of the step,
    and ``cell``, the volume of a particle [m^d]. A scene has so many ``particles``: particle i belongs to scene i //
    particles of a batch."""

    launcher: KernelLauncher
    particles: int
    neighbourhood: Any
    order: wp.array
    step: wp.array
    cell: float
    fields: Fields
    fractions: wp.array
    """Mass fractions of the sorted particles, of which the rest of the step is made: after its diffusion."""
    parameters: Parameters
    bodies: Sequence[Any] = ()
    """The free bodies of the solver, each a `cortado.sph.free_solids.FreeBody`."""
    kick: wp.array | None = None
    """(n,) vectors: what pressure added to velocities of sorted particles in the step before [m/s]; None of a solver
    whose steps do not begin with it."""

    @cached_property
    def _known(self) -> tuple[Named, ...]:
        own = {"s": self.neighbourhood, "particles": self.particles, "order": self.order, "step": self.step}
        return {**own, "cell": self.cell, "fractions": self.fractions}, self.fields.named(), self.parameters.named()

    def launch(self, kernel: wp.Kernel, *groups: Named, threads: int | None = None, **arguments: Any) -> None:
        """Launch a kernel over the particles; what is not among ``arguments`` and ``groups`` is the step's.

        A kernel that takes ``s`` takes it first and works on particle ``s.first + wp.tid()``, as its launch may be cut
        into ranges of particles; ``threads`` is for kernels without it.
        """
        self.launcher(kernel, *groups, *self._known, threads=threads, **arguments)

    def aside(self) -> AbstractContextManager[None]:
        """Let launches within run beside those that come after, until `join`: neither needs anything of the other."""
        return self.launcher.aside()

    def join(self) -> None:
        """Let later launches wait for all that went `aside`; a step ends with it."""
        self.launcher.join()


@dataclass(frozen=True)
class Tangents:
    """Tangents of the sorted particles and of the parameters."""

    fields: Fields
    fractions: wp.array
    parameters: Parameters
    bodies: Sequence[Any] = ()
    """Tangents of free bodies in the step, each a `cortado.sph.free_solids.Changes`."""
    kick: wp.array | None = None

    @cached_property
    def named(self) -> tuple[Named, ...]:
        """Return the tangents as kernels call them: ``x_dot``, ``viscosity_dot`` and so on."""
        return self.fields.named("_dot"), {"fractions_dot": self.fractions}, self.parameters.named("_dot")


class Shares(Arrays):
    """The adjoints of parameters in which every particle has a share, kept particle by particle until they are added
    up: (n,) numbers or vectors, of a parameter of phases (n,) of one for each phase."""

    def __init__(self, names: Iterable[str], layout: Layout):
        """Allocate shares of the parameters of these names, all 0; raise `TypeError` for one that cannot be shared."""
        precision, self.known = layout.precision, layout.known
        """Of which parameters some are shared."""
        of_phases = precision.fractions(layout.phases)
        dtypes = {Axis.SCALAR: (precision.real, precision.vector), Axis.PHASE: (of_phases, of_phases)}
        used = [self.known[name] for name in self.known.run]
        known = {p.name: dtypes[p.axis][p.rank] for p in used if p.axis in dtypes}
        kinds = {}
        for name in names:
            if name not in known:
                raise TypeError(f"shares has {name!r}, but must be a tuple of some of {', '.join(known)}.")
            kinds[name] = (layout.all_particles, known[name])
        super().__init__(zeros(kinds, layout.device))
        self._sums = {name: layout.sum_of(dtype) for name, (_, dtype) in kinds.items()}

    def collect(self, bar: Parameters) -> None:
        """Add the particles' shares up into the parameters' adjoints ``bar``, and set them to 0."""
        for name, total in self._sums.items():
            add(total(self[name]).view(bar[name].dtype).flatten(), bar[name].flatten())
        self.clear()


@dataclass(frozen=True)
class Adjoints:
    """The adjoints that parts of a step add to: of sorted particles, of parameters, and particles' shares of these."""

    fields: Fields
    fractions: wp.array
    """The mixture adds what forces have added to the adjoint of the new fractions, and sets it to 0."""
    parameters: Parameters
    shares: Shares
    solids: SolidShares
    """Adjoints of the poses of solids that move."""
    bodies: Sequence[Any] = ()
    """Adjoints of free bodies in the step, each a `cortado.sph.free_solids.Changes`."""
    kick: wp.array | None = None

    @cached_property
    def named(self) -> tuple[Named, ...]:
        """Return adjoints as kernels call them: ``x_bar`` and so on; sums, (members, steps), of parameters over time;
        and particles' shares of the parameters that a part names in its ``shares``."""
        over_time = [name for name in self.parameters.names if self.shares.known[name].axis is Axis.STEP]
        whole = {f"{argument(name)}_bar": self.parameters[name] for name in over_time}
        fractions = {"fractions_bar": self.fractions}
        return self.fields.named("_bar"), fractions, self.shares.named("_bar"), whole


@dataclass(frozen=True)
class Setting:
    """The arguments from which a force is made. A module that the registry of parameters names has a
    ``force(setting)``, which makes it, or returns None where nothing acts."""

    scene: Scene
    discretisation: Discretisation
    lattice: Lattice
    walls: WallLayers
    layout: Layout


class Force(Protocol):
    """An explicit force. A step adds up the accelerations [m / s2] of its forces, one after the other. One that says
    ``batches = True`` runs in batches: its kernels read the parameters of scene i // particles for particle i."""

    shares: tuple[str, ...]
    """Parameters, numbers or those of phases, to whose adjoints every particle adds a share: an adjoint kernel sees
    these adjoints with an entry for each particle, (n,), those of parameters over time as sums, (members, steps), and
    no others."""

    def accelerate(self, step: StepContext, before: wp.array, after: wp.array) -> None:
        """Write ``after`` = ``before`` + this force's acceleration, both (n,) vectors."""

    def tangent(self, step: StepContext, dot: Tangents, before: wp.array, after: wp.array) -> None:
        """Write ``after`` = ``before`` + the tangent of this force's acceleration along ``dot``, both (n,) vectors."""

    def adjoint(self, step: StepContext, acceleration_bar: wp.array, bar: Adjoints) -> wp.array | None:
        """Add to the adjoints ``bar`` of the force's inputs, given that of the acceleration, (n,) vectors. A force
        whose own acceleration depends on ``before`` returns the adjoint of that; it says ``is_last = True``, and comes
        after all others. One that solves a system of equations has what does so as ``solve``: see
        `cortado.solvers.loop`. One with which walls act on fluid has what they do, a `cortado.sph.density.WallAction`,
        as ``wall_action``, or loads on solids lack it. Where that does not act at the particle, ``wall_couple`` is
        another one, of the sum of y x a, with which a acts at x_i - y."""


class PartTangent:
    """The tangent of a part of a step, for forward mode."""

    def begin(self, step: StepContext, dot: Tangents, state_dot: State) -> None:
        """Apply the tangent of `Part.begin` to the state's tangent before the step; ``dot`` has the parameters'."""

    def sort(self, step: StepContext, dot: Tangents, state_dot: State) -> None:
        """Apply the tangents of `Part.sort` and `Part.settle`, given the tangent ``state_dot`` of the state before the
        step; ``dot`` has those of the sorted particles."""

    def end(self, step: StepContext, dot: Tangents, state_dot: State) -> None:
        """Apply the tangent of `Part.end`: ``state_dot`` has the tangents of positions and velocities at the end of the
        step, and becomes the tangent of the whole state there."""


class PartAdjoint:
    """The adjoint of a part of a step, for reverse mode."""

    def end(self, step: StepContext, bar: Parameters, state_bar: State, moved_bar: State) -> State:
        """Apply the adjoint of a part with a `Part.target`: turn the adjoint of positions and velocities after the part
        into the adjoint before it, which is returned. It adds to ``bar``; sorted particles have no adjoints yet."""
        return moved_bar

    def sort(self, step: StepContext, bar: Adjoints, state_bar: State) -> None:
        """Apply the adjoints of `Part.settle` and `Part.sort`, and of the sorted particles in `Part.end`. ``state_bar``
        has the adjoint of the part's fields after the step, which is replaced by the adjoint before it."""

    def begin(self, step: StepContext, bar: Adjoints, state_bar: State) -> None:
        """Apply the adjoint of `Part.begin`, after all others; a part without fields changed there needs none."""


class Part:
    """A part of a step, in one solver. A `Force` may be one too."""

    fields: tuple[StateField, ...] = ()
    """Fields that the part keeps from step to step, as arrays of the state."""
    shares: tuple[str, ...] = ()
    """Parameters to whose adjoints every particle adds a share, as those of a `Force`."""

    def set_substeps(self, substeps: int) -> None:
        """Take ``substeps`` explicit substeps of diffusion in each step from now on."""

    def begin(self, step: StepContext, state: State) -> None:
        """Begin a step, before anything else, with its first state, which stays as it is. The part keeps what `end`
        needs of this state, as the state at the end of the step may have the same arrays."""

    def sort(self, step: StepContext, state: State) -> None:
        """Take part in the step once the order of the sorted particles is known."""

    def settle(self, step: StepContext) -> None:
        """Take part in the step once neighbours and densities are known."""

    def target(self, moved: State) -> State:
        """Return the state in which the part finds positions and velocities at its `end`, given the one to which it
        writes them. A part that changes some has room of its own, as nothing is changed in place."""
        return moved

    def end(self, step: StepContext, state: State, moved: State) -> None:
        """Write the part's fields of ``state``, that at the end of the step. If it has a `target` of its own, write all
        positions and velocities of ``moved`` from those that it finds in its target."""

    def new_tangent(self) -> PartTangent:
        """Make the tangent of the part, with arrays of its own; raise `MissingDerivativeError` if it has none."""
        raise MissingDerivativeError(f"{type(self).__name__} has no forward mode: let it have a method new_tangent.")

    def new_adjoint(self) -> PartAdjoint:
        """Make the adjoint of the part, with arrays of its own; raise `MissingDerivativeError` if it has none."""
        raise MissingDerivativeError(f"{type(self).__name__} has no reverse mode: let it have a method new_adjoint.")


class PartMaker(Protocol):
    """A maker of a part of a step, for each solver."""

    def part(self, layout: Layout, requires_grad: bool) -> Part:
        """Make the part; with ``requires_grad`` its arrays have gradients, for Warp's tape."""


class Carried:
    """A set of fields that a solver carries from step to step, such as a pressure, for sorted particles; or their
    tangents or adjoints."""

    def __init__(self, fields: Iterable[StateField], layout: Layout, requires_grad: bool = False):
        """Allocate the fields' arrays; raise `TypeError` for a field that has not an entry for each particle."""
        fields = tuple(fields)
        for field in fields:
            if field.axis is not Axis.PARTICLE:
                raise TypeError(
                    f"field {field.name!r} has one entry, but must have one for each particle to be sorted."
                )
        self._arrays = layout.state(fields, requires_grad)

    def __getitem__(self, name: str) -> wp.array:
        """Return a field's array (n,) in sorted order, as it was at the start of the step."""
        return self._arrays[name]

    def sort(self, step: StepContext, state: State) -> None:
        """Read the fields from a state and sort them."""
        for name in self._arrays.names:
            a = self._arrays[name]
            step.launch(_kernels(a).sort, a_scene=state[name], a=a)

    def unsort(self, step: StepContext, values: Mapping[str, wp.array], state: State) -> None:
        """Write sorted values, one array for each field, to a state."""
        if values.keys() != set(self._arrays.names):
            raise TypeError(f"the step carries {', '.join(self._arrays.names)}, but was given {', '.join(values)}.")
        for name, a in values.items():
            unsort(step, a, state[name])


def sort(step: StepContext, a_scene: wp.array, a: wp.array) -> None:
    """Write the entries (n,) of an array in the scene's order to sorted particles."""
    step.launch(_kernels(a).sort, a_scene=a_scene, a=a)


def unsort(step: StepContext, a: wp.array, a_scene: wp.array) -> None:
    """Write the entries (n,) of sorted particles to an array in the scene's order."""
    step.launch(_kernels(a).unsort, a=a, a_scene=a_scene)


def _kernels(a: wp.array) -> Any:
    module = kernel_module(f"order_{kind_of(True, a.requires_grad)}_{type_name(a.dtype)}", a.requires_grad)
    return order_kernels(a.dtype, module)


@cache
def order_kernels(dtype: Any, module: Any) -> SimpleNamespace:
    """Make the kernels that ``sort`` an array of entries of a Warp type from the scene's order, and ``unsort`` it."""
    typed = TypesByName(dtype, {wp.int32: "order"})

    @wp.kernel(module=module)
    @typed.arrays
    def sort(order, a_scene, a):
        i = wp.tid()
        a[i] = a_scene[order[i]]

    @wp.kernel(module=module)
    @typed.arrays
    def unsort(order, a, a_scene):
        i = wp.tid()
        a_scene[order[i]] = a[i]

    return by_name(sort, unsort)


def integration_module(precision: Precision, forward: bool, taped: bool = False, topic: str = "integration") -> Any:
    """Return the Warp module of kernels without a smoothing kernel; ``taped`` forward ones get Warp's own adjoint. What
    only some scenes need has a ``topic`` of its own: a module with other kernels than before is compiled anew."""
    return kernel_module(f"{topic}_{kind_of(forward, taped)}_{precision.name}", forward and taped)


@cache
def prediction_share(precision: Precision) -> Any:
    """Make the Warp function of the time step's adjoint by a prediction v* = v + dt a, x* = x + dt v*."""
    real, vector = precision.real, precision.vector

    @wp.func
    def adjoint(x_star_bar: vector, speed_bar: vector, v: vector, v_star: vector, dt: real) -> real:
        return wp.dot(x_star_bar, v_star) + wp.dot(speed_bar, v_star - v) / dt

    return adjoint


@cache
def new_state_adjoint(precision: Precision) -> Any:
    """Make the Warp function from the adjoints of x' = x + dt v' and of v' to those of x and of the last prediction of
    v'. It adds to the adjoint of the time step, too."""
    real, vector = precision.real, precision.vector
    adjoin_prediction = prediction_share(precision)

    @wp.func
    def adjoint(x_new_bar: vector, v_new_bar: vector, dt_bar: real, v: vector, v_star: vector, dt: real):
        speed_bar = v_new_bar + dt * x_new_bar
        return x_new_bar, speed_bar, dt_bar + adjoin_prediction(x_new_bar, speed_bar, v, v_star, dt)

    return adjoint


@cache
def integration_kernels(precision: Precision, taped: bool) -> SimpleNamespace:
    """Make kernels that ``sort`` and ``unsort`` a state and ``predict`` without pressure, with derivatives; a tape can
    differentiate ``taped`` ones."""
    real, vector = precision.real, precision.vector
    typed = TypesByName(real, {wp.int32: "order", vector: "x v acceleration"})

    @wp.kernel(module=integration_module(precision, True, taped))
    @typed.arrays
    def sort(order, x_scene, v_scene, m_scene, x, v, m):
        i = wp.tid()
        x[i] = x_scene[order[i]]
        v[i] = v_scene[order[i]]
        m[i] = m_scene[order[i]]

    @wp.kernel(module=integration_module(precision, True, taped))
    @typed.arrays
    def unsort(order, x, v, x_scene, v_scene):
        i = wp.tid()
        x_scene[order[i]] = x[i]
        v_scene[order[i]] = v[i]

    @particle_kernel(integration_module(precision, True, taped), "x_star v_star")
    def predict(time_step: real, x_i: vector, v_i: vector, acceleration_i: vector) -> tuple[vector, vector]:
        velocity = v_i + time_step * acceleration_i
        return x_i + time_step * velocity, velocity

    @particle_kernel(integration_module(precision, False), "x_star_dot v_star_dot")
    @typed
    def predict_tangent(
        time_step, time_step_dot, x_dot_i, v_dot_i, acceleration_i, acceleration_dot_i, v_star_i
    ) -> tuple[vector, vector]:
        velocity_dot = v_dot_i + time_step * acceleration_dot_i + time_step_dot * acceleration_i
        return x_dot_i + time_step * velocity_dot + time_step_dot * v_star_i, velocity_dot

    @particle_kernel(integration_module(precision, False), "acceleration_bar")
    def acceleration_adjoint(time_step: real, v_bar_i: vector) -> vector:
        """Return the adjoint of the acceleration, dt times that of v, as all predictions of a step used v + dt a."""
        return time_step * v_bar_i

    @wp.kernel(module=integration_module(precision, False), enable_backward=False)
    @typed.arrays
    def collect_masses(order, m_bar, m_scene_bar):
        i = wp.tid()
        m_scene_bar[order[i]] = m_scene_bar[order[i]] + m_bar[i]

    begin_adjoint = begin_adjoint_kernel(precision)
    return by_name(sort, unsort, predict, predict_tangent, acceleration_adjoint, collect_masses, begin_adjoint)


@cache
def begin_adjoint_kernel(precision: Precision) -> Any:
    """Make the kernel that turns the adjoint of the new state, in scene order, into the prediction's."""
    real, vector = precision.real, precision.vector
    adjoin_new_state = new_state_adjoint(precision)
    vectors = wp.array(dtype=vector)
    typed = TypesByName(real, {wp.int32: "order", vector: "v", vectors: "x_scene v_scene"})

    @particle_kernel(integration_module(precision, False), "x_bar v_bar n_bar m_bar rho_0_bar mu_bar time_step_bar")
    @typed
    def begin_adjoint(
        order_i, time_step, v_i, v_star_i, x_scene_bar, v_scene_bar, time_step_bar_i
    ) -> tuple[vector, vector, real, real, real, real, real]:
        x_bar, v_bar, dt_bar = adjoin_new_state(
            x_scene_bar[order_i], v_scene_bar[order_i], time_step_bar_i, v_i, v_star_i, time_step
        )
        no = real(0.0)
        return x_bar, v_bar, no, no, no, no, dt_bar

    return begin_adjoint
