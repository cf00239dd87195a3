"""The viscous force as a stress (`cortado.sph.stress_kernels`), which is either explicit or implicit.

The implicit force does not limit the time step. Let a be the acceleration by all other forces, and g(v) the
acceleration by the viscous stress of fluid with velocities v. The function g uses the viscosity mu and the matrix M
from the start of the step. The acceleration a' at the end of a step solves

    a' = a + g(v + dt a'),   that is   B (a' - a) = g(v + dt a),   B y = y - dt g(y).

`cortado.sph.viscous_solve` solves this equation to round-off. The operator B is symmetric and positive in the product
sum_i m_i a_i . b_i. The viscosity mu follows from the velocities v at the start of the step. The stress follows from
the velocities u = v + dt a' at the end. Derivatives are exact for the solved equation: the tangent and the adjoint each
need one more solve with B.
"""

from collections.abc import Sequence
from functools import cache, cached_property, partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from cortado.device.launching import Named
from cortado.device.modules import by_name, kernel_module
from cortado.device.precision import Precision
from cortado.device.reduction import add
from cortado.discretise.smoothing import stress_control
from cortado.errors import MissingDerivativeError
from cortado.particles.particle_kernels import particle_kernel
from cortado.particles.state import clear
from cortado.particles.wall_terms import WallTerm, WorkMaker, solid_kernel
from cortado.scene.parameters import Parameter
from cortado.scene.scene import Scene
from cortado.scene.stability import is_implicit
from cortado.sph.density import WallSums
from cortado.sph.formula import Formula, OwnParameters, compiled
from cortado.sph.free_friction import FreeFriction
from cortado.sph.parts import Adjoints, Setting, StepContext, Tangents
from cortado.sph.stress_forces import newtonian_law, stress_couple_work, stress_work
from cortado.sph.stress_kernels import moments_work, stress_kernels
from cortado.sph.viscous_solve import Solve, operator_kernels

CLOSEST = 0.25
"""Distance from a no-slip wall below which its force is constant [spacings]."""


