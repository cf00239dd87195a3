"""Along what the pressure of a particle pushes the walls of one solid in the projection: gamma / V of that solid.

    gamma_s = normal_s + e (whole_s - normal_s)

with the sums of `cortado.solvers.projection.beside` over the wall particles of the solid, and e from those over all
walls. Loads are read now and then, so that it is put together off the device, in float64.
"""

from dataclasses import dataclass

import numpy as np
import warp as wp
from numpy.typing import NDArray

from cortado.particles.neighbourhood import Discretisation
from cortado.particles.solid_shares import ALL_WALLS
from cortado.particles.state import Layout
from cortado.solvers.projection.beside import DIRECTION, EDGED, normal_term
from cortado.solvers.projection.constants import ProjectionConstants
from cortado.sph.parts import Adjoints, StepContext, Tangents
from cortado.sph.wall_slope import wall_slope_term
from cortado.sph.wall_sums import WallSums


@dataclass(frozen=True)
class _Sums:
    """The sums of one solid and of all walls, (n, 3)."""

    normal: NDArray
    whole: NDArray
    all_normal: NDArray
    all_whole: NDArray


class ProjectionPush:
    """A `cortado.sph.wall_sums.WallAction`."""

    def __init__(self, discretisation: Discretisation, layout: Layout, constants: ProjectionConstants, volume: float):
        """``volume`` V of a particle at rest [m^d]."""
        self._layout = layout
        self._normal, self._whole = (WallSums(term(discretisation), layout) for term in (normal_term, wall_slope_term))
        self._least = DIRECTION * constants.least_diagonal / volume**2

    def total(self, step: StepContext, solid: int) -> wp.array:
        at = self._sums(step, solid)
        return self._on_device(at.normal + self._edge(at)[0] * (at.whole - at.normal))

    def tangent(self, step: StepContext, dot: Tangents, solid: int) -> wp.array:
        at, change = self._sums(step, solid), self._sums(step, solid, dot)
        (e, by_normal, by_whole), off = self._edge(at), at.whole - at.normal
        e_dot = ((by_normal * change.all_normal) + (by_whole * change.all_whole)).sum(axis=1, keepdims=True)
        return self._on_device(change.normal + e * (change.whole - change.normal) + e_dot * off)

    def adjoint(self, step: StepContext, bar: Adjoints, solid: int, total_bar: wp.array, v_star_bar: wp.array) -> None:
        """v* gets nothing."""
        at, own = self._sums(step, solid), np.asarray(total_bar.numpy(), dtype=np.float64)
        e, by_normal, by_whole = self._edge(at)
        e_bar = (own * (at.whole - at.normal)).sum(axis=1, keepdims=True)
        for sums, share, slope in ((self._normal, 1.0 - e, by_normal), (self._whole, e, by_whole)):
            sums.adjoint(step, bar, solid, self._on_device(share * own), v_star_bar)
            sums.adjoint(step, bar, ALL_WALLS, self._on_device(e_bar * slope), v_star_bar)

    def _sums(self, step: StepContext, solid: int, dot: Tangents | None = None) -> _Sums:
        """Or their tangents along ``dot``."""

        def found(sums: WallSums, over: int) -> NDArray:
            array = sums.total(step, over) if dot is None else sums.tangent(step, dot, over)
            return np.array(array.numpy(), dtype=np.float64)  # a copy: the next sum overwrites the array

        return _Sums(*(found(sums, over) for over in (solid, ALL_WALLS) for sums in (self._normal, self._whole)))

    def _edge(self, at: _Sums) -> tuple[NDArray, NDArray, NDArray]:
        """e (n, 1), and its gradients (n, 3) with respect to normal and whole of all walls."""
        normal, whole = at.all_normal, at.all_whole
        square = (whole**2).sum(axis=1, keepdims=True)
        below = square + self._least
        off = (square - (normal**2).sum(axis=1, keepdims=True)) / below
        t = np.clip((off - EDGED[0]) / (EDGED[1] - EDGED[0]), 0.0, 1.0)
        slope = 6.0 * t * (1.0 - t) / (EDGED[1] - EDGED[0])
        return t * t * (3.0 - 2.0 * t), -2.0 * slope / below * normal, 2.0 * slope * (1.0 - off) / below * whole

    def _on_device(self, array: NDArray) -> wp.array:
        return wp.array(array, dtype=self._layout.precision.vector, device=self._layout.device)
