"""Free bodies in a step of the projection, with derivatives: see `cortado.solvers.projection.body_kernels`."""

from copy import copy
from typing import Any

import warp as wp

from cortado.device.launching import Named
from cortado.device.reduction import add
from cortado.particles.state import Layout, zeros
from cortado.solvers.projection.body_kernels import body_kernels, motion_kernels
from cortado.solvers.projection.joints import Joints, JointsAdjoint, JointsTangent
from cortado.sph.free_solids import Changes, FreeBody, FreeSolidsPart
from cortado.sph.parts import Adjoints, StepContext, Tangents

Arrays = dict[str, wp.array]


class Held:
    """Arrays of particles about one body, or tangents or adjoints with names that end in ``suffix``."""

    def __init__(self, body: FreeBody, layout: Layout, begun: FreeBody | Changes, suffix: str = ""):
        self.body, self.given, self._layout = body, begun.given, layout
        self.start = {f"{name[0]}_0{name[1:]}": array for name, array in begun.before.items()}
        """V_0, W_0 and L_0 before pressures push the body, with precedence over other arrays of a step."""
        precision, vector, device = layout.precision, layout.precision.vector, layout.device
        self.known = layout.arrays(suffix, gamma_of=vector, arm=vector, sizes=precision.pair)
        self.shares = layout.arrays(suffix, pulled=vector, twisted=vector)
        self.moved = {f"{name}{suffix}": wp.zeros(layout.members, dtype=vector, device=device) for name in "VWL"}
        """V, W and L of the body in an iteration."""
        names = ("faster", "turned_faster")
        self.faster = {f"{name}{suffix}": wp.zeros(layout.members, dtype=vector, device=device) for name in names}
        """V - V_0 and W - W_0."""
        self._sums = [layout.sum_of(vector) for _ in range(2)]
        self._suffix, self._whole = suffix, layout.sum_of(precision.pair)
        self.whole: Arrays = {}
        """Sums over particles of |gamma| and |r x gamma|."""

    def at_rest(self) -> "Held":
        """Return a copy that shares the arrays but begins at rest, for a step of length 0 without gravity."""
        other = copy(self)
        vector, real = self._layout.precision.vector, self._layout.precision.real
        kinds = {"V_0": vector, "W_0": vector, "L_0": vector, "time_step": real}
        sizes = {f"{name}{self._suffix}": (self._layout.members, kind) for name, kind in kinds.items()}
        other.start, other.given = zeros(sizes, self._layout.device), {}
        return other

    def add_sizes(self) -> None:
        self.whole = {f"whole{self._suffix}": self._whole(self.known[f"sizes{self._suffix}"])}

    def sums(self) -> Arrays:
        """Return (members,) sums of y gamma and y r x gamma."""
        found = (total(share) for total, share in zip(self._sums, self.shares.values(), strict=True))
        return dict(zip((f"pulled_sum{self._suffix}", f"twisted_sum{self._suffix}"), found, strict=True))


