"""Particles on the device of the ray tracer, and sums over the particles near a point."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from cortado.calls import counted
from cortado.device.cells import CellSort
from cortado.device.grid import Grid
from cortado.device.launching import BandLauncher
from cortado.device.modules import kernel_module
from cortado.device.precision import FLOAT32
from cortado.discretise.shapes import Points
from cortado.errors import ComputationError

Ints, Ints2d = wp.array(dtype=wp.int32), wp.array2d(dtype=wp.int32)
Floats, Floats2d = wp.array(dtype=wp.float32), wp.array2d(dtype=wp.float32)
Vec2s, Vec3s = wp.array(dtype=wp.vec2), wp.array(dtype=wp.vec3)
Vec3s2d, Vec4s2d = wp.array2d(dtype=wp.vec3), wp.array2d(dtype=wp.vec4)

MODULE = kernel_module("liquid")
MODULE.options["max_unroll"] = 2  # compiles in half the time
Look = wp.types.vector(5, wp.float32)
"""Linear red, green and blue from 0 to 1, then scattering and absorption [1/m]."""
Looks = wp.array(dtype=Look)
OPAQUE = (1e6, 0.0)
"""Scattering and absorption of opaque fluid [1/m]."""
PARTS = 4096
AT_ONCE = 8000
"""Number of particles in one matrix product. For larger products, BLAS starts threads and is slower."""


def mixed(fractions: Points, values: Points) -> Points:
    """Return the means (n, c) of the phases' ``values`` (phases, c), weighted by mass ``fractions`` (n, phases)."""
    found, shares = np.empty((len(fractions), values.shape[1])), np.clip(fractions, 0.0, 1.0)
    for first in range(0, len(shares), AT_ONCE):
        np.matmul(shares[first : first + AT_ONCE], values, out=found[first : first + AT_ONCE])
    return found


@dataclass(frozen=True)
class Particles:
    places: wp.array
    """Positions of the particles (n,) as vec3 [m]."""
    looks: wp.array
    """A `Look` of each particle (n,): colour, scattering and absorption."""

    @classmethod
    def on(cls, device: Any, places: Points, colours: Points, media: ArrayLike = OPAQUE) -> "Particles":
        """``media`` (n, 2) or (2,) are scattering and absorption [1/m]. Raises `ComputationError` for positions that
        are not finite."""
        finite = np.isfinite(places)
        if not finite.all():
            astray = len(places) - int(finite.all(axis=1).sum())
            raise ComputationError(f"{counted(astray, 'particle')} cannot be drawn, as their positions are not finite.")
        looks = np.empty((len(places), 5), dtype=np.float32)
        looks[:, :3], looks[:, 3:] = colours, media
        own = np.asarray(places, dtype=np.float32)
        return cls(wp.array(own, dtype=wp.vec3, device=device), wp.array(looks, dtype=Look, device=device))

    def __len__(self) -> int:
        return len(self.places)

    def ends(self, launch: BandLauncher) -> tuple[Points, Points]:
        """Return the lower and the upper corner (3,) [m] of the smallest box around the particles."""
        count, device = min(PARTS, len(self)), self.places.device
        lower, upper = (wp.empty(count, dtype=wp.vec3, device=device) for _ in range(2))
        launch(find_ends, count, places=self.places, lower=lower, upper=upper)
        return lower.numpy().astype(np.float64).min(axis=0), upper.numpy().astype(np.float64).max(axis=0)


@wp.kernel(module=MODULE, enable_backward=False)
def find_ends(first: wp.int32, places: Vec3s, lower: Vec3s, upper: Vec3s):
    part = first + wp.tid()
    low = places[part]
    high = places[part]
    i = part
    while i < places.shape[0]:
        low = wp.min(low, places[i])
        high = wp.max(high, places[i])
        i += lower.shape[0]
    lower[part] = low
    upper[part] = high


@wp.kernel(module=kernel_module("marked"), enable_backward=False)
def list_marked(first: wp.int32, marks: Ints, counts: Ints, numbers: Ints):
    i = first + wp.tid()
    if marks[i] > 0:
        numbers[counts[i] - 1] = i


def marked(marks: wp.array, launch: BandLauncher) -> tuple[wp.array, wp.array]:
    """Return the indices at which ``marks`` (n,) is 1, and the cumulative sum of ``marks`` (n,)."""
    counts = wp.empty_like(marks)
    wp.utils.array_scan(marks, counts)
    numbers = wp.empty(last_of(counts), dtype=wp.int32, device=marks.device)
    launch(list_marked, len(marks), marks=marks, counts=counts, numbers=numbers)
    return numbers, counts


def last_of(numbers: wp.array) -> int:
    return int(numbers[len(numbers) - 1 :].numpy()[0])


