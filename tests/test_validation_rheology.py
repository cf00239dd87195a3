"""Fluids whose viscosity depends on the shear rate between plates, beside closed forms.

A push g along the channel is balanced by the shear stress rho g (1/2 - y), a width of 1 m from wall to wall, so that a
law of viscosity says how fast the fluid is at each y. Runs begin at that, and go on until rows have passed each other.
"""

import numpy as np
import pytest
from scipy.integrate import cumulative_trapezoid
from scipy.optimize import brentq

from cortado import Scene, Simulation
from yielding_films import LAW, observed, steady_speeds

PUSH, DENSITY = 1.0, 1000.0
ACROSS = 40


def channel(viscosity, rheology, speeds, time_step, steps):
    """Heights [m] and speeds [m/s] of particles after so many steps; ``speeds``, of heights, are those at the start."""
    spacing = 1.0 / ACROSS
    upper = [10.0 * spacing, 1.0]
    simulation = Simulation(
        Scene(
            dimension=2,
            discretisation={"spacing": spacing},
            phase=[{"name": "paste", "rest_density": DENSITY, "viscosity": viscosity, "rheology": rheology}],
            fluid=[{"shape": "box", "lower": [0.0, 0.0], "upper": upper, "phase": "paste"}],
            container={"shape": "box", "lower": [0.0, 0.0], "upper": upper, "periodic": [True, False], "slip": "no"},
            forces={"gravity": [PUSH, 0.0]},
            solver={"kind": "pcisph", "time_step": time_step, "density_tolerance": 0.001},
        ),
        precision="float64",
    )
    along = np.zeros_like(simulation.positions)
    along[:, 0] = speeds(simulation.positions[:, 1])
    state = simulation.step(simulation.state({"initial_velocities": along}), {}, steps=steps)
    return state["positions"][:, 1], state["velocities"][:, 0]


def test_a_bingham_fluid_has_a_plug_between_plates():
    """As wide as the stress is below the yield stress, 2 yield_stress / (rho g), to one spacing; without a yield stress
    there is none."""
    viscosity, yields = 100.0, 250.0
    edge = yields / (DENSITY * PUSH)

    def speeds(y):
        sheared = np.maximum(np.abs(y - 0.5) - edge, 0.0)
        return 0.5 * DENSITY * PUSH / viscosity * ((0.5 - edge) ** 2 - sheared**2)

    y, u = channel(viscosity, {"kind": "bingham", "yield_stress": yields}, speeds, 0.01, 100)
    from_middle = np.abs(y - 0.5)
    plug = np.median(u[from_middle < 0.1])
    sheared = (from_middle > edge + 0.06) & (from_middle < 0.47)
    slope, offset = np.polyfit(from_middle[sheared], np.sqrt(np.maximum(plug - u[sheared], 0.0)), 1)
    assert -offset / slope == pytest.approx(edge, abs=1.0 / ACROSS)
    assert plug == pytest.approx(speeds(0.5), rel=0.02) and np.ptp(u[from_middle < 0.2]) < 0.01 * plug


def test_a_carreau_fluid_flows_between_plates_as_it_should():
    """Its flow rate is that of the law to 0.5 %; a Newtonian fluid would have a quarter of it."""
    viscosity, time, index = 100.0, 1.0, 0.5

    def stress(rate):
        return viscosity * (1.0 + (time * rate) ** 2) ** (0.5 * (index - 1.0)) * rate

    def shear_rate(wanted):
        return brentq(lambda rate: stress(rate) - wanted, 0.0, 1e4)

    heights = np.linspace(0.0, 1.0, 201)
    slopes = [np.sign(0.5 - y) * shear_rate(DENSITY * PUSH * abs(0.5 - y)) for y in heights]
    exact = cumulative_trapezoid(slopes, heights, initial=0.0)

    def speeds(y):
        return np.interp(y, heights, exact)

    y, u = channel(viscosity, {"kind": "carreau", "relaxation_time": time, "flow_index": index}, speeds, 0.005, 100)
    assert u.mean() == pytest.approx(speeds(y).mean(), rel=0.005)
    assert DENSITY * PUSH / (12.0 * viscosity) < 0.3 * u.mean()


def test_a_film_of_mud_flows_as_its_law_says():
    """Down a slope of 4 %, on which a third of it is not sheared; without the yield stress it is twice as fast."""
    found = observed(16, LAW, (0.04,))
    assert found == pytest.approx(steady_speeds(0.04), rel=0.02)
    without = observed(16, {**LAW, "herschel_bulkley.yield_stress": 0.0}, (0.04,))
    assert (without > 1.5 * found).all()
