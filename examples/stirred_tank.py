"""How viscous is the fluid in a stirred tank? The torque that its stirrer takes tells.

``python stirred_tank.py stirrer.stl`` takes a stirrer of your own, in metres, with its axis along y.
"""

import sys

import numpy as np

import cortado

STEPS, ITERATIONS, TIME_STEP = 25, 6, 0.004
TRUE, GUESS = 9.0, 2.0  # Pa s

shape = {"shape": "box", "lower": [0.2, 0.05, 0.2], "upper": [0.4, 0.2, 0.4]}
if len(sys.argv) > 1:
    shape = {"shape": "mesh", "file": sys.argv[1]}
turns = {"position": [0.3, 0.125, 0.3], "motion": "path", "angular_velocity": [0.0, 3.0, 0.0], "slip": "no"}
scene = cortado.Scene(
    name="stirred tank",
    dimension=3,
    discretisation={"spacing": 0.05},
    phase=[{"name": "honey", "rest_density": 1400.0, "viscosity": GUESS, "colour": [0.9, 0.55, 0.1]}],
    fluid=[{"shape": "box", "lower": [0.0, 0.0, 0.0], "upper": [0.6, 0.25, 0.6], "phase": "honey"}],
    container={"shape": "box", "lower": [0.0, 0.0, 0.0], "upper": [0.6, 0.4, 0.6], "slip": "no"},
    solid=[{**shape, **turns, "name": "stirrer"}],
    solver={"kind": "projection", "time_step": TIME_STEP},
)
simulation, sensor = cortado.Simulation(scene), cortado.sensors.SolidLoad("stirrer")


def torque(viscosity):
    """(STEPS + 1,) about the axis, after each step [N m]."""
    return simulation.run(STEPS, {"viscosity": viscosity}, STEPS, sensors={"load": sensor}).sensors["load"]["torque_y"]


# What was measured: a simulation that we pretend not to know, with 2 % of noise.
times, true = TIME_STEP * np.arange(STEPS + 1), torque(TRUE)
values = np.full((STEPS + 1, 6), np.nan)  # three forces and three torques, of which one counts
values[:, 4] = true * (1.0 + 0.02 * np.random.default_rng(0).normal(size=STEPS + 1))
series = cortado.losses.Series(sensor, times[1:], values[1:], TIME_STEP, every=5, scale=np.abs(true).mean())

problem = cortado.Problem(simulation, STEPS, series)
optimiser = cortado.optimisers.LBFGS(scale=4.0)
found = cortado.optimise(problem, {"viscosity": GUESS}, optimiser, ITERATIONS, {"viscosity": (0.1, 30.0)})
viscosity = float(np.ravel(found.parameters["viscosity"])[0])
print(f"loss {found.loss:.2g}, viscosity {viscosity:.2f} Pa s, torque at the end {torque(viscosity)[-1]:.3f} N m")
assert abs(viscosity / TRUE - 1.0) < 0.05, "the viscosity is not that of the torque"

picture = simulation.picture(simulation.run(STEPS, found.parameters, STEPS)[-1], width=640, height=400)
cortado.pictures.write_picture("stirred_tank.png", picture)
