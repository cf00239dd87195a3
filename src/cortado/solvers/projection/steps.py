"""A step of the projection: pressures that remove divergence, a shift of particles, and repairs of the density.

`docs/projection_step.md` has the equations of the pressure, the shift delta and the repairs. With
``velocities_follow``, velocities change to first order with the positions in the shift and the repairs (Xu, Stansby and
Laurence 2009):

    v' = v - A (1.05 (M + 0.05 I)^-1) (x_K - x - dt v),   A = sum_j v_ij g_ij^T,

where M is the moment matrix, I the unit matrix, and x_K are the positions after the last repair. The matrix A is from
the last iteration of the pressure.
"""

from functools import cache, cached_property
from math import inf
from types import SimpleNamespace
from typing import Any

import numpy as np
import warp as wp

from cortado.device.grid import Grid
from cortado.device.modules import Kernels
from cortado.device.precision import Precision
from cortado.particles.neighbourhood import Discretisation
from cortado.particles.particle_kernels import pointwise_kernels
from cortado.particles.state import Entry, Parameters, State, StateField
from cortado.scene.solvers import ProjectionSolver
from cortado.solvers.loop import IterationLog, Loop, LoopLimits
from cortado.solvers.particles import ParticleSolver, ParticleSystem
from cortado.solvers.projection.bodies import Bodies
from cortado.solvers.projection.coarse import Coarse
from cortado.solvers.projection.effects import effect_functions
from cortado.solvers.projection.lattice import ProjectionConstants
from cortado.solvers.projection.mean_stress import ImageLoads, MeanStress, pressed_kernels
from cortado.solvers.projection.pressure import beginning_kernels, pressure_kernels
from cortado.solvers.projection.repair import repair_kernels
from cortado.solvers.projection.sides import Sides
from cortado.solvers.projection.sums import velocity_kernels
from cortado.solvers.projection.surroundings import Surroundings
from cortado.solvers.projection.wall_sums import ProjectionPush, types_by_name
from cortado.solvers.solver import Counts
from cortado.sph.free_solids import FreeSolidsPart
from cortado.sph.moment_functions import symmetric
from cortado.sph.parts import Carried, StepContext, integration_module

RATE = 20.0
GREATEST = 0.5
"""Upper bound on the rate of the shift."""
FARTHEST = 0.1
"""Greatest shift of a particle in a step [spacings]."""
SURFACE = 0.03
"""Magnitude of the surface normal vector times the spacing, below which a particle has no surface direction."""
AWAY = 4.0
"""Additional factor for moving close pairs apart."""
LEAST = 1e-5
"""Velocity gradient times time step below which the rate of the shift is quadratic."""
PULLED = 60.0
"""Factor of the rate of the shift under tension."""
WEAK = 0.004
"""Dimensionless tension below which the rate of the shift is quadratic."""


@cache
def shift_kernels(d: Discretisation, dimension: int) -> Kernels:
    precision, modules = d.precision, d.modules(f"projection_{dimension}d")
    real, vector, typed = precision.real, precision.vector, types_by_name(precision)
    inverse = effect_functions(precision, dimension, modules[0]).inverse
    rate, greatest, least = (wp.constant(real(value)) for value in (RATE, GREATEST, LEAST))
    farthest, away = wp.constant(real(FARTHEST)), wp.constant(real(AWAY))
    surface, pulled, weak = (wp.constant(real(value)) for value in (SURFACE**2, PULLED, WEAK))

    @typed
    def shift(spacing, time_step, A_i, k_i, m_i, M_i, g_i, beside_i, crowd_i, apart_i, weights_i) -> vector:
        G = A_i * inverse(real(0.5) * (M_i + wp.transpose(M_i)))  # so that the adjoint of M is symmetric, as M is
        turned = time_step * time_step * wp.ddot(G, G)
        strength = rate * turned / (wp.sqrt(turned + least * least) + least)
        pull = weights_i[3] * time_step * wp.max(-k_i, real(0.0)) / (m_i * spacing * spacing)
        strength += pulled * pull * pull / ((pull + weak) * wp.sqrt(pull + weak))
        out, slope = g_i + beside_i, crowd_i + beside_i
        square = wp.dot(out, out) + surface / (spacing * spacing)
        along = slope - (wp.dot(out, slope) / square) * out
        strength = strength / wp.sqrt(real(1.0) + (strength / greatest) * (strength / greatest))
        wish = strength * (away * apart_i - (spacing * spacing * weights_i[2]) * along)
        most = farthest * spacing
        return wish / wp.sqrt(real(1.0) + wp.dot(wish, wish) / (most * most))

    return pointwise_kernels(precision, modules, lambda _: shift, ["delta"], numbers=["spacing"])


