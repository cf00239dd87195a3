"""Lengths of the time steps of a rollout, which are fixed or chosen on the device before each step.

A chosen length depends only on the state before the step, so that a resumed run has the same steps.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from math import inf
from typing import Any

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
"""Greatest accepted increase of the compression of a particle in a step, relative to the density."""
SHORTER = 0.25
"""Length of a repeated step, relative to its previous length."""


class Retaken:
    """Steps that are repeated with a shorter length, because they compress fluid or lose a particle. A step keeps its
    length if a shorter step does not help."""

    def __init__(self) -> None:
        self._tries: dict[tuple[int, int], tuple[float, list[tuple[float, float]]]] = {}
        """Shortest length [s], and tried lengths [s] with increases of compression, by (step, scene)."""
        self._settled: set[tuple[int, int]] = set()

    def found(
        self, first: int, added: NDArray, sizes: NDArray, longest: NDArray, lost: dict[int, int]
    ) -> dict[tuple[int, int], float]:
        """Return the new length [s] of the first step that each scene must repeat, by (step, scene).

        Arrays have the shape (steps, members). ``added`` is the increase of compression. ``lost`` maps the number of a
        scene to the step that lost a particle.
        """
        again = {}
        for member in range(added.shape[1]):
            end = lost.get(member, first + len(added))
            pressing = [first + int(n) for n in np.flatnonzero(added[:, member] > PRESSED) if first + n < end]
            for step in (*pressing, end) if first <= end < first + len(added) else pressing:
                n, key = step - first, (step, member)
                now = inf if step == end else float(added[n, member])
                least = 0.01 * float(longest[n, member])
                if key not in self._settled and (size := self._next(key, float(sizes[n, member]), now, least)):
                    again[key] = size
                    break
        return again

    def _next(self, key: tuple[int, int], size: float, added: float, least: float) -> float | None:
        least, tries = self._tries.setdefault(key, (least, []))
        helped = not tries or not np.isfinite(tries[-1][1]) or added <= 0.5 * tries[-1][1]
        tries.append((size, added))
        if helped and len(tries) <= 2 and SHORTER * size >= least:
            return SHORTER * size
        self._settled.add(key)
        return None if helped else next((one for one, more in tries[:-1] if np.isfinite(more)), None)


class Compressions:
    """Records on the device the greatest increase of a particle's compression in each step."""

    def __init__(self, solver: ProjectionSteps, steps: int):
        layout, device = solver.layout, solver.device
        self._solver, (self._compare, self._record) = solver, compression_kernels(layout.precision)
        self._each = wp.zeros(layout.all_particles, dtype=layout.precision.pair, device=device)
        self._greatest = sum_and_maximum(layout.particles, layout.precision, device, layout.members)
        self.added = wp.zeros((steps, layout.members), dtype=layout.precision.real, device=device)

    def measure(self, state: State) -> None:
        solver, members = self._solver, self._solver.layout.members
        numbers = {"particles": solver.layout.particles, "first_waiting": solver.system.waiting}
        now = {"order": solver.search.order, "n": solver.fields["n"], "x": state.positions}
        repaired = {"excess": solver.repaired[0]["excess"], "x_free": solver.repaired[0]["x_now"]}
        solver.launch(self._compare, numbers, now, repaired, added=self._each)
        greatest = {"greatest": self._greatest(self._each), "step": solver.step_number}
        solver.launch(self._record, greatest, added=self.added, threads=members)


@cache
def compression_kernels(precision: Precision) -> tuple[Any, Any]:
    real, pair, vector = precision.real, precision.pair, precision.vector
    module = kernel_module(f"compressions_{precision.name}")
    typed = TypesByName(real, {pair: "added greatest", vector: "x", wp.int32: "order step"})

    @wp.kernel(module=module, enable_backward=False)
    @typed.arrays
    def compare(particles: int, first_waiting: int, order, n, excess, x_free, x, added):
        """Write the increase of the compression max(n - 1, 0), with the number density n."""
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
LEAST = 1e-6
"""Shortest time step for fast fluid, relative to the bound without fluid."""


Scheduled = tuple[Callable[[NDArray], NDArray], Callable[[int, NDArray, NDArray], None]]
"""The first of the two functions maps times (members,) [s] to the longest time steps. The second function writes the
scheduled parameters of a step, given its number, times and lengths (members,) [s]."""


@dataclass(frozen=True)
class RecordedSizes:
    sizes: NDArray
    """Lengths of the time steps (steps + 1, members) [s], including the step after the last state."""
    times: NDArray
    """Times (steps + 1, members) [s] of all states."""


