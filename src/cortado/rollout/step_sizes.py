"""Lengths of a rollout's steps: fixed, or chosen on the device before each step, recorded, and reused for repeats.

An adaptive step of the projection is retaken with a shorter length if it compresses fluid or loses a particle, as
between facing walls that are closer than a spacing. The step keeps its length if a shorter step does not help. Only the
state before a step decides, so that a resumed run has the steps of an uninterrupted run.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from math import inf
from typing import Any, Protocol

import numpy as np
import warp as wp
from numpy.typing import NDArray

from cortado.device.modules import kernel_module
from cortado.device.precision import Precision, TypesByName
from cortado.device.reduction import sum_and_maximum
from cortado.particles.state import Parameters, State
from cortado.scene.restart import Clock, RecordedClock
from cortado.solvers.projection.steps import ProjectionSteps
from cortado.solvers.solver import Solver

PRESSED = 0.2
"""Greatest compression, as a fraction of the density, that a step may add to a particle without being retaken."""
SHORTER = 0.25
"""Factor by which a retaken step is shortened."""


@dataclass(frozen=True)
class Try:
    size: float
    """Length of the step [s]."""
    added: float
    """Greatest compression that the step added to a particle; infinite if a particle was lost."""


class Retaken:
    """The steps of a run that were retaken with a shorter length."""

    def __init__(self) -> None:
        self._tries: dict[tuple[int, int], tuple[float, list[Try]]] = {}
        self._settled: set[tuple[int, int]] = set()

    def found(
        self, first: int, added: NDArray, sizes: NDArray, longest: NDArray, lost: dict[int, int]
    ) -> dict[tuple[int, int], float]:
        """Return new lengths [s] by (step, scene) for the first step of each scene to retake. Arrays (steps, members):
        ``added`` compression, ``sizes`` [s], and ``longest`` lengths [s] that states allow. ``lost``: number of the
        step in which a scene lost a particle."""
        again = {}
        for member in range(added.shape[1]):
            end = lost.get(member, first + len(added))
            pressing = [first + int(n) for n in np.flatnonzero(added[:, member] > PRESSED) if first + n < end]
            for step in (*pressing, end) if first <= end < first + len(added) else pressing:
                n, key = step - first, (step, member)
                now = Try(float(sizes[n, member]), np.inf if step == end else float(added[n, member]))
                if key not in self._settled and (size := self._next(key, now, 0.01 * float(longest[n, member]))):
                    again[key] = size
                    break
        return again

    def _next(self, key: tuple[int, int], now: Try, least: float) -> float | None:
        """Return the next length [s], at least ``least``, of a failed step; None if the step keeps its length."""
        least, tries = self._tries.setdefault(key, (least, []))
        tries.append(now)
        helped = len(tries) == 1 or not np.isfinite(tries[-2].added) or now.added <= 0.5 * tries[-2].added
        if helped and len(tries) <= 2 and SHORTER * now.size >= least:
            return SHORTER * now.size
        self._settled.add(key)
        whole = [one for one in tries if np.isfinite(one.added)]
        stays = whole[0] if whole and not helped else now
        return None if stays is now else stays.size


class Compressions:
    """The greatest compression that each step of a run adds to a particle, recorded on the device."""

    def __init__(self, solver: ProjectionSteps, steps: int):
        layout, device = solver.layout, solver.device
        self._solver, (self._compare, self._record) = solver, compression_kernels(layout.precision)
        self._each = wp.zeros(layout.all_particles, dtype=layout.precision.pair, device=device)
        self._greatest = sum_and_maximum(layout.particles, layout.precision, device, layout.members)
        self._added = wp.zeros((steps, layout.members), dtype=layout.precision.real, device=device)

    def measure(self, state: State) -> None:
        """Record the compression added by the step before ``state``; kernel launches only."""
        solver, members = self._solver, self._solver.layout.members
        numbers = {"particles": solver.layout.particles, "first_waiting": solver.system.waiting}
        now = {"order": solver.search.order, "n": solver.fields["n"], "x": state.positions}
        repaired = {"excess": solver.repaired[0]["excess"], "x_free": solver.repaired[0]["x_now"]}
        solver.launch(self._compare, numbers, now, repaired, added=self._each)
        greatest = {"greatest": self._greatest(self._each), "step": solver.step_number}
        solver.launch(self._record, greatest, added=self._added, threads=members)

    def read(self, first: int, last: int) -> NDArray[np.float64]:
        """Return the added compressions (last - first, members) [-] of steps ``first`` to ``last``."""
        return np.asarray(self._added[first:last].numpy(), dtype=np.float64)


@cache
def compression_kernels(precision: Precision) -> tuple[Any, Any]:
    """Return two kernels without derivatives: added compression of each particle, and its maximum in each scene."""
    real, pair, vector = precision.real, precision.pair, precision.vector
    module = kernel_module(f"compressions_{precision.name}")
    typed = TypesByName(real, {pair: "added greatest", vector: "x", wp.int32: "order step"})

    @wp.kernel(module=module, enable_backward=False)
    @typed.arrays
    def compare(particles: int, first_waiting: int, order, n, excess, x_free, x, added):
        """Write to ``added`` a pair (0, growth of compression) per sorted particle. Compression is (n - 1)+, at the
        last repair and before the step. Particles in a nozzle, perhaps inside walls, add 0."""
        i = wp.tid()
        more = wp.max(excess[i], real(0.0)) - wp.max(n[i] - real(1.0), real(0.0))
        p = order[i]
        let_go = bool(True)
        if p % particles >= first_waiting:
            let_go = x[p] == x_free[i]
        if not let_go:
            more = real(0.0)
        added[i] = pair(real(0.0), more)

    @wp.kernel(module=module, enable_backward=False)
    @typed.arrays
    def record(greatest, step, added: wp.array2d(dtype=real)):
        b = wp.tid()
        added[step[b] - 1, b] = greatest[b][1]

    return compare, record


GROWTH = 1.1
"""Greatest ratio of the lengths of two successive steps."""
LEAST = 1e-6
"""Least length to which the fluid's speed shortens a step, as a fraction of the other bounds."""


