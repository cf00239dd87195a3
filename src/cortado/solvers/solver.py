"""The protocol of a solver: steps, repeated steps, tangents and adjoints.

Rollouts, gradients, files and reports of runs use a solver only through the protocol `Solver`.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, Self

import warp as wp
from numpy.typing import NDArray

from cortado.device.launching import HostCopy, KernelLauncher
from cortado.device.threads import Turn
from cortado.particles.neighbourhood import Discretisation
from cortado.particles.state import Fields, Layout, Parameters, State
from cortado.solvers.containment import Containment
from cortado.sph.parts import StepContext

Counts = tuple[int, ...]
"""Numbers of iterations of each loop in a step. With these numbers, a step can be repeated exactly."""


class StepLog(Protocol):
    """Protocol of a log with the diagnostics of each step. The numbers stay on the device until `read` is called."""

    @property
    def diagnostics(self) -> Mapping[str, NDArray]:
        """Return arrays (steps,) of diagnostics by name up to the last `read`; a batch has arrays (steps, batch).

        Every solver has ``converged``. The log of PCISPH also has ``iterations``, ``density_errors`` and
        ``greatest_density_errors``. The two errors are the mean and the maximum of the particles' relative compression.
        The log of the projection also has ``divergence``. Reports plot ``density_errors``, and treat integer
        diagnostics as numbers of iterations.
        """

    @property
    def copies(self) -> Sequence[HostCopy]:
        """Return the host copies of the log's arrays."""

    def is_calm(self, limits: Mapping[str, float]) -> bool:
        """Return True if all loops converged in the steps of the last `read`, and no diagnostic exceeds ``limits``."""

    def read(self, steps: int) -> None:
        """Set ``steps`` as the number of steps in the last run. The diagnostics of the last run are read from the
        device when needed."""

    def assign(self, other: Self) -> None:
        """Copy the diagnostics from a log of a solver of the same kind, with the same length."""

    def seek(self, step: int) -> Counts:
        """Return how often each loop iterated in step ``step``, and prepare the loops to repeat the step. For a batch,
        each number is the greatest over all scenes."""


class StepTangent(Protocol):
    """Protocol of the tangent of a repeated step (forward mode).

    A solver with pressures also has the `Tangents` ``dot``, and the methods ``pressures(rounds)`` and
    ``stresses(rounds)``. The methods return tangents of pressures on walls and for pressure sensors [Pa], for sorted
    particles (n,). The list ``rounds`` has the number of pressure iterations of each scene.
    """

    def step(self, counts: Counts, state_dot: State, parameters: Parameters) -> None:
        """Update ``state_dot`` from the tangent before the repeated step to the tangent after the step."""


class StepAdjoint(Protocol):
    """Protocol of the adjoint of a repeated step (reverse mode).

    A solver with pressures also has the method ``from_within(counts, within, state_bar, parameters)``. The method
    writes the adjoint of the state before the step to ``state_bar``, given the adjoints ``within`` the step.
    """

    def begin(self) -> None:
        """Set the adjoints of the parameters to 0."""

    def step(self, counts: Counts, state_bar: State, parameters: Parameters) -> None:
        """Update ``state_bar`` from the adjoint after the repeated step to the adjoint before the step."""

    def collect(self) -> Parameters:
        """Return the adjoints of the parameters, summed over all steps since `begin`."""


@dataclass(frozen=True)
class WithinBar:
    """Adjoints of intermediate quantities of sorted particles in a step."""

    fields: Fields
    p: wp.array
    """Array of shape (n,) with the adjoints of pressures on walls."""
    stress: wp.array | None
    """Array of shape (n,) with the adjoints of pressures for pressure sensors, or None."""
    v_star: wp.array
    """Array of shape (n,) with the adjoints of velocities after explicit forces."""


class Solver(Protocol):
    """Protocol of the solver of a scene or of a batch, on one device. Several rollouts may share a solver.

    Only `make_room`, and `reset` to a later step than the first, wait for the device. A rollout captures `reset` to the
    first step as a graph. A solver without derivatives raises `InputError` from `tangent`, `adjoint` and
    `differentiable`.
    """

    discretisation: Discretisation
    layout: Layout
    device: Any
    launch: KernelLauncher
    turn: Turn
    containment: Containment
    step_number: wp.array
    """Array of shape (members,) with the number of each scene's next step."""
    generation: int
    """Number of times that arrays or launches were replaced. After a replacement, captured CUDA graphs are invalid."""

    def new_state(self, requires_grad: bool = False) -> State:
        """Make a state of the solver's particles with the value 0 everywhere."""

    def new_parameters(self, steps: int, requires_grad: bool = False) -> Parameters:
        """Make the parameters of a run of ``steps`` steps with the value 0 everywhere."""

    def new_log(self, steps: int) -> StepLog:
        """Make a log with room for ``steps`` steps."""

    def set_substeps(self, substeps: int) -> None:
        """Set the number of explicit diffusion substeps in each step."""

    def reset(self, step: int = 0) -> None:
        """Prepare to take step ``step``, and forget all records of this step and later steps."""

    @property
    def copies(self) -> Sequence[HostCopy]:
        """Return host copies of the arrays that `make_room` and the search for lost particles read."""

    def make_room(self) -> bool:
        """Lengthen neighbour lists that were too short. Return True if steps must be repeated with the longer lists."""

    def step(self, state: State, new_state: State, parameters: Parameters, log: Any) -> None:
        """Take one step, and record the step in ``log``. ``state`` and ``new_state`` may be the same object."""

    def reserve(self, counts: Counts) -> None:
        """Allocate arrays for the intermediate values of a step with ``counts`` iterations."""

    def replay(self, state: State, parameters: Parameters, counts: Counts) -> None:
        """Repeat a step exactly (bit for bit), and store every intermediate value."""

    def write_state(self, counts: Counts, parameters: Parameters, new_state: State) -> None:
        """Write the result of the repeated step to ``new_state``."""

    def context(self, parameters: Parameters) -> StepContext:
        """Return the context of the current step."""

    def tangent(self, parameters_dot: Parameters) -> StepTangent:
        """Return the tangent of a step (forward mode), given tangents of the parameters."""

    def adjoint(self, steps: int) -> StepAdjoint:
        """Return the adjoint of a step (reverse mode), for a run of ``steps`` steps."""

    def differentiable(self) -> Self:
        """Return a copy of the solver with arrays that ``warp.Tape`` can differentiate."""

    def match(self, other: Self) -> None:
        """Copy the capacities and the number of substeps from a solver of the same kind."""

    def follow(self, other: Self) -> None:
        """Prepare to repeat the same step as the solver ``other``, which is of the same kind."""

    def gradient_memory(self, log: Any) -> Mapping[str, float]:
        """Return the memory [bytes] that reverse mode needs for the steps of a log, by purpose."""
