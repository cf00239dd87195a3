"""Sums over neighbours in the viscous stress (`cortado.sph.stress_kernels`), walls without slip, and viscosity laws.

A wall without slip acts like a neighbour at rest at the surface point below the particle. The wall has the normal n,
and particle i is at the distance d from the wall's surface. A wall particle b at x_b has the vector y_ib and the weight
s_w:

    y_ib = d n,   s_w = w_b s_ib max(n . x_ib, 0) / max(d, e),

where s_ib is the weight of two fluid particles at the same distance. With the weight s_w, the wall acts as if
velocities continued behind the wall with opposite sign (Morris, Fox and Zhu 1997). The distance d is 0 for a particle
behind the surface. Below the distance e, called ``least``, the pull of a wall does not increase further.

The product n . x_ib is negative if b belongs to the other side of a thin wall, or to another face at an edge. Wall
particles with a negative product are left out, because a negative weight would accelerate particle i. The derivative of
s_w jumps where d is 0, where d is e, and where n . x_ib is 0. The normal n comes from the ``foot``, the vector from x_b
to the surface.

A viscosity law returns the viscosity of a fluid from its shear rate. The law is a user's function, a law named in a
scene (`cortado.scene.model`), or the constant of a Newtonian fluid.
"""

import inspect
from collections.abc import Callable, Mapping
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import warp as wp

from cortado.device.launching import launch
from cortado.device.modules import by_name, kernel_module
from cortado.device.precision import Precision, TypesByName
from cortado.errors import InputError
from cortado.particles.neighbourhood import Discretisation, neighbourhood_type, pair_functions
from cortado.particles.pair_sums import rubbing_sum, tangent_of
from cortado.sph.formula import Formula, applied, formula, theta_of
from cortado.sph.function_text import plain_function


@cache
def contact_functions(discretisation: Discretisation) -> SimpleNamespace:
    real, vector, neighbourhood = discretisation.types
    pair = pair_functions(discretisation)
    slope, slope_gradient = pair.slope, pair.slope_gradient

    @wp.func
    def weight(x: vector, s: neighbourhood) -> real:
        return -s.volume * slope(x, s)

    @wp.func
    def rise(x_ib: vector, foot: vector) -> real:
        return wp.dot(x_ib, foot) / wp.length(foot)

    @wp.func
    def height(x_ib: vector, foot: vector) -> real:
        return rise(x_ib, foot) - wp.length(foot)

    @wp.func
    def fall(x_ib: vector, foot: vector) -> vector:
        return (wp.max(height(x_ib, foot), real(0.0)) / wp.length(foot)) * foot

    @wp.func
    def hold(x_ib: vector, foot: vector, least: real, s: neighbourhood) -> real:
        return weight(x_ib, s) * wp.max(rise(x_ib, foot), real(0.0)) / wp.max(height(x_ib, foot), least)

    @wp.func
    def fall_change(x_ib: vector, u: vector, foot: vector) -> vector:
        square = wp.dot(foot, foot)
        return wp.where(height(x_ib, foot) > real(0.0), wp.dot(u, foot) / square, real(0.0)) * foot

    @wp.func
    def hold_gradient(x_ib: vector, foot: vector, least: real, s: neighbourhood) -> vector:
        above, d = rise(x_ib, foot), height(x_ib, foot)
        if above <= real(0.0):
            return vector()
        per = real(1.0) / wp.max(d, least)
        along = weight(x_ib, s) * per * (real(1.0) - wp.where(d > least, above * per, real(0.0)))
        return (-s.volume * above * per) * slope_gradient(x_ib, s) + (along / wp.length(foot)) * foot

    return by_name(weight, fall, fall_change, hold, hold_gradient)


