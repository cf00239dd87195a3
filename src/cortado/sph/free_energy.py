"""Free energies of a mixture, mobilities of its phases, and the Cahn-Hilliard diffusion of phases (Yang et al. 2015).

`docs/discretisation.md` has the equations. The operator B has a term for each pair of particles, which is antisymmetric
in the two particles. The mass of each phase is therefore constant to round-off. The projection P keeps the sum of a
particle's mass fractions constant. The free energy E of particles at rest decreases, because the factor F is not
positive. Mass fractions are not clipped, because clipping would break conservation and the decrease of energy. A
constant keeps the degenerate mobility positive and smooth if a mass fraction leaves the range from 0 to 1.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import warp as wp

from cortado.arrays import as_one_number, require_function
from cortado.calls import public
from cortado.device.modules import Kernels, by_name, kernel_module
from cortado.device.precision import Precision, TypesByName
from cortado.discretise.smoothing import laplacian_rate, smoothing_kernel
from cortado.errors import InputError, OutOfRangeError, shown
from cortado.particles.neighbourhood import Discretisation, pair_functions
from cortado.particles.pair_sums import adjoint_of, fluid_sum, tangent_of
from cortado.particles.particle_kernels import dotted, over, particle_kernel
from cortado.scene.scene import Scene
from cortado.sph.formula import compiled
from cortado.sph.function_text import code_words

FLOOR = 1e-3


@public
@dataclass(frozen=True)
class FreeEnergy:
    """A free energy as a function of mass fractions (phases,), for kernels and for NumPy. Users may define others."""

    name: str
    value: Callable[[np.ndarray], np.ndarray]
    """Function from mass fractions (n, phases) to free energies (n,)."""
    curvature: float
    """Greatest eigenvalue of the Hessian of the free energy, for mass fractions from 0 to 1 with a constant sum. The
    eigenvalue limits the time step of diffusion."""
    functions: Callable[[Precision, int], Any]
    """Function from a precision and a number of phases to an object with two Warp functions. ``gradient`` is the
    gradient of the free energy, and ``hessian_product`` is the product of the Hessian and a vector."""

    def __post_init__(self) -> None:
        if not isinstance(self.name, str):
            raise InputError(f"FreeEnergy has the name {shown(self.name)}, but the name must be a text.")
        require_function(f"FreeEnergy {self.name}'s value", self.value, "fractions (n, phases)")
        require_function(f"FreeEnergy {self.name}'s functions", self.functions, "a precision", "a number of phases")
        if not 0.0 <= as_one_number(f"FreeEnergy {self.name}'s curvature", self.curvature) < np.inf:
            raise InputError(f"FreeEnergy {self.name}'s curvature is {self.curvature}, but must be at least 0.")

    def check(self, precision: Precision, phases: int, device: Any) -> None:
        """Raise `InputError` if ``functions`` fails, or if the Warp functions do not take ``phases`` mass fractions."""
        what = f"FreeEnergy {self.name}'s functions"
        try:
            found = self.functions(precision, phases)
        except Exception as problem:
            reason = " ".join(f"{type(problem).__name__}: {problem}".split()).rstrip(".")
            raise InputError(f"{what} fail: {reason}.") from problem
        for name in ("gradient", "hessian_product"):
            if not isinstance(given := getattr(found, name, None), wp.Function):
                wanted = "an object whose gradient and hessian_product are functions under wp.func"
                raise InputError(f"{what} must return {wanted}, but {name} is {shown(given)}.")
        fractions, module = precision.fractions(phases), kernel_module(f"free_energy_{code_words(self.functions)}")
        gradient, hessian_product = found.gradient, found.hessian_product

        @wp.kernel(module=module)
        def trial(c: wp.array(dtype=fractions), found: wp.array(dtype=fractions)):
            i = wp.tid()
            found[i] = gradient(c[i]) + hessian_product(c[i], c[i])

        compiled(what, module, device, f"vector of {phases} fractions")


@dataclass(frozen=True)
class Mobility:
    name: str
    greatest: Callable[[int], float]
    functions: Callable[[Precision, int], Any]
    """Function from a precision and a number of phases to the mobility's Warp functions ``value`` and ``gradient``."""


