"""Viscosity as a stress at the end of a step: its time step has no limit.

With the acceleration a by all other forces, and g(v) by the stress of fluid with velocities v
(`cortado.sph.stress_kernels`), with M and mu of the velocities at the start, what acts is a' of

    a' = a + g(v + dt a'),   that is   B (a' - a) = g(v + dt a),   B y = y - dt g(y),

which `cortado.sph.conjugate_gradients` solves to round-off. So the derivatives are those of the solution, whatever way
led to it: the tangent is one more solve with B, and so is the adjoint, as B is symmetric in the product weighted with
masses.
"""

from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from cortado.device.reduction import add
from cortado.errors import MissingDerivativeError
from cortado.particles.state import Layout
from cortado.scene.scene import Scene
from cortado.scene.stability import is_implicit
from cortado.sph.conjugate_gradients import ConjugateGradients, round_off
from cortado.sph.implicit_derivatives import implicit_kernels
from cortado.sph.implicit_kernels import operator_kernels
from cortado.sph.parts import Adjoints, Setting, StepContext, Tangents
from cortado.sph.viscosity_law import Law
from cortado.sph.viscous_stress import ViscousStress

MOST = 1_000
"""Iterations of a solve."""


class Solve(ConjugateGradients):
    """Conjugate gradients for the particles of one solver."""

    name, most = "viscous_iterations", MOST

    def __init__(self, layout: Layout, operator: tuple[Any, Any]):
        """``operator``: the kernels that `operator_kernels` gives."""
        precision = layout.precision
        super().__init__(layout, precision.vector, round_off(precision), MOST)
        self._pull, self._multiply = operator

    def __call__(self, step: StepContext, known: Any, r: wp.array, y: wp.array) -> None:
        """Write to ``y`` what solves B y = r, (n,) vectors both, and overwrite ``r``; ``known``: arguments of the
        kernels of B."""

        def multiply(p: wp.array, found: dict[str, wp.array]) -> None:
            step.launch(self._pull, *known, v=p)
            step.launch(self._multiply, *known, found, v=p)

        self.solve(step, multiply, step.fields["m"], r, y)


