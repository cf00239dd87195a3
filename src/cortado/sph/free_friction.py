"""Free bodies without slip in the implicit viscous solve, with derivatives; see `cortado.sph.friction_kernels`.

The velocities of bodies are additional unknowns of the solve (Weiler, Koschier, Brand and Bender 2018). Fluid with
velocities u exerts the force F(u, U) on a body with the mass matrix M and the velocities U. At the start of the step, U
includes gravity and contact. The solve has the additional equations

    U' = U + M^-1 J,   J = dt F(u', U'),

where u' and U' are the velocities at the end of the step. The operator B of `cortado.sph.viscous_stress` remains
symmetric in the scalar product that is weighted with the masses of particles and M. The impulse J is added to the
body's momenta before pressures act, so that light bodies neither oscillate nor need smaller steps.

Friction acts before pressures, but pressures hold fluid and bodies against gravity. Therefore u excludes gravity, and U
includes the velocity change by the pressures of the previous step.
"""

from collections.abc import Iterator
from functools import cached_property
from typing import Any

import warp as wp

from cortado.device.launching import Named
from cortado.device.reduction import add
from cortado.particles.mirrors import ALL_WALLS
from cortado.particles.state import Layout, clear, zeros
from cortado.scene.motions import free
from cortado.sph.free_solids import Changes, FreeBody, Motions
from cortado.sph.friction_kernels import friction_kernels, lift_kernels, row_kernels
from cortado.sph.moving_solids import move_kernels
from cortado.sph.parts import Adjoints, Setting, StepContext, Tangents

Arrays = dict[str, wp.array]
VELOCITIES = ("V", "L", "W", "faster", "turned_faster")


def begun(body: Motions) -> Arrays:
    return {f"{name[0]}_0{name[1:]}": array for name, array in body.before.items()}


class BodyFriction:
    """Arrays by kernel argument name. ``suffix`` is "_dot" for tangents and "_bar" for adjoints."""

    def __init__(self, layout: Layout, suffix: str = ""):
        precision, members = layout.precision, layout.members
        real, vector, six = precision.real, precision.vector, precision.six
        kinds = {"H": real, "Y": vector, "N": precision.matrix, "load": six}
        self._load, self._sum = f"load{suffix}", layout.sum_of(six)
        self._momenta = [f"{name}{suffix}" for name in ("pulled_sum", "twisted_sum")]
        motion = [f"{name}{suffix}" for name in VELOCITIES] + self._momenta
        self.arrays = layout.arrays(suffix, **kinds, **dict.fromkeys(("arm", "rub", "couple"), vector))
        self.arrays |= zeros(dict.fromkeys(motion, (members, vector)), layout.device)
        self.turned = wp.zeros(members, dtype=vector, device=layout.device)
        self.none_total = wp.zeros(members, dtype=real, device=layout.device)
        self.impulse = {"impulse": wp.zeros(members, dtype=six, device=layout.device)}

    def momenta(self, body: Motions) -> Iterator[tuple[wp.array, wp.array, wp.array]]:
        """Yield arrays of the total momentum, of the momentum by contacts, and of the momentum by pressures."""
        return zip((self.arrays[one] for one in self._momenta), body.given.values(), body.pressed.values(), strict=True)

    def add_up(self, body: Motions) -> None:
        for total, given, pressed in self.momenta(body):
            wp.copy(total, given)
            add(pressed, total)

    def whole(self) -> wp.array:
        return self._sum(self.arrays[self._load])


class BodyRows:
    def __init__(self, layout: Layout):
        six, vector = layout.precision.six, layout.precision.vector
        kinds = {**dict.fromkeys(("r", "rise", "p", "y", "product", "first"), six), "V": vector, "W": vector}
        self.arrays = zeros({name: (layout.members, kind) for name, kind in kinds.items()}, layout.device)
        self.velocities = {name: self.arrays[name] for name in "VW"}
        self.kernels, self._members = row_kernels(layout.precision), layout.members
        self.known: tuple[Named, ...] = ()
        self.load: Any = None

    def launch(self, step: StepContext, kernel: Any, *groups: Named, **arrays: Any) -> None:
        step.launch(kernel, self.arrays, *groups, *self.known, threads=self._members, **arrays)


