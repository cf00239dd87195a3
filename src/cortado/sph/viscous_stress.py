"""The viscous force as a stress: the arrays and constants of its kernels (`cortado.sph.stress_kernels`), and what walls
without slip do to particles by it.

T_i and mu_i of a particle follow from sums over all of its neighbours, so that the way back goes on from them to these.
"""

from collections.abc import Sequence
from functools import cached_property
from typing import Any

import warp as wp

from cortado.device.launching import Named
from cortado.device.reduction import add
from cortado.discretise.calibration import stress_control
from cortado.particles.wall_terms import WallTerm, WorkMaker
from cortado.scene.parameters import Parameter
from cortado.sph.formula import Packed, compiled
from cortado.sph.moment_functions import matrix_type
from cortado.sph.parts import Adjoints, Setting, StepContext, Tangents
from cortado.sph.stress_forces import stress_couple_work, stress_work
from cortado.sph.stress_kernels import stress_kernels, stress_solid_kernels
from cortado.sph.viscosity_law import Law, newtonian_law
from cortado.sph.walls import WallSums

CLOSEST = 0.25
"""In spacings: walls without slip pull no harder on particles that are closer, see `cortado.sph.stress_forces`."""


class ViscousStress:
    """The explicit viscous force as a stress; its arrays are those of the last step."""

    shares: tuple[str, ...] = ()  # viscosities reach particles through the mixture, which has the phases' adjoints
    batches = True

    def __init__(self, setting: Setting, law: Law | None = None, parameters: Sequence[Parameter] = ()):
        """Prepare the force with a ``law`` of viscosity and its parameters; by default a Newtonian fluid's."""
        scene, discretisation, layout = setting.scene, setting.discretisation, setting.layout
        cut, self._law = scene.discretisation, law or newtonian_law()
        self._made_for = (discretisation, scene.dimension, self._law, scene.sticks)
        """What its kernels are made for."""
        self._kernels, self._layout = stress_kernels(*self._made_for), layout
        control = stress_control(discretisation.smoothing, cut.spacing, cut.support_radius, scene.dimension)
        self.constants: dict[str, Any] = {"control": control, "least": CLOSEST * cut.spacing}
        self._packed = Packed(parameters, layout, discretisation.taped)
        self._of = self.arrays("M", "A", "R", "T", "eta", taped=discretisation.taped)
        self._change = self.arrays("M", "A", "A_u", "R", "T", "eta")
        """Tangents or adjoints."""
        self.wall_action = StressWalls(setting, self, stress_work, "acceleration_bar") if scene.sticks else None
        self.wall_couple = StressWalls(setting, self, stress_couple_work, "couple_bar") if scene.sticks else None

    def arrays(self, *names: str, taped: bool = False) -> dict[str, wp.array]:
        """Make arrays (n,) of particles by name, all 0: R and eta are numbers, and all others matrices."""
        precision, sizes = self._layout.precision, {"shape": self._layout.all_particles, "device": self._layout.device}
        kinds = {name: precision.real if name in ("R", "eta") else matrix_type(precision) for name in names}
        return {name: wp.zeros(dtype=kind, **sizes, requires_grad=taped) for name, kind in kinds.items()}

    def compile(self, what: str) -> None:
        """Compile the kernels with the law of viscosity; raise `InputError` where Warp cannot."""
        compiled(what, self._kernels.stress.forward.module, self._layout.device, "number")

    def accelerate(self, step: StepContext, before: wp.array, after: wp.array) -> None:
        self._measure(step)
        accelerations = {"acceleration_in": before, "acceleration": after}
        step.launch(self._kernels.force.forward, self.constants, self._of, **accelerations)

    def _measure(self, step: StepContext) -> None:
        """Write M, A, R, T and mu of the velocities at the start."""
        step.launch(self._kernels.moments.forward, self.constants, self._of)
        known = {"A_u": self._of["A"], "theta": self._packed.theta(step)}
        step.launch(self._kernels.stress.forward, known, self.constants, self._of)

    def tangent(self, step: StepContext, dot: Tangents, before: wp.array, after: wp.array) -> None:
        known = self._stress_along(step, dot), *dot.named, self.constants, self._of
        step.launch(self._kernels.force.tangent, *known, acceleration_in_dot=before, acceleration_dot=after)

    def _stress_along(self, step: StepContext, dot: Tangents, resisted: Named | None = None) -> dict[str, wp.array]:
        """Write the tangents of T and mu. Velocities other than those at the start may be ``resisted``, given as ``v``
        with their tangent, and their A as ``A_u``."""
        change, known = {f"{name}_dot": a for name, a in self._change.items()}, (*dot.named, self.constants, self._of)
        if resisted is not None:
            step.launch(self._kernels.moments.tangent, {"A_dot": change["A_u_dot"]}, resisted, change, *known)
        step.launch(self._kernels.moments.tangent, change, *known)
        resisted = resisted or {"A_u": self._of["A"], "A_u_dot": change["A_dot"]}
        theta = {"theta": self._packed.theta(step), "theta_dot": self._packed.theta_dot(step, dot.parameters)}
        step.launch(self._kernels.stress.tangent, theta, resisted, change, *known)
        return change

    def adjoint(self, step: StepContext, acceleration_bar: wp.array, bar: Adjoints) -> wp.array | None:
        self._back(step, bar, acceleration_bar, self.resisted(step), bar.fields["v"])
        return None

    def _back(self, step: StepContext, bar: Adjoints, acceleration_bar: wp.array, now: Named, v_bar: wp.array) -> None:
        """Go back from the adjoint of the acceleration to those of its inputs; ``now`` has the arrays of `resisted`,
        and the adjoint of the resisted velocities is added to ``v_bar``."""
        bars = {**{f"{name}_bar": array for name, array in self._change.items()}, "v_bar": v_bar}
        known = bars, now, *bar.named, self.constants, self._of, {"acceleration_bar": acceleration_bar}
        of_stress, of_particles = self._kernels.force.adjoint
        step.launch(of_stress, *known)
        self.back_to_sums(step, bar, bars, now)
        step.launch(of_particles, *known)
        self._give(step, bar, 1, *known)

    def back_to_sums(self, step: StepContext, bar: Adjoints, bars: dict[str, wp.array], now: Named) -> None:
        """Turn the adjoints of T and mu into those of particles and solids, by way of the sums; ``now`` has the arrays
        of `resisted`. ``bars`` has ``v_bar``, to which the adjoint of its velocities is added, and room for the
        adjoints of M, R, A and A_u."""
        theta = {"theta": self._packed.theta(step), "theta_bar": self._packed.shares}
        step.launch(self._kernels.stress.adjoint, theta, bars, now, *bar.named, self.constants, self._of)
        at_the_start, A_bar = now["v"] is step.fields["v"], bars["A_u_bar"]
        if at_the_start:
            add(bars["A_bar"], A_bar)
        self._back_to_particles(step, bar, {"A_bar": A_bar}, bars, now)
        if not (at_the_start or self._law.is_newtonian):
            self._back_to_particles(step, bar, {"A_bar": bars["A_bar"]}, self._no_bars)
        self._packed.collect(step, bar)

    def _back_to_particles(self, step: StepContext, bar: Adjoints, *known: Named) -> None:
        step.launch(self._kernels.moments.adjoint, *known, *bar.named, self.constants)
        self._give(step, bar, 0, *known, *bar.named)

    @cached_property
    def _no_bars(self) -> dict[str, wp.array]:
        return {f"{name}_bar": array for name, array in self.arrays("M", "R").items()}

    def _give(self, step: StepContext, bar: Adjoints, which: int, *known: Named) -> None:
        """Add to the adjoints of moving solids by those of the sums (``which`` 0) or of the acceleration (1)."""
        if self._made_for[-1]:
            constants, kernel = (
                tuple(self.constants[name] for name in ("least", "control")),
                stress_solid_kernels(self._made_for[0])[which],
            )
            bar.solids.add(step.launch, kernel, *known, self._of, constants=constants)

    def resisted(self, step: StepContext) -> dict[str, wp.array]:
        """Return T, eta, the velocities ``v`` that are resisted, and their A as ``A_u``, in a step."""
        return {**{name: self._of[name] for name in ("T", "eta")}, "A_u": self._of["A"], "v": step.fields["v"]}

    def resisted_tangent(self, step: StepContext, dot: Tangents) -> dict[str, wp.array]:
        """Return the tangents of T, eta and the resisted velocities, after forward mode of the step."""
        return {**{f"{name}_dot": self._change[name] for name in ("T", "eta")}, "v_dot": dot.fields["v"]}

    def resisted_adjoint(self, step: StepContext, v_bar: wp.array, bar: Adjoints, v_star_bar: wp.array) -> None:
        """Add the adjoint of the resisted velocities to that of the velocities at the start."""
        add(v_bar, bar.fields["v"])