@cache
def _double_well(precision: Precision, phases: int) -> SimpleNamespace:
    real, fractions = precision.real, precision.fractions(phases)

    @wp.func
    def gradient(c: fractions) -> fractions:
        squares = wp.cw_mul(c, c)
        return c - real(3.0) * squares + real(2.0) * wp.cw_mul(squares, c)

    @wp.func
    def hessian_product(c: fractions, u: fractions) -> fractions:
        return u - real(6.0) * wp.cw_mul(c, u) + real(6.0) * wp.cw_mul(wp.cw_mul(c, c), u)

    return by_name(gradient, hessian_product)


@cache
def _miscible(precision: Precision, phases: int) -> SimpleNamespace:
    fractions = precision.fractions(phases)

    @wp.func
    def gradient(c: fractions) -> fractions:
        return c

    @wp.func
    def hessian_product(c: fractions, u: fractions) -> fractions:
        return u

    return by_name(gradient, hessian_product)


@cache
def _constant(precision: Precision, phases: int) -> SimpleNamespace:
    real, fractions = precision.real, precision.fractions(phases)

    @wp.func
    def value(c: fractions) -> real:
        return real(1.0)

    @wp.func
    def gradient(c: fractions) -> fractions:
        return fractions()

    return by_name(value, gradient)


@cache
def _degenerate(precision: Precision, phases: int) -> SimpleNamespace:
    real, fractions = precision.real, precision.fractions(phases)
    floor = wp.constant(real(FLOOR))

    @wp.func
    def total(c: fractions) -> real:
        t = real(0.0)
        for k in range(wp.static(phases)):
            t += c[k]
        return t

    @wp.func
    def products(c: fractions) -> real:
        t = total(c)
        return real(0.5) * (t * t - wp.dot(c, c))

    @wp.func
    def value(c: fractions) -> real:
        z = products(c)
        return real(0.5) * (z + wp.sqrt(z * z + floor * floor))

    @wp.func
    def gradient(c: fractions) -> fractions:
        z = products(c)
        t = total(c)
        along = fractions()
        for k in range(wp.static(phases)):
            along[k] = t - c[k]
        return (real(0.5) + real(0.5) * z / wp.sqrt(z * z + floor * floor)) * along

    return by_name(value, gradient)


def _double_well_value(c: np.ndarray) -> np.ndarray:  # a lambda would not be pickled
    return np.asarray(0.5 * (c**2 * (1.0 - c) ** 2).sum(1))


def _miscible_value(c: np.ndarray) -> np.ndarray:
    return np.asarray(0.5 * (c**2).sum(1))


DOUBLE_WELL = FreeEnergy("double_well", _double_well_value, curvature=1.0, functions=_double_well)
MISCIBLE = FreeEnergy("miscible", _miscible_value, curvature=1.0, functions=_miscible)
FREE_ENERGIES = {energy.name: energy for energy in (DOUBLE_WELL, MISCIBLE)}

CONSTANT = Mobility("constant", lambda phases: 1.0, _constant)
DEGENERATE = Mobility("degenerate", lambda phases: 0.5 * (phases - 1) / phases, _degenerate)
MOBILITIES = {mobility.name: mobility for mobility in (CONSTANT, DEGENERATE)}


@cache
def pairwise_laplacian_functions(discretisation: Discretisation, phases: int) -> Kernels:
    real, vector, neighbourhood = discretisation.types
    fractions = discretisation.precision.fractions(phases)
    pair = pair_functions(discretisation)
    factor, factor_gradient = pair.factor, pair.factor_gradient

    typed = TypesByName(real, {vector: "x", fractions: "u y", neighbourhood: "s"})

    @fluid_sum(discretisation, typed)
    def spread(x_ij, n_i, n_j, w_i, w_j, u_ij, s) -> fractions:
        return ((w_i / n_j + w_j / n_i) * factor(x_ij, s)) * u_ij

    @tangent_of(spread)
    @fluid_sum(discretisation, typed, ahead=False)
    def spread_tangent(
        x_ij, x_dot_ij, n_i, n_j, n_dot_i, n_dot_j, w_i, w_j, w_dot_i, w_dot_j, u_ij, u_dot_ij, s
    ) -> fractions:
        weight = w_i / n_j + w_j / n_i
        weight_dot = (w_dot_i - w_i * n_dot_j / n_j) / n_j + (w_dot_j - w_j * n_dot_i / n_i) / n_i
        f = factor(x_ij, s)
        f_dot = wp.dot(factor_gradient(x_ij, s), x_dot_ij)
        return (weight_dot * f + weight * f_dot) * u_ij + (weight * f) * u_dot_ij

    @adjoint_of(spread)
    @fluid_sum(discretisation, typed)
    def spread_adjoint(x_ij, n_i, n_j, w_i, w_j, u_ij, y_i, y_ij, s) -> tuple[vector, real, real, fractions, real]:
        f = factor(x_ij, s)
        weight = w_i / n_j + w_j / n_i
        work = wp.dot(u_ij, y_ij)
        x_bar = (weight * work) * factor_gradient(x_ij, s)
        n_bar = -w_j * f * work / (n_i * n_i)
        return x_bar, n_bar, f * work / n_j, (weight * f) * y_ij, weight * f * wp.dot(u_ij, y_i)

    return Kernels(spread, spread_tangent, spread_adjoint)


