"""The parts of a step, such as forces, the mixture and the nozzle: their arguments, and the order in which a step calls
them.

A part reads the sorted particles and the parameters, and adds to adjoints. It never overwrites its arguments.

Besides accelerating particles a part may keep fields from step to step, and work at the beginning and at the end of a
step. The mixture, the emitter, and forces with state are parts; a solver only has a list of parts.

For each method below a step calls all parts in their order; reverse mode calls them in the reverse order. A part may
omit any method. In `begin` kernels can read the parameters and the number of the step, in `sort` also the order of
particles and x, v and m. From `settle` on neighbours and n exist as well, and in `end` all arrays of the step.

A derivative replays a step from its state, without calling `end`. So `begin`, `sort` or `settle` must store all values
that the tangent or the adjoint needs.

A solver too carries fields of particles from step to step, such as the pressure that the next step begins with. A state
stores particles in the scene's order, and a step works on sorted particles. The adjoint of sorting is unsorting.

At the end of this module are the kernels of time integration (semi-implicit Euler) and of sorting, with derivatives.
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
    and ``cell``, the volume of a particle [m^d]. ``particles`` is the number of particles of one scene: in a batch
    particle i belongs to scene i // particles."""

    launcher: KernelLauncher
    particles: int
    neighbourhood: Any
    order: wp.array
    step: wp.array
    cell: float
    fields: Fields
    fractions: wp.array
    """Mass fractions of the sorted particles after the step's diffusion; the rest of the step uses them."""
    parameters: Parameters
    bodies: Sequence[Any] = ()
    """The free bodies of the solver, each a `cortado.sph.free_solids.FreeBody`."""
    kick: wp.array | None = None
    """(n,) vectors: the velocity change of sorted particles by pressure in the previous step [m/s]; None if the solver
    does not carry it."""

    @cached_property
    def _known(self) -> tuple[Named, ...]:
        own = {"s": self.neighbourhood, "particles": self.particles, "order": self.order, "step": self.step}
        return {**own, "cell": self.cell, "fractions": self.fractions}, self.fields.named(), self.parameters.named()

    def launch(self, kernel: wp.Kernel, *groups: Named, threads: int | None = None, **arguments: Any) -> None:
        """Launch a kernel over the particles; arguments missing from ``arguments`` and ``groups`` are taken from the
        step by name.

        A kernel that takes ``s`` takes it first and works on particle ``s.first + wp.tid()``, because its launch may be
        split into ranges of particles. ``threads`` is for kernels without ``s``.
        """
        self.launcher(kernel, *groups, *self._known, threads=threads, **arguments)

    def aside(self) -> AbstractContextManager[None]:
        """Let the launches inside run concurrently with later launches until `join`; the two groups must be
        independent."""
        return self.launcher.aside()

    def join(self) -> None:
        """Let later launches wait for all launches made `aside`; every step ends with this call."""
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
        """Return the tangents under the names of kernel arguments: ``x_dot``, ``viscosity_dot`` and so on."""
        return self.fields.named("_dot"), {"fractions_dot": self.fractions}, self.parameters.named("_dot")


class Shares(Arrays):
    """Adjoints of parameters to which every particle adds a share, stored per particle until they are summed. They are
    (n,) numbers or vectors; for a parameter of phases each entry has one number for each phase."""

    def __init__(self, names: Iterable[str], layout: Layout):
        """Allocate shares of the parameters of these names, all 0; raise `TypeError` for one that cannot be shared."""
        precision, self.known = layout.precision, layout.known
        """The parameters of the simulation, some of which are shared."""
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
    """The adjoints to which parts of a step add: those of sorted particles and of parameters, and each particle's
    shares of the latter."""

    fields: Fields
    fractions: wp.array
    """Forces add to this adjoint of `StepContext.fractions`; the mixture then turns it into that of the old fractions
    and sets it to 0."""
    parameters: Parameters
    shares: Shares
    solids: SolidShares
    """Adjoints of the poses of solids that move."""
    bodies: Sequence[Any] = ()
    """Adjoints of free bodies in the step, each a `cortado.sph.free_solids.Changes`."""
    kick: wp.array | None = None

    @cached_property
    def named(self) -> tuple[Named, ...]:
        """Return adjoints under the names of kernel arguments, such as ``x_bar``. Parameters over time have sums,
        (members, steps); parameters in a part's ``shares`` have the particles' shares."""
        over_time = [name for name in self.parameters.names if self.shares.known[name].axis is Axis.STEP]
        whole = {f"{argument(name)}_bar": self.parameters[name] for name in over_time}
        fractions = {"fractions_bar": self.fractions}
        return self.fields.named("_bar"), fractions, self.shares.named("_bar"), whole


