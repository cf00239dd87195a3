"""A dam of mud breaks and strikes a pillar: how dense is the mud? The load on the pillar tells.

Once the mud is at rest, its load is that of hydrostatics: density g depth^2 / 2 for each metre of breadth.
"""

import numpy as np

import cortado

STRUCK, STEPS, REST, TIME_STEP, ITERATIONS = 140, 220, 700, 0.0025, 3  # steps, s
TRUE, GUESS = 1600.0, 1000.0  # kg/m3
WIDTH, HEIGHT, PILLAR = 0.24, 0.3, 0.5  # m, of the mud at first, and where the pillar stands

scene = cortado.Scene(
    name="struck pillar",
    dimension=2,
    discretisation={"spacing": 0.02},
    phase=[{"name": "mud", "rest_density": GUESS, "viscosity": 40.0, "colour": [0.4, 0.27, 0.15]}],
    fluid=[{"shape": "box", "lower": [0.0, 0.0], "upper": [WIDTH, HEIGHT], "phase": "mud"}],
    container={"shape": "box", "lower": [0.0, 0.0], "upper": [0.9, 0.5], "slip": "no"},
    solid=[{"name": "pillar", "shape": "box", "lower": [PILLAR, -0.1], "upper": [PILLAR + 0.1, 0.4]}],
    forces={"viscosity": "stress"},
    solver={"kind": "projection", "time_step": TIME_STEP},
)
simulation, sensor = cortado.Simulation(scene), cortado.sensors.SolidLoad("pillar")


def push(steps, density):
    """(steps + 1,) from left to right, after each step [N], for each metre of breadth."""
    run = simulation.run(steps, {"rest_density": density}, steps, sensors={"load": sensor})
    return run.sensors["load"]["force_x"]


# What was measured: a simulation that we pretend not to know, with 2 % of noise.
true = push(REST, TRUE)
values = np.full((STEPS + 1, 3), np.nan)  # two forces and a torque, of which one counts
values[:, 0] = true[: STEPS + 1] * (1.0 + 0.02 * np.random.default_rng(0).normal(size=STEPS + 1))
times, scale = TIME_STEP * np.arange(STEPS + 1), true[STRUCK]  # the first blow itself is too rough to fit
series = cortado.losses.Series(sensor, times[STRUCK:], values[STRUCK:], TIME_STEP, every=4, scale=scale)

problem, optimiser = cortado.Problem(simulation, STEPS, series), cortado.optimisers.LBFGS(scale=400.0)
bounds = {"rest_density": (500.0, 3000.0)}
found = cortado.optimise(problem, {"rest_density": GUESS}, optimiser, ITERATIONS, bounds)
density, depth = float(np.ravel(found.parameters["rest_density"])[0]), WIDTH * HEIGHT / PILLAR
rest, hydrostatic = true[-100:].mean(), 0.5 * TRUE * 9.81 * depth**2
print(f"loss {found.loss:.2g}, density {density:.0f} kg/m3")
print(f"load: at most {true.max():.0f} N, at rest {rest:.0f} N; hydrostatics {hydrostatic:.0f} N")
assert abs(density / TRUE - 1.0) < 0.05, "the density is not that of the load"
assert abs(rest / hydrostatic - 1.0) < 0.06, "the load at rest is not that of hydrostatics"
run = simulation.run(REST, found.parameters, record_every=50)
pictures = [simulation.picture(run[k], width=480, height=280) for k in (0, 2, 3, 14)]
cortado.pictures.write_picture("struck_pillar.png", np.concatenate(pictures, axis=1))
