"""A paddle makes waves: how must it move so that they bring a raft to a place, level and at a given time?

What is searched are the amplitudes of a few waves of which the paddle's path is made; it begins at rest.
"""

import numpy as np

import cortado
from cortado.optimisation.transforms import Affine, Transformed

STEPS, TIME_STEP, MODES = 320, 0.003, 16
WANTED = np.array([0.55, 0.2])  # m, where the middle of the raft shall be

paddle = {"name": "paddle", "shape": "box", "lower": [0.06, -0.1], "upper": [0.16, 0.4]}
raft = {"name": "raft", "shape": "box", "lower": [0.36, 0.15], "upper": [0.61, 0.25], "density": 500.0}
scene = cortado.Scene(
    name="steered raft",
    dimension=2,
    discretisation={"spacing": 0.025},
    phase=[{"name": "water", "rest_density": 1000.0, "viscosity": 0.1}],
    fluid=[{"shape": "box", "lower": [0.16, 0.0], "upper": [0.96, 0.2], "phase": "water"}],
    container={"shape": "box", "lower": [-0.2, 0.0], "upper": [0.96, 0.5]},
    solid=[{**paddle, "motion": "path", "velocity": [0.0, 0.0]}, {**raft, "motion": "free"}],
    solver={"kind": "projection", "time_step": TIME_STEP},
)

# From amplitudes (MODES,) to the paddle's path (STEPS,) [m].
phases = np.pi * np.arange(1, STEPS + 1)[:, None] / STEPS * np.arange(1, MODES + 1)
waves = 0.04 * (1.0 - np.cos(phases)) / np.arange(1, MODES + 1)
path = Affine(np.zeros((STEPS, 2)), np.einsum("sk,d->sdk", waves, [1.0, 0.0]))

problem = cortado.Problem(cortado.Simulation(scene), STEPS, cortado.losses.SolidPose("raft", WANTED, 0.0, length=0.1))
search = Transformed(problem, {"paddle.displacement": path})
start, bounds = {"paddle.displacement": np.zeros(MODES)}, {"paddle.displacement": (-1.0, 1.0)}
optimiser, gradient = cortado.optimisers.LineSearch(), cortado.gradients.AdjointViscosity()
found = cortado.optimise(search, start, optimiser, 16, bounds, gradient=gradient)

for name, u in (("no waves", start), ("found", found.parameters)):
    body = problem.simulation.run(STEPS, search.parameters(u), record_every=STEPS).solids["raft"]
    place, turn = body.positions[-1], float(np.ravel(body.rotations[-1])[0])
    print(f"{name}: loss {search.value(u):.3g} m2, the raft is at {place} m, turned by {turn:.3f} rad")
assert found.loss < 0.05 * search.value(start), "the raft is not where it should be"

run = problem.simulation.run(STEPS, search.parameters(found.parameters), record_every=80)
pictures = [problem.simulation.picture(run[k], width=600, height=320) for k in (0, 2, 4)]
cortado.pictures.write_picture("steered_raft.png", np.concatenate(pictures, axis=1))
