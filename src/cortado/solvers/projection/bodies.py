"""A rigid body in the projection: pressures change the velocities of the body and of the fluid.

The walls of a body push particle i in proportion to the vector

    gamma_i = sum w_b (N_b g_ib + e_i (g_ib - N_b g_ib)),   N_b = n_b n_b^T.

Each wall particle b of the body adds a term with its weight w_b, its normal n_b and its kernel gradient g_ib. The edge
factor e_i is computed from all walls (`cortado.solvers.projection.wall_sums`). Pressure impulses y give the body the
velocity V, the angular momentum L and the angular velocity W:

    V = V_0 + dt g + sum y_i gamma_i / (rho K),   L = L_0 + sum y_i r_i x gamma_i,   W = R' I^-1 R'^T L / rho

Particle i has the arm r_i = x_i - c'. The body has the density rho, and its volume is K particle volumes. The map from
y to V and W is the transpose of the body's term in the divergence, - gamma_i . (V + W x r_i). The sum over all walls
already contains the part of the body's term from the wall velocity (V_0, W_0). For a body with restricted motion,
smaller matrices replace 1 / (rho K) and R' I^-1 R'^T (`cortado.sph.moving_solids`).

All particles around a light body move the body. The diagonal a_i of the pressure iteration therefore includes the term

    |gamma_i| sum_j |gamma_j| / (rho K) + lambda |r_i x gamma_i| sum_j |r_j x gamma_j| / rho

with the largest eigenvalue lambda of I^-1. With this diagonal the body's part of the matrix has no eigenvalue above 2.
"""

from copy import copy
from functools import cache
from types import SimpleNamespace
from typing import Any

import warp as wp

from cortado.device.launching import Named
from cortado.device.modules import Kernels
from cortado.device.precision import Precision
from cortado.device.reduction import add
from cortado.particles.neighbourhood import Discretisation, pair_functions
from cortado.particles.pair_sums import solid_sum
from cortado.particles.particle_kernels import over, particle_kernel, pointwise_kernels
from cortado.particles.state import Layout, clear, zeros
from cortado.solvers.projection.joints import Joints, JointsAdjoint, JointsTangent
from cortado.solvers.projection.wall_sums import normal_part, types_by_name
from cortado.sph.free_solids import Changes, FreeBody, FreeSolidsPart
from cortado.sph.moving_solids import free_module, move_kernels
from cortado.sph.parts import Adjoints, StepContext, Tangents