class Scheduled(Protocol):
    """Protocol of scheduled parameters of all scenes of a batch, as functions of time."""

    def longest(self, times: NDArray) -> NDArray:
        """Return the longest steps (members,) [s] that may begin at times (members,) [s]."""

    def fill(self, step: int, times: NDArray, sizes: NDArray) -> None:
        """Write the scheduled parameters of a step with times and lengths (members,) [s]."""


@dataclass(frozen=True)
class RecordedSizes:
    sizes: NDArray
    """Lengths (steps + 1, members) [s] of all steps and the next."""
    times: NDArray
    """Times (steps + 1, members) [s] of all states."""


class StepSizes:
    """The lengths of the steps of a rollout, in this base class fixed by the parameter ``time_step``."""

    longest_chunk = 2**31
    """Greatest number of steps between two reads by the host."""
    end = inf
    """Latest time [s] of the end of the run; infinite if the number of steps determines the end."""

    def begin_at(self, state: State) -> None:
        """Choose the length of the first step."""

    def go_on(self, step: int, state: State, sizes: NDArray | None) -> bool:
        """Choose the length of the step after ``step`` steps of lengths ``sizes`` (step,) [s] by an earlier process.
        Return True if the run ends with the state."""
        return False

    def choose(self, state: State) -> None:
        """Choose the length of the step after ``state``; kernel launches only."""

    def seek(self, step: int) -> None:
        """Set the solver to the recorded length of a step, counted from 0."""

    def read(self, first: int, last: int) -> tuple[int, bool]:
        """Read the lengths of the steps after states ``first`` to ``last``. Return the number of the run's last state
        among them, and True if the run ends there."""
        return last, False

    def again(self, first: int, last: int) -> bool:
        """Test if steps between states ``first`` and ``last`` must be retaken with a shorter length."""
        return False

    def is_end(self, step: int) -> bool:
        """Test if the run ends with the state after ``step`` steps."""
        return False

    def of_step(self, step: int) -> NDArray | None:
        """Return the lengths (members,) [s] of a step; None for fixed steps."""
        return None

    def diagnostics(self, steps: int) -> dict[str, NDArray]:
        """Return diagnostics of the first steps: arrays (steps,) by name, in a batch (steps, batch)."""
        return {}

    def recorded(self) -> RecordedSizes | None:
        """Return the recorded lengths and times; None for fixed steps."""
        return None

    def assign(self, recorded: RecordedSizes | None) -> None:
        """Restore recorded lengths and times."""


