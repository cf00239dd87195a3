"""Constants of surface tension by curvature (`cortado.sph.curvature_kernels`), from surfaces whose curvature is known.

J is that of flat surfaces: a lattice is cut across an axis and across a diagonal of a plane. In a layer all particles
are alike, so that the sums of a few layers are all that it takes.

What delta has to make up for was found on discs and balls whose particles lie in concentric rings and shells, a
spacing apart (in spacings, for every kernel with a support of 2.5 spacings or more within 0.05): the curvature is found
`DEEP` below the surface, where it is greater, and w |q| adds up to 1 + `EXCESS` / R times J, as more of what surrounds
a particle is outside of a curved surface. With delta = DEEP / (d - 1) + EXCESS, d - 1 being the number of curvatures in
the sum, the pressure in a drop is (d - 1) sigma / R. But the force acts `ACTS` below the surface, where a wave of the
surface moves less: the square of the frequency of the mode n would be n ACTS / R too small in the plane, and (n + 1)
ACTS / R in space. A smaller delta raises pressures, and twice as much the force that a change of the curvature makes.
So ACTS d / (3 (d - 1)) is taken off: pressure and squared frequency of the mode 2 then err by as much, one to this side
and one to that, by 0.5 / R in the plane and 0.75 / R in space, which gets less where particles are finer.
"""

from dataclasses import dataclass
from functools import cache

import numpy as np

from cortado.discretise.calibration import lattice_offsets, rest_volume
from cortado.discretise.smoothing import SmoothingKernel
from cortado.sph.curvature_functions import CLEAR, FAINT

DEEP, EXCESS, ACTS = 1.05, 0.6, 0.75
"""In spacings, see above."""


@dataclass(frozen=True)
class CurvatureConstants:
    """Of a smoothing kernel and a spacing."""

    spacing: float
    """[m]"""
    width: float
    """J [-]"""
    depth: float
    """delta [m]"""

    @classmethod
    def of(cls, kernel: SmoothingKernel, spacing: float, support: float, dimension: int) -> "CurvatureConstants":
        """On a lattice with a spacing [m], for a support radius [m]."""
        width = float(np.mean([_width(kernel, support / spacing, dimension, cut) for cut in ((1, 0), (1, 1))]))
        shared = ACTS * dimension / (3.0 * (dimension - 1))
        return cls(spacing, width, spacing * (DEEP / (dimension - 1) + EXCESS - shared))


def _indicator(size: np.ndarray) -> np.ndarray:
    """w of s |q|."""
    t = np.clip((size - FAINT) / (CLEAR - FAINT), 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)


@cache
def _width(kernel: SmoothingKernel, support: float, dimension: int, cut: tuple[int, int]) -> float:
    """J of a flat surface across a direction in the plane of the first two axes, for a support in spacings."""
    offsets, volume = lattice_offsets(1.0, support, dimension), rest_volume(kernel, 1.0, support, dimension)
    apart = 1.0 / float(np.linalg.norm(cut))
    weights = volume * kernel.weight(np.linalg.norm(offsets, axis=1), dimension, support)
    upwards = offsets[:, :2] @ np.array(cut)
    slopes = volume * kernel.gradient(offsets, support)[:, :2] @ np.array(cut) * apart
    layers = 2 * int(support / apart) + 3
    above = np.arange(layers)[:, None] - np.rint(upwards).astype(int)[None, :]  # layer of each neighbour of a layer
    inside, place = above >= 0, np.clip(above, 0, 2 * layers)
    g = np.append((inside * slopes).sum(axis=1), np.zeros(layers + 1))
    q = (inside * weights * g[place]).sum(axis=1) / (inside * weights).sum(axis=1)
    return float((_indicator(np.abs(q)) * np.abs(q)).sum() * apart)