@cache
def body_kernels(discretisation: Discretisation) -> SimpleNamespace:
    precision, (real, vector, neighbourhood) = discretisation.precision, discretisation.types
    pair_of, pair = precision.pair, pair_functions(discretisation)
    gradient, hessian_product, separation = pair.gradient, pair.hessian_product, pair.separation
    normal, typed = normal_part(discretisation), types_by_name(precision)
    modules = module, tangent_module, adjoint_module = discretisation.modules("projection_bodies")

    @wp.func
    def between(a: vector, foot: vector, edge: real) -> vector:
        """Return the part of ``a`` along a wall's normal, plus ``edge`` times the remaining part."""
        part = normal(a, foot)
        return part + edge * (a - part)

    @solid_sum(discretisation)
    def push(x_ij: vector, edge_i: real, foot: vector, solid: int, s: neighbourhood) -> vector:
        return s.volume * between(gradient(x_ij, s), foot, edge_i)

    @solid_sum(discretisation, typed)
    def push_tangent(x_ij, x_dot_ij, edge_i, edge_dot_i, foot, turn_dot, solid: int, s) -> vector:
        G, rest = gradient(x_ij, s), x_dot_ij - wp.cross(turn_dot, x_ij)
        change = between(hessian_product(x_ij, rest, s), foot, edge_i) + edge_dot_i * (G - normal(G, foot))
        return s.volume * (change + wp.cross(turn_dot, between(G, foot, edge_i)))

    @solid_sum(discretisation, typed)
    def push_back(x_ij, edge_i, bar_i: vector, foot, solid: int, s) -> tuple[vector, real]:
        G = gradient(x_ij, s)
        pushed = s.volume * hessian_product(x_ij, between(bar_i, foot, edge_i), s)
        return pushed, s.volume * wp.dot(G - normal(G, foot), bar_i)

    @particle_kernel(module, "gamma_of arm", [over(push, "total")], numbers=["solid"])
    def hold(solid: int, total: vector, after: vector, x_i: vector, s: neighbourhood) -> tuple[vector, vector]:
        return total, separation(x_i, after, s)

    @particle_kernel(tangent_module, "gamma_of_dot arm_dot", [over(push_tangent, "total")], numbers=["solid"])
    def hold_tangent(solid: int, total: vector, after_dot: vector, x_dot_i: vector) -> tuple[vector, vector]:
        return total, x_dot_i - after_dot

    back = over(push_back, "total edge_part", bar="gamma_of_bar")

    @particle_kernel(adjoint_module, "+edge_bar +x_bar +force_bar +torque_bar", [back], numbers=["solid"])
    def hold_adjoint(
        total: vector, edge_part: real, gamma_of_i: vector, arm_i: vector, gamma_of_bar_i: vector, arm_bar_i: vector
    ) -> tuple[real, vector, vector, vector]:
        torque = wp.cross(gamma_of_i, gamma_of_bar_i) - wp.cross(arm_i, total)
        return edge_part, total + arm_bar_i, -total - arm_bar_i, torque

    def measure(gamma_of_i: vector, arm_i: vector) -> pair_of:
        return pair_of(wp.length(gamma_of_i), wp.length(wp.cross(arm_i, gamma_of_i)))

    def weigh(density: real, pushed_volume: real, greatest: real, sizes_i: pair_of, whole: pair_of) -> real:
        return wp.dot(sizes_i, pair_of(whole[0] / pushed_volume, greatest * whole[1])) / density

    @particle_kernel(adjoint_module, "+sizes_bar")
    def share(whole_bar: pair_of) -> pair_of:
        return whole_bar

    def pull(y_i: real, gamma_of_i: vector, arm_i: vector) -> tuple[vector, vector]:
        return y_i * gamma_of_i, y_i * wp.cross(arm_i, gamma_of_i)

    @particle_kernel(tangent_module, "pulled_dot twisted_dot", typed=typed)
    def pull_tangent(y_i, y_dot_i, gamma_of_i, gamma_of_dot_i, arm_i, arm_dot_i) -> tuple[vector, vector]:
        """The generated tangent of `pull` would be slower."""
        turn = wp.cross(arm_dot_i, gamma_of_i) + wp.cross(arm_i, gamma_of_dot_i)
        return y_dot_i * gamma_of_i + y_i * gamma_of_dot_i, y_dot_i * wp.cross(arm_i, gamma_of_i) + y_i * turn

    def made(function: Any, results: list[str], **names: Any) -> Kernels:
        return pointwise_kernels(precision, modules, lambda _: function, results, **names)

    sums = ["pulled", "twisted"]
    return SimpleNamespace(
        hold=Kernels(hold, hold_tangent, hold_adjoint),
        measure=made(measure, ["sizes"]),
        weigh=made(weigh, ["a:a"], numbers=["pushed_volume", "greatest"], written=["sizes", "whole", "density"]),
        share=share,
        pull=made(pull, sums, summed=sums)._replace(tangent=pull_tangent),
    )


@cache
def motion_kernels(precision: Precision) -> SimpleNamespace:
    real, vector = precision.real, precision.vector

    def carry(faster: vector, turned_faster: vector, gamma_of_i: vector, arm_i: vector) -> real:
        return wp.dot(gamma_of_i, faster + wp.cross(turned_faster, arm_i))

    modules, written = [free_module(precision)] * 3, ["faster", "turned_faster"]
    carries = pointwise_kernels(precision, modules, lambda _: carry, ["drift:drift_in"], written=written)
    return SimpleNamespace(move=move_kernels(precision), carry=carries)


Arrays = dict[str, wp.array]


