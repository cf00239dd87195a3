"""The protocol of a solver, which takes steps, replays a step, and computes its tangent and its adjoint.

Rollouts, gradients, the certificate, files and reports of runs use a solver only through this protocol.
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
"""Numbers of iterations of each loop of a step, with which the step can be replayed bit for bit."""


class StepLog(Protocol):
    """Diagnostics of each step of a run, on the device until they are read."""

    @property
    def diagnostics(self) -> Mapping[str, NDArray]:
        """Return diagnostics by name, (steps,) or in a batch (steps, batch), of the steps that were read. Every solver
        has ``converged``. PCISPH also has ``iterations``, ``density_errors``, the average of the compressions (rho* -
        rho_0)+ / rho_0, and ``greatest_density_errors``; the projection also has ``divergence``. Reports plot
        ``density_errors``, and take integer diagnostics for iterations of loops."""

    def read(self, steps: int) -> None:
        """Read the diagnostics of the first ``steps`` steps from the device."""

    def assign(self, other: Self) -> None:
        """Copy the diagnostics of another log of the same solver and length."""

    def seek(self, step: int) -> Counts:
        """Return the iterations of a step of the run, counted from 0, and prepare the solver's loops to repeat the
        step. In a batch the scene with the most iterations sets the numbers."""


class StepTangent(Protocol):
    """The tangent of steps that a solver has replayed, along tangents of the parameters (forward mode)."""

    def step(self, counts: Counts, state_dot: State, parameters: Parameters) -> None:
        """Replace the tangent of the replayed step's state by the tangent of the step's result."""


class StepAdjoint(Protocol):
    """The adjoint of steps that a solver has replayed (reverse mode)."""

    def begin(self) -> None:
        """Set the adjoints of the parameters to 0, before a backward pass."""

    def step(self, counts: Counts, state_bar: State, parameters: Parameters) -> None:
        """Replace the adjoint of the replayed step's result by the adjoint of the step's state."""

    def collect(self) -> Parameters:
        """Return the adjoints of the parameters, summed over all steps since `begin`."""


class PressureTangent(StepTangent, Protocol):
    """The tangent of a solver with pressures."""

    dot: Tangents

    def pressures(self, rounds: Sequence[int]) -> NDArray:
        """Return tangents (n,) of the pressures of sorted particles on walls in the last step [Pa]; ``rounds`` has the
        iterations of the step's first loop in each scene."""

    def stresses(self, rounds: Sequence[int]) -> NDArray:
        """Return tangents (n,) of the pressures that a gauge reads at sorted particles [Pa]."""


@dataclass(frozen=True)
class WithinBar:
    """Adjoints of sorted particles' quantities within a step."""

    fields: Fields
    """Adjoints of the fields at the start of the step."""
    p: wp.array
    """(n,) adjoint of the pressures of particles on walls."""
    stress: wp.array | None
    """(n,) adjoint of the pressures that a gauge reads; None without such an adjoint."""
    v_star: wp.array
    """(n,) adjoint of v* = v + dt a by explicit forces, without the dependence of v* on dt."""


class PressureAdjoint(StepAdjoint, Protocol):
    """The adjoint of a solver with pressures."""

    def from_within(self, counts: Counts, within: WithinBar, state_bar: State, parameters: Parameters) -> None:
        """Write to ``state_bar`` the adjoint of the replayed step's state, given adjoints ``within`` the step and a
        zero adjoint of its result."""


class Solver(Protocol):
    """The solver of a scene, or of a batch of scenes, on one device; rollouts share it. Only the methods `make_room`
    and `reset` wait for the device. A solver without a derivative raises `InputError` from `tangent`, `adjoint` or
    `differentiable`."""

    discretisation: Discretisation
    layout: Layout
    device: Any
    launch: KernelLauncher
    turn: Turn
    containment: Containment
    step_number: wp.array
    """(members,) number of the next step, which `step` increments; equal in all scenes of a batch."""
    generation: int
    """Number of replacements of arrays or launches; graphs captured before the last replacement are stale."""

    def new_state(self, requires_grad: bool = False) -> State:
        """Make a state of this solver's particles, all 0."""

    def new_parameters(self, steps: int, requires_grad: bool = False) -> Parameters:
        """Make the parameters of a run of ``steps`` steps, all 0."""

    def new_log(self, steps: int) -> StepLog:
        """Make a log with room for ``steps`` steps."""

    def set_substeps(self, substeps: int) -> None:
        """Set the number of explicit substeps of diffusion in each step."""

    def reset(self, step: int = 0) -> None:
        """Prepare to take a step; forget the counts and flags from that step on."""

    def make_room(self) -> bool:
        """Lengthen neighbour lists that were too short. If the result is True, repeat the steps that used the lists."""

    def step(self, state: State, new_state: State, parameters: Parameters, log: Any) -> None:
        """Take one step, and record it in a log of `new_log`; the two states may be one object."""

    def reserve(self, counts: Counts) -> None:
        """Make room for all intermediate values of a step."""

    def replay(self, state: State, parameters: Parameters, counts: Counts) -> None:
        """Take a step again, bit for bit, and keep every intermediate value."""

    def write_state(self, counts: Counts, parameters: Parameters, new_state: State) -> None:
        """Write the result of the step that was replayed."""

    def context(self, parameters: Parameters) -> StepContext:
        """Return the context of the present step, which its parts read."""

    def tangent(self, parameters_dot: Parameters) -> StepTangent:
        """Return the tangent of steps along tangents of the parameters (forward mode)."""

    def adjoint(self, steps: int) -> StepAdjoint:
        """Return the adjoint of the steps of a run of ``steps`` steps (reverse mode)."""

    def differentiable(self) -> Self:
        """Return a copy of this solver with arrays that Warp's tape can differentiate."""

    def match(self, other: Self) -> None:
        """Copy the capacities and the number of substeps of another solver, which differs only in its arrays."""

    def follow(self, other: Self) -> None:
        """Prepare to replay the step that another solver is ready to replay; only the arrays of both solvers differ."""

    def gradient_memory(self, log: Any) -> Mapping[str, float]:
        """Return the memory [bytes] that reverse mode through the steps of a log needs, by purpose."""