class Bodies:
    def __init__(self, part: FreeSolidsPart, discretisation: Any, layout: Layout):
        self.part, self.layout = part, layout
        self.kernels, self.motion = body_kernels(discretisation), motion_kernels(layout.precision)
        self.held = [Held(body, layout, body) for body in part.bodies]
        self.joints = Joints(part, part.made_of.joints, layout)
        self.drift = wp.zeros(layout.all_particles, dtype=layout.precision.real, device=layout.device)

    @property
    def velocities(self) -> list[Arrays]:
        return [{**held.moved, **held.faster} for held in self.held]

    def at_rest(self) -> "Bodies":
        """Return a copy of these bodies that begins at rest without hinges, so that `drifted` is linear in the
        pressures."""
        other = copy(self)
        other.joints = Joints(self.part, (), self.layout)
        other.held, other.drift = [held.at_rest() for held in self.held], wp.zeros_like(self.drift)
        return other

    def known(self, context: StepContext, held: Held) -> tuple[Named, ...]:
        own = held.known, held.shares, held.faster, held.whole, held.start
        return *own, *held.body.known(context)

    def begin(self, context: StepContext, around: Arrays, k: wp.array) -> None:
        """Compute pushes on bodies and their term in the diagonal. For bodies without slip, compute the momenta by the
        pressures ``k`` of the previous step."""
        self.joints.begin(context)
        for held in self.held:
            context.launch(self.kernels.hold.forward, *self.known(context, held), edge=around["edge"])
            context.launch(self.kernels.measure.forward, *self.known(context, held))
            held.add_sizes()
            context.launch(self.kernels.weigh.forward, *self.known(context, held), a=around["a"])
            if held.body.table.sticks:
                context.launch(self.kernels.pull.forward, *self.known(context, held), y=k)
                for total, pressed in zip(held.sums().values(), held.body.pressed.values(), strict=True):
                    wp.copy(pressed, total)

    def move(self, context: StepContext, held: Held, y: wp.array, moved: Arrays) -> Arrays:
        """Write V, W and L of a body pushed by pressures y, and return the sums of y gamma and y r x gamma."""
        known = self.known(context, held)
        context.launch(self.kernels.pull.forward, *known, y=y)
        sums = held.sums()
        for given, total in zip(held.given.values(), sums.values(), strict=False):
            add(given, total)
        context.launch(self.motion.move.forward, sums, moved, *known, threads=self.layout.members)
        return sums

    def drifted(self, context: StepContext, drift: wp.array, y: wp.array) -> wp.array:
        """Return the drift of walls for the velocities that pressures y give to bodies."""
        self.join(context, y)
        for held in self.held:
            known = self.known(context, held)
            context.launch(self.motion.carry.forward, *known, drift_in=drift, drift=self.drift)
            drift = self.drift
        return drift

    def loosen(self, context: StepContext, y: wp.array) -> list[Arrays]:
        """Write the velocities that pressures y give to bodies without hinges, and return the sums of `move`."""
        return [self.move(context, held, y, held.moved) for held in self.held]

    def join(self, context: StepContext, y: wp.array) -> None:
        """Write the velocities that pressures y give to bodies with hinges."""
        self.loosen(context, y)
        self.joints.join(context, self.velocities)

    def settle(self, context: StepContext, y: wp.array) -> None:
        """Write the velocities that pressures y give to bodies, as those at the end of the step."""
        self.join(context, y)
        for held in self.held:
            for name, array in held.body.moved.items():
                wp.copy(array, held.moved[name])