class Held:
    """Arrays of the particles near one rigid body. ``suffix`` selects tangents or adjoints."""

    def __init__(self, body: FreeBody, layout: Layout, begun: FreeBody | Changes, suffix: str = ""):
        self.body, self.given, self._layout = body, begun.given, layout
        self.start = {f"{name[0]}_0{name[1:]}": array for name, array in begun.before.items()}
        precision, vector, size = layout.precision, layout.precision.vector, (layout.members, layout.precision.vector)
        self.known = layout.arrays(suffix, gamma_of=vector, arm=vector, sizes=precision.pair)
        self.shares = layout.arrays(suffix, pulled=vector, twisted=vector)
        self.moved = zeros({f"{name}{suffix}": size for name in "VWL"}, layout.device)
        """Velocity, angular velocity and angular momentum of the body with the pressures of an iteration."""
        self.faster = zeros({f"{name}{suffix}": size for name in ("faster", "turned_faster")}, layout.device)
        self._sums = [layout.sum_of(vector) for _ in range(2)]
        self._suffix, self._whole = suffix, layout.sum_of(precision.pair)
        self.whole: Arrays = {}
        """Sums of the magnitudes of all particles' forces and torques on the body."""

    def at_rest(self) -> "Held":
        """Return a copy that shares the arrays, for a body at rest."""
        other, precision, members = copy(self), self._layout.precision, self._layout.members
        kinds = {**dict.fromkeys(("V_0", "W_0", "L_0"), precision.vector), "time_step": precision.real}
        sizes = {f"{name}{self._suffix}": (members, kind) for name, kind in kinds.items()}
        other.start, other.given = zeros(sizes, self._layout.device), {}
        return other

    def add_sizes(self) -> None:
        self.whole = {f"whole{self._suffix}": self._whole(self.known[f"sizes{self._suffix}"])}

    def sums(self) -> Arrays:
        """Return arrays of shape (members,) with the momentum and angular momentum that pressures give to the body."""
        found = (total(share) for total, share in zip(self._sums, self.shares.values(), strict=True))
        return dict(zip((f"pulled_sum{self._suffix}", f"twisted_sum{self._suffix}"), found, strict=True))

    def pushes(self) -> Arrays:
        """Return the momentum and angular momentum that pressures, contacts, springs and friction give to the body."""
        found = self.sums()
        for given, total in zip(self.given.values(), found.values(), strict=False):
            add(given, total)
        return found


class Bodies:
    def __init__(self, part: FreeSolidsPart, discretisation: Discretisation, around: Arrays):
        self.part, self.layout, self._around = part, part.layout, around
        layout = part.layout
        self.kernels, self.motion = body_kernels(discretisation), motion_kernels(layout.precision)
        self.held = [Held(body, layout, body) for body in part.bodies]
        self.joints = Joints(part, part.made_of.joints, layout)
        self.drift = wp.zeros(layout.all_particles, dtype=layout.precision.real, device=layout.device)

    @property
    def velocities(self) -> list[Arrays]:
        return [{**held.moved, **held.faster} for held in self.held]

    def at_rest(self) -> "Bodies":
        """Return a copy for bodies at rest without hinges. The copy has a `drifted` that is linear in the pressures."""
        other = copy(self)
        other.joints = Joints(self.part, (), self.layout)
        other.held, other.drift = [held.at_rest() for held in self.held], wp.zeros_like(self.drift)
        return other

    def known(self, context: StepContext, held: Held) -> tuple[Named, ...]:
        own = held.known, held.shares, held.faster, held.whole, held.start
        return *own, *held.body.known(context), self._around

    def begin(self, context: StepContext, k: wp.array) -> None:
        """``k`` are the pressures of the last step."""
        self.joints.begin(context)
        for held in self.held:
            context.launch(self.kernels.hold.forward, *self.known(context, held))
            context.launch(self.kernels.measure.forward, *self.known(context, held))
            held.add_sizes()
            context.launch(self.kernels.weigh.forward, *self.known(context, held))
            if held.body.table.sticks:
                context.launch(self.kernels.pull.forward, *self.known(context, held), y=k)
                copy_each(held.sums(), held.body.pressed)

    def loosen(self, context: StepContext, y: wp.array) -> list[Arrays]:
        """Write velocities of bodies without the effect of hinges. Return the momenta that pressures ``y`` give."""
        found = []
        for held in self.held:
            known = self.known(context, held)
            context.launch(self.kernels.pull.forward, *known, y=y)
            found.append(held.pushes())
            context.launch(self.motion.move.forward, found[-1], held.moved, *known, threads=self.layout.members)
        return found

    def join(self, context: StepContext, y: wp.array) -> None:
        self.loosen(context, y)
        self.joints.join(context, self.velocities)

    def drifted(self, context: StepContext, drift: wp.array, y: wp.array) -> wp.array:
        """Return the divergence that walls cause when bodies move under pressures ``y``."""
        self.join(context, y)
        for held in self.held:
            known = self.known(context, held)
            context.launch(self.motion.carry.forward, *known, drift_in=drift, drift=self.drift)
            drift = self.drift
        return drift

    def settle(self, context: StepContext, y: wp.array) -> None:
        self.join(context, y)
        for held in self.held:
            copy_each(held.moved, held.body.moved)


