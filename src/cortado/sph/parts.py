"""What a part of a step is given, and what it gives: forces, the mixture, the nozzle.

A part reads the sorted particles and the parameters, and adds to adjoints: nothing that it is given is overwritten.
"""

from collections.abc import Iterable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

import warp as wp

from cortado.device.launching import KernelLauncher, Named
from cortado.device.reduction import add
from cortado.discretise.walls.layers import WallLayers
from cortado.particles.arrays import Arrays, Fields, zeros
from cortado.particles.neighbourhood import Discretisation
from cortado.particles.solid_shares import SolidShares
from cortado.particles.state import Layout, Parameters
from cortado.scene.discrete_scene import Lattice
from cortado.scene.parameters.known import argument
from cortado.scene.parameters.parameter import Axis
from cortado.scene.scene import Scene


@dataclass(frozen=True)
class StepContext:
    """A step as its parts see it. Kernels find in it, by name, the fields of the particles, the parameters, ``s`` (what
    lies around each particle), ``order`` (sorted -> scene), ``step`` (members,), the number of the step,
    ``particles``, how many a scene has: particle i belongs to scene i // particles of a batch; and ``cell``, the volume
    of a particle [m^d]."""

    launcher: KernelLauncher
    particles: int
    neighbourhood: Any
    order: wp.array
    step: wp.array
    cell: float
    fields: Fields
    parameters: Parameters

    @cached_property
    def _known(self) -> tuple[Named, ...]:
        own = {"s": self.neighbourhood, "particles": self.particles, "order": self.order, "step": self.step}
        return {**own, "cell": self.cell}, self.fields.named(), self.parameters.named()

    def launch(self, kernel: wp.Kernel, *groups: Named, threads: int | None = None, **arguments: Any) -> None:
        """Launch a kernel over the particles; what is not among ``arguments`` and ``groups`` is the step's.

        A kernel that takes ``s`` takes it first and works on particle ``s.first + wp.tid()``, as its launch may be cut
        into ranges of particles; ``threads`` is for kernels without it.
        """
        self.launcher(kernel, *groups, *self._known, threads=threads, **arguments)

    def aside(self) -> AbstractContextManager[None]:
        """What is launched within needs nothing of what comes after it until `join`, nor that of this."""
        return self.launcher.aside()

    def join(self) -> None:
        """Let what comes wait for all that went `aside`; a step ends with it."""
        self.launcher.join()


@dataclass(frozen=True)
class Tangents:
    """Tangents of the sorted particles and of the parameters."""

    fields: Fields
    parameters: Parameters

    @cached_property
    def named(self) -> tuple[Named, ...]:
        """For kernels: ``x_dot``, ``viscosity_dot`` and so on."""
        return self.fields.named("_dot"), self.parameters.named("_dot")


class Shares(Arrays):
    """The adjoints of parameters in which every particle has a share, kept particle by particle until they are added
    up: (n,) numbers or vectors, of a parameter of phases (n,) of one for each phase."""

    def __init__(self, names: Iterable[str], layout: Layout):
        """Of the parameters of these names, all 0. Raises `TypeError` for what cannot be shared."""
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
        """Add them up into ``bar``, and begin anew."""
        for name, total in self._sums.items():
            add(total(self[name]).view(bar[name].dtype).flatten(), bar[name].flatten())
        self.clear()


@dataclass(frozen=True)
class Adjoints:
    """Where parts add adjoints: of the sorted particles, of the parameters, and particles' shares of the latter."""

    fields: Fields
    parameters: Parameters
    shares: Shares
    solids: SolidShares
    """Those of the poses of solids that move."""

    @cached_property
    def named(self) -> tuple[Named, ...]:
        """For kernels: ``x_bar`` and so on; the sums, (members, steps), of parameters over time; and particles' shares,
        of those parameters alone that a part names among its ``shares``."""
        over_time = [name for name in self.parameters.names if self.shares.known[name].axis is Axis.STEP]
        whole = {f"{argument(name)}_bar": self.parameters[name] for name in over_time}
        return self.fields.named("_bar"), self.shares.named("_bar"), whole


@dataclass(frozen=True)
class Setting:
    """What a force is made for: the ``force(setting)`` of a module that the registry of parameters names makes it, or
    returns None where nothing acts."""

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
        """``after`` = ``before`` + this force's acceleration, both (n,) vectors."""

    def tangent(self, step: StepContext, dot: Tangents, before: wp.array, after: wp.array) -> None:
        """The same for the tangents of the accelerations, along ``dot``."""

    def adjoint(self, step: StepContext, acceleration_bar: wp.array, bar: Adjoints) -> wp.array | None:
        """Add to ``bar`` what the adjoint of the acceleration, (n,) vectors, asks for. A force whose own acceleration
        depends on ``before`` returns the adjoint of that; it says ``is_last = True``, and comes after all others.
        One that solves a system of equations has what does so as ``solve``: see `cortado.solvers.solve_record`. One
        with which walls act on fluid has what they do, a `cortado.sph.wall_sums.WallAction`, as ``wall_action``, or
        loads on solids lack it. Where that does not act at the particle, ``wall_couple`` is another one, of the sum of
        y x a, with which a acts at x_i - y."""