@cache
def stress_sums(discretisation: Discretisation, sticks: bool) -> SimpleNamespace:
    precision, (real, vector, neighbourhood) = discretisation.precision, discretisation.types
    slope_gradient, contact = pair_functions(discretisation).slope_gradient, contact_functions(discretisation)
    weight, fall, fall_change = contact.weight, contact.fall, contact.fall_change
    hold, hold_gradient = contact.hold, contact.hold_gradient

    typed = TypesByName(real, {vector: "x v foot turn bar", precision.matrix: "T", neighbourhood: "s"})
    summed = rubbing_sum(discretisation, sticks, typed)

    @typed
    def wall_force(x_ij, v_ij, m_i, T_i, mu_i, control, least, foot, s) -> vector:
        return (-hold(x_ij, foot, least, s) / m_i) * (T_i * fall(x_ij, foot) + (control * mu_i) * v_ij)

    @summed(wall_force)
    def force(x_ij, v_ij, m_i, T_i, T_j, mu_i, mu_j, control, least, s) -> vector:
        return (-weight(x_ij, s) / m_i) * ((T_i + T_j) * x_ij + (control * (mu_i + mu_j)) * v_ij)

    @typed
    def wall_force_tangent(
        x_ij, x_dot_ij, v_ij, v_dot_ij, m_i, m_dot_i, T_i, T_dot_i, mu_i, mu_dot_i, control, least, foot, turn_dot, s
    ) -> vector:
        w, y, rest = hold(x_ij, foot, least, s), fall(x_ij, foot), x_dot_ij - wp.cross(turn_dot, x_ij)
        u = fall_change(x_ij, rest, foot) + wp.cross(turn_dot, y)
        w_dot = wp.dot(hold_gradient(x_ij, foot, least, s), rest) - w * m_dot_i / m_i
        pull = T_i * y + (control * mu_i) * v_ij
        change = T_dot_i * y + T_i * u + control * (mu_dot_i * v_ij + mu_i * v_dot_ij)
        return (real(-1.0) / m_i) * (w_dot * pull + w * change)

    @tangent_of(force)
    @summed(wall_force_tangent, ahead=False, grows=force)
    def force_tangent(
        x_ij, x_dot_ij, v_ij, v_dot_ij, m_i, m_dot_i, T_i, T_j, T_dot_i, T_dot_j, mu_i, mu_j, mu_dot_i, mu_dot_j,
        control, least, s,
    ) -> vector:  # fmt: skip
        w = weight(x_ij, s)
        w_dot = -s.volume * wp.dot(slope_gradient(x_ij, s), x_dot_ij) - w * m_dot_i / m_i
        T, mu = T_i + T_j, control * (mu_i + mu_j)
        pull = T * x_ij + mu * v_ij
        change = (T_dot_i + T_dot_j) * x_ij + T * x_dot_ij + (control * (mu_dot_i + mu_dot_j)) * v_ij + mu * v_dot_ij
        return (real(-1.0) / m_i) * (w_dot * pull + w * change)

    @typed
    def wall_traction_back(x_ij, v_ij, m_i, bar_i, control, least, foot, s) -> tuple[vector, vector, vector, real]:
        z = (-hold(x_ij, foot, least, s) / m_i) * bar_i
        y = fall(x_ij, foot)
        return z[0] * y, z[1] * y, z[2] * y, control * wp.dot(z, v_ij)

    @summed(wall_traction_back)
    def traction_back(x_ij, v_ij, m_i, m_j, bar_i, bar_j, control, least, s) -> tuple[vector, vector, vector, real]:
        z = -weight(x_ij, s) * (bar_i / m_i - bar_j / m_j)
        return z[0] * x_ij, z[1] * x_ij, z[2] * x_ij, control * wp.dot(z, v_ij)

    @typed
    def wall_force_back(x_ij, v_ij, m_i, T_i, mu_i, bar_i, control, least, foot, s) -> tuple[vector, vector, real]:
        w, y, u = hold(x_ij, foot, least, s), fall(x_ij, foot), bar_i / m_i
        level = -wp.dot(u, T_i * y + (control * mu_i) * v_ij)
        x_part = level * hold_gradient(x_ij, foot, least, s) - w * fall_change(x_ij, wp.transpose(T_i) * u, foot)
        return x_part, (-w * control * mu_i) * u, -level * w / m_i

    @summed(wall_force_back)
    def force_back(
        x_ij, v_ij, m_i, m_j, T_i, T_j, mu_i, mu_j, bar_i, bar_j, control, least, s
    ) -> tuple[vector, vector, real]:
        w, T, mu, own_u = weight(x_ij, s), T_i + T_j, control * (mu_i + mu_j), bar_i / m_i
        u, pull = own_u - bar_j / m_j, T * x_ij + mu * v_ij
        x_part = (s.volume * wp.dot(u, pull)) * slope_gradient(x_ij, s) - w * (wp.transpose(T) * u)
        return x_part, (-w * mu) * u, w * wp.dot(own_u, pull) / m_i

    return by_name(force, force_tangent, traction_back, force_back)


def work_types(precision: Precision) -> TypesByName:
    kinds = {precision.vector: "x v foot acceleration couple", precision.matrix: "T M A"}
    return TypesByName(precision.real, {**kinds, precision.pair: "constants", neighbourhood_type(precision): "s"})


def stress_work(d: Discretisation) -> Any:
    precision, real, contact = d.precision, d.precision.real, contact_functions(d)
    fall, hold = contact.fall, contact.hold

    @work_types(precision)
    def stress_work(x_ij, v_ij, m_i, T_i, eta_i, acceleration_bar_i, constants, foot, s) -> real:
        pull = T_i * fall(x_ij, foot) + (constants[1] * eta_i) * v_ij
        return (-hold(x_ij, foot, constants[0], s) / m_i) * wp.dot(pull, acceleration_bar_i)

    return stress_work