def copy_each(given: Named, to: Named) -> None:
    for source, array in zip(given.values(), to.values(), strict=True):
        wp.copy(array, source)


class BodiesTangent:
    def __init__(self, bodies: Bodies, changes: list[Changes], dot: Tangents, around: Arrays):
        self._bodies, self._changes, self._dot, self._around = bodies, changes, dot, around
        self._held = [Held(own.body, bodies.layout, own, "_dot") for own in changes]
        self._joints, self.drift = JointsTangent(bodies.joints, dot), wp.zeros_like(bodies.drift)

    def at_rest(self, bodies: Bodies) -> "BodiesTangent":
        other = copy(self)
        other._bodies, other._held = bodies, [own.at_rest() for own in self._held]
        other._joints, other.drift = JointsTangent(bodies.joints, self._dot), wp.zeros_like(self.drift)
        return other

    def _known(self, context: StepContext, k: int) -> tuple[Named, ...]:
        held, own = self._bodies.held[k], self._held[k]
        rates = {"density_dot": self._dot.parameters[held.body.table.weight]}
        dots = own.known, own.shares, own.faster, own.whole, own.start, rates
        return *dots, *self._dot.named, self._around, *self._bodies.known(context, held)

    def begin(self, context: StepContext, k: wp.array, k_dot: wp.array) -> None:
        kernels = self._bodies.kernels
        self._joints.begin(context)
        for n, own in enumerate(self._held):
            context.launch(kernels.hold.tangent, *self._known(context, n))
            context.launch(kernels.measure.tangent, *self._known(context, n))
            own.add_sizes()
            context.launch(kernels.weigh.tangent, *self._known(context, n))
            if own.body.table.sticks:
                context.launch(kernels.pull.tangent, *self._known(context, n), y=k, y_dot=k_dot)
                copy_each(own.sums(), self._changes[n].pressed)

    def _join(self, context: StepContext, y: wp.array, y_dot: wp.array) -> None:
        bodies, members = self._bodies, self._bodies.layout.members
        sums = bodies.loosen(context, y)
        for k, own in enumerate(self._held):
            known = self._known(context, k)
            context.launch(bodies.kernels.pull.tangent, *known, y=y, y_dot=y_dot)
            found = sums[k], own.pushes(), bodies.held[k].moved, own.moved
            context.launch(bodies.motion.move.tangent, *found, *known, threads=members)
        self._joints.join(context, bodies.velocities, [{**own.moved, **own.faster} for own in self._held])

    def drifted(self, context: StepContext, drift_dot: wp.array, y: wp.array, y_dot: wp.array) -> wp.array:
        self._join(context, y, y_dot)
        for k in range(len(self._held)):
            drifts = {"drift_in_dot": drift_dot, "drift_dot": self.drift}
            context.launch(self._bodies.motion.carry.tangent, drifts, *self._known(context, k))
            drift_dot = self.drift
        return drift_dot

    def settle(self, context: StepContext, y: wp.array, y_dot: wp.array) -> None:
        self._join(context, y, y_dot)
        for held, own, changes in zip(self._bodies.held, self._held, self._changes, strict=True):
            copy_each(held.moved, held.body.moved)
            copy_each(own.moved, changes.moved)


