"""Packing: particles are moved until the fluid has its rest density everywhere, in float64.

Each round of packing solves a nonlinear least-squares problem (Gauss-Newton). A solution moves the density of every
particle towards the lattice's density and keeps close pairs apart. In the density of a particle, walls count with their
weights, and points of air count as fluid. Colagrossi et al. (2012) and Negi and Ramachandran (2021) separate particles
by repulsion instead.
"""

from contextlib import nullcontext
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cortado.discretise.shapes import (
    Numbers,
    Points,
    Which,
    in_space,
    launch_on_cpu,
    pairs_within,
    recorded_on_cpu,
    shared,
)
from cortado.discretise.smoothing import SLACK, lattice_offsets, rest_volume
from cortado.discretise.walls import RestLattice
from cortado.files.terminal import timed_note

Int32s = NDArray[np.int32]
MOST_CELLS = 2_000_000
NO_LIMIT = 2**31 - 1


@dataclass(frozen=True, eq=False)
class PointsAround:
    """The points are all particles, followed by fixed points in the air and in the walls."""

    lattice: RestLattice
    points: Points
    """Points (m, d) [m]."""
    weights: Points
    """Weights of the points (m,), relative to a particle [-]."""
    air: tuple[int, int]
    """Index of the first point of air, and the index after the last point of air. ``blind`` particles ignore air."""
    lengths: Points
    """Lengths of the periodic box (d,) [m], or 0 along axes without a period."""
    reach: float
    """Search radius [m]."""

    def near(self, particles: Points) -> Which:
        return self._looked(particles, np.zeros(len(particles), dtype=bool), most=1)["counts"] > 0

    def sums(self, particles: Points, blind: Which) -> Points:
        """Return the sums of weighted kernels (n,) [1 / m^d]. Particles in ``blind`` (n,) ignore air."""
        return np.asarray(self._looked(particles, blind)["sums"])

    def lists(self, particles: Points, blind: Which) -> tuple[Int32s, Int32s, Int32s]:
        """Return starts (n,), ends (n,) and neighbours. Only neighbours with a higher index are listed."""
        room = len(lattice_offsets(self.lattice.spacing, self.reach, self.lattice.dimension))
        while True:
            starts = (room * np.arange(len(particles) + 1)).astype(np.int32)
            others = np.empty(max(starts[-1], 1), dtype=np.int32)
            counts = self._looked(particles, blind, are_own=True, starts=starts, others=others)["counts"]
            if counts.max(initial=0) <= room:
                return starts[:-1], starts[:-1] + counts, others
            room = int(counts.max())

    def _looked(self, particles: Points, blind: Which, **given: Any) -> dict[str, Any]:
        count = len(particles)
        found = {"are_own": False, "most": NO_LIMIT, "starts": np.zeros(count + 1, dtype=np.int32), **given}
        found |= {"counts": np.zeros(count, dtype=np.int32), "sums": np.zeros(count)}
        found.setdefault("others", np.zeros(1, dtype=np.int32))
        if len(self.points):
            placed, grid = self._by_cell
            where = {"around": self.on_cpu, "placed": placed, "grid": grid, "reach": self.reach}
            launch_on_cpu(self.kernels.look_around, count, x=in_space(particles), blind=blind, **where, **found)
        return found

    @property
    def volume(self) -> float:
        return rest_volume(self.lattice.kernel, self.lattice.spacing, self.lattice.support, self.lattice.dimension)

    @cached_property
    def kernels(self) -> Any:
        from cortado.device.modules import start_warp

        start_warp()
        from cortado.discretise.packing_kernels import packing_kernels

        return packing_kernels(self.lattice.kernel)

    @cached_property
    def in_space(self) -> Points:
        return in_space(self.points)

    @cached_property
    def on_cpu(self) -> Any:
        around, dimension = self.kernels.around(), self.lattice.dimension
        around.x, around.weights = shared(self.in_space), shared(self.weights)
        around.air, around.behind_air = self.air
        around.is_periodic, around.period = bool(self.lengths.any()), in_space(self.lengths)
        around.frequency = np.divide(1.0, around.period, where=np.array(around.period) > 0.0, out=np.zeros(3))
        around.per_support = 1.0 / self.lattice.support
        around.normalisation = self.lattice.kernel.normalisation(dimension, self.lattice.support)
        return around

    @cached_property
    def _by_cell(self) -> tuple[Any, Any]:
        from cortado.device.grid import Grid

        ends = self.points.min(axis=0), self.points.max(axis=0)
        cells = Grid.around(*ends, self.lengths, self.reach, MOST_CELLS)
        along = np.floor((self.in_space - cells.origin) / cells.cell).astype(np.int64) % np.array(cells.shape)
        own = (along[:, 2] * cells.shape[1] + along[:, 1]) * cells.shape[0] + along[:, 0]
        order = np.argsort(own, kind="stable").astype(np.int32)
        placed, grid = self.kernels.placed(), self.kernels.grid()
        placed.x, placed.numbers = shared(self.in_space[order]), shared(order)
        grid.origin, grid.frequency, grid.shape = cells.origin, 1.0 / cells.cell, cells.shape
        grid.starts = shared(np.append(0, np.cumsum(np.bincount(own, minlength=cells.cells))).astype(np.int32))
        return placed, grid