class ViscousStress:
    """The tangent and the adjoint read arrays of the last call of `accelerate`."""

    shares: tuple[str, ...] = ()  # viscosities reach particles through the mixture, which has the phases' adjoints
    batches = True

    def __init__(self, setting: Setting, law: Formula | None = None, parameters: Sequence[Parameter] = ()):
        scene, discretisation, layout = setting.scene, setting.discretisation, setting.layout
        cut, self._law = scene.discretisation, law or newtonian_law()
        self._made_for = (discretisation, scene.dimension, self._law, scene.sticks)
        self._kernels, self._layout = stress_kernels(*self._made_for), layout
        control = stress_control(discretisation.smoothing, cut.spacing, cut.support_radius, scene.dimension)
        self.constants: dict[str, Any] = {"control": control, "least": CLOSEST * cut.spacing}
        self.free = FreeFriction(setting, self.constants)
        self._own = OwnParameters(parameters, layout, discretisation.taped)
        self._of = self.arrays("M", "A", "R", "T", "eta", taped=discretisation.taped)
        self._change = self.arrays("M", "A", "A_u", "R", "T", "eta")
        sums = (stress_work, "acceleration_bar", "rub"), (stress_couple_work, "couple_bar", "couple")
        walls = (StressWalls(setting, self, *one) if scene.sticks else None for one in sums)
        self.wall_action, self.wall_couple = walls

    def arrays(self, *names: str, taped: bool = False) -> dict[str, wp.array]:
        precision = self._layout.precision
        kinds = {name: precision.real if name in ("R", "eta") else precision.matrix for name in names}
        return self._layout.arrays(requires_grad=taped, **kinds)

    def compile(self, what: str) -> None:
        compiled(what, self._kernels.stress.forward.module, self._layout.device, "number")

    def accelerate(self, step: StepContext, before: wp.array, after: wp.array) -> None:
        self._measure(step)
        accelerations = {"acceleration_in": before, "acceleration": after}
        step.launch(self._kernels.force.forward, self.constants, self._of, **accelerations)

    def _measure(self, step: StepContext) -> None:
        self.free.begin(step)
        step.launch(self._kernels.moments.forward, self.constants, self._of)
        self.free.gather(step, self._of)
        known = self._own.now(step), {"A_u": self._of["A"]}, self.constants, self._of
        step.launch(self._kernels.stress.forward, *known)

    def tangent(self, step: StepContext, dot: Tangents, before: wp.array, after: wp.array) -> None:
        known = self._stress_along(step, dot), *dot.named, self.constants, self._of
        step.launch(self._kernels.force.tangent, *known, acceleration_in_dot=before, acceleration_dot=after)

    def _stress_along(self, step: StepContext, dot: Tangents, resisted: Named | None = None) -> dict[str, wp.array]:
        """``resisted`` are velocities and velocity sums of the implicit force, with tangents."""
        change, known = {f"{name}_dot": a for name, a in self._change.items()}, (*dot.named, self.constants, self._of)
        free = self.free.dots
        free.begin(step, dot)
        if resisted is not None:
            step.launch(self._kernels.moments.tangent, {"A_dot": change["A_u_dot"]}, resisted, change, *known)
            free.lean(step, dot, change["A_u_dot"], resisted)
        step.launch(self._kernels.moments.tangent, change, *known)
        free.gather(step, dot, change)
        resisted = resisted or {"A_u": self._of["A"], "A_u_dot": change["A_dot"]}
        step.launch(self._kernels.stress.tangent, self._own.along(step, dot.parameters), resisted, change, *known)
        return change

    def adjoint(self, step: StepContext, acceleration_bar: wp.array, bar: Adjoints) -> wp.array | None:
        self._back(step, bar, acceleration_bar, self.resisted(step), bar.fields["v"])
        return None

    def _back(self, step: StepContext, bar: Adjoints, acceleration_bar: wp.array, now: Named, v_bar: wp.array) -> None:
        bars = {**{f"{name}_bar": array for name, array in self._change.items()}, "v_bar": v_bar}
        known = bars, now, *bar.named, self.constants, self._of, {"acceleration_bar": acceleration_bar}
        of_stress, of_particles = self._kernels.force.adjoint
        step.launch(of_stress, *known)
        self.free.bars.push(step, bar, acceleration_bar, *known)
        self.back_to_sums(step, bar, bars, now)
        step.launch(of_particles, *known)
        self._give(step, bar, 1, *known)

    def back_to_sums(self, step: StepContext, bar: Adjoints, bars: dict[str, wp.array], now: Named) -> None:
        known = self._own.back(step), bars, now, *bar.named, self.constants, self._of
        step.launch(self._kernels.stress.adjoint, *known)
        at_the_start, A_bar = now["v"] is step.fields["v"], bars["A_u_bar"]
        if at_the_start:
            add(bars["A_bar"], A_bar)
        self._back_to_particles(step, bar, {"A_bar": A_bar}, bars, now)
        self.free.bars.lean(step, bar, A_bar, bars, now)
        self.free.bars.gather(step, bar, {name: bars[name] for name in ("M_bar", "A_bar", "R_bar")})
        if self._law.topic and not at_the_start:
            self._back_to_particles(step, bar, {"A_bar": bars["A_bar"]}, self._no_bars)
        self._own.collect(step, bar)

    def _back_to_particles(self, step: StepContext, bar: Adjoints, *known: Named) -> None:
        step.launch(self._kernels.moments.adjoint, *known, *bar.named, self.constants)
        self._give(step, bar, 0, *known, *bar.named)

    @cached_property
    def _no_bars(self) -> dict[str, wp.array]:
        return {f"{name}_bar": array for name, array in self.arrays("M", "R").items()}

    def _give(self, step: StepContext, bar: Adjoints, which: int, *known: Named) -> None:
        if self._made_for[-1]:
            work = (moments_work, stress_work)[which]
            kernel = partial(solid_kernel, self._made_for[0], "viscous_stress", work, rubs=True)
            constants = self.constants["least"], self.constants["control"]
            bar.solids.add(step.launch, kernel, *known, self._of, constants=constants)

    def resisted(self, step: StepContext) -> dict[str, wp.array]:
        """Return stress, viscosity, the velocities ``v`` that the stress resists, and the velocity sums ``A_u``."""
        return {**{name: self._of[name] for name in ("T", "eta")}, "A_u": self._of["A"], "v": step.fields["v"]}

    def resisted_tangent(self, step: StepContext, dot: Tangents) -> dict[str, wp.array]:
        return {**{f"{name}_dot": self._change[name] for name in ("T", "eta")}, "v_dot": dot.fields["v"]}

    def resisted_adjoint(self, step: StepContext, v_bar: wp.array, bar: Adjoints, v_star_bar: wp.array) -> None:
        add(v_bar, bar.fields["v"])


