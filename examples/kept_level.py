"""A tap runs into a tank: how far must the drain be opened, from one moment to the next, so that the level stays?

What is searched are the flow rates of the drain at a few times; they begin shut.
"""

import numpy as np

import cortado
from cortado.optimisation.transforms import TimeInterpolation, Transformed

STEPS, TIME_STEP, KNOTS = 300, 0.0025, 4
FLOW, LEVEL = 0.16, 0.4  # m2/s that the tap gives, and m

scene = cortado.Scene(
    name="kept level",
    dimension=2,
    discretisation={"spacing": 0.05},
    phase=[{"name": "water", "rest_density": 1000.0, "viscosity": 0.05, "colour": [0.05, 0.3, 0.6]}],
    fluid=[{"shape": "box", "lower": [0.0, 0.0], "upper": [1.0, LEVEL], "phase": "water"}],
    emitter=[{"phase": "water", "outlet": [0.15, 0.5], "radius": 0.1, "flow_rate": FLOW}],
    drain=[{"shape": "sink", "name": "hole", "position": [0.85, 0.0], "flow_rate": 0.0}],
    container={"shape": "box", "lower": [0.0, 0.0], "upper": [1.0, 1.2]},
    solver={"kind": "projection", "time_step": TIME_STEP},
)
simulation = cortado.Simulation(scene.lasting(STEPS * TIME_STEP), precision="float64")
gauge, times = cortado.sensors.WaveGauge([0.35, 0.0], radius=0.25), TIME_STEP * np.arange(STEPS + 1)
level = cortado.losses.Series(gauge, times[1:], np.full(STEPS, LEVEL), TIME_STEP, every=10)
search = Transformed(cortado.Problem(simulation, STEPS, level), {"hole.flow_rate": TimeInterpolation(STEPS, KNOTS)})

start, bounds = {"hole.flow_rate": np.zeros(KNOTS)}, {"hole.flow_rate": (0.0, 0.4)}
optimiser, gradient = cortado.optimisers.LineSearch(), cortado.gradients.AdjointViscosity()
found = cortado.optimise(search, start, optimiser, 8, bounds, gradient=gradient)


def heights(u):
    """(STEPS + 1,) of the surface after each step [m]."""
    run = simulation.run(STEPS, search.parameters(u), STEPS, sensors={"gauge": gauge})
    return run.sensors["gauge"]["height"]


shut, kept = heights(start), heights(found.parameters)
print("flow rates", np.round(found.parameters["hole.flow_rate"], 3), "m2/s, where the tap gives", FLOW)
print(f"the level at the end: {1e3 * shut[-1]:.0f} mm with a shut drain, {1e3 * kept[-1]:.0f} mm with that")
off = np.sqrt(np.mean((kept - LEVEL) ** 2))
assert off < 0.3 * np.sqrt(np.mean((shut - LEVEL) ** 2)), f"the level is {1e3 * off:.0f} mm off"

picture = simulation.picture(
    simulation.run(STEPS, search.parameters(found.parameters), STEPS)[-1], width=640, height=400
)
cortado.pictures.write_picture("kept_level.png", picture)
