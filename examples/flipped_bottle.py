"""A bottle is thrown into a pool: how, so that it turns over once, and plunges upright in a given place?

What is searched are its velocity and its angular velocity as it leaves the hand, three numbers.
"""

import numpy as np

import cortado

# Judged as its foot is in the water: what water does to a slanted bottle after that makes a second minimum.
STEPS, TIME_STEP = 180, 0.0025  # s
WANTED = np.array([0.7, 0.24])  # m, where its middle shall be then

outline = np.array([[-0.05, 0.0], [0.05, 0.0], [0.05, 0.14], [0.02, 0.19], [0.02, 0.25]])
corners = np.concatenate([outline, outline[:1:-1] * [-1.0, 1.0]]) + [0.2, 0.3]
scene = cortado.Scene(
    name="flipped bottle",
    dimension=2,
    discretisation={"spacing": 0.025},
    phase=[{"name": "water", "rest_density": 1000.0, "viscosity": 0.5}],
    fluid=[{"shape": "box", "lower": [0.0, 0.0], "upper": [1.0, 0.2], "phase": "water"}],
    container={"shape": "box", "lower": [0.0, 0.0], "upper": [1.0, 1.0]},
    solid=[{"name": "bottle", "shape": "polygon", "corners": corners.tolist(), "motion": "free", "density": 600.0}],
    solver={"kind": "projection", "time_step": TIME_STEP},
)
simulation = cortado.Simulation(scene)
problem = cortado.Problem(simulation, STEPS, cortado.losses.SolidPose("bottle", WANTED, 0.0, length=0.1))
start = {"bottle.velocity": np.array([1.0, 1.8]), "bottle.angular_velocity": np.array(-9.0)}
optimiser = cortado.optimisers.LineSearch(scale={"bottle.velocity": 0.3, "bottle.angular_velocity": 3.0})
found = cortado.optimise(problem, start, optimiser, 4)

for name, throw in (("first throw", start), ("found", found.parameters)):
    run = simulation.run(STEPS, throw, record_every=36)
    bottle = run.solids["bottle"]
    place, turn = bottle.positions[-1], float(np.ravel(bottle.rotations[-1])[0])
    print(f"{name}: loss {problem.value(throw):.3g} m2, the bottle is at {place} m, turned by {turn:.2f} rad")
assert found.loss < 0.01 * problem.value(start), "the bottle does not plunge upright where it should"
pictures = [simulation.picture(run[k], width=400, height=360) for k in (0, 2, 4, 5)]
cortado.pictures.write_picture("flipped_bottle.png", np.concatenate(pictures, axis=1))