class BodiesTangent:
    def __init__(self, bodies: Bodies, changes: list[Changes]):
        self._bodies, self._changes = bodies, changes
        self._held = [Held(own.body, bodies.layout, own, "_dot") for own in changes]
        self._joints, self.drift = JointsTangent(bodies.joints), wp.zeros_like(bodies.drift)

    def at_rest(self, bodies: Bodies) -> "BodiesTangent":
        other = copy(self)
        other._bodies, other._held = bodies, [own.at_rest() for own in self._held]
        other._joints, other.drift = JointsTangent(bodies.joints), wp.zeros_like(self.drift)
        return other

    def _known(self, context: StepContext, dot: Tangents, k: int) -> tuple[Named, ...]:
        bodies, held, own = self._bodies, self._bodies.held[k], self._held[k]
        rates = {"density_dot": dot.parameters[held.body.table.weight]}
        dots = own.known, own.shares, own.faster, own.whole, own.start, rates
        return *dots, *dot.named, *bodies.known(context, held)

    def begin(
        self,
        context: StepContext,
        dot: Tangents,
        around: Arrays,
        around_dot: Arrays,
        pressures: tuple[wp.array, wp.array],
    ) -> None:
        kernels = self._bodies.kernels
        edges = {"edge": around["edge"], "edge_dot": around_dot["edge_dot"]}
        self._joints.begin(context, dot)
        for k, own in enumerate(self._held):
            context.launch(kernels.hold.tangent, *self._known(context, dot, k), edges)
            context.launch(kernels.measure.tangent, *self._known(context, dot, k))
            own.add_sizes()
            context.launch(kernels.weigh.tangent, *self._known(context, dot, k), a_dot=around_dot["a_dot"])
            if own.body.table.sticks:
                context.launch(kernels.pull.tangent, *self._known(context, dot, k), y=pressures[0], y_dot=pressures[1])
                for total, pressed in zip(own.sums().values(), self._changes[k].pressed.values(), strict=True):
                    wp.copy(pressed, total)

    def _join(self, context: StepContext, dot: Tangents, y: wp.array, y_dot: wp.array) -> None:
        bodies = self._bodies
        for k in range(len(self._held)):
            self._move(context, dot, k, (y, y_dot))
        dots = [{**own.moved, **own.faster} for own in self._held]
        self._joints.join(context, dot, bodies.velocities, dots)

    def _move(self, context: StepContext, dot: Tangents, k: int, y: tuple[wp.array, wp.array]) -> None:
        bodies, held, own = self._bodies, self._bodies.held[k], self._held[k]
        sums = bodies.move(context, held, y[0], held.moved)
        known = self._known(context, dot, k)
        context.launch(bodies.kernels.pull.tangent, *known, y=y[0], y_dot=y[1])
        sums_dot = own.sums()
        for given, total in zip(own.given.values(), sums_dot.values(), strict=False):
            add(given, total)
        out = held.moved, own.moved
        context.launch(bodies.motion.move.tangent, sums, sums_dot, *out, *known, threads=bodies.layout.members)

    def drifted(
        self, context: StepContext, dot: Tangents, drift_dot: wp.array, y: wp.array, y_dot: wp.array
    ) -> wp.array:
        self._join(context, dot, y, y_dot)
        for k in range(len(self._held)):
            drifts = {"drift_in_dot": drift_dot, "drift_dot": self.drift}
            context.launch(self._bodies.motion.carry.tangent, drifts, *self._known(context, dot, k))
            drift_dot = self.drift
        return drift_dot

    def settle(self, context: StepContext, dot: Tangents, y: wp.array, y_dot: wp.array) -> None:
        self._join(context, dot, y, y_dot)
        for held, own, changes in zip(self._bodies.held, self._held, self._changes, strict=True):
            for name, array in held.body.moved.items():
                wp.copy(array, held.moved[name])
            for name, array in changes.moved.items():
                wp.copy(array, own.moved[name])