class ChosenSteps(StepSizes):
    """Step lengths chosen on the device from each scene's state, see `choose` of `step_size_kernels`."""

    def __init__(self, solver: Solver, parameters: Parameters, steps: int, length: float):
        """Prepare the arrays for ``steps`` steps, in each of which a particle may move by ``length`` [m]."""
        layout, device, real = solver.layout, solver.device, solver.layout.precision.real
        shape = (steps + 1, layout.members)
        self._solver, self._parameters, self._length = solver, parameters, length
        self._speeds, self._choice = step_size_kernels(layout.precision)
        self._squares = wp.zeros(layout.all_particles, dtype=layout.precision.pair, device=device)
        self._greatest = sum_and_maximum(layout.particles, layout.precision, device, layout.members)
        self._sizes, self._longest = (wp.zeros(shape, dtype=real, device=device) for _ in range(2))
        self._times = wp.zeros(shape, dtype=wp.float64, device=device)
        self._bounds = wp.zeros((max(steps, 1), layout.members), dtype=real, device=device)
        self._first = wp.zeros(layout.members, dtype=real, device=device)
        self._read = RecordedSizes(np.zeros(shape), np.zeros(shape))
        self._scheduled: Scheduled | None = None
        self._compressions = Compressions(solver, steps) if isinstance(solver, ProjectionSteps) else None
        self._steps, self._retaken = steps, Retaken()
        self.end = inf
        self.longest_chunk = StepSizes.longest_chunk

    def begin(self, clocks: Sequence[Clock], bounds: NDArray, scheduled: Scheduled | None) -> list[Clock]:
        """Prepare a run with upper bounds (steps, members) [s], and return clocks that record times. With
        ``scheduled`` parameters the host reads every step."""
        self._steps, room = len(bounds), len(self._bounds)
        self._bounds.assign(np.pad(bounds, ((0, room - len(bounds)), (0, 0)), mode="edge"))
        self._first.assign([clock.time_step for clock in clocks])
        self._times[0].assign([clock.time for clock in clocks])
        self._scheduled, self._retaken, self.end = scheduled, Retaken(), inf
        self.longest_chunk = StepSizes.longest_chunk if scheduled is None else 1
        found = self._read = RecordedSizes(np.zeros(self._sizes.shape), np.zeros(self._times.shape))
        own = zip(clocks, found.times.T, found.sizes.T, strict=True)
        return [RecordedClock(c.steps, c.time, c.time_step, times, sizes) for c, times, sizes in own]

    def begin_at(self, state: State) -> None:
        self._solver.step_number.fill_(0)
        self._choose(state)
        self._look(0, 0)

    def go_on(self, step: int, state: State, sizes: NDArray | None) -> bool:
        assert sizes is not None
        times = np.cumsum([self._read.times[0, 0], *sizes[: step - 1].astype(np.float64)])  # in the device's order
        self._sizes[:step].assign(sizes[:step, None])
        self._times[:step].assign(times[:, None])
        self._solver.step_number.fill_(step)
        self._choose(state)
        for first, last in [(0, step)] if self._scheduled is None else [(n, n) for n in range(step + 1)]:
            self._look(first, last)
        return self.is_end(step)

    def end_after(self, duration: float) -> None:
        """End the run of a single scene with the first state at least ``duration`` [s] after its start."""
        self.end = float(self._read.times[0, 0]) + duration

    def choose(self, state: State) -> None:
        if self._compressions is not None:
            self._compressions.measure(state)
        self._choose(state)

    def _choose(self, state: State) -> None:
        solver = self._solver
        solver.launch(self._speeds, v=state.velocities, squares=self._squares)
        limits = {"length": self._length, "least": LEAST, "growth": GROWTH, "bounds": self._bounds}
        known = {"first": self._first, "greatest": self._greatest(self._squares), "step": solver.step_number}
        found = {"times": self._times, "sizes": self._sizes, "longest": self._longest}
        time_step = self._parameters["time_step"]
        solver.launch(self._choice, limits, known, found, time_step=time_step, threads=solver.layout.members)

    def seek(self, step: int) -> None:
        wp.copy(self._parameters["time_step"], self._sizes[step])

    def read(self, first: int, last: int) -> tuple[int, bool]:
        self._look(first + 1, last)
        past = np.flatnonzero(self._read.times[first + 1 : last + 1, 0] >= self.end)
        return (first + 1 + int(past[0]), True) if len(past) else (last, False)

    def again(self, first: int, last: int) -> bool:
        if self._compressions is None:
            return False
        taken, longest = (array[first:last].numpy() for array in (self._sizes, self._longest))
        lost = {member: one.step for member, one in self._solver.containment.lost().items()}
        found = self._retaken.found(first, self._compressions.read(first, last), taken, longest, lost)
        if not found:
            return False
        sizes, bounds = self._sizes.numpy(), self._bounds.numpy()
        for key, size in found.items():
            sizes[key] = bounds[key] = size
        self._sizes.assign(sizes)
        self._bounds.assign(bounds)
        self._look(first, first)
        return True

    def is_end(self, step: int) -> bool:
        return bool(self._read.times[step, 0] >= self.end)

    def _look(self, first: int, last: int) -> None:
        """Read the lengths and times of steps; with scheduled parameters, shorten the last step to their bound and
        write their rows."""
        for found, array in ((self._read.sizes, self._sizes), (self._read.times, self._times)):
            found[first : last + 1] = array[first : last + 1].numpy()
        if self._scheduled is None:
            return
        times, sizes = self._read.times[last], self._read.sizes[last]
        longest = self._scheduled.longest(times)
        if (sizes > longest).any():
            own = self._sizes[last : last + 1]
            own.assign(np.minimum(sizes, longest)[None])
            sizes[:] = own.numpy()[0]
            self.seek(last)
        if last < self._steps:
            self._scheduled.fill(last, times, sizes)

    def of_step(self, step: int) -> NDArray:
        return self._read.sizes[step].copy()

    def diagnostics(self, steps: int) -> dict[str, NDArray]:
        found = self._read.sizes[:steps]
        return {"time_steps": found[:, 0] if self._solver.layout.batch is None else found}

    def recorded(self) -> RecordedSizes:
        return self._read

    def assign(self, recorded: RecordedSizes | None) -> None:
        assert recorded is not None
        self._read = recorded
        self._sizes.assign(recorded.sizes)
        self._times.assign(recorded.times)


