"""Formulas of quantities on the device, with tangents and adjoints.

A particle has the number density n, the volume V on the rest lattice, and the mass V m. The vorticity is an SPH sum
over fluid neighbours (Monaghan 1992):

    c_i = V sum_j (v_i - v_j) x G_ij,   omega_i = c_i / (mu n_i).

G_ij is the kernel gradient. With the factor mu = -(V / d) sum_j x_j . G_j on the rest lattice, a rigidly rotating fluid
has a vorticity of twice its angular velocity. The force of particle i on all walls, or on the walls of one solid, is

    f_i = s^d (V p_i / n_i^power A_i - m_i sum a_i + B_i),

where s is the spacing, m_i s^d the mass of the particle, and ``power`` the solver's ``density_power``. The pressure p_i
acts along A_i, a sum over wall particles (`ParticleSolver.wall_push`). Wall forces such as viscosity give particle i
the accelerations a_i. Mirror images add B_i (`cortado.solvers.projection.mean_stress`). Walls gain the momentum that
the fluid loses.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any, Protocol

import warp as wp

from cortado.device.launching import Named
from cortado.device.modules import Kernels, kernel_module
from cortado.device.precision import Precision, TypesByName
from cortado.device.reduction import TreeReduction, add
from cortado.particles.made_derivatives import made_adjoint, made_tangent
from cortado.particles.neighbourhood import Discretisation, neighbourhood_type, pair_functions
from cortado.particles.pair_sums import fluid_sum
from cortado.particles.particle_kernels import particle_kernel, pointwise_kernels, sum_kernels
from cortado.particles.wall_terms import ALL_WALLS
from cortado.scene.parameters import load_name
from cortado.solvers.obstacles import NamedSolid
from cortado.solvers.particles import ParticleSolver
from cortado.sph.parts import Adjoints, StepContext, Tangents

SIX = wp.types.vector(6, wp.float64)


@dataclass(frozen=True)
class Bars:
    """Adjoints of a time step's intermediate values. Formulas add to these adjoints."""

    of: Adjoints
    p: wp.array
    stress: wp.array
    """Adjoint of the measured pressure (n,)."""
    v_star: wp.array


class QuantityFormula(Protocol):
    """Protocol of the formula of a quantity. A quantity has a value for each sorted particle (n,), or six numbers for
    each scene. ``p`` (n,) are the pressures of particles on walls."""

    def value(self, step: StepContext, p: Any) -> wp.array: ...

    def tangent(self, step: StepContext, p: Any, along: Tangents, p_dot: Any, stress_dot: Any) -> wp.array:
        """Return the tangent of the quantity, given the tangents of ``p`` and of the measured pressure."""

    def adjoint(self, step: StepContext, p: Any, own: wp.array, bar: Bars) -> None:
        """Add the adjoints of the arguments to ``bar``. ``own`` is the adjoint of the quantity."""


def turns(discretisation: Discretisation) -> Callable[..., Any]:
    vector, neighbourhood = discretisation.precision.vector, neighbourhood_type(discretisation.precision)
    gradient = pair_functions(discretisation).gradient

    def turning(x_ij: vector, v_ij: vector, s: neighbourhood) -> vector:
        return wp.cross(v_ij, gradient(x_ij, s))

    return turning


@cache
def circulation_kernels(discretisation: Discretisation) -> Kernels:
    sums = (
        fluid_sum(discretisation)(turns(discretisation)),
        *(make(discretisation, turns) for make in (made_tangent, made_adjoint)),
    )
    _, tangent_module, adjoint_module = discretisation.modules("vorticity")
    modules = adjoint_module, tangent_module, adjoint_module  # a tape does not see the sum
    return sum_kernels("circulation", modules, sums, "circulation", times="s.volume")


@cache
def number_kernels(precision: Precision) -> tuple[Kernels, Kernels, Kernels]:
    real, vector = precision.real, precision.vector
    modules = [kernel_module(f"quantities_{kind}_{precision.name}") for kind in ("forward", "tangent", "derivative")]

    def density(m_i: real, n_i: real) -> real:
        return m_i * n_i

    def speed(v_i: vector) -> real:
        return wp.length(v_i)

    def vorticity(factor: real, circulation_i: vector, n_i: real) -> vector:
        return circulation_i / (factor * n_i)

    def made(function: Any, **names: Any) -> Kernels:
        return pointwise_kernels(precision, modules, lambda _: function, ["q"], **names)

    return made(density), made(speed), made(vorticity, numbers=["factor"], written=["circulation"])


