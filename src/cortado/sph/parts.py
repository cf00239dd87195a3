"""The parts of a step, such as forces, the mixture and emitters, and the order of their methods.

A part reads the sorted particles and the parameters, and must not overwrite them. A part can accelerate particles, keep
fields from step to step, and act at the beginning and end of a step. A part may omit any method.

A step calls each method for all parts in turn, and reverse mode uses the reverse order. In `begin`, kernels can read
the parameters and the number of the step. From `sort` on, kernels can also read positions, velocities and masses. From
`settle` on, kernels can also read neighbours and densities. In `end`, kernels can read all arrays of the step.
Derivatives repeat a step without `end`, so the earlier methods must store all values that tangent or adjoint need.

A state stores particles in the order of the scene, and a step works on sorted particles. At the end of this module are
the kernels of time integration (semi-implicit Euler) and of sorting, with derivatives.
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
    """The current step, with all arrays that its parts may read.

    Kernels find arguments in the context by name: the fields of the particles and the parameters. Kernels also find the
    neighbourhood ``s``, the ``order`` of particles, the number ``step`` (members,) of the step, and the volume ``cell``
    of a particle [m^d]. In a batch particle i belongs to scene i // ``particles``.
    """

    launcher: KernelLauncher
    particles: int
    neighbourhood: Any
    order: wp.array
    step: wp.array
    cell: float
    fields: Fields
    fractions: wp.array
    parameters: Parameters
    bodies: Sequence[Any] = ()
    kick: wp.array | None = None
    """Array of shape (n,) with sorted particles' velocity changes by the previous step's pressure [m/s], or None."""

    @cached_property
    def _known(self) -> tuple[Named, ...]:
        own = {"s": self.neighbourhood, "particles": self.particles, "order": self.order, "step": self.step}
        return {**own, "cell": self.cell, "fractions": self.fractions}, self.fields.named(), self.parameters.named()

    def launch(self, kernel: wp.Kernel, *groups: Named, threads: int | None = None, **arguments: Any) -> None:
        """Launch a kernel over the particles. The context provides all arguments that are missing in ``arguments`` and
        ``groups``.

        If a kernel has the argument ``s``, ``s`` is its first argument. The kernel works on particle ``s.first +
        wp.tid()``, because a launch may be split into ranges of particles. ``threads`` is for kernels without ``s``.
        """
        self.launcher(kernel, *groups, *self._known, threads=threads, **arguments)

    def aside(self) -> AbstractContextManager[None]:
        """Let the launches inside this context manager run concurrently with later launches, until `join` is called.
        The launches inside the context manager must not depend on each other."""
        return self.launcher.aside()

    def join(self) -> None:
        """Let later launches wait for all launches made in `aside`. Every step must end with `join`."""
        self.launcher.join()


@dataclass(frozen=True)
class Tangents:
    fields: Fields
    fractions: wp.array
    parameters: Parameters
    bodies: Sequence[Any] = ()
    kick: wp.array | None = None

    @cached_property
    def named(self) -> tuple[Named, ...]:
        """Return the tangents by kernel argument name, such as ``x_dot`` and ``viscosity_dot``."""
        return self.fields.named("_dot"), {"fractions_dot": self.fractions}, self.parameters.named("_dot")


class Shares(Arrays):
    """Arrays of shape (n,) with the particles' terms in the adjoints of parameters, before summation."""

    def __init__(self, names: Iterable[str], layout: Layout):
        """Raise `TypeError` for a parameter whose adjoint has no terms of particles."""
        precision, self.known, kinds = layout.precision, layout.known, {}
        of_phases = precision.fractions(layout.phases)
        dtypes = {Axis.SCALAR: (precision.real, precision.vector), Axis.PHASE: (of_phases, of_phases)}
        used = [self.known[name] for name in self.known.run]
        known = {p.name: dtypes[p.axis][p.rank] for p in used if p.axis in dtypes}
        for name in names:
            if name not in known:
                raise TypeError(f"shares has {name!r}, but must be a tuple of names among {', '.join(known)}.")
            kinds[name] = (layout.all_particles, known[name])
        super().__init__(zeros(kinds, layout.device))
        self._sums = {name: layout.sum_of(dtype) for name, (_, dtype) in kinds.items()}

    def collect(self, bar: Parameters) -> None:
        for name, total in self._sums.items():
            add(total(self[name]).view(bar[name].dtype).flatten(), bar[name].flatten())
        self.clear()