SAFETY = 0.5
MOST_SUBSTEPS = 10_000


def stable_substeps(
    scene: Scene, energy: FreeEnergy, time_step: float, mobility: float, width: float, densities: np.ndarray
) -> int:
    """Return the number of diffusion substeps that makes a ``time_step`` [s] stable. ``mobility`` is in m2/s, the
    interface ``width`` in m, and the rest ``densities`` (phases,) in kg/m3. A substep of diffusion lasts at most

        dt = safety 2 / (M l (eps^2 l + max f'')),   l the greatest eigenvalue of the Laplacian on the lattice,

    with the mobility M, the width eps and the curvature max f'' of the free energy. Beside a particle that is ``ratio``
    times as heavy, a light particle diffuses up to (1 + ratio) / 2 times as fast.
    """
    mixture, cut = scene.mixture, scene.discretisation
    rate = laplacian_rate(smoothing_kernel(cut.kernel), cut.spacing, cut.support_radius, scene.dimension)
    rate *= 0.5 * (1.0 + float(np.max(densities) / np.min(densities)))
    greatest = mobility * MOBILITIES[mixture.mobility_form].greatest(len(scene.phase))
    speed = greatest * rate * (width**2 * rate + mixture.strength * energy.curvature)
    limit = 2.0 * SAFETY / speed if speed > 0.0 else np.inf
    number = float(np.ceil(time_step / limit))
    if number > MOST_SUBSTEPS:
        raise OutOfRangeError(
            f"mobility is {mobility:g} m2/s, which takes {number:.3g} explicit diffusion steps in a time step, but "
            f"at most {MOST_SUBSTEPS} are possible: lower mobility, interface_width or time_step."
        )
    return int(number)


@dataclass(frozen=True)
class Diffusion:
    discretisation: Discretisation
    phases: int
    energy: FreeEnergy
    mobility: Mobility