@dataclass(frozen=True)
class Setting:
    """The arguments from which a force is made. A module named in the registry of parameters has a function
    ``force(setting)``, which makes its force, or returns None where none acts."""

    scene: Scene
    discretisation: Discretisation
    lattice: Lattice
    walls: WallLayers
    layout: Layout


class Force(Protocol):
    """An explicit force. A step adds up the accelerations [m / s2] of its forces, one after the other. ``batches =
    True`` declares that the force runs in batches: its kernels read, for particle i, the parameters of scene i //
    particles."""

    shares: tuple[str, ...]
    """Parameters, numbers or per phase, to whose adjoints every particle adds a share. An adjoint kernel gets these
    adjoints with an entry for each particle, (n,), those of parameters over time as sums, (members, steps), and no
    others."""

    def accelerate(self, step: StepContext, before: wp.array, after: wp.array) -> None:
        """Write ``after`` = ``before`` + this force's acceleration, both (n,) vectors."""

    def tangent(self, step: StepContext, dot: Tangents, before: wp.array, after: wp.array) -> None:
        """Write ``after`` = ``before`` + the tangent of this force's acceleration along ``dot``, both (n,) vectors."""

    def adjoint(self, step: StepContext, acceleration_bar: wp.array, bar: Adjoints) -> wp.array | None:
        """Add to the adjoints ``bar`` of the force's inputs, given the adjoint of the acceleration, (n,) vectors. A
        force whose acceleration depends on ``before`` has ``is_last = True``, comes after all others, and returns the
        adjoint of ``before``. A force that solves a system of equations has the solver as its attribute ``solve``, see
        `cortado.solvers.loop`. A force by which walls act on fluid has this action, a `cortado.sph.density.WallAction`,
        as ``wall_action``; without it loads on solids lack this force. If walls act at x_i - y instead of at the
        particle, ``wall_couple`` is a second `WallAction`: the sum of y x a."""


class PartTangent:
    """The tangent of a part of a step, for forward mode."""

    def begin(self, step: StepContext, dot: Tangents, state_dot: State) -> None:
        """Apply the tangent of `Part.begin` to the state's tangent before the step; ``dot`` has the parameters'
        tangents."""

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
        into the adjoint before the part, return that, and add to ``bar``. Sorted particles have no adjoints yet."""
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
    """Parameters to whose adjoints every particle adds a share; see `Force.shares`."""

    def set_substeps(self, substeps: int) -> None:
        """Take ``substeps`` explicit substeps of diffusion in each step from now on."""

    def begin(self, step: StepContext, state: State) -> None:
        """Begin a step, before anything else, from its first state, which must not change. Copy the arrays of this
        state that `end` needs: the state at the end of the step may be in the same arrays."""

    def sort(self, step: StepContext, state: State) -> None:
        """Take part in the step once the order of the sorted particles is known."""

    def settle(self, step: StepContext) -> None:
        """Take part in the step once neighbours and densities are known."""

    def target(self, moved: State) -> State:
        """Return the state from which the part's `end` reads positions and velocities, given the state to which it
        writes them. A part that changes any returns a state of its own, because nothing is changed in place."""
        return moved

    def end(self, step: StepContext, state: State, moved: State) -> None:
        """Write the part's fields of ``state``, the state at the end of the step. If the part has a `target` of its
        own, read positions and velocities from the target and write them all to ``moved``."""

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
    """Fields of sorted particles that a solver carries from step to step, such as a pressure; or the tangents or
    adjoints of such fields."""

    def __init__(self, fields: Iterable[StateField], layout: Layout, requires_grad: bool = False):
        """Allocate the fields' arrays; raise `TypeError` for a field without an entry for each particle."""
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
    """Return the Warp module of kernels without a smoothing kernel; ``taped`` forward kernels get Warp's own adjoint.
    Kernels that only some scenes need have a ``topic`` of their own, because Warp recompiles a whole module if its
    kernels differ."""
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