@dataclass(frozen=True)
class Adjoints:
    fields: Fields
    fractions: wp.array
    """Adjoint of the mass fractions after diffusion, `StepContext.fractions`."""
    parameters: Parameters
    shares: Shares
    solids: SolidShares
    bodies: Sequence[Any] = ()
    kick: wp.array | None = None

    @cached_property
    def named(self) -> tuple[Named, ...]:
        """Return the adjoints by kernel argument name, such as ``x_bar``. Adjoints of parameters over time are sums
        (members, steps) over particles. Adjoints of parameters in ``shares`` are terms of particles (n,), which are
        summed later."""
        over_time = [name for name in self.parameters.names if self.shares.known[name].axis is Axis.STEP]
        whole = {f"{argument(name)}_bar": self.parameters[name] for name in over_time}
        return self.fields.named("_bar"), {"fractions_bar": self.fractions}, self.shares.named("_bar"), whole


@dataclass(frozen=True)
class Setting:
    """The arguments for making a force. A force's module has a function ``force(setting)``, which may return None."""

    scene: Scene
    discretisation: Discretisation
    lattice: Lattice
    walls: WallLayers
    layout: Layout


class Force(Protocol):
    """Protocol of an explicit force. A step adds up the accelerations [m / s2] of all forces.

    ``batches = True`` declares that the force supports batches. The kernels then read, for particle i, the parameters
    of scene i // particles.
    """

    shares: tuple[str, ...]
    """Names of parameters whose adjoints are sums over particles. Adjoint kernels write a term for each particle (n,).
    Adjoints of parameters over time are sums (members, steps) instead."""

    def accelerate(self, step: StepContext, before: wp.array, after: wp.array) -> None:
        """Write the sum of ``before`` and the force's acceleration to ``after``. The arrays have (n,) vectors."""

    def tangent(self, step: StepContext, dot: Tangents, before: wp.array, after: wp.array) -> None:
        """Write the sum of ``before`` and the tangent of the force's acceleration to ``after``, (n,) vectors."""

    def adjoint(self, step: StepContext, acceleration_bar: wp.array, bar: Adjoints) -> wp.array | None:
        """Add to the adjoints ``bar`` of the force's inputs, given the adjoint of the acceleration, (n,) vectors.

        A force with an acceleration that depends on ``before`` has ``is_last = True``, comes last, and returns the
        adjoint of ``before``. A force that solves a system has the attribute ``solve``; see `cortado.solvers.loop`.

        A force of walls on fluid has the attribute ``wall_action``, a `cortado.sph.density.WallAction`. Without
        ``wall_action``, loads on solids do not include the force. If walls act at the surface instead of at the
        particle position, ``wall_couple`` is a second `WallAction` for the moment.
        """


class PartTangent:
    def __init__(self, part: Any = None):
        self.part = part

    def begin(self, step: StepContext, dot: Tangents, state_dot: State) -> None:
        """Apply the tangent of `Part.begin`, given the tangent of the state before the step."""

    def sort(self, step: StepContext, dot: Tangents, state_dot: State) -> None:
        """Do forward mode for `Part.sort` and `Part.settle`, given the tangent of the state before the step."""

    def end(self, step: StepContext, dot: Tangents, state_dot: State) -> None:
        """Apply the tangent of `Part.end`, and complete ``state_dot``, the tangent of the state after the step."""


class PartAdjoint:
    def __init__(self, part: Any = None):
        self.part = part

    def end(self, step: StepContext, bar: Parameters, state_bar: State, moved_bar: State) -> State:
        """Apply the adjoint of `Part.end` to the adjoints of positions and velocities. Return the adjoints before the
        part acts, and add to ``bar``. Only a part with a `Part.target` has the method `end`."""
        return moved_bar

    def sort(self, step: StepContext, bar: Adjoints, state_bar: State) -> None:
        """Apply the adjoints of `Part.settle` and `Part.sort`. In ``state_bar``, replace the adjoint of the part's
        fields after the step by the adjoint before the step."""

    def begin(self, step: StepContext, bar: Adjoints, state_bar: State) -> None:
        """Apply the adjoint of `Part.begin`, after all other adjoints."""


