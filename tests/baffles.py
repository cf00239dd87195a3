"""Water beside a sheet: two levels that are held."""

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
