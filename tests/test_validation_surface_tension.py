"""Drops in the plane and in space whose surface tension is by curvature, against the linear problem with viscosity.

`validation/surface_tension.py` prints the table for more of them."""

from functools import cache

import numpy as np
import pytest

from cortado.sph.curvature import CurvatureConstants
from oscillating_drops import C2, C4, Drop, exact_mode, packed_disc

pytestmark = pytest.mark.filterwarnings("ignore::cortado.CortadoWarning")


@cache
def drop(turned, name):
    return Drop(24, turned=turned, discretisation={"C2": C2, "C4": C4}[name], slope=True)


def test_the_exact_root_is_lambs_without_viscosity():
    """sqrt(6) (Lamb 1932), with a damping of 2 n (n - 1) Oh."""
    frequency, damping = exact_mode(1e-5)
    assert abs(frequency / np.sqrt(6.0) - 1.0) < 1e-4 and abs(damping / 4e-5 - 1.0) < 0.01


@pytest.mark.parametrize("name", ["C2", "C4"])
@pytest.mark.parametrize("turned", [0.0, 45.0])
def test_a_drop_oscillates_as_it_must(turned, name):
    """Whatever the direction of its lattice, and so the derivative of its frequency."""
    made = drop(turned, name)
    frequency, damping, rest = made.fit()
    assert abs(frequency - 1.0) < 0.04 and 0.82 < damping < 1.1 and rest < 0.05
    assert abs(made.frequency_slope() - 1.0) < 0.1


def test_a_drop_as_scenes_have_it_is_damped_as_it_must_be():
    """Particles of round bodies are packed, and no lattice has to come to rest."""
    frequency, damping, rest = Drop(24, discretisation=C4, particles=packed_disc).fit()
    assert abs(frequency - 1.0) < 0.02 and abs(damping - 1.0) < 0.1 and rest < 0.01


@pytest.mark.parametrize("turned", [0.0, 45.0])
def test_the_pressure_in_a_drop_is_that_of_laplace(turned):
    """But for what the depth of the force takes: half a spacing over the radius."""
    made = drop(turned, "C4")
    late = made.pressure[len(made.time) // 2 :]
    assert abs(late.mean() - 1.0 - 0.5 / 12.0) < 0.02 and late.std() < 0.01


def test_it_is_nearer_with_more_particles():
    coarse, fine = (Drop(across, turned=45.0, discretisation=C4, periods=1.5) for across in (16, 36))
    assert abs(fine.fit()[0] - 1.0) < 0.03 < abs(coarse.fit()[0] - 1.0)
    late = [abs(made.pressure[len(made.time) // 2 :].mean() - 1.0) for made in (coarse, fine)]
    assert late[1] < 0.6 * late[0]


def test_without_tension_or_without_the_depth_of_the_curvature_it_does_not(monkeypatch):
    still = Drop(24, discretisation=C4, periods=0.5, surface_tension=0.0)
    assert still.stretch[-1] > 0.9 * still.stretch[0]
    made = CurvatureConstants.of

    def shallow(*given):
        found = made(*given)
        return CurvatureConstants(found.spacing, found.width, 0.0)

    monkeypatch.setattr(CurvatureConstants, "of", shallow)
    assert Drop(24, turned=45.0, discretisation=C4, periods=1.5).fit()[0] > 1.06


def test_how_far_the_drop_drifts():
    """The force keeps momentum but nearly: of a drop whose particles are stirred."""
    made = Drop(24, turned=20.0, jitter=0.1, discretisation=C4)
    assert 1e-6 < made.drift.max() / made.speed.max() < 0.15


def test_a_drop_in_space():
    """Lamb (1932), art. 355."""
    made = Drop(12, dimension=3, discretisation=C2, ohnesorge=0.05, periods=1.5)
    frequency, _, rest = made.fit()
    assert abs(frequency - 1.0) < 0.12 and rest < 0.1