HIGHEST, AIM, LOWEST = 0.5 * SLACK, (-6e-3, -1e-3), -9e-3
"""Greatest value, desired range and least value of the relative density excess of a packed particle."""
ROUNDS = 6
LISTED = 0.6
NEAR = 0.9
"""Distance below which pairs of particles repel each other [spacings]."""
PUSH = 0.1
"""Weight of close pairs in the least-squares problem, relative to density errors."""
FARTHEST = 0.15
"""Greatest move of a particle in a round [spacings]."""
DAMPING, MOST_INNER_ROUNDS = 0.02, 20
"""Damping and greatest number of iterations of the linear least-squares problem."""


def density_errors(around: PointsAround, sums: Points, stays: Which) -> Points:
    """Return the relative density excess (n,). Negative values are set to 0 where ``stays`` (n,) is true."""
    errors = around.volume * sums - (1.0 - SLACK)
    return np.where(stays, np.maximum(errors, 0.0), errors)


class Relaxation:
    """Particles in ``free`` (n,) move. The density of particles in ``stays`` (n,) does not include air."""

    def __init__(self, around: PointsAround, stays: Which, free: Which):
        starts, ends, listed = around.lists(around.points[: len(free)], stays)
        self._around, self._stays, self._free, self._most = around, stays, free, int((ends - starts).sum())
        self._given = {"around": around.on_cpu, "free": free, "starts": starts, "ends": ends, "listed": listed}

    def relaxed(self) -> Points:
        spacing, places = self._around.lattice.spacing, self._around.in_space[: len(self._free)]
        first, dimension = places.copy(), self._around.points.shape[1]
        for _ in range(ROUNDS):
            moves = self._solved()
            sizes = np.linalg.norm(moves, axis=1, keepdims=True)
            places += spacing * moves * np.minimum(1.0, FARTHEST / np.maximum(sizes, FARTHEST))
            if np.abs(places - first).max() > 0.5 * (LISTED - FARTHEST) * spacing:
                break
        return places[:, :dimension].copy()

    def _solved(self) -> Points:
        from scipy.sparse.linalg import LinearOperator, lsmr

        spacing, count = self._around.lattice.spacing, len(self._free)
        self.linearise(NEAR * spacing)
        errors = density_errors(self._around, self.sums, self._stays)
        counted = (~self._stays | (errors > HIGHEST)).astype(np.float64)
        unit, held = spacing * self._around.volume * counted, ~self._free
        gaps = NEAR - self.distances / spacing
        wanted = np.concatenate([counted * (np.clip(errors, *AIM) - errors), PUSH * gaps])

        def multiply(moves: Points) -> Points:
            changes, approaches = self.multiply(moves.reshape(-1, 3))
            return np.concatenate([unit * changes, PUSH * approaches])

        def multiply_back(wrong: Points) -> Points:
            moves = self.multiply_back(unit * wrong[:count], PUSH * wrong[count:])
            moves[held] = 0.0
            return moves.ravel()

        product = LinearOperator((len(wanted), 3 * count), multiply, multiply_back, dtype=np.float64)
        found = lsmr(product, wanted, damp=DAMPING, maxiter=MOST_INNER_ROUNDS, atol=1e-3, btol=1e-3)[0]
        return np.asarray(found.reshape(-1, 3))

    def linearise(self, close: float) -> None:
        """Compute `sums` (n,) [1 / m^d], `distances` (m,) of pairs closer than ``close`` [m], and their derivatives."""
        kernels, count, most = self._around.kernels, len(self._free), self._most
        at_its_place = self._around.lattice.weights(np.zeros((1, self._around.lattice.dimension)))[0]
        self.sums, distances = np.full(count, at_its_place), np.empty(most)
        self._equations, close_starts = kernels.equations(), np.zeros(count + 1, dtype=np.int32)
        arrays: dict[str, NDArray[Any]] = {"starts": np.zeros_like(close_starts), "close_starts": close_starts}
        arrays |= {name: np.empty(most, dtype=np.int32) for name in ("others", "close_others")}
        arrays |= {name: np.empty((most, 3)) for name in ("gradients", "directions")}
        arrays["own"] = np.empty((count, 3))
        for name, array in arrays.items():
            setattr(self._equations, name, shared(array))
        equations: dict[str, Any] = {"equations": self._equations}
        given = {"sums": self.sums, "distances": distances, "close": close, **self._given, **equations}
        recorded_on_cpu(kernels.linearise, count, **given)()
        self.distances = distances[: close_starts[-1]]
        self._moves, self._changes = np.empty((count, 3)), np.empty(count)
        self._approaches = np.empty_like(self.distances)
        given = equations | {"moves": self._moves, "changes": self._changes, "approaches": self._approaches}
        self._multiply, self._multiply_back = (
            recorded_on_cpu(kernel, count, **given) for kernel in (kernels.multiply, kernels.multiply_back)
        )

    def multiply(self, moves: Points) -> tuple[Points, Points]:
        """Return the changes of `sums` (n,) and of `distances` (m,) for moves (n, 3) [m]."""
        self._moves[:], self._changes[:] = moves, 0.0
        self._multiply()
        return self._changes.copy(), self._approaches.copy()

    def multiply_back(self, changes: Points, approaches: Points) -> Points:
        self._moves[:], self._changes[:], self._approaches[:] = 0.0, changes, approaches
        self._multiply_back()
        return self._moves.copy()