class Part:
    """A part of a step. A `Force` may also be a part."""

    fields: tuple[StateField, ...] = ()
    """State fields that the part keeps from step to step."""
    shares: tuple[str, ...] = ()
    """Names of parameters with adjoints that are sums over particles; see `Force.shares`."""
    derivatives: tuple[type[PartTangent], type[PartAdjoint]] | None = None

    def set_substeps(self, substeps: int) -> None:
        """Set the number of diffusion substeps for later steps."""

    def begin(self, step: StepContext, state: State) -> None:
        """Begin a step. ``state`` is the state before the step and must not be changed. Copy arrays that `end` needs,
        because the step may overwrite them."""

    def sort(self, step: StepContext, state: State) -> None:
        """A step calls `sort` when the particles are sorted."""

    def settle(self, step: StepContext) -> None:
        """A step calls `settle` when neighbours and densities are known."""

    def target(self, moved: State) -> State:
        """Return the state from which `end` reads positions and velocities. A part that changes positions or velocities
        must return a new state, because arrays must not be changed in place."""
        return moved

    def end(self, step: StepContext, state: State, moved: State) -> None:
        """Write the part's fields to ``state``, the state after the step. A part with a new `target` also writes all
        positions and velocities to ``moved``."""

    def new_tangent(self) -> PartTangent:
        """Make the tangent of the part. Raise `MissingDerivativeError` without forward mode."""
        if self.derivatives is None:
            name = type(self).__name__
            raise MissingDerivativeError(f"{name} has no forward mode: define the method new_tangent.")
        return self.derivatives[0](self)

    def new_adjoint(self) -> PartAdjoint:
        """Make the adjoint of the part. Raise `MissingDerivativeError` without reverse mode."""
        if self.derivatives is None:
            name = type(self).__name__
            raise MissingDerivativeError(f"{name} has no reverse mode: define the method new_adjoint.")
        return self.derivatives[1](self)


class PartMaker(Protocol):
    def part(self, layout: Layout, requires_grad: bool) -> Part:
        """Make the part for a solver. With ``requires_grad``, the part's arrays have gradients for ``warp.Tape``."""


class Carried:
    """Fields of sorted particles that a solver uses in the next step, such as a pressure."""

    def __init__(self, fields: Iterable[StateField], layout: Layout, requires_grad: bool = False):
        """Allocate arrays for the part's fields. Raise `TypeError` for a field without a value for each particle."""
        fields = tuple(fields)
        for field in fields:
            if field.axis is not Axis.PARTICLE:
                wanted = "one entry for each particle"
                raise TypeError(f"field {field.name!r} has one entry, but must have {wanted}.")
        self._arrays = layout.state(fields, requires_grad)
        self._orders = {name: orders_of(self._arrays[name]) for name in self._arrays.names}

    def __getitem__(self, name: str) -> wp.array:
        """Return the array (n,) of a field at the start of the step, in sorted order."""
        return self._arrays[name]

    def sort(self, step: StepContext, state: State) -> None:
        for name in self._arrays.names:
            step.launch(self._orders[name].sort, a_scene=state[name], a=self._arrays[name])

    def unsort(self, step: StepContext, values: Mapping[str, wp.array], state: State) -> None:
        if values.keys() != set(self._arrays.names):
            raise TypeError(f"the step sorts {', '.join(self._arrays.names)}, but was given {', '.join(values)}.")
        for name, a in values.items():
            step.launch(self._orders[name].unsort, a=a, a_scene=state[name])


def orders_of(a: wp.array) -> SimpleNamespace:
    """Return the kernels that copy values like those of ``a`` (n,) from the order of the scene to sorted order (`sort`)
    and back (`unsort`)."""
    module = kernel_module(f"order_{kind_of(True, a.requires_grad)}_{type_name(a.dtype)}", a.requires_grad)
    return order_kernels(a.dtype, module)


