"""At which scale a field on particles lives: from their common motion over long waves to single particles."""

import itertools
from collections.abc import Sequence
from functools import cache

import numpy as np
from numpy.typing import NDArray

from cortado.discretise.smoothing import SmoothingKernel

Field = NDArray[np.float64]


def common_share(u: Field) -> float:
    """The part of the energy sum_i |u_i|^2 that moving all particles alike has, of a field u (n, d).

    For white noise it is 1 / n on average.
    """
    return float(len(u) * (u.mean(axis=0) ** 2).sum() / (u**2).sum())


def box_modes(positions: Field, lower: Sequence[float], upper: Sequence[float]) -> Field:
    """Cosine modes (n, n) of a box on its n particles, longest waves first, made orthonormal: columns.

    Mode (a, b, c) is cos(pi a x / L_x) cos(pi b y / L_y) cos(pi c z / L_z): what sloshes in that box.
    """
    lengths = tuple(float(b - a) for a, b in zip(lower, upper, strict=True))
    waves = np.pi * _lowest(lengths, len(positions)) / np.array(lengths)
    modes = np.cos((positions - np.asarray(lower))[:, None, :] * waves).prod(axis=2)
    return np.linalg.qr(modes)[0]


def shares_of_modes(modes: Field, u: Field) -> Field:
    """The part of the energy (n,) that the first k = 1 ... n modes hold; for white noise k / n on average."""
    return np.cumsum(((modes.T @ u) ** 2).sum(axis=1)) / (u**2).sum()


@cache
def _lowest(lengths: tuple[float, ...], count: int) -> NDArray[np.int64]:
    """So many modes (count, d) of the smallest wave numbers."""
    most = 1
    while True:  # all modes below the first that the cube of candidates lacks
        candidates = np.array(list(itertools.product(range(most + 1), repeat=len(lengths))))
        numbers = ((candidates / np.array(lengths)) ** 2).sum(axis=1)
        if (numbers < ((most + 1) / max(lengths)) ** 2).sum() >= count:
            return candidates[np.argsort(numbers, kind="stable")[:count]]
        most += 1


def smoothed_share(positions: Field, u: Field, kernel: SmoothingKernel, support: float) -> float:
    """The part of the energy that averages over neighbours, the particle itself included (Shepard), have left."""
    distances = np.linalg.norm(positions[:, None] - positions[None], axis=2)
    weights = kernel.weight(distances, positions.shape[1], support)
    smoothed = weights @ u / weights.sum(axis=1, keepdims=True)
    return float((smoothed**2).sum() / (u**2).sum())


def participation(u: Field) -> float:
    """How many particles the energy is spread over: 1 if one has it all, n if all have the same."""
    energies = (u**2).sum(axis=1)
    return float(energies.sum() ** 2 / (energies**2).sum())


def picture_change(positions: Field, u: Field, width: float) -> Field:
    """How a picture in the plane of the first two axes changes along u, at its pixels (k,): particles are Gaussian
    spots of that width [m], pixels as far apart."""
    plane, along = positions[:, :2], u[:, :2]
    least, greatest = plane.min(axis=0) - 3.0 * width, plane.max(axis=0) + 3.0 * width
    axes = [np.arange(a, b, width) for a, b in zip(least, greatest, strict=True)]
    pixels = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 1, 2)
    away = pixels - plane
    spots = np.exp(-0.5 * (away**2).sum(axis=2) / width**2)
    return (spots * (away * along).sum(axis=2)).sum(axis=1) / width**2
