"""The laws of viscosity that scenes name (`cortado.scene.rheology`), each a function that Warp compiles."""

from collections.abc import Callable
from typing import Any

import warp as wp


def power_law(shear_rate, viscosity, flow_index, least_shear_rate):
    """Of Ostwald and de Waele."""
    return viscosity * wp.pow(shear_rate * shear_rate + least_shear_rate * least_shear_rate, 0.5 * (flow_index - 1.0))


def carreau(shear_rate, viscosity, relaxation_time, flow_index, infinite_viscosity):
    """Of Carreau (1972)."""
    turned = relaxation_time * shear_rate
    return infinite_viscosity + (viscosity - infinite_viscosity) * wp.pow(
        1.0 + turned * turned, 0.5 * (flow_index - 1.0)
    )


def bingham(shear_rate, viscosity, yield_stress, regularisation):
    """Of Bingham, made smooth by Papanastasiou (1987); for small m g, (1 - exp(-m g)) / (m g) as a series."""
    x = regularisation * shear_rate
    part = 1.0 - x / 2.0 + x * x / 6.0
    if x > 0.01:
        part = (1.0 - wp.exp(-x)) / x
    return viscosity + yield_stress * regularisation * part


def herschel_bulkley(shear_rate, viscosity, yield_stress, regularisation, flow_index, least_shear_rate):
    """The same with a power law in the place of the viscosity."""
    x = regularisation * shear_rate
    part = 1.0 - x / 2.0 + x * x / 6.0
    if x > 0.01:
        part = (1.0 - wp.exp(-x)) / x
    square = shear_rate * shear_rate + least_shear_rate * least_shear_rate
    return viscosity * wp.pow(square, 0.5 * (flow_index - 1.0)) + yield_stress * regularisation * part


LAWS: dict[str, Callable[..., Any]] = {law.__name__: law for law in (power_law, carreau, bingham, herschel_bulkley)}
"""By the ``kind`` of the key ``rheology``."""