@cache
def following_kernels(d: Discretisation, dimension: int) -> Kernels:
    precision, modules = d.precision, d.modules(f"projection_following_{dimension}d")
    real, vector, matrix = precision.real, precision.vector, precision.matrix
    inverse = effect_functions(precision, dimension, modules[0]).inverse

    def follow(time_step: real, x_i: vector, M_i: matrix, A_i: matrix, x_now_i: vector, v_new_i: vector) -> vector:
        M = real(0.5) * (M_i + wp.transpose(M_i))  # so that the adjoint of M is symmetric, as M is
        return v_new_i - A_i * (inverse(M) * (x_now_i - x_i - time_step * v_new_i))

    return pointwise_kernels(precision, modules, lambda _: follow, ["v_end"], {"v_end": "v_new"})


@cache
def moving_kernels(precision: Precision) -> Kernels:
    modules = [integration_module(precision, forward, topic="moving") for forward in (True, False, False)]
    real, vector = precision.real, precision.vector

    def move(time_step: real, x_i: vector, v_new_i: vector, delta_i: vector) -> vector:
        return x_i + time_step * v_new_i + delta_i

    return pointwise_kernels(precision, modules, lambda _: move, ["x_moved"], {"x_moved": "delta"})


IMPULSE = "pressure_impulse"
"""Name of the state field for pressure times time step."""
KICK = "pressure_kick"
"""Name of the state field for the velocity change by pressures."""
MOMENTUM = 8.0 / (1.0 + 101.0**0.5)
"""Momentum of the first pressure iteration (Nesterov 1983). Later pressure iterations have no momentum."""


