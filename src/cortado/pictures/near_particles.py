"""Sums over the particles near a place, as Warp functions: particles are sorted into cells one spacing wide, so that
those near are in few rows of cells, which lie one behind the other."""

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import warp as wp

from cortado.device.bands import BandLauncher
from cortado.device.cells import CellSort
from cortado.device.grid import Grid
from cortado.device.precision import FLOAT32
from cortado.pictures.particles import MODULE, Look, Particles


@wp.struct
class NearParticles:
    """Particles sorted by cells."""

    lower: wp.vec3
    """Corner of the first cell [m]."""
    spacing: wp.float32
    """[m] which is the width of a cell, too."""
    shape: wp.vec3i
    """Cells along each axis."""
    starts: wp.array(dtype=wp.int32)
    """(cells + 1,) the first particle of each"""
    places: wp.array(dtype=wp.vec3)
    """(n,) [m]"""
    looks: wp.array(dtype=Look)
    """(n,)"""
    volumes: wp.array(dtype=wp.float32)
    """(n,) of each, such that their bumps add up to about 1 within fluid; a particle alone has 1"""


@wp.func
def bump(q: wp.float32):
    """The cubic spline, 1 in the middle, 0 from q = 1 on."""
    if q < 0.5:
        return 1.0 - 6.0 * q * q * (1.0 - q)
    r = 1.0 - q
    return 2.0 * r * r * r


def bump_at(q: float) -> float:
    """The same in Python."""
    return 1.0 - 6.0 * q * q * (1.0 - q) if q < 0.5 else 2.0 * max(1.0 - q, 0.0) ** 3


@cache
def sum_near(term: Callable[..., Any], number: Any) -> Any:
    """The Warp function ``(s, p, reach)`` that adds up ``term(s, j)``, a ``number`` of Warp's, over the particles j
    around p, each times the bump of that reach [m]."""

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
def sort_particles(
    first: wp.int32,
    order: wp.array(dtype=wp.int32),
    given: wp.array(dtype=wp.vec3),
    given_looks: wp.array(dtype=Look),
    places: wp.array(dtype=wp.vec3),
    looks: wp.array(dtype=Look),
):
    i = first + wp.tid()
    places[i] = given[order[i]]
    looks[i] = given_looks[order[i]]


@wp.kernel(module=MODULE, enable_backward=False)
def find_volumes(first: wp.int32, s: NearParticles, reach: wp.float32, volumes: wp.array(dtype=wp.float32)):
    i = first + wp.tid()
    volumes[i] = 1.0 / count_near(s, s.places[i], reach)


def near_particles(
    given: Particles, ends: tuple[np.ndarray, np.ndarray], spacing: float, reach: float, launch: BandLauncher
) -> Any:
    """`NearParticles` of particles, those of them that are between ``ends``, (3,) each [m]; bumps have a ``reach``
    [m]."""
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
