"""A law of viscosity is tried where fluids are sheared before a run begins: as it is compiled, in its precision."""

from collections.abc import Mapping
from functools import cache
from typing import Any

import numpy as np
import warp as wp

from cortado.device.launching import launch
from cortado.device.modules import kernel_module
from cortado.device.precision import Precision
from cortado.errors import InputError
from cortado.sph.packed import theta_of
from cortado.sph.viscosity_law import Law

SHEAR_RATES = np.logspace(-6.0, 6.0, 601)
"""[1/s]: no particle has a lower one (`cortado.sph.stress_functions.SLOWEST`)."""


@cache
def trial_kernel(precision: Precision, law: Law) -> Any:
    """Of the law at each shear rate, for each viscosity and each theta."""
    module = kernel_module(f"{law.topic}trial_{precision.name}")
    real, theta_type, apparent = precision.real, theta_of(precision, law.ranks), law.applied(precision, module)

    @wp.kernel(module=module, enable_backward=False)
    def trial(
        shear_rates: wp.array(dtype=real),
        viscosities: wp.array(dtype=real),
        thetas: wp.array(dtype=theta_type),
        # out
        found: wp.array3d(dtype=real),
    ):
        k, p, t = wp.tid()
        found[k, p, t] = apparent(shear_rates[k], viscosities[p], thetas[t])

    return trial


def check_law(
    what: str, law: Law, viscosities: Mapping[str, float], thetas: np.ndarray, precision: Precision, device: Any
) -> None:
    """``viscosities`` [Pa s] by the names of phases, ``thetas`` (k, numbers) as the law has them. Raises `InputError`
    where the law returns what is no viscosity."""
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
