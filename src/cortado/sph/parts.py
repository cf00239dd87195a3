"""The parts of a step, such as forces, the mixture and the nozzle: their arguments, and the order in which a step calls
them.

A part reads the sorted particles and the parameters, adds to adjoints, and never overwrites its arguments. Besides
accelerating particles, a part may keep fields from step to step, and act at the beginning and end of a step. A part may
omit any method.

For each method a step calls all parts in their order, reverse mode in reverse order. In `begin` kernels can read the
parameters and the number of the step; from `sort` on also the order of particles and x, v and m; from `settle` on
neighbours and n; in `end` all arrays of the step. A derivative replays a step from its state without `end`, so the
other methods must store all values that tangent or adjoint need.

A state stores particles in the scene's order, and a step works on sorted particles. The adjoint of sorting is
unsorting. At the end of this module are the kernels of time integration (semi-implicit Euler) and of sorting, with
derivatives.
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
    """A step as its parts see it. Kernels find in the context, by name, the fields of the particles, the parameters,
    the neighbourhood ``s``, ``order`` (sorted -> scene), the number ``step`` (members,) of the step, and ``cell``, the
    volume of a particle [m^d]. In a batch particle i belongs to scene i // ``particles``."""

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
    """(n,) velocity changes of sorted particles by pressure in the previous step [m/s]; None if not carried."""

    @cached_property
    def _known(self) -> tuple[Named, ...]:
        own = {"s": self.neighbourhood, "particles": self.particles, "order": self.order, "step": self.step}
        return {**own, "cell": self.cell, "fractions": self.fractions}, self.fields.named(), self.parameters.named()

    def launch(self, kernel: wp.Kernel, *groups: Named, threads: int | None = None, **arguments: Any) -> None:
        """Launch a kernel over the particles; the step has the arguments missing from ``arguments`` and ``groups``.

        A kernel that takes ``s`` takes it first and works on particle ``s.first + wp.tid()``, because its launch may be
        split into ranges of particles. ``threads`` is for kernels without ``s``.
        """
        self.launcher(kernel, *groups, *self._known, threads=threads, **arguments)

    def aside(self) -> AbstractContextManager[None]:
        """Let the launches inside run concurrently with later launches until `join`; both must be independent."""
        return self.launcher.aside()

    def join(self) -> None:
        """Let later launches wait for all launches made `aside`; every step ends with this call."""
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
    """Terms (n,) of the particles in the adjoints of parameters, stored until they are summed: numbers or vectors, and
    for a parameter of phases a number for each phase."""

    def __init__(self, names: Iterable[str], layout: Layout):
        """Allocate terms of the parameters ``names``, all 0; raise `TypeError` for a parameter without such terms."""
        precision, self.known = layout.precision, layout.known
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
        for name, total in self._sums.items():
            add(total(self[name]).view(bar[name].dtype).flatten(), bar[name].flatten())
        self.clear()


@dataclass(frozen=True)
class Adjoints:
    fields: Fields
    fractions: wp.array
    """Adjoint of `StepContext.fractions`, which the mixture turns into that of the old fractions and sets to 0."""
    parameters: Parameters
    shares: Shares
    solids: SolidShares
    bodies: Sequence[Any] = ()
    kick: wp.array | None = None

    @cached_property
    def named(self) -> tuple[Named, ...]:
        """Return adjoints by kernel argument name, such as ``x_bar``: sums (members, steps) of parameters over time,
        and the particles' terms of parameters in a part's ``shares``."""
        over_time = [name for name in self.parameters.names if self.shares.known[name].axis is Axis.STEP]
        whole = {f"{argument(name)}_bar": self.parameters[name] for name in over_time}
        fractions = {"fractions_bar": self.fractions}
        return self.fields.named("_bar"), fractions, self.shares.named("_bar"), whole


@dataclass(frozen=True)
class Setting:
    """The arguments from which a force is made. A module named in the registry of parameters has a function
    ``force(setting)``, which returns its force, or None without one."""

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
    """Parameters, numbers or per phase, to whose adjoints every particle adds a term. An adjoint kernel gets these
    adjoints per particle, (n,), those of parameters over time as sums, (members, steps), and no others."""

    def accelerate(self, step: StepContext, before: wp.array, after: wp.array) -> None:
        """Write ``after`` = ``before`` + this force's acceleration, both (n,) vectors."""

    def tangent(self, step: StepContext, dot: Tangents, before: wp.array, after: wp.array) -> None:
        """Write ``after`` = ``before`` + the tangent of this force's acceleration along ``dot``, both (n,) vectors."""

    def adjoint(self, step: StepContext, acceleration_bar: wp.array, bar: Adjoints) -> wp.array | None:
        """Add to the adjoints ``bar`` of the force's inputs, given the adjoint of the acceleration, (n,) vectors.

        A force whose acceleration depends on ``before`` has ``is_last = True``, comes after all others, and returns the
        adjoint of ``before``. A force that solves a system has the solver as its attribute ``solve``, see
        `cortado.solvers.loop`. A force by which walls act on fluid has a `cortado.sph.density.WallAction` as
        ``wall_action``; without it, loads on solids lack this force. If walls act at x_i - y instead of at the
        particle, ``wall_couple`` is a second `WallAction`: the sum of y x a.
        """


