"""Laws of viscosity, by which the viscosity of a fluid follows from its shear rate: a user's function, one of those
that scenes name (`cortado.scene.model`), or the constant of a Newtonian fluid. Before a run begins each law is
tried, as Warp compiles it, at shear rates that fluids have."""

import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import warp as wp

from cortado.device.launching import launch
from cortado.device.modules import kernel_module
from cortado.device.precision import Precision, TypesByName
from cortado.errors import InputError
from cortado.sph.formula import Formula, applied, formula, theta_of
from cortado.sph.function_text import plain_function


@dataclass(frozen=True)
class Law:
    """A law of viscosity as a function of the shear rate, with the ranks of its parameters: 0 for numbers."""

    text: Formula
    ranks: tuple[int, ...]
    topic: str
    """Name that tells the Warp modules of one law from those of others; empty for Newtonian fluids."""

    @property
    def is_newtonian(self) -> bool:
        """Return True for a viscosity that does not depend on the shear rate."""
        return not self.topic

    def applied(self, precision: Precision, module: Any) -> Any:
        """Make the Warp function of the shear rate [1/s], the particles' viscosity [Pa s] and theta that returns the
        viscosity [Pa s]."""
        return applied(self.text, precision, self.ranks, 3, module)


def newtonian(shear_rate, viscosity):
    """Return the viscosity as it is: it does not depend on the shear rate."""
    return viscosity


@cache
def newtonian_law() -> Law:
    """Return the law of fluids that have no other law of viscosity."""
    return Law(formula("Rheology", plain_function("Rheology", newtonian), inspect.getsource(newtonian), {})[0], (), "")


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
    """Return a Bingham fluid's viscosity as Papanastasiou (1987) smooths it; for small m g by a series."""
    x = regularisation * shear_rate
    part = 1.0 - x / 2.0 + x * x / 6.0
    if x > 0.01:
        part = (1.0 - wp.exp(-x)) / x
    return viscosity + yield_stress * regularisation * part


def herschel_bulkley(shear_rate, viscosity, yield_stress, regularisation, flow_index, least_shear_rate):
    """Return a Herschel-Bulkley fluid's viscosity: a Bingham fluid's with a power law for the constant one."""
    x = regularisation * shear_rate
    part = 1.0 - x / 2.0 + x * x / 6.0
    if x > 0.01:
        part = (1.0 - wp.exp(-x)) / x
    square = shear_rate * shear_rate + least_shear_rate * least_shear_rate
    return viscosity * wp.pow(square, 0.5 * (flow_index - 1.0)) + yield_stress * regularisation * part


LAWS: dict[str, Callable[..., Any]] = {law.__name__: law for law in (power_law, carreau, bingham, herschel_bulkley)}
"""By the ``kind`` of the key ``rheology``."""


SHEAR_RATES = np.logspace(-6.0, 6.0, 601)
"""[1/s]: no particle has a lower one (`cortado.sph.stress_kernels.SLOWEST`)."""


@cache
def trial_kernel(precision: Precision, law: Law) -> Any:
    """Make the kernel that applies a law at each shear rate, for each viscosity and each theta."""
    module = kernel_module(f"{law.topic}trial_{precision.name}")
    real, theta_type, apparent = precision.real, theta_of(precision, law.ranks), law.applied(precision, module)

    @wp.kernel(module=module, enable_backward=False)
    @TypesByName(real, {theta_type: "thetas"}).arrays
    def trial(shear_rates, viscosities, thetas, found: wp.array3d(dtype=real)):
        k, p, t = wp.tid()
        found[k, p, t] = apparent(shear_rates[k], viscosities[p], thetas[t])

    return trial


def check_law(
    what: str, law: Law, viscosities: Mapping[str, float], thetas: np.ndarray, precision: Precision, device: Any
) -> None:
    """Raise `InputError` where a law returns no valid viscosity, for ``viscosities`` [Pa s] by the names of phases and
    parameters ``thetas`` (k, numbers)."""
    kernel, rows = trial_kernel(precision, law), np.zeros((len(thetas), theta_of(precision, law.ranks)._length_))
    rows[:, : thetas.shape[1]] = thetas
    given = {"shear_rates": SHEAR_RATES, "viscosities": np.array(list(viscosities.values()))}
    arrays = {name: wp.array(values, dtype=precision.real, device=device) for name, values in given.items()}
    arrays["thetas"] = wp.array(rows, dtype=theta_of(precision, law.ranks), device=device)
    shape = len(SHEAR_RATES), len(viscosities), len(rows)
    found = wp.zeros(shape, dtype=precision.real, device=device)
    launch(kernel, shape, device, **arrays, found=found)
    values = found.numpy()
    wrong = np.argwhere(~(np.isfinite(values) & (values >= 0.0)))
    if len(wrong):
        k, phase, theta = wrong[0]
        name, viscosity = list(viscosities.items())[phase]
        found = f"{what} returns {values[k, phase, theta]:g} Pa s at a shear rate of {SHEAR_RATES[k]:.3g} 1/s"
        wanted = "but must return a finite number that is at least 0 from 1e-06 to 1e+06 1/s"
        raise InputError(f"{found}, for the viscosity of {name}, {viscosity:g} Pa s, {wanted}.")
