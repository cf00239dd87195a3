"""What a solver is: an algorithm that takes steps, and can take one again, along tangents, and back.

Rollouts, gradients and the certificate know a solver by this protocol, and so do files and reports of runs.
`cortado.solvers.particles` has what solvers of particles share; `cortado.solvers.pcisph` is one.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, Self

import warp as wp
from numpy.typing import NDArray

from cortado.device.launching import KernelLauncher
from cortado.device.threads import Turn
from cortado.particles.neighbourhood import Discretisation
from cortado.particles.state import Fields, Layout, Parameters, State
from cortado.solvers.containment import Containment
from cortado.sph.parts import StepContext, Tangents

Counts = tuple[int, ...]
"""How often each loop of a step went round: with it the step can be taken again, bit for bit."""


class StepLog(Protocol):
    """What a solver notes of each step of a run, on the device until it is read."""

    @property
    def diagnostics(self) -> Mapping[str, NDArray]:
        """(steps,) by name, in a batch (steps, batch), of the steps that were read. Every solver has ``converged``;
        PCISPH also ``iterations``, ``density_errors``, the average of the compressions (rho* - rho_0)+ / rho_0, and
        ``greatest_density_errors``. The projection has ``divergence`` too. Reports draw ``density_errors``, and whole
        numbers as the iterations of loops.
        """

    def read(self, steps: int) -> None:
        """Read so many steps from the device."""

    def assign(self, other: Self) -> None:
        """Hold what another of as many steps of the same solver has read."""

    def seek(self, step: int) -> Counts:
        """Make the loops of the solver ready to take a step again that was read, from 0. Of a batch the counts are
        those of the scene that went round most often."""


class StepTangent(Protocol):
    """Forward mode of a step that a solver has replayed, along tangents of the parameters."""

    def step(self, counts: Counts, state_dot: State, parameters: Parameters) -> None:
        """Replace the tangent of the step's state by that of its result."""


class StepAdjoint(Protocol):
    """Reverse mode of steps that a solver has replayed."""

    def begin(self) -> None:
        """Forget the adjoints of the parameters of an earlier way back."""

    def step(self, counts: Counts, state_bar: State, parameters: Parameters) -> None:
        """Replace the adjoint of the step's result by that of its state."""

    def collect(self) -> Parameters:
        """The adjoints of the parameters, of all steps since `begin`."""


class ResumingAdjoint(StepAdjoint, Protocol):
    """The same where the pressure of a step is taken from the state that the step led to."""

    def arrive(self, state: State) -> None:
        """The state after the step that comes next."""

    def replay(self, state: State, parameters: Parameters, counts: Counts) -> None:
        """As that of `Solver`, but without the iterations of the pressure. The step before comes next."""


class PressureTangent(StepTangent, Protocol):
    """That of a solver with pressures, which quantities and sensors can be differentiated through."""

    dot: Tangents

    def pressures(self, rounds: Sequence[int]) -> NDArray:
        """Tangents (n,) of the pressures of the last step, of sorted particles, with which they push walls; its first
        loop went round so often in each scene."""

    def stresses(self, rounds: Sequence[int]) -> NDArray:
        """The same of what a gauge would read."""


@dataclass(frozen=True)
class WithinBar:
    """Adjoints of what a step computes, of sorted particles."""

    fields: Fields
    """Of the fields at its start."""
    p: wp.array
    """(n,) of the pressures with which they push walls."""
    stress: wp.array | None
    """(n,) of what a gauge would read; None where it has none."""
    v_star: wp.array
    """(n,) of the velocities v* = v + dt a that the explicit forces lead to; what they depend on dt is counted
    elsewhere."""


class PressureAdjoint(StepAdjoint, Protocol):
    """The same in reverse mode."""

    def from_within(self, counts: Counts, within: WithinBar, state_bar: State, parameters: Parameters) -> None:
        """Write to ``state_bar`` the adjoint of the replayed step's state, for adjoints ``within`` the step, with none
        of its result."""


class Solver(Protocol):
    """The solver of a scene, or of a batch of scenes, on one device, which rollouts share. Of its methods `make_room`
    and `reset` alone wait for the device and read from it. `tangent`, `adjoint`, `implicit_adjoint` and
    `differentiable` raise `InputError`, one sentence, where a solver has no such derivative.
    """

    discretisation: Discretisation
    layout: Layout
    device: Any
    launch: KernelLauncher
    turn: Turn
    containment: Containment
    step_number: wp.array
    """(members,) of the step to take, which `step` counts; the same for all scenes of a batch."""
    generation: int
    """How often arrays, or the work of a step, were replaced; what was captured before is stale."""

    def new_state(self, requires_grad: bool = False) -> State:
        """A state of this solver's particles, all 0."""

    def new_parameters(self, steps: int, requires_grad: bool = False) -> Parameters:
        """Parameters of a run of so many steps, all 0."""

    def new_log(self, steps: int) -> StepLog:
        """Room for what is noted of so many steps."""

    def set_substeps(self, substeps: int) -> None:
        """Take so many explicit substeps of diffusion in each step from now on."""

    def reset(self, step: int = 0) -> None:
        """Be ready to take a step, and forget the counts and flags of those from it on, also of an interrupted run."""

    def make_room(self) -> bool:
        """Whether the lists of neighbours were too short; they are longer now, and what used them must be repeated."""

    def step(self, state: State, new_state: State, parameters: Parameters, log: Any) -> None:
        """One step, noted in a log of `new_log`. The two states may be one and the same."""

    def reserve(self, counts: Counts) -> None:
        """Make room for all intermediate values of a step."""

    def replay(self, state: State, parameters: Parameters, counts: Counts) -> None:
        """The same step again, bit for bit, with every intermediate value kept."""

    def write_state(self, counts: Counts, parameters: Parameters, new_state: State) -> None:
        """The result of the step that was replayed."""

    def context(self, parameters: Parameters) -> StepContext:
        """The present step as its parts see it."""

    def tangent(self, parameters_dot: Parameters) -> StepTangent:
        """Forward mode along tangents of the parameters."""

    def adjoint(self, steps: int) -> StepAdjoint:
        """Reverse mode of a run of so many steps."""

    def implicit_adjoint(self, steps: int, tolerance: float, iterations: int) -> ResumingAdjoint:
        """The same with the pressure as the fixed point of its iterations, whose adjoint is solved for until the
        residual has fallen to ``tolerance`` of the first, in ``iterations`` at most: for `ImplicitPressure`."""

    def differentiable(self) -> Self:
        """The same solver, with arrays that Warp's tape can differentiate."""

    def match(self, other: Self) -> None:
        """Have the room and the substeps of another that is the same but for its arrays."""

    def follow(self, other: Self) -> None:
        """Be ready to replay the step that another, that is the same but for its arrays, is ready to replay."""

    def gradient_memory(self, log: Any) -> Mapping[str, float]:
        """[bytes] by what they are for, that going back through the steps of a log takes."""