@cache
def diffusion_kernels(diffusion: Diffusion) -> SimpleNamespace:
    discretisation, phases = diffusion.discretisation, diffusion.phases
    precision, (real, vector, neighbourhood) = discretisation.precision, discretisation.types
    fractions = precision.fractions(phases)
    sums = pairwise_laplacian_functions(discretisation, phases)
    spread, spread_tangent, spread_adjoint = sums.forward, sums.tangent, sums.adjoint
    energy, form = diffusion.energy.functions(precision, phases), diffusion.mobility.functions(precision, phases)
    energy_gradient, energy_hessian_product = energy.gradient, energy.hessian_product
    mobile, mobile_gradient = form.value, form.gradient

    topic = f"diffusion_{phases}_{diffusion.energy.name}_{diffusion.mobility.name}"
    module, tangent_module, adjoint_module = discretisation.modules(topic)
    of_c, of_chi = {"w": "m", "u": "c"}, {"u": "chi"}

    @wp.func
    def project(u: fractions) -> fractions:
        mean = real(0.0)
        for k in range(wp.static(phases)):
            mean += u[k]
        mean = mean / real(wp.static(phases))
        result = fractions()
        for k in range(wp.static(phases)):
            result[k] = u[k] - mean
        return result

    typed = TypesByName(real, {fractions: "B c chi", neighbourhood: "s", vector: "x"})

    @particle_kernel(module, "chi w", [over(spread, "B", **of_c)], numbers=["strength"], typed=typed)
    def potential(B, strength, interface_width, mobility, m_i, c_i, s) -> tuple[fractions, real]:
        stiffness = interface_width * interface_width * s.volume / m_i
        return strength * project(energy_gradient(c_i)) - stiffness * B, m_i * mobility * mobile(c_i)

    @particle_kernel(module, "c_new", [over(spread, "B", **of_chi)], numbers=["substeps"], typed=typed)
    def flux(B, substeps: int, time_step, m_i, c_i, s) -> fractions:
        return c_i + (time_step / real(substeps) * s.volume / m_i) * B

    both = [over(spread, "B", **of_c), over(spread_tangent, "B_dot", **of_c, **dotted(of_c))]

    @particle_kernel(tangent_module, "chi_dot w_dot", both, numbers=["strength"], typed=typed)
    def potential_tangent(
        B, B_dot, strength, interface_width, interface_width_dot, mobility, mobility_dot, m_i, m_dot_i, c_i, c_dot_i, s
    ) -> tuple[fractions, real]:
        scale = s.volume / m_i
        stiffness = interface_width * interface_width * scale
        stiffness_dot = real(2.0) * interface_width * interface_width_dot * scale - stiffness * m_dot_i / m_i
        chi_dot = strength * project(energy_hessian_product(c_i, c_dot_i)) - stiffness * B_dot - stiffness_dot * B
        by_m = (m_dot_i * mobility + m_i * mobility_dot) * mobile(c_i)
        return chi_dot, by_m + m_i * mobility * wp.dot(mobile_gradient(c_i), c_dot_i)

    both = [over(spread, "B", **of_chi), over(spread_tangent, "B_dot", **of_chi, **dotted(of_chi))]

    @particle_kernel(tangent_module, "c_new_dot", both, numbers=["substeps"], typed=typed)
    def flux_tangent(B, B_dot, substeps: int, time_step, time_step_dot, m_i, m_dot_i, c_dot_i, s) -> fractions:
        scale = time_step / real(substeps) * s.volume / m_i
        return c_dot_i + scale * (B_dot + (time_step_dot / time_step - m_dot_i / m_i) * B)

    @particle_kernel(adjoint_module, "y", numbers=["substeps"], typed=typed)
    def scale_adjoint(substeps: int, time_step, m_i, c_bar_i, s) -> fractions:
        return (time_step / real(substeps) * s.volume / m_i) * c_bar_i

    @particle_kernel(
        adjoint_module,
        "+x_bar +n_bar +m_bar +c_bar +time_step_bar +mobility_bar z",
        [over(spread_adjoint, "x_sum n_sum w_bar chi_bar own", **of_chi)],
        numbers=["strength"],
    )
    @typed
    def flux_adjoint(
        x_sum, n_sum, w_bar, chi_bar, own, strength, time_step, interface_width, mobility, m_i, c_i, s
    ) -> tuple[vector, real, real, fractions, real, real, fractions]:
        m_part = w_bar * mobility * mobile(c_i) - own / m_i
        c_part = (w_bar * m_i * mobility) * mobile_gradient(c_i)
        c_part += strength * energy_hessian_product(c_i, project(chi_bar))
        z = (-interface_width * interface_width * s.volume / m_i) * chi_bar
        return x_sum, n_sum, m_part, c_part, own / time_step, w_bar * m_i * mobile(c_i), z

    of_potential = [over(spread_adjoint, "x_sum n_sum m_sum c_sum own", y="z", **of_c)]

    @particle_kernel(adjoint_module, "+x_bar +n_bar +m_bar +c_bar +interface_width_bar", of_potential, typed=typed)
    def potential_adjoint(
        x_sum, n_sum, m_sum, c_sum, own, interface_width, m_i
    ) -> tuple[vector, real, real, fractions, real]:
        return x_sum, n_sum, m_sum - own / m_i, c_sum, real(2.0) * own / interface_width

    return SimpleNamespace(
        potential=Kernels(potential, potential_tangent, potential_adjoint),
        flux=Kernels(flux, flux_tangent, (scale_adjoint, flux_adjoint)),
    )