class FreeFriction:
    """All methods do nothing in scenes without no-slip bodies."""

    def __init__(self, setting: Setting, constants: Named):
        layout, scene = setting.layout, setting.scene
        self.layout, self.constants = layout, constants
        names = [table.name for table in free(scene.solid) if table.sticks]
        self.own = {name: BodyFriction(layout) for name in names}
        self._rows = {name: BodyRows(layout) for name in names}
        self.rows = list(self._rows.values())
        self.kernels: Any = None
        if names:
            self.kernels = friction_kernels(setting.discretisation, scene.dimension)
            self.move, self.lifts = move_kernels(layout.precision), lift_kernels(layout.precision)
        self.lift = {"lift": wp.zeros(layout.members, dtype=layout.precision.vector, device=layout.device)}
        """Minus the velocity change by gravity in a step [m/s]."""
        self.dots, self.bars = FrictionTangent(self), FrictionAdjoint(self)

    def each(self, step: StepContext) -> Iterator[tuple[FreeBody, BodyFriction, BodyRows]]:
        for body in step.bodies:
            if body.table.sticks:
                yield body, self.own[body.table.name], self._rows[body.table.name]

    def begin(self, step: StepContext) -> None:
        if self.rows:
            step.launch(self.lifts.forward, self.lift, threads=self.layout.members)
        for body, own, rows in self.each(step):
            rows.known = body.known(step)
            step.launch(self.kernels.hold.forward, own.arrays, self.constants, *rows.known)

    def gather(self, step: StepContext, sums: Named) -> None:
        for body, own, _ in self.each(step):
            step.launch(self.kernels.thicken.forward, own.arrays, sums)
            step.launch(self.kernels.lean.forward, body.before, own.arrays, sums)

    def hang(self, step: StepContext, u: wp.array) -> None:
        """Subtract the velocity change by gravity from the velocities ``u`` of particles."""
        if self.rows:
            step.launch(self.kernels.hang.forward, self.lift, u=u)

    def start(self, step: StepContext) -> None:
        for body, own, _ in self.each(step):
            own.add_up(body)
            self.launch(step, self.move.forward, body, own.arrays)

    def launch(self, step: StepContext, kernel: Any, body: FreeBody, *groups: Named) -> None:
        step.launch(kernel, *groups, begun(body), *body.known(step), threads=self.layout.members)

    def pull(self, step: StepContext, *known: Named, v: wp.array, solves: bool = False) -> None:
        """With ``solves``, bodies have the velocities ``V`` and ``W`` of `BodyRows`."""
        for _, own, rows in self.each(step):
            step.launch(self.kernels.pull, rows.velocities if solves else {}, own.arrays, self.constants, *known, v=v)

    def push(self, step: StepContext, *known: Named, v: wp.array, acceleration: wp.array) -> None:
        for _, own, rows in self.each(step):
            step.launch(self.kernels.rub.forward, own.arrays, self.constants, *known, v=v)
            add(own.arrays["rub"], acceleration)
            step.launch(self.kernels.bear.forward, own.arrays)
            wp.copy(rows.arrays["r"], own.whole())

    def multiply(self, step: StepContext, known: tuple[Named, ...], p: wp.array, found: Named) -> None:
        for _, own, rows in self.each(step):
            step.launch(self.kernels.push, rows.velocities, own.arrays, self.constants, found, *known, v=p)
            rows.load = own.whole()

    def finish(self, step: StepContext) -> None:
        for body, own, rows in self.each(step):
            rows.launch(step, rows.kernels.give, body.given, own.impulse)
        self.start(step)

    def act(self, step: StepContext, solid: int, name: str, total: wp.array, now: Named) -> None:
        """Add accelerations to ``total`` if ``name`` is "rub". Add couples if ``name`` is "couple"."""
        for body, own, _ in self.each(step):
            if solid in (ALL_WALLS, body.table.number):
                step.launch(self.kernels.rub.forward, own.arrays, self.constants, now)
                add(own.arrays[name], total)


class FrictionChanges:
    suffix: str

    def __init__(self, friction: FreeFriction):
        self._friction = friction

    @cached_property
    def _own(self) -> dict[str, BodyFriction]:
        return {name: BodyFriction(self._friction.layout, self.suffix) for name in self._friction.own}

    def _each(
        self, step: StepContext, of: Tangents | Adjoints
    ) -> Iterator[tuple[Changes, BodyFriction, BodyFriction, BodyRows]]:
        changes = (one for one in of.bodies if one.body.table.sticks)
        for (body, own, rows), change in zip(self._friction.each(step), changes, strict=True):
            yield change, self._own[body.table.name], own, rows