class StressWalls:
    """The sums by which walls act on particles through viscous stress: a `cortado.sph.walls.WallAction`."""

    def __init__(self, setting: Setting, stress: ViscousStress, work: WorkMaker, bar: str):
        """Take ``work`` and ``bar`` of its `WallTerm`: `stress_work` for accelerations, `stress_couple_work` for their
        couples."""
        self._stress, self._layout = stress, setting.layout
        term = WallTerm(setting.discretisation, "viscous_stress", work, bar, rubs=True)
        self._sums = WallSums(term, setting.layout, (stress.constants["least"], stress.constants["control"]))

    def total(self, step: StepContext, solid: int) -> wp.array:
        return self._sums.total(step, solid, self._stress.resisted(step))

    def tangent(self, step: StepContext, dot: Tangents, solid: int) -> wp.array:
        known = self._stress.resisted_tangent(step, dot), self._stress.resisted(step)
        return self._sums.tangent(step, dot, solid, *known)

    def adjoint(self, step: StepContext, bar: Adjoints, solid: int, total_bar: wp.array, v_star_bar: wp.array) -> None:
        now, bars = self._stress.resisted(step), self._bars
        for name in ("T_bar", "eta_bar", "v_bar"):
            bars[name].zero_()
        self._sums.adjoint(step, bar, solid, total_bar, v_star_bar, bars, now)
        self._stress.back_to_sums(step, bar, bars, now)
        self._stress.resisted_adjoint(step, bars["v_bar"], bar, v_star_bar)

    @cached_property
    def _bars(self) -> dict[str, wp.array]:
        """Make arrays of adjoints when they are first asked for, as runs do without."""
        own = self._stress.arrays("M", "A", "A_u", "R", "T", "eta")
        sizes = {"shape": self._layout.all_particles, "device": self._layout.device}
        v_bar = wp.zeros(dtype=self._layout.precision.vector, **sizes)
        return {**{f"{name}_bar": array for name, array in own.items()}, "v_bar": v_bar}