class StepSizes:
    """Fixed lengths of time steps, which are the values of the parameter ``time_step``."""

    longest_chunk = 2**31
    """Greatest number of steps between two reads of step lengths."""
    end = inf
    """End time of the run [s], or infinity."""

    def begin_at(self, state: State) -> None: ...

    def go_on(self, step: int, state: State, sizes: NDArray | None) -> bool:
        """Continue after ``step`` steps of lengths ``sizes`` (step,) [s]. Return True at the end of the run."""
        return False

    def choose(self, state: State) -> None: ...

    def seek(self, step: int) -> None:
        """Set the solver to the recorded length of a step. The first ``step`` is 0."""

    def read(self, first: int, last: int) -> tuple[int, bool]:
        """Read step lengths. Return the number of the last valid state, and True if the run ends at that state."""
        return last, False

    def again(self, first: int, last: int) -> bool:
        """Test if a step between two states must be repeated with a shorter length."""
        return False

    def is_end(self, step: int) -> bool:
        return False

    def of_step(self, step: int) -> NDArray | None:
        """Return the lengths (members,) [s] of a step, or None for fixed steps."""
        return None

    def diagnostics(self, steps: int) -> dict[str, NDArray]:
        """Return diagnostics by name: (steps,), or (steps, batch) for a batch."""
        return {}

    def recorded(self) -> RecordedSizes | None:
        return None

    def assign(self, recorded: RecordedSizes | None) -> None: ...


class ChosenSteps(StepSizes):
    """Step lengths that are chosen on the device from the state of each scene; see `step_size_kernels`."""

    def __init__(self, solver: Solver, parameters: Parameters, steps: int, length: float):
        """Allocate arrays for ``steps`` steps. A particle may move by ``length`` [m] in a step."""
        layout, device, real = solver.layout, solver.device, solver.layout.precision.real
        self._solver, self._parameters, self._length = solver, parameters, length
        self._speeds, self._choice = step_size_kernels(layout.precision)
        shape, bounded = (steps + 1, layout.members), (max(steps, 1), layout.members)
        self._squares = wp.zeros(layout.all_particles, dtype=layout.precision.pair, device=device)
        self._greatest = sum_and_maximum(layout.particles, layout.precision, device, layout.members)
        sizes = shape, shape, bounded, layout.members
        self._sizes, self._longest, self._bounds, self._first = (wp.zeros(n, real, device=device) for n in sizes)
        self._times = wp.zeros(shape, dtype=wp.float64, device=device)
        self._read = RecordedSizes(np.zeros(shape), np.zeros(shape))
        self._scheduled: Scheduled | None = None
        self._compressions = Compressions(solver, steps) if isinstance(solver, ProjectionSteps) else None
        self._steps, self._retaken = steps, Retaken()

    def begin(self, clocks: Sequence[Clock], bounds: NDArray, scheduled: Scheduled | None) -> list[Clock]:
        """Prepare a run with upper ``bounds`` (steps, members) [s]. Return clocks that record the times of a run."""
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
        """End the run of a single scene at the first state that is at least ``duration`` [s] after its start."""
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
        added = self._compressions.added[first:last].numpy().astype(np.float64)
        found = self._retaken.found(first, added, taken, longest, lost)
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
        of = slice(first, last + 1)
        self._read.sizes[of], self._read.times[of] = self._sizes[of].numpy(), self._times[of].numpy()
        if self._scheduled is None:
            return
        times, sizes, (longest_from, fill) = self._read.times[last], self._read.sizes[last], self._scheduled
        longest = longest_from(times)
        if (sizes > longest).any():
            own = self._sizes[last : last + 1]
            own.assign(np.minimum(sizes, longest)[None])
            sizes[:] = own.numpy()[0]
            self.seek(last)
        if last < self._steps:
            fill(last, times, sizes)

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
    """Return the kernels ``speeds`` for squared speeds and ``choose`` for time steps."""
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
        length: real, least: real, growth: real, greatest, bounds: wp.array2d(dtype=real), first, step,
        times: wp.array2d(dtype=wp.float64), sizes: wp.array2d(dtype=real), longest: wp.array2d(dtype=real), time_step,
    ):  # fmt: skip
        """Write dt = min(bounds, growth dt_0, max(length / u, least bounds)) with the greatest speed u. The previous
        step is dt_0, or ``first`` before the first step. ``longest`` is dt without the growth term."""
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
