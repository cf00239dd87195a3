"""The viscosity of a fluid is the one that was asked for: flows of closed forms, for the default form of the force.

Waves, plates and layers at a ratio of 5 break their bounds with the form "pairwise":
`validation/README.md` has the figures.
"""

import numpy as np
import pytest

from viscous_flows import KERNELS, NU, Channel, acceleration, disordered, simulation, turning, viscosity_of_wave
from viscous_layers import by_engine, by_hand, profile_error, two_layers

PLANE = [((0, 1), (1, 0)), ((1, 1), (1, -1)), ((1, 2), (2, -1)), ((1, 3), (3, -1))]
"""Waves along rows, along a diagonal and at 27 and 18 degrees from a row, and their velocities."""
SPACE = [((1, 0, 0), (0, 0, 1)), ((1, 1, 0), (1, -1, 0)), ((1, 1, 0), (0, 0, 1))]
LEAST_FALL = {0.0: 150.0, 0.2: 8.0, None: 16.0}
"""By the disorder of particles in spacings, None for some that were stirred: from 20 to 80 across an error falls by so
much at least, 16 at second order; where each place is random it scatters by 0.001."""


def errors_of_waves(across: int, kernel: str, disorder: float | None, waves=PLANE, form: str = "stress") -> np.ndarray:
    one = simulation([1.0, 1.0, 8.0 / across][: len(waves[0][0])], 1.0 / across, kernel, form)
    x = disordered(one, disorder)
    return np.array([viscosity_of_wave(one, x, *wave) for wave in waves]) - 1.0


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("disorder", LEAST_FALL)
def test_a_wave_of_shear_decays_as_asked_in_every_direction(kernel, disorder):
    """20, 40 and 80 particles in a side of the box, whose waves are 1, 0.7, 0.4 and 0.3 m long."""
    coarse, middle, fine = (np.abs(errors_of_waves(across, kernel, disorder)).max() for across in (20, 40, 80))
    assert middle < 0.03 and fine < 0.01
    assert fine < coarse / LEAST_FALL[disorder]


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("disorder", [0.0, 0.2])
def test_so_it_does_in_space(kernel, disorder):
    assert np.abs(errors_of_waves(24, kernel, disorder, SPACE)).max() < 0.01


@pytest.mark.parametrize("pressure", [False, True])
@pytest.mark.parametrize("dimension, across", [(2, 16), (3, 8)])
def test_what_turns_alone_goes_on_turning(dimension, across, pressure):
    """To 1e-10 of its angular momentum after 2 s."""
    assert np.abs(turning(dimension, across, pressure=pressure) - 1.0).max() < 1e-10


def test_energy_is_never_made():
    """In 1,000 steps, each of other particles at random places with random velocities."""
    one = simulation([0.6, 0.6], 0.1)
    random = np.random.default_rng(1)
    for _ in range(1000):
        x = random.uniform(0.0, 0.6, one.positions.shape)
        v = random.normal(size=x.shape)
        a = acceleration(one, x, v)
        assert (a * v).sum() < 0.0 and np.abs(a.sum(axis=0)).max() < 1e-9 * np.abs(a).max()


@pytest.mark.parametrize("reynolds, low", [(1.0, 0.0), (10.0, 0.0), (10.0, 0.45)])
def test_what_flows_between_plates(reynolds, low):
    """Rows slide past each other by 0.3 and 3 spacings; the flow and what it changes by with the viscosity, within 1 %
    of the closed form."""
    found = Channel(20, reynolds, low, pressure=False, time=0.06 / NU).run()
    assert found["slid"] > 0.2 * reynolds
    assert found["flow"] == pytest.approx(1.0, abs=0.01) and found["slope"] == pytest.approx(1.0, abs=0.01)


def test_with_pressure_the_projection_keeps_what_flows():
    """Between rows of a Couette flow that slide past each other by 5 spacings."""
    found = Channel(20, 4.0, 0.45, "wendland_c2", solver="projection").run()
    assert found["slid"] > 4.0
    assert found["flow"] == pytest.approx(1.0, abs=0.01) and found["slope"] == pytest.approx(1.0, abs=0.01)


def test_layers_shear_each_other():
    """Two fluids, the upper one 5 times as viscous: the profile within 2 % with the harmonic mean, as the engine has
    it to round-off, and not with the arithmetic one; 50 times as viscous, within 2.5 %."""
    one = two_layers(40, 5.0)
    engine, harmonic, arithmetic = by_engine(one), by_hand(one, "harmonic"), by_hand(one, "arithmetic")
    u = np.random.default_rng(0).normal(size=one.particles)
    wanted = harmonic(u)
    assert np.abs(engine(u) - wanted).max() < 1e-11 * np.abs(wanted).max()
    assert profile_error(one, 5.0, engine) < 0.02 < profile_error(one, 5.0, arithmetic)
    assert profile_error(two_layers(40, 50.0), 50.0, by_engine(two_layers(40, 50.0))) < 0.025