@cache
def step_size_kernels(precision: Precision) -> tuple[Any, Any]:
    """Return two kernels without derivatives: ``speeds`` computes squared speeds of particles, ``choose`` the time step
    of each scene."""
    real, pair, vector = precision.real, precision.pair, precision.vector
    module = kernel_module(f"step_sizes_{precision.name}")
    typed = TypesByName(real, {pair: "greatest squares", vector: "v", wp.int32: "step"})

    @wp.kernel(module=module, enable_backward=False)
    @typed.arrays
    def speeds(v, squares):
        i = wp.tid()
        squares[i] = pair(real(0.0), wp.length_sq(v[i]))

    @wp.kernel(module=module, enable_backward=False)
    @typed.arrays
    def choose(
        length: real,
        least: real,
        growth: real,
        greatest,
        bounds: wp.array2d(dtype=real),
        first,
        step,
        times: wp.array2d(dtype=wp.float64),
        sizes: wp.array2d(dtype=real),
        longest: wp.array2d(dtype=real),
        time_step,
    ):
        """Write dt = min(bound, max(length / max |v|, least bound), growth dt of the step before), and the time before
        the step.

        ``length``: greatest move of a particle in a step; ``first``: dt of the step before the first step, or 0;
        ``longest``: dt without the last term. Speeds of 0, and infinite speeds of lost particles, do not bound dt.
        """
        b = wp.tid()
        n = step[b]
        dt = bounds[wp.min(n, bounds.shape[0] - 1), b]
        speed = wp.sqrt(greatest[b][1])
        if wp.isfinite(speed) and dt * speed > length:
            dt = wp.max(length / speed, least * dt)
        longest[n, b] = dt
        before = first[b]
        if n > 0:
            before = sizes[n - 1, b]
            times[n, b] = times[n - 1, b] + wp.float64(before)
        if before > real(0.0):
            dt = wp.min(dt, growth * before)
        sizes[n, b] = dt
        time_step[b] = dt

    return speeds, choose
