"""What walls without slip do to particles by viscosity as a stress (`cortado.sph.stress_forces`), with derivatives.

T_i and mu_i of a particle follow from sums over all of its neighbours, so that the way back goes on from them to these.
"""

from collections.abc import Mapping
from functools import cached_property
from typing import Any, Protocol

import warp as wp

from cortado.device.launching import Named
from cortado.particles.solid_shares import WorkMaker
from cortado.particles.wall_terms import WallTerm
from cortado.sph.formula import Packed
from cortado.sph.moment_functions import matrix_type
from cortado.sph.parts import Adjoints, Setting, StepContext, Tangents
from cortado.sph.stress_wall_kernels import stress_wall_kernels
from cortado.sph.walls import WallSums


class Resisting(Protocol):
    """A viscous stress, as what it does at walls is computed."""

    def resisted(self, step: StepContext) -> Named:
        """T, eta, the velocities ``v`` that are resisted, and A of them, ``A_u``, in a step."""

    def resisted_tangent(self, step: StepContext, dot: Tangents) -> Named:
        """The tangents of T, eta and these velocities, after forward mode of the step."""

    def resisted_adjoint(self, step: StepContext, v_bar: wp.array, bar: Adjoints, v_star_bar: wp.array) -> None:
        """From the adjoint of these velocities."""

    def give(self, step: StepContext, bar: Adjoints, *bars: Named, by_force: bool = True) -> None:
        """What solids that move are given by the adjoints of the sums."""


class StressWalls:
    """The `cortado.sph.walls.WallAction` of a viscous stress."""

    def __init__(
        self,
        setting: Setting,
        made_for: tuple[Any, ...],
        constants: Mapping[str, float],
        of: Mapping[str, wp.array],
        packed: Packed,
        stress: Resisting,
        work: WorkMaker,
        bar: str,
    ):
        """``made_for``: what its kernels are made for; ``of``: M, A, R, T and eta of all particles; ``work`` and
        ``bar`` of its `WallTerm`: `stress_work` for accelerations, `stress_couple_work` for their couples."""
        self._made_for, self._constants, self._of, self._packed, self._stress = made_for, constants, of, packed, stress
        self._layout = setting.layout
        term = WallTerm(setting.discretisation, "viscous_stress", work, bar, rubs=True)
        self._sums = WallSums(term, setting.layout, (constants["least"], constants["control"]))

    def total(self, step: StepContext, solid: int) -> wp.array:
        return self._sums.total(step, solid, self._stress.resisted(step))

    def tangent(self, step: StepContext, dot: Tangents, solid: int) -> wp.array:
        known = self._stress.resisted_tangent(step, dot), self._stress.resisted(step)
        return self._sums.tangent(step, dot, solid, *known)

    def adjoint(self, step: StepContext, bar: Adjoints, solid: int, total_bar: wp.array, v_star_bar: wp.array) -> None:
        stress, kernels, law = self._stress, stress_wall_kernels(*self._made_for), self._made_for[2]
        now, bars = stress.resisted(step), self._bars
        resisted_bar = {name: bars[name] for name in ("T_bar", "eta_bar", "v_bar")}
        for array in resisted_bar.values():
            array.zero_()
        self._sums.adjoint(step, bar, solid, total_bar, v_star_bar, resisted_bar, now)
        theta = {"theta": self._packed.theta(step), "theta_bar": self._packed.shares}
        step.launch(kernels.own, bars, now, *bar.named, self._constants, self._of, **theta)
        step.launch(kernels.sums, bars, now, *bar.named, self._constants)
        stress.give(step, bar, bars, now, by_force=False)
        stress.resisted_adjoint(step, bars["v_bar"], bar, v_star_bar)
        if not law.is_newtonian:
            strain = {"M_bar": bars["no_M"], "A_bar": bars["A_v_bar"], "R_bar": bars["no_R"]}
            step.launch(kernels.sums, strain, *bar.named, self._constants)
            stress.give(step, bar, strain, by_force=False)
        self._packed.collect(step, bar)

    @cached_property
    def _bars(self) -> dict[str, wp.array]:
        """Adjoints, and what stays 0 in ``no_M`` and ``no_R``; made when they are asked for, as runs do without."""
        precision = self._layout.precision
        matrix, real, vector = matrix_type(precision), precision.real, precision.vector
        kinds = dict.fromkeys(("T_bar", "M_bar", "A_bar", "A_v_bar", "no_M"), matrix)
        kinds |= {**dict.fromkeys(("eta_bar", "R_bar", "no_R"), real), "v_bar": vector}
        sizes = {"shape": self._layout.all_particles, "device": self._layout.device}
        return {name: wp.zeros(dtype=kind, **sizes) for name, kind in kinds.items()}