@cache
def order_kernels(dtype: Any, module: Any) -> SimpleNamespace:
    typed = TypesByName(dtype, {wp.int32: "order"})

    @typed.kernel(module)
    def sort(order, a_scene, a):
        i = wp.tid()
        a[i] = a_scene[order[i]]

    @typed.kernel(module)
    def unsort(order, a, a_scene):
        i = wp.tid()
        a_scene[order[i]] = a[i]

    return by_name(sort, unsort)


def integration_module(precision: Precision, forward: bool, taped: bool = False, topic: str = "integration") -> Any:
    """Kernels that only few scenes use have their own ``topic``, so that Warp compiles no other kernels again."""
    return kernel_module(f"{topic}_{kind_of(forward, taped)}_{precision.name}", forward and taped)


@cache
def prediction_share(precision: Precision) -> Any:
    """Make the Warp function of a particle's term in the adjoint of the time step."""
    real, vector = precision.real, precision.vector

    @wp.func
    def adjoint(x_star_bar: vector, speed_bar: vector, v: vector, v_star: vector, dt: real) -> real:
        return wp.dot(x_star_bar, v_star) + wp.dot(speed_bar, v_star - v) / dt

    return adjoint


@cache
def integration_kernels(precision: Precision, taped: bool) -> SimpleNamespace:
    real, vector = precision.real, precision.vector
    typed = TypesByName(real, {wp.int32: "order", vector: "x v acceleration"})
    adjoin_prediction, vectors = prediction_share(precision), wp.array(dtype=vector)

    @typed.kernel(integration_module(precision, True, taped))
    def sort(order, x_scene, v_scene, m_scene, x, v, m):
        i = wp.tid()
        x[i] = x_scene[order[i]]
        v[i] = v_scene[order[i]]
        m[i] = m_scene[order[i]]

    @typed.kernel(integration_module(precision, True, taped))
    def unsort(order, x, v, x_scene, v_scene):
        i = wp.tid()
        x_scene[order[i]] = x[i]
        v_scene[order[i]] = v[i]

    @particle_kernel(integration_module(precision, True, taped), "x_star v_star")
    def predict(time_step: real, x_i: vector, v_i: vector, acceleration_i: vector) -> tuple[vector, vector]:
        velocity = v_i + time_step * acceleration_i
        return x_i + time_step * velocity, velocity

    @particle_kernel(integration_module(precision, False), "x_star_dot v_star_dot", typed=typed)
    def predict_tangent(
        time_step, time_step_dot, x_dot_i, v_dot_i, acceleration_i, acceleration_dot_i, v_star_i
    ) -> tuple[vector, vector]:
        velocity_dot = v_dot_i + time_step * acceleration_dot_i + time_step_dot * acceleration_i
        return x_dot_i + time_step * velocity_dot + time_step_dot * v_star_i, velocity_dot

    @particle_kernel(integration_module(precision, False), "acceleration_bar")
    def acceleration_adjoint(time_step: real, v_bar_i: vector) -> vector:
        return time_step * v_bar_i

    @typed.kernel(integration_module(precision, False), enable_backward=False)
    def collect_masses(order, m_bar, m_scene_bar):
        i = wp.tid()
        m_scene_bar[order[i]] = m_scene_bar[order[i]] + m_bar[i]

    @particle_kernel(integration_module(precision, False), "x_bar v_bar n_bar m_bar rho_0_bar mu_bar time_step_bar")
    @typed
    def begin_adjoint(
        order_i, time_step, v_i, v_star_i, x_scene_bar: vectors, v_scene_bar: vectors, time_step_bar_i
    ) -> tuple[vector, vector, real, real, real, real, real]:
        no = real(0.0)
        x_bar = x_scene_bar[order_i]
        v_bar = v_scene_bar[order_i] + time_step * x_bar
        dt_bar = time_step_bar_i + adjoin_prediction(x_bar, v_bar, v_i, v_star_i, time_step)
        return x_bar, v_bar, no, no, no, no, dt_bar

    return by_name(sort, unsort, predict, predict_tangent, acceleration_adjoint, collect_masses, begin_adjoint)