class FrictionTangent(FrictionChanges):
    suffix = "_dot"

    def begin(self, step: StepContext, dot: Tangents) -> None:
        of = self._friction
        for change, dots, _, _ in self._each(step, dot):
            step.launch(of.kernels.hold.tangent, dots.arrays, *dot.named, of.constants, *change.body.known(step))

    def hang(self, step: StepContext, dot: Tangents, u_dot: wp.array) -> None:
        of = self._friction
        if of.rows:
            known = self._lift, of.lift, *dot.named
            step.launch(of.lifts.tangent, *known, threads=of.layout.members)
            step.launch(of.kernels.hang.tangent, *known, u_dot=u_dot)

    @cached_property
    def _lift(self) -> Arrays:
        return {"lift_dot": wp.zeros_like(self._friction.lift["lift"])}

    def gather(self, step: StepContext, dot: Tangents, sums: Named) -> None:
        kernels = self._friction.kernels
        for change, dots, own, _ in self._each(step, dot):
            known = sums, dots.arrays, own.arrays, *dot.named
            step.launch(kernels.thicken.tangent, *known)
            step.launch(kernels.lean.tangent, change.before, change.body.before, *known)

    def start(self, step: StepContext, dot: Tangents) -> None:
        of = self._friction
        for change, dots, own, _ in self._each(step, dot):
            dots.add_up(change)
            rates = {"density_dot": dot.parameters[change.body.table.weight]}
            of.launch(step, of.move.tangent, change.body, dots.arrays, begun(change), rates, *dot.named, own.arrays)

    def lean(self, step: StepContext, dot: Tangents, A_dot: wp.array, *known: Named) -> None:
        for _, dots, own, _ in self._each(step, dot):
            groups = *known, dots.arrays, own.arrays, *dot.named
            step.launch(self._friction.kernels.lean.tangent, *groups, A_dot=A_dot)

    def push(self, step: StepContext, dot: Tangents, acceleration_dot: wp.array, *known: Named) -> None:
        kernels, time_step_dot = self._friction.kernels, dot.parameters["time_step"]
        for _, dots, own, rows in self._each(step, dot):
            self._rub(step, dot, dots, own, *known)
            add(dots.arrays["rub_dot"], acceleration_dot)
            step.launch(kernels.bear.tangent, dots.arrays, *dot.named, own.arrays)
            load = dots.whole()
            rows.launch(step, rows.kernels.lengthen, own.impulse, time_step_dot=time_step_dot, load=load)
            wp.copy(rows.arrays["r"], load)

    def _rub(self, step: StepContext, dot: Tangents, dots: BodyFriction, own: BodyFriction, *known: Named) -> None:
        groups = *known, dots.arrays, *dot.named, own.arrays, self._friction.constants
        step.launch(self._friction.kernels.rub.forward, *groups)
        step.launch(self._friction.kernels.rub.tangent, *groups)

    def finish(self, step: StepContext, dot: Tangents) -> None:
        for change, dots, _, rows in self._each(step, dot):
            given = {name.removesuffix("_dot"): array for name, array in change.given.items()}
            rows.launch(step, rows.kernels.give, given, dots.impulse)

    def act(self, step: StepContext, dot: Tangents, solid: int, name: str, total_dot: wp.array, *known: Named) -> None:
        for change, dots, own, _ in self._each(step, dot):
            if solid in (ALL_WALLS, change.body.table.number):
                self._rub(step, dot, dots, own, *known)
                add(dots.arrays[f"{name}_dot"], total_dot)