@cache
def wall_force_kernels(discretisation: Discretisation) -> Kernels:
    real, vector = discretisation.precision.real, discretisation.precision.vector

    @TypesByName(real, {vector: "push rub by_images"})
    def wall_force(scale, power, cell, p_i, n_i, m_i, push_i, rub_i, by_images_i) -> vector:
        return (scale * p_i / wp.pow(n_i, power)) * push_i - (cell * m_i) * rub_i + cell * by_images_i

    names: dict[str, Any] = {"numbers": ["scale", "power", "cell"], "written": ["push", "rub", "by_images"]}
    modules = discretisation.modules("wall_force")
    return pointwise_kernels(discretisation.precision, modules, lambda _: wall_force, ["f"], **names)


@cache
def load_kernels(precision: Precision) -> Kernels:
    real, vector = precision.real, precision.vector
    module, derivative = (kernel_module(f"{name}_{precision.name}") for name in ("load", "load_derivative"))
    numbers = ["cell", "period"]

    @wp.func
    def double(a: vector) -> wp.vec3d:
        return wp.vec3d(wp.float64(a[0]), wp.float64(a[1]), wp.float64(a[2]))

    @wp.func
    def single(a: wp.vec3d) -> vector:
        return vector(real(a[0]), real(a[1]), real(a[2]))

    @wp.func
    def arm_of(x: vector, middle: vector, period: vector) -> wp.vec3d:
        arm = double(x) - double(middle)
        for k in range(3):
            if period[k] > real(0.0):
                length = wp.float64(period[k])
                arm[k] = arm[k] - length * wp.rint(arm[k] / length)
        return arm

    @wp.func
    def six(force: wp.vec3d, torque: wp.vec3d) -> SIX:
        return SIX(force[0], force[1], force[2], torque[0], torque[1], torque[2])

    typed = TypesByName(real, {vector: "period middle x f twist", SIX: "load"})

    @particle_kernel(module, "load", numbers=numbers)
    @typed
    def load(cell, period, middle, x_i, m_i, f_i, twist_i) -> SIX:
        force, mass = double(f_i), wp.float64(cell) * wp.float64(m_i)
        return six(force, mass * double(twist_i) + wp.cross(arm_of(x_i, middle, period), force))

    @particle_kernel(derivative, "load_dot", numbers=numbers)
    @typed
    def load_tangent(
        cell, period, middle, middle_dot, x_i, x_dot_i, m_i, m_dot_i, f_i, f_dot_i, twist_i, twist_dot_i
    ) -> SIX:
        force, arm = double(f_dot_i), arm_of(x_i, middle, period)
        twisted = wp.float64(m_dot_i) * double(twist_i) + wp.float64(m_i) * double(twist_dot_i)
        turned = wp.cross(double(x_dot_i) - double(middle_dot), double(f_i)) + wp.cross(arm, force)
        return six(force, wp.float64(cell) * twisted + turned)

    @particle_kernel(derivative, "+x_bar +m_bar f_bar twist_bar middle_bar", numbers=numbers)
    @typed
    def load_adjoint(
        cell, period, middle, x_i, m_i, f_i, twist_i, load_bar
    ) -> tuple[vector, real, vector, vector, vector]:
        force, torque = wp.vec3d(load_bar[0], load_bar[1], load_bar[2]), wp.vec3d(load_bar[3], load_bar[4], load_bar[5])
        x_bar = single(wp.cross(double(f_i), torque))  # type: ignore[arg-type]
        f_bar = single(force + wp.cross(torque, arm_of(x_i, middle, period)))  # type: ignore[arg-type]
        cell_torque = wp.float64(cell) * torque
        m_bar, twist_bar = real(wp.dot(cell_torque, double(twist_i))), single(wp.float64(m_i) * cell_torque)
        return x_bar, m_bar, f_bar, twist_bar, -x_bar

    return Kernels(load, load_tangent, load_adjoint)


