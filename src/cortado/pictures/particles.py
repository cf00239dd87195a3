"""Particles on the device that draws them."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from cortado.device.bands import BandLauncher
from cortado.device.modules import kernel_module
from cortado.discretise.shapes import Points
from cortado.errors import ComputationError
from cortado.words import counted

MODULE = kernel_module("liquid")
MODULE.options["max_unroll"] = 2  # compiles in half the time
Look = wp.types.vector(5, wp.float32)
"""Red, green and blue, linear from 0 to 1, then scattering and absorption [1/m]."""
OPAQUE = (1e6, 0.0)
"""The medium of what nothing is seen through."""
PARTS = 4096
"""Of particles, of each of which the ends are found."""
AT_ONCE = 8000
"""Particles whose values are mixed at a time: of more, BLAS waits longer for its threads than they save."""


def mixed(fractions: Points, values: Points) -> Points:
    """(n, c) what particles of mass fractions (n, phases) have of the values (phases, c) of phases."""
    found, shares = np.empty((len(fractions), values.shape[1])), np.clip(fractions, 0.0, 1.0)
    for first in range(0, len(shares), AT_ONCE):
        np.matmul(shares[first : first + AT_ONCE], values, out=found[first : first + AT_ONCE])
    return found


@dataclass(frozen=True)
class Particles:
    """Where they are, and what they look like."""

    places: wp.array
    """(n,) of vec3 [m]"""
    looks: wp.array
    """(n,) of `Look`"""

    @classmethod
    def on(
        cls, device: Any, places: Points, colours: Points, media: Points | tuple[float, float] = OPAQUE
    ) -> "Particles":
        """Those of arrays of NumPy, (n, 3) each, with ``media`` (n, 2), or (2,) for all: scattering and absorption
        [1/m]. Raises `ComputationError` for places that are not finite."""
        finite = np.isfinite(places)
        if not finite.all():
            astray = len(places) - int(finite.all(axis=1).sum())
            raise ComputationError(f"{counted(astray, 'particle')} cannot be drawn, whose positions are not finite.")
        looks = np.empty((len(places), 5), dtype=np.float32)
        looks[:, :3], looks[:, 3:] = colours, media
        return cls(
            wp.array(np.asarray(places, dtype=np.float32), dtype=wp.vec3, device=device),
            wp.array(looks, dtype=Look, device=device),
        )

    def __len__(self) -> int:
        return len(self.places)

    def and_images(self, places: Points, of: np.ndarray) -> "Particles":
        """With others behind them, at places (m, 3) [m], each looking like one, (m,)."""
        looks = np.concatenate([self.looks.numpy(), self.looks.numpy()[of]])
        both = np.concatenate([self.places.numpy(), places])
        return Particles.on(self.places.device, both, looks[:, :3], looks[:, 3:])

    def ends(self, launch: BandLauncher) -> tuple[Points, Points]:
        """Lower and upper ends, (3,) each [m]."""
        count, device = min(PARTS, len(self)), self.places.device
        lower, upper = (wp.empty(count, dtype=wp.vec3, device=device) for _ in range(2))
        launch(find_ends, count, places=self.places, lower=lower, upper=upper)
        return lower.numpy().astype(np.float64).min(axis=0), upper.numpy().astype(np.float64).max(axis=0)


@wp.kernel(module=MODULE, enable_backward=False)
def find_ends(
    first: wp.int32,
    places: wp.array(dtype=wp.vec3),
    lower: wp.array(dtype=wp.vec3),
    upper: wp.array(dtype=wp.vec3),
):
    """Those of every so many."""
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