class BodiesAdjoint:
    def __init__(self, bodies: Bodies, changes: list[Changes], bar: Adjoints, around: Arrays):
        self._bodies, self._changes, self._bar, self._around = bodies, changes, bar, around
        layout = bodies.layout
        self._held = [Held(own.body, layout, own, "_bar") for own in changes]
        self.drift_bar = wp.zeros_like(bodies.drift)
        self._turned = [{"turned_bar": wp.zeros_like(own.turned_end)} for own in changes]
        self._joints = JointsAdjoint(bodies.joints, bar, self._turned)
        shares = layout.arrays("_bar", whole=layout.precision.pair, density=layout.precision.real)
        self._weighed, self._sum = shares, {name: layout.sum_of(array.dtype) for name, array in shares.items()}
        kinds = dict.fromkeys(("pulled_sum_bar", "twisted_sum_bar"), (layout.members, layout.precision.vector))
        self._sums_bar = zeros(kinds, layout.device)

    def at_rest(self, bodies: Bodies) -> "BodiesAdjoint":
        other = copy(self)
        other._bodies, other._held = bodies, [own.at_rest() for own in self._held]
        other._joints = JointsAdjoint(bodies.joints, self._bar, self._turned)
        return other

    def _known(self, context: StepContext, k: int) -> tuple[Named, ...]:
        held, own, bar = self._bodies.held[k], self._held[k], self._bar.parameters
        rates = {"density_bar": bar[held.body.table.weight], "time_step_bar": bar["time_step"]}
        bars = own.known, own.start, self._turned[k], self._sums_bar, rates
        return *bars, *self._bar.named, self._around, *self._bodies.known(context, held)

    def begin(self) -> None:
        self._joints.begin()
        for own in self._held:
            clear(own.known.values())

    def _loosen(self, context: StepContext, y: wp.array, y_bar: wp.array) -> None:
        bodies, bars = self._bodies, [{**own.moved, **own.faster} for own in self._held]
        sums = bodies.loosen(context, y)
        self._joints.join(context, bodies.velocities, bars)
        for k, own in enumerate(self._held):
            known = self._known(context, k)
            context.launch(bodies.motion.move.adjoint, bars[k], sums[k], *known, threads=bodies.layout.members)
            for total, given in zip(self._sums_bar.values(), own.given.values(), strict=False):
                add(total, given)
            context.launch(bodies.kernels.pull.adjoint, *known, y=y, y_bar=y_bar)

    def settle(self, context: StepContext, y: wp.array, y_bar: wp.array) -> None:
        for own, changes in zip(self._held, self._changes, strict=True):
            copy_each(changes.moved, own.moved)
            clear(own.faster.values())
        self._loosen(context, y, y_bar)
        for own in self._held:
            clear(own.moved.values())

    def drifted(self, context: StepContext, drift_bar: wp.array, y: wp.array, y_bar: wp.array) -> None:
        """Apply the adjoint of `Bodies.drifted`. The method adds adjoints to ``drift_bar`` and ``y_bar``."""
        self.carried(context, self.drift_bar, y, y_bar)
        add(self.drift_bar, drift_bar)
        self.drift_bar.zero_()

    def carried(self, context: StepContext, carried_bar: wp.array, y: wp.array, y_bar: wp.array) -> None:
        bodies = self._bodies
        bodies.join(context, y)
        for k, held in enumerate(bodies.held):
            faster = self._held[k].faster
            shares = dict(zip(faster, held.shares.values(), strict=True))
            context.launch(bodies.motion.carry.adjoint, shares, *self._known(context, k), drift_bar=carried_bar)
            copy_each(held.sums(), faster)
        self._loosen(context, y, y_bar)

    def release(self, context: StepContext, k_before: wp.array, k_before_bar: wp.array) -> None:
        for k, held in enumerate(self._bodies.held):
            if held.body.table.sticks:
                clear(self._held[k].known.values())
                sums = dict(zip(self._sums_bar, self._changes[k].pressed.values(), strict=True))
                pulled = {"y": k_before, "y_bar": k_before_bar}
                context.launch(self._bodies.kernels.pull.adjoint, sums, *self._known(context, k), pulled)
                given = self._bar.solids.of(held.body.table.number)
                context.launch(self._bodies.kernels.hold.adjoint, given, *self._known(context, k))

    def finish(self, context: StepContext) -> None:
        bodies, bar = self._bodies, self._bar
        self._joints.finish(context)
        for k, held in enumerate(bodies.held):
            known, table = self._known(context, k), held.body.table
            context.launch(bodies.kernels.weigh.adjoint, self._weighed, *known)
            sums = {name: self._sum[name](share) for name, share in self._weighed.items()}
            add(sums["density_bar"], bar.parameters[table.weight])
            context.launch(bodies.kernels.share, sums, *known)
            context.launch(bodies.kernels.measure.adjoint, *known)
            context.launch(bodies.kernels.hold.adjoint, bar.solids.of(table.number), *known)
            bar.solids.add_whole(table.number, **self._turned[k])
            self._turned[k]["turned_bar"].zero_()