class OfParticles:
    def __init__(self, solver: ParticleSolver, kernels: Kernels, kind: Any, total: Kernels | None = None, **given: Any):
        self._kernels, self._total, self._given = kernels, total, given
        self._q = solver.layout.arrays(q=kind, q_dot=kind)
        names = () if total is None else ("circulation", "circulation_dot", "circulation_bar")
        self._sums = {name: solver.vectors() for name in names}

    def value(self, step: StepContext, p: Any) -> wp.array:
        if self._total is not None:
            step.launch(self._total.forward, self._sums)
        step.launch(self._kernels.forward, self._sums, self._given, self._q)
        return self._q["q"]

    def tangent(self, step: StepContext, p: Any, along: Tangents, p_dot: Any, stress_dot: Any) -> wp.array:
        self.value(step, p)
        if self._total is not None:
            step.launch(self._total.tangent, *along.named, self._sums)
        step.launch(self._kernels.tangent, *along.named, self._sums, self._given, self._q)
        return self._q["q_dot"]

    def adjoint(self, step: StepContext, p: Any, own: wp.array, bar: Bars) -> None:
        self.value(step, p)
        step.launch(self._kernels.adjoint, *bar.of.named, self._sums, self._given, q_bar=own)
        if self._total is not None:
            step.launch(self._total.adjoint, *bar.of.named, self._sums)


@dataclass(frozen=True)
class Pressure:
    solver: ParticleSolver

    def value(self, step: StepContext, p: Any) -> wp.array:
        return self.solver.stresses()

    def tangent(self, step: StepContext, p: Any, along: Tangents, p_dot: Any, stress_dot: Any) -> wp.array:
        return stress_dot

    def adjoint(self, step: StepContext, p: Any, own: wp.array, bar: Bars) -> None:
        add(own, bar.stress)


class WallLoads:
    """The forces (n,) [N] of particles on the walls of the solid with number ``solid``. `ALL_WALLS` selects all
    walls."""

    def __init__(self, solver: ParticleSolver):
        self._kernels, self.cell = wall_force_kernels(solver.discretisation), solver.lattice.cell
        power, scale = float(solver.density_power), self.cell * solver.lattice.volume
        self._numbers = {"power": power, "scale": scale, "cell": self.cell}
        self._push, self._images = solver.wall_push(), solver.image_loads()
        self._rubs, self._twists = (
            [action for force in solver.forces if (action := getattr(force, name, None)) is not None]
            for name in ("wall_action", "wall_couple")
        )
        names = ("rub", "f", "twist", "by_images", "rub_dot", "f_dot", "twist_dot", "by_images_dot")
        self._vectors = {name: solver.vectors() for name in names}
        self._bars = {name: solver.vectors() for name in ("push_bar", "rub_bar", "by_images_bar")}

    def value(self, step: StepContext, p: Any, solid: int = ALL_WALLS) -> wp.array:
        found, known = self._vectors["f"], self._sums(step, p, solid)
        step.launch(self._kernels.forward, known, self._numbers, f=found)
        return found

    def tangent(
        self, step: StepContext, p: Any, along: Tangents, p_dot: Any, stress_dot: Any, solid: int = ALL_WALLS
    ) -> wp.array:
        rub_dot = self._total("rub_dot", [action.tangent(step, along, solid) for action in self._rubs])
        dots = {"push_dot": self._push.tangent(step, along, solid), "rub_dot": rub_dot, "p_dot": p_dot}
        dots["by_images_dot"] = self._vectors["by_images_dot"]
        if self._images is not None:
            dots["by_images_dot"] = self._images.tangent(step, along, solid, p, p_dot)
        found, known = self._vectors["f_dot"], self._sums(step, p, solid)
        step.launch(self._kernels.tangent, known, dots, *along.named, self._numbers, f_dot=found)
        return found

    def adjoint(self, step: StepContext, p: Any, own: wp.array, bar: Bars, solid: int = ALL_WALLS) -> None:
        known, bars = self._sums(step, p, solid), {**self._bars, "p_bar": bar.p}
        step.launch(self._kernels.adjoint, known, bars, *bar.of.named, self._numbers, f_bar=own)
        self._push.adjoint(step, bar.of, solid, self._bars["push_bar"], bar.v_star)
        if self._images is not None:
            self._images.adjoint(step, bar.of, solid, p, self._bars["by_images_bar"], bar.p)
        for action in self._rubs:
            action.adjoint(step, bar.of, solid, self._bars["rub_bar"], bar.v_star)

    def twists(self, step: StepContext, solid: int) -> wp.array:
        return self._total("twist", [action.total(step, solid) for action in self._twists])

    def twists_tangent(self, step: StepContext, along: Tangents, solid: int) -> wp.array:
        return self._total("twist_dot", [action.tangent(step, along, solid) for action in self._twists])

    def twists_adjoint(self, step: StepContext, total_bar: wp.array, bar: Bars, solid: int) -> None:
        for action in self._twists:
            action.adjoint(step, bar.of, solid, total_bar, bar.v_star)

    def _sums(self, step: StepContext, p: wp.array, solid: int) -> dict[str, wp.array]:
        rub = self._total("rub", [action.total(step, solid) for action in self._rubs])
        found = {"push": self._push.total(step, solid), "rub": rub, "by_images": self._vectors["by_images"], "p": p}
        if self._images is not None:
            found["by_images"] = self._images.total(step, solid, p)
        return found

    def _total(self, name: str, arrays: list[wp.array]) -> wp.array:
        if len(arrays) == 1:
            return arrays[0]
        total = self._vectors[name]
        if arrays:  # else it is 0 from the start
            total.zero_()
        for array in arrays:
            add(array, total)
        return total