def stress_couple_work(d: Discretisation) -> Any:
    real, fall, force = d.precision.real, contact_functions(d).fall, wp.func(stress_work(d))

    @work_types(d.precision)
    def stress_couple_work(x_ij, v_ij, m_i, T_i, eta_i, couple_bar_i, constants, foot, s) -> real:
        return force(x_ij, v_ij, m_i, T_i, eta_i, wp.cross(couple_bar_i, fall(x_ij, foot)), constants, foot, s)

    return stress_couple_work


def newtonian(shear_rate, viscosity):
    return viscosity


@cache
def newtonian_law() -> Formula:
    return formula("Rheology", plain_function("Rheology", newtonian), inspect.getsource(newtonian), {})[0]


def power_law(shear_rate, viscosity, flow_index, least_shear_rate):
    """Return the viscosity of a power-law fluid (Ostwald and de Waele)."""
    return viscosity * wp.pow(shear_rate * shear_rate + least_shear_rate * least_shear_rate, 0.5 * (flow_index - 1.0))


def carreau(shear_rate, viscosity, relaxation_time, flow_index, infinite_viscosity):
    """Return the viscosity by the law of Carreau (1972)."""
    turned = relaxation_time * shear_rate
    return infinite_viscosity + (viscosity - infinite_viscosity) * wp.pow(
        1.0 + turned * turned, 0.5 * (flow_index - 1.0)
    )


def bingham(shear_rate, viscosity, yield_stress, regularisation):
    """Return the viscosity of a Bingham fluid, smoothed as by Papanastasiou (1987)."""
    x = regularisation * shear_rate
    part = 1.0 - x / 2.0 + x * x / 6.0
    if x > 0.01:
        part = (1.0 - wp.exp(-x)) / x
    return viscosity + yield_stress * regularisation * part


def herschel_bulkley(shear_rate, viscosity, yield_stress, regularisation, flow_index, least_shear_rate):
    """Return the viscosity of a Herschel-Bulkley fluid: a power law with a yield stress."""
    x = regularisation * shear_rate
    part = 1.0 - x / 2.0 + x * x / 6.0
    if x > 0.01:
        part = (1.0 - wp.exp(-x)) / x
    square = shear_rate * shear_rate + least_shear_rate * least_shear_rate
    return viscosity * wp.pow(square, 0.5 * (flow_index - 1.0)) + yield_stress * regularisation * part


LAWS: dict[str, Callable[..., Any]] = {law.__name__: law for law in (power_law, carreau, bingham, herschel_bulkley)}


SHEAR_RATES = np.logspace(-6.0, 6.0, 601)


@cache
def trial_kernel(precision: Precision, law: Formula) -> Any:
    module = kernel_module(f"{law.topic}trial_{precision.name}")
    real, theta_type, apparent = precision.real, theta_of(precision, law.ranks), applied(law, precision, 3, module)

    @TypesByName(real, {theta_type: "thetas"}).kernel(module, enable_backward=False)
    def trial(shear_rates, viscosities, thetas, found: wp.array3d(dtype=real)):
        k, p, t = wp.tid()
        found[k, p, t] = apparent(shear_rates[k], viscosities[p], thetas[t])

    return trial


def check_law(
    what: str, law: Formula, viscosities: Mapping[str, float], thetas: np.ndarray, precision: Precision, device: Any
) -> None:
    """``viscosities`` are the viscosities of phases by name, and ``thetas`` the parameters of the law."""
    kernel, theta_type = trial_kernel(precision, law), theta_of(precision, law.ranks)
    rows = np.zeros((len(thetas), theta_type._length_))
    rows[:, : thetas.shape[1]] = thetas
    given = {"shear_rates": SHEAR_RATES, "viscosities": np.array(list(viscosities.values()))}
    arrays = {name: wp.array(values, dtype=precision.real, device=device) for name, values in given.items()}
    arrays["thetas"] = wp.array(rows, dtype=theta_type, device=device)
    shape = len(SHEAR_RATES), len(viscosities), len(rows)
    found = wp.zeros(shape, dtype=precision.real, device=device)
    launch(kernel, shape, device, **arrays, found=found)
    values = found.numpy()
    wrong = np.argwhere(~(np.isfinite(values) & (values >= 0.0)))
    if len(wrong):
        k, phase, theta = wrong[0]
        name, viscosity = list(viscosities.items())[phase]
        found = f"{what} returns {values[k, phase, theta]:g} Pa s at a shear rate of {SHEAR_RATES[k]:.3g} 1/s"
        wanted = "but must return a finite number of at least 0 at shear rates from 1e-06 to 1e+06 1/s"
        raise InputError(f"{found} for {name} with the viscosity {viscosity:g} Pa s, {wanted}.")