MOST_LOOKS, MOST_ROUNDS = 12, 36
"""Greatest number of checks of all particles, and of least-squares rounds after each check."""
COMPRESSED, DIGITS = 0.03, 6
"""Relative density excess above which a particle may be removed, and decimal places of comparisons."""
BESIDE, MOST_OUT = 10.0, 40
"""Least distance between two particles that one round removes [support radii], and greatest number of rounds."""
ROUND_OFF = 1e-9
MANY = 20_000
GRAINS = 2.0**13
"""Inverse of the rounding step of moves [1 / spacings]. Rounding hides differences between machines."""


@dataclass(frozen=True)
class Packing:
    lattice: RestLattice
    fixed: Points
    """Fixed points (m, d) [m]. Points of air come before points of walls."""
    weights: Points
    """Weights of the fixed points (m,), relative to a particle [-]."""
    air: int
    """Number of points of air."""
    lengths: Points
    """Lengths of the periodic box (d,) [m], or 0 along axes without a period."""

    def packed(self, particles: Points, stays: Which) -> tuple[Points, Numbers]:
        """Return rest positions (m, d) and indices of the remaining particles. Particles in ``stays`` do not move."""
        arrays = self.fixed, self.weights, self.lengths, particles, stays
        found, kept = _packed(self.lattice, particles.shape, self.air, *(array.tobytes() for array in arrays))
        return found.copy(), kept

    def errors(self, particles: Points, stays: Which, some: slice | Which = slice(None)) -> Points:
        """The density of particles in ``stays`` (n,) does not include air, and their excess is at least 0."""
        around = self._around(particles, self.lattice.support)
        return density_errors(around, around.sums(particles[some], stays[some]), stays[some])

    def settled(self, particles: Points, stays: Which) -> tuple[Points, Numbers]:
        """Particles that remain too compressed, and are more compressed than their neighbours, are removed."""
        kept, found = np.arange(len(particles)), self._at_rest(particles, stays)
        for _ in range(MOST_OUT):
            errors = np.round(self.errors(found, np.ones(len(found), dtype=bool)), DIGITS)
            over = np.flatnonzero((errors > COMPRESSED) & ~stays[kept])
            points, reach = found[over], BESIDE * self.lattice.support
            lengths = np.where(self.lengths > 2.0 * reach, self.lengths, 0.0)
            one, other, _ = pairs_within(points, points, reach, lengths=lengths)
            crowded = np.delete(over, np.unique(one[errors[over[one]] < errors[over[other]]]))
            if not len(crowded):
                break
            kept, found = np.delete(kept, crowded), np.delete(found, crowded, axis=0)
            found = self._at_rest(found, stays[kept])
        grain = self.lattice.spacing / GRAINS
        return np.asarray(particles[kept] + grain * np.rint((found - particles[kept]) / grain)), kept

    def _at_rest(self, particles: Points, stays: Which) -> Points:
        found, support = particles.copy(), self.lattice.support
        near, reach = support + self.lattice.spacing, support + LISTED * self.lattice.spacing
        for _ in range(MOST_LOOKS):
            wrong = self._wrong(found, stays)
            if not wrong.any():
                break
            movable = self._near(found, wrong, near) & ~stays
            region = self._near(found, movable, support)
            around, part = self._among(found[~region]), found[region]
            part_stays, part_wrong = stays[region], wrong[region]
            for _ in range(MOST_ROUNDS // ROUNDS):
                free = around._near(part, part_wrong, near) & movable[region]
                if not free.any():
                    break
                seen = around._near(part, free, support)
                others = around._among(part[~seen])
                part[seen] = Relaxation(others._around(part[seen], reach), part_stays[seen], free[seen]).relaxed()
                part_wrong[seen] = around._wrong(part, part_stays, seen)
            found[region] = part
        return found

    def _wrong(self, particles: Points, stays: Which, some: slice | Which = slice(None)) -> Which:
        errors = self.errors(particles, stays, some)
        return np.asarray((errors > HIGHEST) | (errors < LOWEST))

    def _near(self, particles: Points, some: Which, reach: float) -> Which:
        others = particles[some]
        reach *= 1.0 + ROUND_OFF
        return PointsAround(self.lattice, others, np.ones(len(others)), (0, 0), self.lengths, reach).near(particles)

    def _around(self, particles: Points, reach: float) -> PointsAround:
        count = len(particles)
        points, weights = np.concatenate([particles, self.fixed]), np.append(np.ones(count), self.weights)
        return PointsAround(self.lattice, points, weights, (count, count + self.air), self.lengths, reach)

    def _among(self, others: Points) -> "Packing":
        weights = np.append(self.weights, np.ones(len(others)))
        return replace(self, fixed=np.concatenate([self.fixed, others]), weights=weights)


@lru_cache(maxsize=8)
def _packed(lattice: RestLattice, shape: tuple[int, int], air: int, *arrays: bytes) -> tuple[Points, Numbers]:
    *numbers, stays = arrays
    fixed, weights, lengths, particles = (np.frombuffer(one) for one in numbers)
    packing = Packing(lattice, fixed.reshape(-1, shape[1]), weights, air, lengths)
    is_long = shape[0] > MANY
    with timed_note(f"Packing the particles of round bodies, {shape[0]:,} in all") if is_long else nullcontext():
        return packing.settled(particles.reshape(shape), np.frombuffer(stays, dtype=bool))
