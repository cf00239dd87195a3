"""A cup is carried from one place to another in 0.72 s: how, so that no water is spilt and it is at rest afterwards?

Its path is made of accelerations in blocks of time, which are searched; all of them lead to the same place and stand.
"""

import numpy as np

import cortado
from cortado.optimisation.transforms import Affine, Transformed

DISTANCE, TIME_STEP, MOVING, STANDING, BLOCKS = 0.4, 0.003, 240, 60, 40  # m, s, steps
STEPS = MOVING + STANDING

cup = {"name": "cup", "shape": "cup", "base": [0.1, -0.05], "radius": 0.1, "height": 0.25, "thickness": 0.05}
scene = cortado.Scene(
    name="carried cup",
    dimension=2,
    discretisation={"spacing": 0.0125},
    phase=[{"name": "water", "rest_density": 1000.0, "viscosity": 0.05}],
    fluid=[{"shape": "box", "lower": [0.0, 0.0], "upper": [0.2, 0.125], "phase": "water"}],
    container={"shape": "box", "lower": [-0.25, -0.25], "upper": [0.85, 0.4]},
    solid=[{**cup, "motion": "path", "velocity": [0.0, 0.0]}],
    solver={"kind": "projection", "time_step": TIME_STEP},
)


class Motion:
    """Mean squared velocity of the water, in m2/s2; of water that falls beside the cup it is great."""

    def value(self, end):
        return (end.velocities**2).sum(axis=1).mean()

    def adjoint(self, end):
        return np.zeros_like(end.positions), 2.0 * end.velocities / len(end.velocities)


# From accelerations of blocks (BLOCKS,) [m/s2] to the cup's path (STEPS,) [m], and those that arrive and stand.
blocks = np.eye(BLOCKS)[np.arange(MOVING) * BLOCKS // MOVING]
places = TIME_STEP**2 * np.tril(np.ones((STEPS, STEPS))) @ np.tril(np.ones((STEPS, MOVING))) @ blocks
end = np.stack([places[-1], (places[-1] - places[-2]) / TIME_STEP])  # the last place, and the last velocity
free = np.eye(BLOCKS) - np.linalg.pinv(end) @ end
straight = places @ np.sign(BLOCKS / 2 - 0.5 - np.arange(BLOCKS))  # full throttle, and full brake
path = Affine(DISTANCE * np.outer(straight / straight[-1], [1, 0]), 5 * np.einsum("sb,d->sdb", places @ free, [1, 0]))

simulation = cortado.Simulation(scene)
loss = cortado.losses.Frames({step: Motion() for step in range(MOVING + 10, STEPS + 1, 10)})
problem = cortado.Problem(simulation, STEPS, loss)
search = Transformed(problem, {"cup.displacement": path})
optimiser, gradient = cortado.optimisers.LineSearch(), cortado.gradients.AdjointViscosity()
start, bounds = {"cup.displacement": np.zeros(BLOCKS)}, {"cup.displacement": (-1.0, 1.0)}
found = cortado.optimise(search, start, optimiser, 12, bounds, gradient=gradient)

for name, u in (("full throttle", start), ("found", found.parameters)):
    water = problem.end(search.parameters(u)).positions
    inside = (water[:, 1] > 0.0) & (np.abs(water[:, 0] - 0.1 - DISTANCE) < 0.1)
    print(f"{name}: loss {search.value(u):.4g} m2/s2, {(~inside).sum()} of {len(water)} particles are spilt")
assert inside.all() and found.loss < 0.1 * search.value(start), "water is spilt, or sloshes"
run = simulation.run(STEPS, search.parameters(found.parameters), record_every=50)
pictures = [simulation.picture(run[k], width=480, height=300) for k in (0, 2, 4, 6)]
cortado.pictures.write_picture("carried_cup.png", np.concatenate(pictures, axis=1))