class BodiesAdjoint:
    def __init__(self, bodies: Bodies, changes: list[Changes]):
        self._bodies, self._changes = bodies, changes
        layout = bodies.layout
        self._held = [Held(own.body, layout, own, "_bar") for own in changes]
        self.drift_bar = wp.zeros_like(bodies.drift)
        """The adjoint of the drift of one iteration."""
        self._turned, self._joints = (
            [{"turned_bar": wp.zeros_like(own.turned_end)} for own in changes],
            JointsAdjoint(bodies.joints),
        )
        shares = layout.arrays("_bar", whole=layout.precision.pair, density=layout.precision.real)
        self._weighed, self._sum = shares, {name: layout.sum_of(array.dtype) for name, array in shares.items()}
        vectors = {"dtype": layout.precision.vector, "device": layout.device}
        self._sums_bar = {f"{name}_sum_bar": wp.zeros(layout.members, **vectors) for name in ("pulled", "twisted")}

    def _known(self, context: StepContext, bar: Adjoints, k: int) -> tuple[Named, ...]:
        held, own, table = self._bodies.held[k], self._held[k], self._bodies.held[k].body.table
        rates = {"density_bar": bar.parameters[table.weight], "time_step_bar": bar.parameters["time_step"]}
        bars = own.known, own.start, self._turned[k], self._sums_bar, rates
        return *bars, *bar.named, *self._bodies.known(context, held)

    def at_rest(self, bodies: Bodies) -> "BodiesAdjoint":
        other = copy(self)
        other._bodies, other._held = bodies, [own.at_rest() for own in self._held]
        other._joints = JointsAdjoint(bodies.joints)
        return other

    def begin(self) -> None:
        self._joints.begin()
        for own in self._held:
            for array in own.known.values():
                array.zero_()

    def _loosen(self, context: StepContext, bar: Adjoints, y: wp.array, y_bar: wp.array) -> None:
        """Turn the adjoints of bodies' V, W, L, V - V_0 and W - W_0 into the adjoint of the pressures y."""
        bodies, bars = self._bodies, [{**own.moved, **own.faster} for own in self._held]
        sums = bodies.loosen(context, y)
        self._joints.join(context, bar, bodies.velocities, bars, self._turned)
        for k in range(len(bodies.held)):
            known = self._known(context, bar, k)
            context.launch(bodies.motion.move.adjoint, bars[k], sums[k], *known, threads=bodies.layout.members)
            for total, given in zip(self._sums_bar.values(), self._held[k].given.values(), strict=False):
                add(total, given)
            context.launch(bodies.kernels.pull.adjoint, *known, y=y, y_bar=y_bar)

    def settle(self, context: StepContext, bar: Adjoints, y: wp.array, y_bar: wp.array) -> None:
        for own, changes in zip(self._held, self._changes, strict=True):
            for name, array in own.moved.items():
                wp.copy(array, changes.moved[name])
            for array in own.faster.values():
                array.zero_()
        self._loosen(context, bar, y, y_bar)
        for own in self._held:
            for array in own.moved.values():
                array.zero_()

    def drifted(self, context: StepContext, bar: Adjoints, drift_bar: wp.array, y: wp.array, y_bar: wp.array) -> None:
        """Apply the adjoint of `Bodies.drifted` to ``self.drift_bar``, add this array to ``drift_bar``, and set it to
        0."""
        self.carried(context, bar, self.drift_bar, y, y_bar)
        add(self.drift_bar, drift_bar)
        self.drift_bar.zero_()

    def carried(self, context: StepContext, bar: Adjoints, carried_bar: wp.array, y: wp.array, y_bar: wp.array) -> None:
        """Apply the adjoint of the part that `Bodies.drifted` adds to the drift."""
        bodies = self._bodies
        bodies.join(context, y)
        for k, held in enumerate(bodies.held):
            faster = self._held[k].faster
            shares = dict(zip(faster, held.shares.values(), strict=True))
            context.launch(bodies.motion.carry.adjoint, shares, *self._known(context, bar, k), drift_bar=carried_bar)
            for array, total in zip(faster.values(), held.sums().values(), strict=True):
                wp.copy(array, total)
        self._loosen(context, bar, y, y_bar)

    def release(
        self,
        context: StepContext,
        bar: Adjoints,
        around: Arrays,
        around_bar: Arrays,
        pressures: tuple[wp.array, wp.array],
    ) -> None:
        """Apply, after `finish`, the adjoint of the momenta of bodies without slip, given the previous step's pressures
        and their adjoints."""
        for k, held in enumerate(self._bodies.held):
            if held.body.table.sticks:
                for array in self._held[k].known.values():
                    array.zero_()
                known, pressed = self._known(context, bar, k), self._changes[k].pressed.values()
                sums = dict(zip(self._sums_bar, pressed, strict=True))
                context.launch(self._bodies.kernels.pull.adjoint, sums, *known, y=pressures[0], y_bar=pressures[1])
                edges = {"edge": around["edge"], "edge_bar": around_bar["edge_bar"]}
                given = bar.solids.of(held.body.table.number)
                context.launch(self._bodies.kernels.hold.adjoint, given, *known, edges)

    def finish(self, context: StepContext, bar: Adjoints, around: Arrays, around_bar: Arrays) -> None:
        bodies, a_bar = self._bodies, around_bar["a_bar"]
        edges = {"edge": around["edge"], "edge_bar": around_bar["edge_bar"]}
        self._joints.finish(context, bar, self._turned)
        for k, held in enumerate(bodies.held):
            known = self._known(context, bar, k)
            context.launch(bodies.kernels.weigh.adjoint, self._weighed, *known, a_bar=a_bar)
            sums = {name: self._sum[name](share) for name, share in self._weighed.items()}
            add(sums["density_bar"], bar.parameters[held.body.table.weight])
            context.launch(bodies.kernels.share, sums, *known)
            context.launch(bodies.kernels.measure.adjoint, *known)
            given = bar.solids.of(held.body.table.number)
            context.launch(bodies.kernels.hold.adjoint, given, *known, edges)
            turned = self._turned[k]["turned_bar"]
            bar.solids.add_whole(held.body.table.number, turned_bar=turned)
            turned.zero_()
