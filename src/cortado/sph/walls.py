"""The sums over walls by which walls act on a particle in one term of a step. The pressure's is

g_i = sum_b w_b G_ib,   g_i' = sum_b w_b H_ib x_ib' + w_b' G_ib.

A particle with the pressure p_i pushes the walls around it with the force V^2 p_i / n_i^2 g_i. H is symmetric: its sum
of forward mode is that of reverse mode too.
"""

from functools import cache, cached_property
from types import SimpleNamespace
from typing import Any, Protocol

import warp as wp

from cortado.device.launching import Named
from cortado.device.modules import by_name
from cortado.particles.neighbourhood import Discretisation, neighbourhood_type, pair_functions
from cortado.particles.pair_sums import wall_sum
from cortado.particles.state import Layout
from cortado.particles.wall_terms import WallTerm
from cortado.sph.parts import Adjoints, StepContext, Tangents


@cache
def wall_slope_sums(discretisation: Discretisation) -> SimpleNamespace:
    """Make the Warp functions of sums over walls: the ``slope`` g, its ``tangent``, and the sum ``change`` of H with a
    vector ``along`` of each particle."""
    _, vector, neighbourhood = discretisation.types
    pair = pair_functions(discretisation)
    gradient, hessian_product = pair.gradient, pair.hessian_product

    @wall_sum(discretisation)
    def slope(x_ij: vector, s: neighbourhood) -> vector:
        return gradient(x_ij, s)

    @wall_sum(discretisation)
    def change(x_ij: vector, along: vector, s: neighbourhood) -> vector:
        return hessian_product(x_ij, along, s)

    @wall_sum(discretisation, grows=slope)
    def tangent(x_ij: vector, x_dot_ij: vector, s: neighbourhood) -> vector:
        return hessian_product(x_ij, x_dot_ij, s)

    return by_name(slope, change, tangent)


def wall_slope_term(discretisation: Discretisation) -> WallTerm:
    """Return the wall term g, the weighted sum of kernel gradients over a solid's walls; ``slope_bar`` is its
    adjoint."""
    return WallTerm(discretisation, "wall_slope", _work, "slope_bar")


def _work(d: Discretisation) -> Any:
    real, vector, gradient = d.precision.real, d.precision.vector, pair_functions(d).gradient

    def wall_slope_work(x_ij: vector, slope_bar_i: vector, s: neighbourhood_type(d.precision)) -> real:
        return wp.dot(gradient(x_ij, s), slope_bar_i)

    return wall_slope_work


class WallAction(Protocol):
    """The action of walls on the particles around them by one term of a step, read after the step. ``solid`` is the
    number of wall particles of a solid, or `cortado.particles.wall_terms.ALL_WALLS`."""

    def total(self, step: StepContext, solid: int) -> wp.array:
        """Return the action (n,) of walls on sorted particles, vectors; of a force its accelerations [m / s2]."""

    def tangent(self, step: StepContext, dot: Tangents, solid: int) -> wp.array:
        """Return the tangents (n,) of the action of walls, after forward mode of the step."""

    def adjoint(self, step: StepContext, bar: Adjoints, solid: int, total_bar: wp.array, v_star_bar: wp.array) -> None:
        """Turn the adjoints of the action into those of sorted particles, parameters and solids, in ``bar``, and those
        (n,) of v* = v + dt a, of velocities after all explicit forces."""


class WallSums:
    """A `WallAction` that sums a `WallTerm` over walls; its arrays are those of the last step."""

    def __init__(self, term: WallTerm, layout: Layout, constants: tuple[float, float] = (0.0, 0.0)):
        """Take a wall term and the two ``constants`` of its work."""
        self.term, self._layout, self._constants = term, layout, constants

    @cached_property
    def _arrays(self) -> dict[str, wp.array]:
        """Make the arrays of totals when they are first asked for, as runs do without."""
        vector = self._layout.precision.vector
        return self._layout.arrays(total=vector, total_dot=vector)

    def _known(self, solid: int) -> Named:
        return {"solid": solid, "constants": self._layout.precision.pair(*self._constants)}

    def total(self, step: StepContext, solid: int, *groups: Named) -> wp.array:
        found = self._arrays["total"]
        step.launch(self.term.kernels.forward, *groups, self._known(solid), total=found)
        return found

    def tangent(self, step: StepContext, dot: Tangents, solid: int, *groups: Named) -> wp.array:
        found = self._arrays["total_dot"]
        step.launch(self.term.kernels.tangent, *groups, *dot.named, self._known(solid), total_dot=found)
        return found

    def adjoint(
        self, step: StepContext, bar: Adjoints, solid: int, total_bar: wp.array, v_star_bar: wp.array, *groups: Named
    ) -> None:
        """Apply the adjoint of the sums over walls as `WallAction` says; the adjoint of v* gets nothing."""
        step.launch(self.term.kernels.adjoint, {self.term.bar: total_bar}, *groups, *bar.named, self._known(solid))
        self.give(step, bar, solid, total_bar, *groups)

    def give(self, step: StepContext, bar: Adjoints, solid: int, total_bar: wp.array, *groups: Named) -> None:
        """Add to the adjoints of moving solids by the adjoint of the sums over walls."""
        given = {self.term.bar: total_bar}
        kernel, factors = self.term.solid_kernel, self._constants
        bar.solids.add(step.launch, kernel, given, *groups, *bar.named, constants=factors, over=solid)
