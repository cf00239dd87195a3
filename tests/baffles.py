"""Water beside sheets and thick walls: two levels that are held, and sloshing past a baffle."""

import numpy as np

from cortado import Simulation
from cortado.sensors import SolidLoad
from scenes import box, pool


def two_levels(**tables):
    """Water half a metre deep on one side of a sheet, and a quarter on the other."""
    fluid = [box([0.0, 0.0], [0.5, 0.5], phase="water"), box([0.5, 0.0], [1.0, 0.25], phase="water")]
    water = {"name": "water", "rest_density": 1000.0, "viscosity": 0.001}
    sheet = {"name": "baffle", "shape": "sheet", "corners": [[0.5, -0.1], [0.5, 0.75]]}
    own = {"phase": [water], "fluid": fluid, "container": box([0.0, 0.0], [1.0, 0.75]), "solid": [sheet]}
    own |= {"discretisation": {"spacing": 0.025}, "solver": {"kind": "projection", "time_step": 0.002}}
    return pool([0.5, 0.5], [1.0, 0.75], **{**own, **tables})


def held(steps=300, step=0.002):
    """How far both sides' middles are from where they were, over the spacing; the greatest speed; and the load on the
    sheet over what hydrostatics says, from step 50 on."""
    scene = two_levels(solver={"kind": "projection", "time_step": step})
    simulation = Simulation(scene, precision="float64")
    run = simulation.run(steps, record_every=20, sensors={"load": SolidLoad("baffle")})
    left = run.positions[0][:, 0] < 0.5
    middles = np.array([[x[left].mean(axis=0), x[~left].mean(axis=0)] for x in run.positions])
    load = run.sensors["load"].values[50:, 0].mean() / (0.5 * 9810.0 * (0.5**2 - 0.25**2))
    across = sum(((x[:, 0] < 0.5) != left).sum() for x in run.positions)
    return np.abs(middles - middles[0]).max() / 0.025, np.sqrt((run.velocities**2).sum(2).mean(1)).max(), load, across


LENGTH, DEPTH, HEIGHT = 1.2, 0.4, 0.24
"""Of a tank, of its water, and of a baffle in its middle [m]."""


def sloshed(thickness, spacing, duration=6.0):
    """Water in a tank with a baffle of a thickness [m], or a sheet where it is 0, that begins in its first mode: the
    rate at which the greatest distances of its middle from the tank's fall [1/s], and the period [s]."""
    middle, wave = 0.5 * LENGTH, np.pi / LENGTH
    ends = [middle - 0.5 * thickness, -0.1], [middle + 0.5 * thickness, HEIGHT]
    sheet = {"shape": "sheet", "corners": [[middle, -0.1], [middle, HEIGHT]]}
    baffle = {"name": "baffle", **(sheet if thickness == 0.0 else box(*ends))}
    scene = pool(
        [LENGTH, DEPTH],
        [LENGTH, 0.8],
        phase=[{"name": "water", "rest_density": 1000.0, "viscosity": 0.001}],
        solid=[baffle],
        discretisation={"spacing": spacing},
        solver={"kind": "projection", "time_step": 0.1 * spacing},
    )
    simulation = Simulation(scene, precision="float64")
    x, y = simulation.positions.T
    moving = np.stack([np.sin(wave * x) * np.cosh(wave * y), -np.cos(wave * x) * np.sinh(wave * y)], axis=1)
    first = {"initial_velocities": 0.2 * moving / np.cosh(wave * DEPTH)}
    run = simulation.run(round(duration / scene.solver.time_step), first, record_every=5)
    away = np.abs(run.positions[:, :, 0].mean(axis=1) - middle)
    peaks = 1 + np.flatnonzero((away[1:-1] >= away[:-2]) & (away[1:-1] > away[2:]) & (away[1:-1] > 3e-4))
    rate = -np.polyfit(run.times[peaks], np.log(away[peaks]), 1)[0]
    return float(rate), float(2.0 * np.diff(run.times[peaks]).mean())