class StressWalls:
    def __init__(self, setting: Setting, stress: ViscousStress, work: WorkMaker, bar: str, name: str):
        """``work`` and ``bar`` are arguments of `WallTerm`. ``name`` is "rub" or "couple"."""
        self._stress, self._layout, self._name = stress, setting.layout, name
        term = WallTerm(setting.discretisation, "viscous_stress", work, bar, rubs=True)
        self._sums = WallSums(term, setting.layout, (stress.constants["least"], stress.constants["control"]))

    def total(self, step: StepContext, solid: int) -> wp.array:
        now = self._stress.resisted(step)
        found = self._sums.total(step, solid, now)
        self._stress.free.act(step, solid, self._name, found, now)
        return found

    def tangent(self, step: StepContext, dot: Tangents, solid: int) -> wp.array:
        known = self._stress.resisted_tangent(step, dot), self._stress.resisted(step)
        found = self._sums.tangent(step, dot, solid, *known)
        self._stress.free.dots.act(step, dot, solid, self._name, found, *known)
        return found

    def adjoint(self, step: StepContext, bar: Adjoints, solid: int, total_bar: wp.array, v_star_bar: wp.array) -> None:
        now, bars = self._stress.resisted(step), self._bars
        clear(bars[name] for name in ("T_bar", "eta_bar", "v_bar"))
        self._sums.adjoint(step, bar, solid, total_bar, v_star_bar, bars, now)
        self._stress.free.bars.begin(step, bar)
        self._stress.free.bars.act(step, bar, solid, self._name, total_bar, bars, now)
        self._stress.back_to_sums(step, bar, bars, now)
        self._stress.resisted_adjoint(step, bars["v_bar"], bar, v_star_bar)

    @cached_property
    def _bars(self) -> dict[str, wp.array]:
        own = self._stress.arrays("M", "A", "A_u", "R", "T", "eta")
        v_bar = self._layout.arrays("_bar", v=self._layout.precision.vector)
        return {**{f"{name}_bar": array for name, array in own.items()}, **v_bar}


@cache
def implicit_kernels(precision: Precision) -> SimpleNamespace:
    real, vector, module = precision.real, precision.vector, kernel_module(f"implicit_step_derivative_{precision.name}")

    @particle_kernel(module, "u")
    def predict(time_step: real, v_i: vector, acceleration_i: vector) -> vector:
        return v_i + time_step * acceleration_i

    @particle_kernel(module, "r")
    def weigh(m_i: real, acceleration_bar_i: vector) -> vector:
        return acceleration_bar_i / m_i

    @particle_kernel(module, "r")
    def unweigh(m_i: real, y_i: vector) -> vector:
        return m_i * y_i

    @particle_kernel(module, "+v_bar +time_step_bar")
    def end_adjoint(acceleration_i: vector, u_bar_i: vector) -> tuple[vector, real]:
        return u_bar_i, wp.dot(u_bar_i, acceleration_i)

    return by_name(predict, weigh, unweigh, end_adjoint)