class PartTangent:
    def __init__(self, part: Any = None):
        self.part = part

    def begin(self, step: StepContext, dot: Tangents, state_dot: State) -> None:
        """Apply the tangent of `Part.begin` to the tangent of the state before the step."""

    def sort(self, step: StepContext, dot: Tangents, state_dot: State) -> None:
        """Apply the tangents of `Part.sort` and `Part.settle`; ``state_dot`` is the tangent of the state before the
        step."""

    def end(self, step: StepContext, dot: Tangents, state_dot: State) -> None:
        """Apply the tangent of `Part.end`: ``state_dot`` contains the tangents of positions and velocities at the end
        of the step, and becomes the tangent of the state there."""


class PartAdjoint:
    def __init__(self, part: Any = None):
        self.part = part

    def end(self, step: StepContext, bar: Parameters, state_bar: State, moved_bar: State) -> State:
        """Apply the adjoint of a part with a `Part.target`: turn the adjoint of positions and velocities after the part
        into that before the part, return it, and add to ``bar``. Sorted particles have no adjoints yet."""
        return moved_bar

    def sort(self, step: StepContext, bar: Adjoints, state_bar: State) -> None:
        """Apply the adjoints of `Part.settle` and `Part.sort`, and of the sorted particles in `Part.end`. Replace in
        ``state_bar`` the adjoint of the part's fields after the step by the adjoint before it."""

    def begin(self, step: StepContext, bar: Adjoints, state_bar: State) -> None:
        """Apply the adjoint of `Part.begin`, after all others."""


class Part:
    """A part of a step, in one solver. A `Force` may be a part too."""

    fields: tuple[StateField, ...] = ()
    """Fields that the part keeps from step to step, as arrays of the state."""
    shares: tuple[str, ...] = ()
    """Parameters to whose adjoints every particle adds a term; see `Force.shares`."""
    derivatives: tuple[type[PartTangent], type[PartAdjoint]] | None = None
    """Classes of the part's tangent and adjoint, made of the part; None if the part has none or makes them itself."""

    def set_substeps(self, substeps: int) -> None:
        """Take this number of substeps of diffusion in each later step."""

    def begin(self, step: StepContext, state: State) -> None:
        """Begin a step from its first state, which must not change. Copy the arrays of this state that `end` needs: the
        state at the end of the step may be in the same arrays."""

    def sort(self, step: StepContext, state: State) -> None:
        """Act once the order of the sorted particles is known."""

    def settle(self, step: StepContext) -> None:
        """Act once neighbours and densities are known."""

    def target(self, moved: State) -> State:
        """Return the state from which the part's `end` reads positions and velocities; `end` writes them to ``moved``.
        A part that changes them returns a separate state, because nothing is changed in place."""
        return moved

    def end(self, step: StepContext, state: State, moved: State) -> None:
        """Write the part's fields of ``state``, the state at the end of the step. A part with a separate `target` reads
        positions and velocities there and writes them all to ``moved``."""

    def new_tangent(self) -> PartTangent:
        """Make the tangent of the part, with its arrays; raise `MissingDerivativeError` without forward mode."""
        if self.derivatives is None:
            raise MissingDerivativeError(
                f"{type(self).__name__} has no forward mode: let it have a method new_tangent."
            )
        return self.derivatives[0](self)

    def new_adjoint(self) -> PartAdjoint:
        """Make the adjoint of the part, with its arrays; raise `MissingDerivativeError` without reverse mode."""
        if self.derivatives is None:
            raise MissingDerivativeError(
                f"{type(self).__name__} has no reverse mode: let it have a method new_adjoint."
            )
        return self.derivatives[1](self)


class PartMaker(Protocol):
    def part(self, layout: Layout, requires_grad: bool) -> Part:
        """Make the part for a solver; with ``requires_grad`` its arrays have gradients, for Warp's tape."""


class Carried:
    """Fields of sorted particles, such as a pressure, that a solver carries from step to step, or their derivatives."""

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
        """Return a field's array (n,) in sorted order, as at the start of the step."""
        return self._arrays[name]

    def sort(self, step: StepContext, state: State) -> None:
        for name in self._arrays.names:
            sort(step, state[name], self._arrays[name])

    def unsort(self, step: StepContext, values: Mapping[str, wp.array], state: State) -> None:
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
    """Return the Warp module of kernels without a smoothing kernel, for a ``topic`` that only some scenes need."""
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
def integration_kernels(precision: Precision, taped: bool) -> SimpleNamespace:
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
    """Make the kernel that turns the adjoint of the new state, in scene order, into that of the prediction."""
    real, vector = precision.real, precision.vector
    adjoin_prediction = prediction_share(precision)
    vectors = wp.array(dtype=vector)
    typed = TypesByName(real, {wp.int32: "order", vector: "v", vectors: "x_scene v_scene"})

    @particle_kernel(integration_module(precision, False), "x_bar v_bar n_bar m_bar rho_0_bar mu_bar time_step_bar")
    @typed
    def begin_adjoint(
        order_i, time_step, v_i, v_star_i, x_scene_bar, v_scene_bar, time_step_bar_i
    ) -> tuple[vector, vector, real, real, real, real, real]:
        no = real(0.0)
        x_bar = x_scene_bar[order_i]
        v_bar = v_scene_bar[order_i] + time_step * x_bar
        dt_bar = time_step_bar_i + adjoin_prediction(x_bar, v_bar, v_i, v_star_i, time_step)
        return x_bar, v_bar, no, no, no, no, dt_bar

    return begin_adjoint