class ImplicitViscousStress(ViscousStress):
    """Viscosity as a stress at the end of the step. It comes after all other forces."""

    is_last = True

    def __init__(self, setting: Setting, law: Law | None = None, parameters: Any = ()):
        """As `ViscousStress`."""
        if setting.discretisation.taped:
            raise MissingDerivativeError("implicit viscosity has no tape: try gradients.Exact.")
        super().__init__(setting, law, parameters)
        layout, (discretisation, *others) = setting.layout, self._made_for
        self._implicit = implicit_kernels(*self._made_for)
        self._pull = operator_kernels(*self._made_for)[0]
        self.solve = Solve(layout, operator_kernels(discretisation.still, *others))
        sizes = {"shape": layout.all_particles, "device": layout.device}
        vectors = (wp.zeros(dtype=layout.precision.vector, **sizes) for _ in range(4))
        self._u, self._r, self._y, self._still = vectors
        matrix = self._of["T"].dtype
        self._A_u, self._T_u, self._A_bar, no_matrix = (wp.zeros(dtype=matrix, **sizes) for _ in range(4))
        self._no_bars = {"M_bar": no_matrix, "R_bar": wp.zeros(dtype=layout.precision.real, **sizes)}
        self._after: Any = None
        """a' of the last step."""
        self._after_dot: Any = None
        """Its tangent, after forward mode of the step."""

    @property
    def iterations(self) -> NDArray:
        """(members,) those of the last solve, of a run or of a derivative."""
        return np.asarray(self.solve.count.numpy())

    def _known(self, *more: Any) -> tuple[Any, ...]:
        """Arguments of the kernels of B, with A and T of the velocities u."""
        return *more, self._constants, {**self._of, "A": self._A_u, "T": self._T_u}

    def accelerate(self, step: StepContext, before: wp.array, after: wp.array) -> None:
        step.launch(self._stress.forward, self._constants, **self._of, theta=self._packed.theta(step))
        step.launch(self._implicit.predict, acceleration=before, u=self._u)
        known = self._known()
        step.launch(self._pull, *known, v=self._u)
        step.launch(self._force.forward, *known, v=self._u, acceleration_in=self._still, acceleration=self._r)
        self.solve(step, known, self._r, self._y)
        wp.copy(after, before)
        add(self._y, after)
        self._after = after

    def _at_the_end(self, step: StepContext) -> None:
        """u = v + dt a', with A and T of it."""
        step.launch(self._implicit.predict, acceleration=self._after, u=self._u)
        step.launch(self._pull, *self._known(), v=self._u)

    def tangent(self, step: StepContext, dot: Tangents, before: wp.array, after: wp.array) -> None:
        self._at_the_end(step)
        u_dot, along = self._y, {"v": dot.fields["v"], "time_step": dot.parameters["time_step"]}
        step.launch(self._implicit.predict, along, acceleration=self._after, u=u_dot)
        change = self._stress_along(step, dot, u_dot)
        now = {"v": self._u, "v_dot": u_dot, "acceleration_in_dot": before, "acceleration_dot": self._r}
        step.launch(self._force.tangent, now, change, *self._known(*dot.named))
        self.solve(step, self._known(), self._r, after)
        self._after_dot = after

    def _stress_along(self, step: StepContext, dot: Tangents, u_dot: wp.array) -> dict[str, wp.array]:
        """Write the tangents of T and mu for one of u."""
        change = {f"{name}_dot": self._change[name] for name in ("T", "eta")}
        theta = {"theta": self._packed.theta(step), "theta_dot": self._packed.theta_dot(step, dot.parameters)}
        both = {"u": self._u, "u_dot": u_dot, "A_u": self._A_u}
        step.launch(self._implicit.stress_tangent, *dot.named, self._constants, self._of, both, **theta, **change)
        return change

    def resisted(self, step: StepContext) -> dict[str, wp.array]:
        self._at_the_end(step)
        return {"T": self._T_u, "eta": self._of["eta"], "A_u": self._A_u, "v": self._u}

    def resisted_tangent(self, step: StepContext, dot: Tangents) -> dict[str, wp.array]:
        self._at_the_end(step)
        by_time, u_dot = {"v": dot.fields["v"], "time_step": dot.parameters["time_step"]}, self._y
        step.launch(self._implicit.predict, by_time, acceleration=self._after, u=self._r)
        step.launch(self._implicit.predict, v=self._r, acceleration=self._after_dot, u=u_dot)
        return {**self._stress_along(step, dot, u_dot), "v_dot": u_dot}

    def resisted_adjoint(self, step: StepContext, v_bar: wp.array, bar: Adjoints, v_star_bar: wp.array) -> None:
        own = {"v_bar": v_star_bar, "u_bar": v_bar, "acceleration": self._after}
        step.launch(self._implicit.end_adjoint, own, *bar.named)

    def adjoint(self, step: StepContext, acceleration_bar: wp.array, bar: Adjoints) -> wp.array:
        """Returns the adjoint of the acceleration by all other forces."""
        step.launch(self._implicit.weigh, acceleration_bar=acceleration_bar, r=self._r)
        self.solve(step, self._known(), self._r, self._y)
        step.launch(self._implicit.unweigh, y=self._y, r=self._r)
        self._at_the_end(step)
        theta = {"theta": self._packed.theta(step), "theta_bar": self._packed.shares}
        change = {f"{name}_bar": self._change[name] for name in ("M", "A", "R")}
        now = {"v": self._u, "acceleration_bar": self._r}
        both = {"A_u": self._A_u, "A_v_bar": self._A_bar}
        step.launch(self._implicit.stress_adjoint, now, both, change, *bar.named, self._constants, self._of, **theta)
        u_bar = self._y
        u_bar.zero_()
        step.launch(self._force.adjoint, now, {"v_bar": u_bar}, change, *self._known(*bar.named))
        self.give(step, bar, now, change, {"T": self._T_u})
        step.launch(self._implicit.end_adjoint, {"u_bar": u_bar, "acceleration": self._after}, *bar.named)
        if not self._law.is_newtonian:
            strain = {"A_bar": self._A_bar, **self._no_bars}
            step.launch(self._implicit.strain_adjoint, strain, self._constants, *bar.named)
            self.give(step, bar, strain, by_force=False)
        self._packed.collect(step, bar)
        return self._r


def stress_of(scene: Scene) -> type[ViscousStress]:
    """The class of the viscous stress in a scene."""
    return ImplicitViscousStress if is_implicit(scene) else ViscousStress
