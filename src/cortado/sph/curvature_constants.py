"""Constants of surface tension by curvature (`cortado.sph.curvature_kernels`), from surfaces whose curvature is known.

J is that of flat surfaces: a lattice is cut across an axis and across a diagonal of a plane. In a layer all particles
are alike, so that the sums of a few layers are all that it takes.

delta follows from discs and balls whose particles lie in concentric rings and shells, a spacing s apart. There the
curvature is found `DEEP` below the surface, where it is greater, and w |q| adds up to 1 + `EXCESS` / R times J, as more
of what surrounds a particle is outside of a curved surface: a force of sigma times the curvature as it is found would be
(1 + EXCESS / R) / (1 - DEEP / R) times too strong. Both numbers are those of every kernel with a support of 2.5 spacings
or more, within 0.05. In space, where the sum of both curvatures is found, delta is DEEP / 2 + EXCESS.
"""

from dataclasses import dataclass
from functools import cache

import numpy as np

from cortado.discretise.calibration import lattice_offsets, rest_volume
from cortado.discretise.smoothing import SmoothingKernel
from cortado.sph.curvature_functions import CLEAR, FAINT

DEEP, EXCESS = 1.05, 0.6
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
        return cls(spacing, width, spacing * (DEEP / (dimension - 1) + EXCESS))


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
