"""Lengths of a rollout's steps: fixed, or chosen on the device before each step, recorded, and reused when the step is
repeated. Some adaptive steps of the projection are taken again with a shorter length.

A step is taken again if it compresses fluid or loses a particle. Between facing walls, closer than a spacing, a
pressure that is right on one side of the middle is wrong on the other. If a step moves a particle too far there, it
oscillates, and then passes through a wall. A step keeps its length if a shorter one does not help, because fluid was
compressed before, or because repairs compress it. Only the state before a step decides, so that a resumed run has the
steps of an uninterrupted one.
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
"""Fraction of the density: a step that adds more compression than this to a particle is taken again. In dam breaks,
with ink and with a jug that pours, repairs added at most 0.15."""
SHORTER = 0.25
"""Factor by which a retaken step is shortened."""
TIMES = 2
"""Greatest number of times that a step is shortened."""
LEAST_SHARE = 0.01
"""Least length of a shortened step, as a part of the length that its state alone allows."""
HELPED = 0.5
"""A shortened step counts as a help if it adds at most this part of the compression of the longer one."""


@dataclass(frozen=True)
class Try:
    """The length and outcome of one attempt at a step."""

    size: float
    """Length of the step [s]."""
    added: float
    """Greatest compression that the step added to a particle; infinite if a particle was lost."""


class Retaken:
    """The record of steps of one run that were taken again with a shorter length."""

    def __init__(self) -> None:
        self._tries: dict[tuple[int, int], tuple[float, list[Try]]] = {}
        self._settled: set[tuple[int, int]] = set()

    def found(
        self, first: int, added: NDArray, sizes: NDArray, longest: NDArray, lost: dict[int, int]
    ) -> dict[tuple[int, int], float]:
        """Return new lengths [s] by (step, scene) for steps to retake, the first of each scene. Arrays are (steps,
        members): compression ``added``, ``sizes`` and ``longest`` that states allow [s]; ``lost`` has the step in which
        a scene lost a particle."""
        again = {}
        for member in range(added.shape[1]):
            end = lost.get(member, first + len(added))
            pressing = [first + int(n) for n in np.flatnonzero(added[:, member] > PRESSED) if first + n < end]
            for step in (*pressing, end) if first <= end < first + len(added) else pressing:
                n, key = step - first, (step, member)
                now = Try(float(sizes[n, member]), np.inf if step == end else float(added[n, member]))
                if key not in self._settled and (size := self._next(key, now, LEAST_SHARE * float(longest[n, member]))):
                    again[key] = size
                    break
        return again

    def _next(self, key: tuple[int, int], now: Try, least: float) -> float | None:
        """Return the next length [s] to try for a step that failed; None if it keeps its length."""
        least, tries = self._tries.setdefault(key, (least, []))
        tries.append(now)
        helped = len(tries) == 1 or not np.isfinite(tries[-2].added) or now.added <= HELPED * tries[-2].added
        if helped and len(tries) <= TIMES and SHORTER * now.size >= least:
            return SHORTER * now.size
        self._settled.add(key)
        whole = [one for one in tries if np.isfinite(one.added)]
        stays = whole[0] if whole and not helped else now
        return None if stays is now else stays.size


class Compressions:
    """The greatest compression that each step of a run adds to any particle, recorded on the device."""

    def __init__(self, solver: ProjectionSteps, steps: int):
        layout, device = solver.layout, solver.device
        self._solver, (self._compare, self._record) = solver, compression_kernels(layout.precision)
        self._each = wp.zeros(layout.all_particles, dtype=layout.precision.pair, device=device)
        self._greatest = sum_and_maximum(layout.particles, layout.precision, device, layout.members)
        self._added = wp.zeros((steps, layout.members), dtype=layout.precision.real, device=device)

    def measure(self, state: State) -> None:
        """Record the compression added by the step that led to ``state``; kernel launches only."""
        solver = self._solver
        repaired = solver.repaired[0]
        solver.launch(
            self._compare,
            particles=solver.layout.particles,
            first_waiting=solver.system.waiting,
            order=solver.search.order,
            n=solver.fields["n"],
            excess=repaired["excess"],
            x_free=repaired["x_now"],
            x=state.positions,
            added=self._each,
        )
        solver.launch(
            self._record,
            greatest=self._greatest(self._each),
            step=solver.step_number,
            added=self._added,
            threads=solver.layout.members,
        )

    def read(self, first: int, last: int) -> NDArray[np.float64]:
        """Return the added compressions (last - first, members) [-] of the steps between two numbers."""
        return np.asarray(self._added[first:last].numpy(), dtype=np.float64)


@cache
def compression_kernels(precision: Precision) -> tuple[Any, Any]:
    """Return two kernels: the compression that a step adds to each particle, and its maximum in each scene. They have
    no derivatives: a chosen step is held constant."""
    real, pair, vector = precision.real, precision.pair, precision.vector
    module = kernel_module(f"compressions_{precision.name}")
    typed = TypesByName(real, {pair: "added greatest", vector: "x", wp.int32: "order step"})

    @wp.kernel(module=module, enable_backward=False)
    @typed.arrays
    def compare(particles: int, first_waiting: int, order, n, excess, x_free, x, added):
        """Write to ``added`` a pair (0, growth of compression) per sorted particle: (n - 1)+ as the last repair finds
        it less its value before the step. Particles moved by a nozzle, perhaps inside walls, add nothing."""
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
"""Least fraction of its other bounds to which the fluid's speed shortens a step. Faster fluid was thrown about, ever
faster from step to step, by walls that leave it no room."""


class Scheduled(Protocol):
    """Protocol of scheduled parameters in the scenes of a batch, as functions of time."""

    def longest(self, times: NDArray) -> NDArray:
        """Return the longest steps (members,) [s] that may begin at times (members,) [s]."""

    def fill(self, step: int, times: NDArray, sizes: NDArray) -> None:
        """Write the scheduled parameters for a step, given its number, and its times and lengths (members,) [s]."""


@dataclass(frozen=True)
class RecordedSizes:
    """The step lengths and times of one evaluation, read from the device."""

    sizes: NDArray
    """Lengths (steps + 1, members) [s] of each step, and of the one that would follow."""
    times: NDArray
    """Times (steps + 1, members) [s] of each state."""


class StepSizes:
    """The lengths of the steps of a rollout; in this base class a parameter of the scene, equal for all."""

    longest_chunk = 2**31
    """Greatest number of steps before the host must read."""
    end = inf
    """Time [s] at which the run ends at the latest; infinite where it takes all of its steps."""

    def begin_at(self, state: State) -> None:
        """Choose the length of the first step, from the first state."""

    def go_on(self, step: int, state: State, sizes: NDArray | None) -> bool:
        """Resume after ``step`` steps of lengths ``sizes`` (step,) [s] that an earlier process took, and choose the
        next. Returns True if the run ends with the state."""
        return False

    def choose(self, state: State) -> None:
        """Choose the length of the step after ``state``, which the solver has counted; kernel launches only."""

    def seek(self, step: int) -> None:
        """Set the solver to the recorded length of a step, counted from 0."""

    def read(self, first: int, last: int) -> tuple[int, bool]:
        """Read the lengths of the steps after states ``first`` to ``last``. Returns the last state that belongs to the
        run, and True if the run ends with it."""
        return last, False

    def again(self, first: int, last: int) -> bool:
        """Test if steps between these states, already taken, must be retaken with a shorter length."""
        return False

    def is_end(self, step: int) -> bool:
        """Test if the run ends with the state after ``step`` steps, whose length was read."""
        return False

    def of_step(self, step: int) -> NDArray | None:
        """Return the lengths (members,) [s] of a step that the host has read; None where a parameter has it."""
        return None

    def diagnostics(self, steps: int) -> dict[str, NDArray]:
        """Return diagnostics of the first steps: arrays (steps,) by name, in a batch (steps, batch)."""
        return {}

    def recorded(self) -> RecordedSizes | None:
        """Return the recorded lengths and times that the next evaluation overwrites; None for fixed steps."""
        return None

    def assign(self, recorded: RecordedSizes | None) -> None:
        """Restore the lengths and times that another evaluation recorded."""


class ChosenSteps(StepSizes):
    """Step lengths that each scene's state chooses on the device: see `choose` of `step_size_kernels`. They depend on
    the greatest speed, a maximum with bits independent of order, and on the clock's last step, so a resumed run has the
    steps of an unbroken one."""

    def __init__(self, solver: Solver, parameters: Parameters, steps: int, length: float):
        """Prepare the arrays for at most ``steps`` steps; ``length`` is how far a particle may move in one [m]."""
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
        """Prepare a run with upper bounds (steps, members) [s]; with ``scheduled`` parameters the host reads each step.
        Returns clocks of the first states, which learn the times of later ones."""
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
        """Resume after steps of known lengths; times are summed as on the device, one by one in float64."""
        assert sizes is not None
        times = np.cumsum([self._read.times[0, 0], *sizes[: step - 1].astype(np.float64)])
        self._sizes[:step].assign(sizes[:step, None])
        self._times[:step].assign(times[:, None])
        self._solver.step_number.fill_(step)
        self._choose(state)
        for first, last in [(0, step)] if self._scheduled is None else [(n, n) for n in range(step + 1)]:
            self._look(first, last)
        return self.is_end(step)

    def end_after(self, duration: float) -> None:
        """Make the run of a single scene end with the first state at least ``duration`` [s] after its first."""
        self.end = float(self._read.times[0, 0]) + duration

    def choose(self, state: State) -> None:
        if self._compressions is not None:
            self._compressions.measure(state)
        self._choose(state)

    def _choose(self, state: State) -> None:
        launch = self._solver.launch
        launch(self._speeds, v=state.velocities, squares=self._squares)
        launch(
            self._choice,
            length=self._length,
            least=LEAST,
            growth=GROWTH,
            greatest=self._greatest(self._squares),
            bounds=self._bounds,
            first=self._first,
            step=self._solver.step_number,
            times=self._times,
            sizes=self._sizes,
            longest=self._longest,
            time_step=self._parameters["time_step"],
            threads=self._solver.layout.members,
        )

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
        """Read the lengths and times of these steps; with scheduled parameters, shorten the last one to their bound and
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
    """Return the two kernels that choose a time step, ``speeds`` and ``choose``. They have no derivatives: a chosen
    step is held constant."""
    real, pair, vector = precision.real, precision.pair, precision.vector
    module = kernel_module(f"step_sizes_{precision.name}")

    typed = TypesByName(real, {pair: "greatest squares", vector: "v", wp.int32: "step"})

    @wp.kernel(module=module, enable_backward=False)
    @typed.arrays
    def speeds(v, squares):
        """Write for each particle a pair (0, squared speed), from which a reduction takes the maximum."""
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
        """Write dt = min(bound, max(length / max |v|, least bound), growth dt of the step before), and the time at
        which it begins.

        ``length``: how far a particle may move in a step; ``first``: dt of the step before the first, 0 where there was
        none; ``longest`` is dt without it. Where no particle moves, nothing is divided by its speed. A speed that is
        not finite bounds nothing: its particle is lost, and the bound stands until the host has seen it.
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