class ImplicitViscousStress(ViscousStress):
    is_last = True

    def __init__(self, setting: Setting, law: Formula | None = None, parameters: Any = ()):
        if setting.discretisation.taped:
            raise MissingDerivativeError("Warp's tape cannot differentiate implicit viscosity: take gradients.Exact.")
        super().__init__(setting, law, parameters)
        layout, (discretisation, *others) = setting.layout, self._made_for
        self._implicit = implicit_kernels(layout.precision)
        self._pull = operator_kernels(*self._made_for)[0]
        self.solve = Solve(layout, operator_kernels(discretisation.still, *others), self.free)
        vectors = layout.arrays(**dict.fromkeys(("u", "r", "y", "still"), layout.precision.vector))
        self._u, self._r, self._y, self._still = vectors.values()
        self._at_end = self.arrays("A", "T")
        self._after: Any = None
        self._after_dot: Any = None

    @property
    def iterations(self) -> NDArray:
        return np.asarray(self.solve.count.numpy())

    def _known(self, *more: Any) -> tuple[Any, ...]:
        return *more, self.constants, self._at_end, self._of

    def accelerate(self, step: StepContext, before: wp.array, after: wp.array) -> None:
        self._measure(step)
        self.free.start(step)
        self._find_end(step, before)
        known = self._known()
        step.launch(self._kernels.force.forward, *known, v=self._u, acceleration_in=self._still, acceleration=self._r)
        self.free.push(step, *known, v=self._u, acceleration=self._r)
        self.solve(step, known, self._r, self._y)
        self.free.finish(step)
        wp.copy(after, before)
        add(self._y, after)
        self._after = after

    def _find_end(self, step: StepContext, acceleration: wp.array) -> None:
        step.launch(self._implicit.predict, acceleration=acceleration, u=self._u)
        self.free.hang(step, self._u)
        step.launch(self._pull, *self._known(), v=self._u)
        self.free.pull(step, *self._known(), v=self._u)

    def tangent(self, step: StepContext, dot: Tangents, before: wp.array, after: wp.array) -> None:
        self._find_end(step, self._after)
        u_dot, along = self._y, {"v": dot.fields["v"], "time_step": dot.parameters["time_step"]}
        step.launch(self._implicit.predict, along, acceleration=self._after, u=u_dot)
        self.free.dots.hang(step, dot, u_dot)
        self.free.dots.start(step, dot)
        end = {"v": self._u, "v_dot": u_dot}
        change = self._stress_along(step, dot, {**end, "A_u": self._at_end["A"]})
        now = {**end, "acceleration_in_dot": before, "acceleration_dot": self._r}
        step.launch(self._kernels.force.tangent, now, change, *self._known(*dot.named))
        self.free.dots.push(step, dot, self._r, now, change, *self._known())
        self.solve(step, self._known(), self._r, after)
        self.free.dots.finish(step, dot)
        self._after_dot = after

    def resisted(self, step: StepContext) -> dict[str, wp.array]:
        self._find_end(step, self._after)
        return {"T": self._at_end["T"], "eta": self._of["eta"], "A_u": self._at_end["A"], "v": self._u}

    def resisted_tangent(self, step: StepContext, dot: Tangents) -> dict[str, wp.array]:
        self._find_end(step, self._after)
        by_time, u_dot = {"v": dot.fields["v"], "time_step": dot.parameters["time_step"]}, self._y
        step.launch(self._implicit.predict, by_time, acceleration=self._after, u=self._r)
        step.launch(self._implicit.predict, v=self._r, acceleration=self._after_dot, u=u_dot)
        self.free.dots.hang(step, dot, u_dot)
        self.free.dots.start(step, dot)
        end = {"v": self._u, "v_dot": u_dot, "A_u": self._at_end["A"]}
        return {**self._stress_along(step, dot, end), "v_dot": u_dot}

    def resisted_adjoint(self, step: StepContext, v_bar: wp.array, bar: Adjoints, v_star_bar: wp.array) -> None:
        own = {"v_bar": v_star_bar, "u_bar": v_bar, "acceleration": self._after}
        step.launch(self._implicit.end_adjoint, own, *bar.named)
        self.free.bars.finish(step, bar, v_bar)

    def adjoint(self, step: StepContext, acceleration_bar: wp.array, bar: Adjoints) -> wp.array:
        """Return the adjoint of the accelerations by all earlier forces."""
        step.launch(self._implicit.weigh, acceleration_bar=acceleration_bar, r=self._r)
        if self.free.rows:
            self.free.bars.take(step, bar)
            self.solve.respond(step, self._known(), self._still, self._r)
            self.free.bars.heed(step, bar)
        self.solve(step, self._known(), self._r, self._y)
        step.launch(self._implicit.unweigh, y=self._y, r=self._r)
        now, u_bar = self.resisted(step), self._y
        u_bar.zero_()
        self.free.bars.begin(step, bar)
        self._back(step, bar, self._r, now, u_bar)
        self.resisted_adjoint(step, u_bar, bar, bar.fields["v"])
        return self._r


def stress_of(scene: Scene) -> type[ViscousStress]:
    return ImplicitViscousStress if is_implicit(scene) else ViscousStress