class ProjectionSteps(ParticleSolver):
    topic = "projection"
    density: Surroundings
    density_power = 0
    carried_fields = (StateField(IMPULSE, "Pa s", Entry.NUMBER), StateField(KICK, "m/s", Entry.VECTOR))

    def __init__(
        self, system: ParticleSystem, table: ProjectionSolver, constants: ProjectionConstants, grid: Grid, endless: bool
    ):
        """An ``endless`` scene, with all axes periodic, has no coarse correction on the ``grid``."""
        self.constants, repairs = constants, table.repairs
        limits = LoopLimits(table.iterations, table.iterations, 0.0, 0.0)
        if table.tolerance is not None:
            limits = LoopLimits(table.iterations, table.maximum_iterations, table.tolerance, inf)
        super().__init__(system)
        own = self.discretisation, system.walled.dimension
        self.kernels = SimpleNamespace(
            beginning=beginning_kernels(*own),
            velocity=velocity_kernels(*own),
            pressure=pressure_kernels(*own),
            shift=shift_kernels(*own),
            moving=moving_kernels(self.discretisation.precision),
            repair=repair_kernels(*own),
        )
        precision = self.layout.precision
        real, vector = precision.real, precision.vector
        self._iterate_kinds = {"u": vector, "A": precision.matrix, "d": real, "y": real, "k": real}
        self._repair_kinds = {"x_now": vector, "c": real, "excess": real, "held": real}
        self.iterates: list[dict[str, wp.array]] = []
        """Values before each pressure iteration. The last element has the result."""
        self.corrected: list[dict[str, wp.array]] = []
        """Velocities and pressures after each coarse correction."""
        self.repaired: list[dict[str, wp.array]] = []
        """Positions, multipliers and density errors before each repair."""
        vectors = dict.fromkeys(("x_star", "v_star", "kick", "x_moved", "delta"), vector)
        self.known: dict[str, Any] = {
            **self.density.around,
            **self.density.constants,
            **{"spacing": constants.spacing, "omega": constants.relaxation},
            **self.layout.arrays(**vectors, T=symmetric(precision).kind),
            **{"k_before": self.carried[IMPULSE], "kick_before": self.carried[KICK]},
            "surfaced": self.density.surfaced,
        }
        self.sides = None if system.sheets is None else Sides(system.sheets, constants.spacing, self.layout)
        self.following = following_kernels(*own) if table.velocities_follow else None
        free = [part for part in self.parts if isinstance(part, FreeSolidsPart)]
        self.bodies = Bodies(free[0], self.discretisation, self.density.around) if free else None
        self.coarse = Coarse(system, grid, self.bodies, endless)
        self.known["warm"] = self.coarse.warm
        ProjectionSteps.reserve(self, (0, 0))
        self.repair_relaxations = constants.repair_relaxations(repairs)
        self.loops = (
            Loop(limits, self.layout, self.launch, "iterations", "divergence", weighted=True),
            Loop(LoopLimits(repairs, repairs, 0.0, 0.0), self.layout, self.launch, "repairs", "density_errors"),
        )

    def new_density(self) -> Surroundings:
        return Surroundings(self.system, self.topic, self.constants)

    def kick_of(self, carried: Carried) -> wp.array:
        return carried[KICK]

    def wall_push(self) -> ProjectionPush:
        return ProjectionPush(self.system, self.constants)

    def image_loads(self) -> ImageLoads | None:
        mirrors = np.isfinite(self.system.mirrors).any() or len(self.system.faces.solids)
        return ImageLoads(self.density) if mirrors else None

    def step(self, state: State, new_state: State, parameters: Parameters, log: IterationLog) -> None:
        context = self.predict(state, parameters)
        projection, repair = self.loops
        projection.run(lambda k: self.iterate(context, k, 0, 0))
        self.settle(context, 0)
        repair.run(lambda k: self.mend(context, k, 0, 0))
        v_end = self._finish(context, 0, 0, new_state)
        self.end_step(self.repaired[0]["x_now"], v_end, new_state, log)

    def reserve(self, counts: Counts) -> None:
        iterations, repairs = counts
        while len(self.iterates) <= iterations:
            self.iterates.append(self.layout.arrays(**self._iterate_kinds))
            self.corrected.append({**self.layout.arrays(**self._iterate_kinds), **self.coarse.room()})
        while len(self.repaired) <= repairs:
            self.repaired.append(self.layout.arrays(**self._repair_kinds))

    def replay(self, state: State, parameters: Parameters, counts: Counts) -> None:
        self.reserve(counts)
        iterations, repairs = counts
        context = self.predict(state, parameters)
        for k in range(iterations):
            self.iterate(context, k, k, k + 1)
        self.settle(context, iterations)
        for k in range(repairs):
            self.mend(context, k, k, k + 1)

    def write_state(self, counts: Counts, parameters: Parameters, new_state: State) -> None:
        iterations, repairs = counts
        self._finish(self.context(parameters), iterations, repairs, new_state)

    def pressures(self) -> wp.array:
        return self._over_time(self.iterates[0]["k"], "push")

    def stresses(self) -> wp.array:
        context = self.context(self.parameters)
        return self._over_time(self.mean_stress.impulses(context, self.iterates[0], self.known), "stress")

    def _over_time(self, impulses: wp.array, name: str) -> wp.array:
        pressed, found = pressed_kernels(self.layout.precision).forward, self._pressures[name]
        self.context(self.parameters).launch(pressed, impulse=impulses, p=found)
        return found

    @cached_property
    def _pressures(self) -> dict[str, wp.array]:
        return {"push": self.numbers(), "stress": self.numbers()}

    @cached_property
    def mean_stress(self) -> MeanStress:
        return MeanStress(self.system)

    @property
    def parameters(self) -> Parameters:
        assert self._context is not None
        return self._context.parameters

    def predict(self, state: State, parameters: Parameters) -> StepContext:
        context = self.sort(state, parameters)
        if self.bodies is not None:
            self.bodies.begin(context, self.carried[IMPULSE])
        context.launch(self.integration.predict, self.known, acceleration=self.accelerate(context))
        self.coarse.warm.zero_()
        context.launch(self.kernels.beginning.forward, self.iterates[0], self.known)
        self.coarse.begin(context, self.known)
        return context

    def iterate(self, context: StepContext, k: int, before: int, after: int) -> None:
        """``before`` and ``after`` are indices into `iterates`."""
        old, at, new = self.iterates[before], self.corrected[before], self.iterates[after]

        def correct() -> None:
            self.coarse.correct(context, k, {**self.known, "drift": self._drift(context, old)}, old, at)

        for name in ("k", "y", "u") if k == 0 or self.coarse.endless else ():  # where nothing corrects them
            wp.copy(at[name], old[name])
        self.coarse.where_due(k, correct)
        out = {"k_out": new["k"], "y_out": new["y"], "error": self.loops[0].errors, "drift": self._drift(context, at)}
        context.launch(self.kernels.pressure.update.forward, out, at, self.known, beta=self.momentum(k))
        context.launch(self.kernels.velocity.velocity.forward, new, self.known)

    def momentum(self, k: int) -> float:
        return MOMENTUM if k == 0 else 0.0

    def _drift(self, context: StepContext, at: dict[str, wp.array]) -> wp.array:
        """Return the divergence due to moving walls. The pressures of the iteration move the walls of free bodies."""
        drift = self.density.around["drift"]
        return drift if self.bodies is None else self.bodies.drifted(context, drift, at["y"])

    def settle(self, context: StepContext, last: int) -> None:
        """Write the positions that follow from the new velocities and the shift."""
        if self.bodies is not None:
            self.bodies.settle(context, self.iterates[last]["y"])
        end, first = self.end_of(last), self.repaired[0]
        context.launch(self.kernels.shift.forward, end, self.known)
        context.launch(self.kernels.moving.forward, end, self.known)
        wp.copy(first["x_now"], self.known["x_moved"])
        first["c"].zero_()

    def end_of(self, slot: int) -> dict[str, wp.array]:
        end = self.iterates[slot]
        return {"k": end["k"], "v_new": end["u"], "A": self.corrected[max(slot - 1, 0)]["A"]}

    def mend(self, context: StepContext, k: int, before: int, after: int) -> None:
        """``before`` and ``after`` are indices into `repaired`."""
        kernels, at, new = self.kernels.repair, self.repaired[before], self.repaired[after]
        measured = {"c_in": at["c"], "c_out": new["c"], "omega": self.repair_relaxations[k]}
        context.launch(kernels.measure.forward, measured, at, self.known, error=self.loops[1].errors)
        context.launch(kernels.move.forward, new, self.known)

    def _finish(self, context: StepContext, iterations: int, repairs: int, new_state: State) -> wp.array:
        end, last = self.end_of(iterations), self.repaired[repairs]
        v_end = end["v_new"]
        if self.following is not None:
            v_end = self.known["delta"]  # which is moved by now
            context.launch(self.following.forward, end, last, self.known, v_end=v_end)
        x_end = last["x_now"] if self.sides is None else self.sides.keep(context, last["x_now"])
        self.unsort(context, x_end, v_end, new_state, **{IMPULSE: end["k"], KICK: self.known["kick"]})
        return v_end
