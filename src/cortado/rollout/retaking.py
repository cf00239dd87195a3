"""Which steps of the projection that were chosen are taken again, shorter: those that press fluid together, or lose a
particle.

Between walls that face one another, nearer than a spacing, a pressure that is right on one side of the middle is wrong
on the other. A particle that a step takes too far goes to and fro there, and then through a wall. No shorter step mends
what was compressed before it, nor what repairs do by themselves: then a step stays as long as it was. The state before
a step alone decides, so that a run that goes on has the steps of one that did not stop.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from cortado.device.modules import kernel_module
from cortado.device.precision import Precision
from cortado.device.reduction import sum_and_maximum
from cortado.particles.state import State
from cortado.solvers.projection.steps import ProjectionSteps

PRESSED = 0.2
"""Of the density: a step that compresses a particle by more than this, beyond what it was before, is taken again. In
dam breaks, with ink and with a jug that pours, the repairs found 0.15 at most."""
SHORTER = 0.25
"""How long it is then, in parts of what it was."""
TIMES = 2
"""How often a step is shortened at most."""
LEAST = 0.01
"""No step is shortened below so much of what its state alone allows, whatever the step before it was."""
HELPED = 0.5
"""A shorter step helps if it adds at most so much of the compression that the longer one did."""


@dataclass(frozen=True)
class Try:
    """How a step went."""

    size: float
    """[s]"""
    added: float
    """Compression, infinite where a particle was lost."""


class Retaken:
    """The steps of one run that were taken again."""

    def __init__(self) -> None:
        self._tries: dict[tuple[int, int], tuple[float, list[Try]]] = {}
        self._settled: set[tuple[int, int]] = set()

    def found(
        self, first: int, added: NDArray, sizes: NDArray, longest: NDArray, lost: dict[int, int]
    ) -> dict[tuple[int, int], float]:
        """Of the steps from one number on, which were taken, those to be taken again, each with its scene of a batch,
        and how long [s]: the first of each scene, as the later ones follow from it. All arrays are (steps, members):
        the compression that they ``added``, their ``sizes`` and the ``longest`` that their states allow [s]; ``lost``
        has the steps in which scenes lost a particle."""
        again = {}
        for member in range(added.shape[1]):
            end = lost.get(member, first + len(added))
            pressing = [first + int(n) for n in np.flatnonzero(added[:, member] > PRESSED) if first + n < end]
            for step in (*pressing, end) if first <= end < first + len(added) else pressing:
                n, key = step - first, (step, member)
                now = Try(float(sizes[n, member]), np.inf if step == end else float(added[n, member]))
                if key not in self._settled and (size := self._next(key, now, LEAST * float(longest[n, member]))):
                    again[key] = size
                    break
        return again

    def _next(self, key: tuple[int, int], now: Try, least: float) -> float | None:
        """How long a step is next that went badly [s]; None if it stays as it is."""
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
    """What the steps of one run add to the compression of a particle, at most."""

    def __init__(self, solver: ProjectionSteps, steps: int):
        layout, device = solver.layout, solver.device
        self._solver, (self._compare, self._record) = solver, compression_kernels(layout.precision)
        self._each = wp.zeros(layout.all_particles, dtype=layout.precision.pair, device=device)
        self._greatest = sum_and_maximum(layout.particles, layout.precision, device, layout.members)
        self._added = wp.zeros((steps, layout.members), dtype=layout.precision.real, device=device)

    def measure(self, state: State) -> None:
        """Of the step that led to a state, whose number the solver has counted: launches alone."""
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
        """(last - first, members) of the steps between two numbers, which were taken [-]."""
        return np.asarray(self._added[first:last].numpy(), dtype=np.float64)


@cache
def compression_kernels(precision: Precision) -> tuple[Any, Any]:
    """Kernels: what a step adds to each particle's compression, and the greatest of it in each scene. They have no
    derivatives: a chosen step is held constant."""
    real, pair, vector = precision.real, precision.pair, precision.vector
    module = kernel_module(f"compressions_{precision.name}")

    @wp.kernel(module=module, enable_backward=False)
    def compare(
        particles: int,
        first_waiting: int,
        order: wp.array(dtype=wp.int32),
        n: wp.array(dtype=real),
        excess: wp.array(dtype=real),
        x_free: wp.array(dtype=vector),
        x: wp.array(dtype=vector),
        # out
        added: wp.array(dtype=pair),
    ):
        """``added`` is a pair for a sum, which nobody reads, and a maximum, of sorted particles: (n - 1)+ as the last
        repair finds it less the same before the step. What a nozzle leads, which is not where the step has left it and
        may be in walls, adds nothing."""
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
    def record(
        greatest: wp.array(dtype=pair),
        step: wp.array(dtype=wp.int32),
        # out
        added: wp.array2d(dtype=real),
    ):
        b = wp.tid()
        added[step[b] - 1, b] = greatest[b][1]

    return compare, record