class FrictionAdjoint(FrictionChanges):
    suffix = "_bar"

    @cached_property
    def _shares(self) -> dict[str, wp.array]:
        vector = self._friction.layout.precision.vector
        return self._friction.layout.arrays("_bar", V=vector, W=vector)

    @cached_property
    def _sum(self) -> Any:
        return self._friction.layout.sum_of(self._friction.layout.precision.vector)

    def begin(self, step: StepContext, bar: Adjoints) -> None:
        for _, bars, _, _ in self._each(step, bar):
            clear(bars.arrays.values())

    def take(self, step: StepContext, bar: Adjoints) -> None:
        for change, _, _, rows in self._each(step, bar):
            rows.launch(step, rows.kernels.take, change.given)

    def heed(self, step: StepContext, bar: Adjoints) -> None:
        for _, _, _, rows in self._each(step, bar):
            rows.launch(step, rows.kernels.heed, load=rows.load)

    def push(self, step: StepContext, bar: Adjoints, acceleration_bar: wp.array, *known: Named) -> None:
        kernels, sizes = self._friction.kernels, {"time_step_bar": bar.parameters["time_step"]}
        for _, bars, own, rows in self._each(step, bar):
            solution = {"load_sum_bar": rows.arrays["first"]}
            wp.copy(rows.arrays["r"], rows.arrays["y"])
            rows.launch(step, rows.kernels.lift, total=bars.none_total)
            rows.launch(step, rows.kernels.answer, own.impulse, sizes)
            step.launch(kernels.rub.forward, *known, own.arrays, self._friction.constants)
            step.launch(kernels.bear.adjoint, solution, bars.arrays, *bar.named, own.arrays)
            add(acceleration_bar, bars.arrays["rub_bar"])
            self._rub(step, bar, bars, own, *known)

    def act(self, step: StepContext, bar: Adjoints, solid: int, name: str, total_bar: wp.array, *known: Named) -> None:
        for change, bars, own, _ in self._each(step, bar):
            if solid in (ALL_WALLS, change.body.table.number):
                wp.copy(bars.arrays[f"{name}_bar"], total_bar)
                self._rub(step, bar, bars, own, *known)

    def _rub(self, step: StepContext, bar: Adjoints, bars: BodyFriction, own: BodyFriction, *known: Named) -> None:
        groups = *known, bars.arrays, *bar.named, own.arrays, self._friction.constants
        self._shared(step, self._friction.kernels.rub.adjoint, bars.arrays, *groups)

    def _shared(self, step: StepContext, kernel: Any, motion_bar: Named, *known: Named) -> None:
        clear(self._shares.values())
        step.launch(kernel, self._shares, *known)
        for name, share in self._shares.items():
            add(self._sum(share), motion_bar[name])

    def lean(self, step: StepContext, bar: Adjoints, A_bar: wp.array, *known: Named) -> None:
        for _, bars, own, _ in self._each(step, bar):
            groups = {"A_bar": A_bar}, *known, bars.arrays, *bar.named, own.arrays
            self._shared(step, self._friction.kernels.lean.adjoint, bars.arrays, *groups)

    def gather(self, step: StepContext, bar: Adjoints, sums_bar: Named) -> None:
        kernels = self._friction.kernels
        for change, bars, own, _ in self._each(step, bar):
            groups = sums_bar, bars.arrays, *bar.named, own.arrays
            step.launch(kernels.thicken.adjoint, *groups)
            self._shared(step, kernels.lean.adjoint, change.before, change.body.before, *groups)

    def finish(self, step: StepContext, bar: Adjoints, u_bar: wp.array) -> None:
        """``u_bar`` is the adjoint of the particles' velocities after the step."""
        of = self._friction
        if of.rows:
            share, sizes = self._shares["V_bar"], {"time_step_bar": bar.parameters["time_step"]}
            share.zero_()
            step.launch(of.kernels.hang.adjoint, *bar.named, of.lift, u_bar=u_bar, lift_bar=share)
            total = {"lift_bar": self._sum(share)}
            step.launch(of.lifts.adjoint, total, sizes, *bar.named, of.lift, threads=of.layout.members)
        for change, bars, own, _ in self._each(step, bar):
            body = change.body
            rates = {"density_bar": bar.parameters[body.table.weight], "time_step_bar": bar.parameters["time_step"]}
            rates["turned_bar"] = bars.turned
            bars.turned.zero_()
            of.launch(step, of.move.adjoint, body, bars.arrays, begun(change), rates, *bar.named, own.arrays)
            for total, given, pressed in bars.momenta(change):
                add(total, given)
                add(total, pressed)
            bar.solids.add_whole(body.table.number, turned_bar=bars.turned)
            known = bar.solids.of(body.table.number), bars.arrays, own.arrays, *bar.named, of.constants
            step.launch(of.kernels.hold.adjoint, *known, *body.known(step))
