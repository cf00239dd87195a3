"""What a part of a step may do besides accelerating particles: keep fields from step to step, and work at the beginning
and at the end of a step. The mixture, the emitter, and forces that remember are parts; a solver knows only their list.

A step goes through its parts in their order at each of the times below, forward and in forward mode, and in the reverse
order in reverse mode. A method that a part has not does nothing. Of what a step knows, kernels find at the `begin` of a
part the parameters and the number of the step; at `sort` also the order of particles and x, v and m; from `settle` on
neighbours and n as well, and at `end` everything.

A derivative takes a step again from its state, but not its end. So what a tangent or an adjoint needs of a step has to
stand in arrays that `begin`, `sort` or `settle` write.
"""

from typing import Protocol

from cortado.errors import MissingDerivativeError
from cortado.particles.fields import StateField
from cortado.particles.state import Layout, Parameters, State
from cortado.sph.parts import Adjoints, StepContext, Tangents


class PartTangent:
    """Forward mode of a part."""

    def begin(self, step: StepContext, dot: Tangents, state_dot: State) -> None:
        """Of `Part.begin`, from the tangent of the state before the step; ``dot`` has those of the parameters."""

    def sort(self, step: StepContext, dot: Tangents, state_dot: State) -> None:
        """Of `Part.sort` and `Part.settle`: from the tangent of the state before the step; ``dot`` has those of the
        sorted particles."""

    def end(self, step: StepContext, dot: Tangents, state_dot: State) -> None:
        """Of `Part.end`: ``state_dot`` has the tangents of positions and velocities at the end of the step, and becomes
        that of the state there."""


class PartAdjoint:
    """Reverse mode of a part."""

    def end(self, step: StepContext, bar: Parameters, state_bar: State, moved_bar: State) -> State:
        """Of a part that has a `Part.target`: from the adjoint of the positions and velocities that it left to that of
        those that it found, which is returned. It adds to ``bar``; sorted particles have no adjoints yet."""
        return moved_bar

    def sort(self, step: StepContext, bar: Adjoints, state_bar: State) -> None:
        """Of `Part.settle` and `Part.sort`, and of what `Part.end` wrote of sorted particles: ``state_bar`` has the
        adjoint of the part's fields after the step, and becomes that of those before it."""

    def begin(self, step: StepContext, bar: Adjoints, state_bar: State) -> None:
        """Of `Part.begin`, after all others; a part whose fields it has left as they were lets `sort` be."""


class Part:
    """A part of a step, in one solver. A `Force` may be one too."""

    fields: tuple[StateField, ...] = ()
    """What it keeps from step to step, as arrays of the state."""
    shares: tuple[str, ...] = ()
    """Parameters to whose adjoints every particle adds a share, as those of a `Force`."""

    def set_substeps(self, substeps: int) -> None:
        """Take so many explicit substeps of diffusion in each step from now on."""

    def begin(self, step: StepContext, state: State) -> None:
        """Before anything else, with the state that the step begins from, which stays as it is. What `end` needs of it
        is kept here, as the state at the end of the step may have the same arrays."""

    def sort(self, step: StepContext, state: State) -> None:
        """Once the order of the sorted particles is known."""

    def settle(self, step: StepContext) -> None:
        """Once neighbours and densities are known."""

    def target(self, moved: State) -> State:
        """Where the part finds positions and velocities at its `end`, given where it leaves them: a part that changes
        some has room of its own for them, as nothing is changed in place."""
        return moved

    def end(self, step: StepContext, state: State, moved: State) -> None:
        """Write the part's fields of ``state``, that at the end of the step, and, if it has a `target` of its own, all
        positions and velocities of ``moved``, from those that it finds in its target."""

    def new_tangent(self) -> PartTangent:
        """Forward mode of it, with arrays of its own. Raises `MissingDerivativeError` for a part that has none."""
        raise MissingDerivativeError(f"{type(self).__name__} has no forward mode: let it have a method new_tangent.")

    def new_adjoint(self) -> PartAdjoint:
        """Reverse mode of it, with arrays of its own. Raises `MissingDerivativeError` for a part that has none."""
        raise MissingDerivativeError(f"{type(self).__name__} has no reverse mode: let it have a method new_adjoint.")


class PartMaker(Protocol):
    """Makes a part for a solver."""

    def part(self, layout: Layout, requires_grad: bool) -> Part:
        """The part; with ``requires_grad`` its arrays have gradients, for Warp's tape."""
