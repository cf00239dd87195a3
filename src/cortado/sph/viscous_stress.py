"""The viscous force as a stress: its kernels (`cortado.sph.stress_kernels`), their arrays and their constants."""

from collections.abc import Sequence
from typing import Any

import warp as wp

from cortado.device.launching import Named
from cortado.device.reduction import add
from cortado.discretise.calibration import stress_control
from cortado.scene.parameters import Parameter
from cortado.sph.formula import Packed, compiled
from cortado.sph.moment_functions import matrix_type
from cortado.sph.parts import Adjoints, Setting, StepContext, Tangents
from cortado.sph.stress_forces import stress_couple_work, stress_work
from cortado.sph.stress_kernels import stress_kernels, stress_solid_kernels
from cortado.sph.stress_walls import StressWalls
from cortado.sph.viscosity_law import Law, newtonian_law

CLOSEST = 0.25
"""In spacings: walls without slip pull no harder on particles that are closer, see `cortado.sph.stress_forces`."""


class ViscousStress:
    """Viscosity as a stress; its arrays are those of the last step."""

    shares: tuple[str, ...] = ()  # viscosities reach particles through the mixture, which has the phases' adjoints
    batches = True

    def __init__(self, setting: Setting, law: Law | None = None, parameters: Sequence[Parameter] = ()):
        """``law``: of the viscosity, with its parameters; by default that of a Newtonian fluid."""
        scene, discretisation, layout = setting.scene, setting.discretisation, setting.layout
        cut, self._law = scene.discretisation, law or newtonian_law()
        self._made_for = (discretisation, scene.dimension, self._law, scene.sticks)
        """What its kernels are made for."""
        self._stress, self._force = stress_kernels(*self._made_for)
        control = stress_control(discretisation.smoothing, cut.spacing, cut.support_radius, scene.dimension)
        self._constants: dict[str, Any] = {"control": control, "least": CLOSEST * cut.spacing}
        self._packed, self._device = Packed(parameters, layout, discretisation.taped), layout.device
        matrix, real = matrix_type(layout.precision), layout.precision.real
        kinds = {"M": matrix, "A": matrix, "R": real, "T": matrix, "eta": real}
        sizes = {"shape": layout.all_particles, "device": layout.device}
        taped = discretisation.taped
        self._of = {name: wp.zeros(dtype=kind, **sizes, requires_grad=taped) for name, kind in kinds.items()}
        self._change = {name: wp.zeros(dtype=kind, **sizes) for name, kind in kinds.items()}
        """Tangents of T and eta, or adjoints of M, A and R."""
        own = setting, self._made_for, self._constants, self._of, self._packed, self
        self.wall_action = StressWalls(*own, stress_work, "acceleration_bar") if scene.sticks else None
        self.wall_couple = StressWalls(*own, stress_couple_work, "couple_bar") if scene.sticks else None

    def compile(self, what: str) -> None:
        """Compile the law in it; raises `InputError` where Warp cannot."""
        compiled(what, self._stress.forward.module, self._device, "number")

    def accelerate(self, step: StepContext, before: wp.array, after: wp.array) -> None:
        step.launch(self._stress.forward, self._constants, **self._of, theta=self._packed.theta(step))
        step.launch(self._force.forward, self._constants, self._of, acceleration_in=before, acceleration=after)

    def tangent(self, step: StepContext, dot: Tangents, before: wp.array, after: wp.array) -> None:
        known = (*dot.named, self._constants, self._of)
        theta = {"theta": self._packed.theta(step), "theta_dot": self._packed.theta_dot(step, dot.parameters)}
        change = {f"{name}_dot": self._change[name] for name in ("T", "eta")}
        step.launch(self._stress.tangent, *known, **theta, **change)
        step.launch(self._force.tangent, *known, change, acceleration_in_dot=before, acceleration_dot=after)

    def resisted(self, step: StepContext) -> dict[str, wp.array]:
        """As that of `cortado.sph.stress_walls.Resisting`, and the next two."""
        return {**{name: self._of[name] for name in ("T", "eta")}, "A_u": self._of["A"], "v": step.fields["v"]}

    def resisted_tangent(self, step: StepContext, dot: Tangents) -> dict[str, wp.array]:
        return {**{f"{name}_dot": self._change[name] for name in ("T", "eta")}, "v_dot": dot.fields["v"]}

    def resisted_adjoint(self, step: StepContext, v_bar: wp.array, bar: Adjoints, v_star_bar: wp.array) -> None:
        add(v_bar, bar.fields["v"])

    def give(self, step: StepContext, bar: Adjoints, *bars: Named, by_force: bool = True) -> None:
        """What solids that move are given, by the adjoints M_bar, A_bar and R_bar of the sums, and by that of the
        acceleration."""
        if not self._made_for[-1]:
            return
        constants = self._constants["least"], self._constants["control"]
        for kernel in stress_solid_kernels(self._made_for[0])[: 1 + by_force]:
            bar.solids.add(step.launch, kernel, *bars, *bar.named, self._of, constants=constants)

    def adjoint(self, step: StepContext, acceleration_bar: wp.array, bar: Adjoints) -> None:
        known = (*bar.named, self._constants, self._of, {"acceleration_bar": acceleration_bar})
        change = {f"{name}_bar": self._change[name] for name in ("M", "A", "R")}
        theta = {"theta": self._packed.theta(step), "theta_bar": self._packed.shares}
        step.launch(self._stress.adjoint, *known, **theta, **change)
        step.launch(self._force.adjoint, *known, change)
        self.give(step, bar, {"acceleration_bar": acceleration_bar}, change)
        self._packed.collect(step, bar)