class SolidLoads:
    def __init__(self, loads: WallLoads, solver: ParticleSolver, solid: NamedSolid):
        vector, layout, number = solver.layout.precision.vector, solver.layout, solid.number
        self._loads, self._layout, self._solid = loads, layout, number
        self._kernels, self._moving = load_kernels(layout.precision), solver.search.moving if number >= 0 else None
        self._given = {"cell": loads.cell, "period": layout.precision.vector_of(solver.system.walled.periods)}
        rest = wp.full(layout.members, vector(*solid.middle), dtype=vector, device=layout.device)
        self._rest = {"middle": rest, "middle_dot": wp.zeros_like(rest)}
        self._bars = {name: solver.vectors() for name in ("f_bar", "twist_bar", "middle_bar")}

    @cached_property
    def _each(self) -> dict[str, wp.array]:
        return self._layout.arrays(load=SIX, load_dot=SIX)

    @cached_property
    def _sums(self) -> tuple[TreeReduction, TreeReduction]:
        return self._layout.sum_of(SIX), self._layout.sum_of(self._layout.precision.vector)

    def _known(self, step: StepContext, p: Any) -> tuple[Named, ...]:
        middles = self._rest
        if self._moving is not None:
            named = {"middle": "after", "middle_dot": "after_dot"}
            middles = {name: self._moving.named[of][:, self._solid] for name, of in named.items()}
        own = {"f": self._loads.value(step, p, self._solid), "twist": self._loads.twists(step, self._solid)}
        return middles, own, self._given, self._each

    def value(self, step: StepContext, p: Any) -> wp.array:
        step.launch(self._kernels.forward, *self._known(step, p))
        return self._sums[0](self._each["load"])

    def tangent(self, step: StepContext, p: Any, along: Tangents, p_dot: Any, stress_dot: Any) -> wp.array:
        dots = {"f_dot": self._loads.tangent(step, p, along, p_dot, stress_dot, self._solid)}
        dots["twist_dot"] = self._loads.twists_tangent(step, along, self._solid)
        step.launch(self._kernels.tangent, *along.named, dots, *self._known(step, p))
        return self._sums[0](self._each["load_dot"])

    def adjoint(self, step: StepContext, p: Any, own: wp.array, bar: Bars) -> None:
        step.launch(self._kernels.adjoint, *bar.of.named, self._bars, *self._known(step, p), load_bar=own)
        self._loads.adjoint(step, p, self._bars["f_bar"], bar, self._solid)
        self._loads.twists_adjoint(step, self._bars["twist_bar"], bar, self._solid)
        if self._moving is not None:
            total = self._sums[1](self._bars["middle_bar"])
            bar.of.solids.add_whole(self._solid, after_bar=total)


def formulas(solver: ParticleSolver, circulation_factor: float) -> dict[str, QuantityFormula]:
    loads, precision = WallLoads(solver), solver.layout.precision
    (density, speed, vorticity), circulation = number_kernels(precision), circulation_kernels(solver.discretisation)
    return {
        "density": OfParticles(solver, density, precision.real),
        "pressure": Pressure(solver),
        "speed": OfParticles(solver, speed, precision.real),
        "vorticity": OfParticles(solver, vorticity, precision.vector, circulation, factor=circulation_factor),
        "wall_force": loads,
        **{load_name(name): SolidLoads(loads, solver, solid) for name, solid in solver.system.solids.items()},
    }
