"""The viscosity of a fluid is the one that was asked for: flows of closed forms, for the default form of the force.

Each bound is broken by the forms "pairwise" or "laminar", as `validation/README.md` says.
"""

import numpy as np
import pytest

from cortado.errors import CortadoWarning
from viscous_flows import KERNELS, Channel, acceleration, disordered, simulation, turning, viscosity_of_wave
from viscous_layers import by_engine, by_hand, profile_error, two_layers

PLANE = [((0, 1), (1, 0)), ((1, 1), (1, -1)), ((1, 2), (2, -1)), ((1, 3), (3, -1))]
"""Waves along rows, along a diagonal and at 27 and 18 degrees from a row, and their velocities."""
SPACE = [((1, 0, 0), (0, 0, 1)), ((1, 1, 0), (1, -1, 0)), ((1, 1, 0), (0, 0, 1))]
DISORDER = [0.0, 0.2, None]
"""Of particles in spacings; None for some that were mixed."""


def errors_of_waves(across: int, kernel: str, disorder: float | None, waves=PLANE, form: str = "stress") -> np.ndarray:
    one = simulation([1.0, 1.0, 8.0 / across][: len(waves[0][0])], 1.0 / across, kernel, form)
    x = disordered(one, disorder)
    return np.array([viscosity_of_wave(one, x, *wave) for wave in waves]) - 1.0


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("disorder", DISORDER)
def test_a_wave_of_shear_decays_as_asked_in_every_direction(kernel, disorder):
    """20, 40 and 80 particles in a side of the box, whose waves are 1, 0.7, 0.4 and 0.3 m long."""
    coarse, middle, fine = (np.abs(errors_of_waves(across, kernel, disorder)).max() for across in (20, 40, 80))
    assert middle < 0.03 and fine < 0.01
    assert disorder == 0.2 or fine < max(coarse / 16.0, 1e-4)  # second order, or all that there is


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("disorder", DISORDER)
def test_so_it_does_in_space(kernel, disorder):
    assert np.abs(errors_of_waves(40, kernel, disorder, SPACE)).max() < 0.03