@wp.struct
class NearParticles:
    lower: wp.vec3
    """Lower corner of the grid of cells [m]."""
    spacing: wp.float32
    """Width of a cell [m]."""
    shape: wp.vec3i
    starts: Ints
    """Index of the first particle of each cell (cells + 1,)."""
    places: Vec3s
    """Positions of the particles (n,) [m]."""
    looks: Looks
    volumes: Floats
    """Volumes of the particles (n,), relative to the volume of an isolated particle."""


@wp.func
def bump(q: wp.float32):
    """Return a cubic spline that falls from 1 at q = 0 to 0 at q = 1."""
    if q < 0.5:
        return 1.0 - 6.0 * q * q * (1.0 - q)
    r = 1.0 - q
    return 2.0 * r * r * r


def bump_at(q: float) -> float:
    return 1.0 - 6.0 * q * q * (1.0 - q) if q < 0.5 else 2.0 * max(1.0 - q, 0.0) ** 3


@cache
def sum_near(term: Callable[..., Any], number: Any) -> Any:
    """Return a Warp function of ``(s, p, reach)`` that sums ``term(s, j)`` over the particles j within ``reach`` [m] of
    the point p, with `bump` as the weight. ``number`` is the Warp type of ``term``."""

    @wp.func
    def summed(s: NearParticles, p: wp.vec3, reach: wp.float32):
        total = number(0.0)
        q = (p - s.lower) / s.spacing
        r = reach / s.spacing
        for z in range(wp.max(int(wp.floor(q[2] - r)), 0), wp.min(int(wp.floor(q[2] + r)) + 1, s.shape[2])):
            off_z = wp.max(wp.max(float(z) - q[2], q[2] - float(z + 1)), 0.0)
            disc = wp.max(r * r - off_z * off_z, 0.0)
            half = wp.sqrt(disc)
            for y in range(wp.max(int(wp.floor(q[1] - half)), 0), wp.min(int(wp.floor(q[1] + half)) + 1, s.shape[1])):
                off_y = wp.max(wp.max(float(y) - q[1], q[1] - float(y + 1)), 0.0)
                along = wp.sqrt(wp.max(disc - off_y * off_y, 0.0))
                first = wp.max(int(wp.floor(q[0] - along)), 0)
                last = wp.min(int(wp.floor(q[0] + along)), s.shape[0] - 1)
                if first <= last:
                    row = (z * s.shape[1] + y) * s.shape[0]
                    for j in range(s.starts[row + first], s.starts[row + last + 1]):
                        off = p - s.places[j]
                        squared = wp.dot(off, off)
                        if squared < reach * reach:
                            total += term(s, j) * bump(wp.sqrt(squared) / reach)
        return total

    return summed


@wp.func
def one(s: NearParticles, j: wp.int32):
    return 1.0


count_near = sum_near(one, wp.float32)


@wp.kernel(module=MODULE, enable_backward=False)
def sort_particles(first: wp.int32, order: Ints, given: Vec3s, given_looks: Looks, places: Vec3s, looks: Looks):
    i = first + wp.tid()
    places[i] = given[order[i]]
    looks[i] = given_looks[order[i]]


@wp.kernel(module=MODULE, enable_backward=False)
def find_volumes(first: wp.int32, s: NearParticles, reach: wp.float32, volumes: Floats):
    i = first + wp.tid()
    volumes[i] = 1.0 / count_near(s, s.places[i], reach)


def near_particles(
    given: Particles, ends: tuple[np.ndarray, np.ndarray], spacing: float, reach: float, launch: BandLauncher
) -> Any:
    """Sort the particles in the box ``ends`` (3,) [m] into cells, for sums within ``reach`` [m] of a point."""
    device, lower = launch.device, np.floor(ends[0] / spacing) * spacing
    x, y, z = (int(n) + 1 for n in np.floor((ends[1] - lower) / spacing))
    sorting = CellSort(Grid(lower, np.full(3, spacing), (x, y, z)), len(given), FLOAT32, device)
    sorting(given.places)
    s = NearParticles()
    s.lower, s.spacing, s.shape, s.starts = wp.vec3(*lower), spacing, wp.vec3i(x, y, z), sorting.grid.starts
    s.places, s.looks = wp.empty_like(given.places), wp.empty_like(given.looks)
    s.volumes = wp.empty(len(given), dtype=wp.float32, device=device)
    unsorted = {"given": given.places, "given_looks": given.looks}
    launch(sort_particles, len(given), order=sorting.order, **unsorted, places=s.places, looks=s.looks)
    launch(find_volumes, len(given), s=s, reach=reach, volumes=s.volumes)
    return s
