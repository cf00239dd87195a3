"""A jug is turned and moved: how fast, and when, so that its syrup ends in the glass?

What is searched, in blocks of time, is by how much faster than steadily it turns, and how fast it moves sideways.
"""

import numpy as np

import cortado
from cortado.optimisation.transforms import Affine, Transformed

STEPS, BLOCKS = 550, 25
LOWER, UPPER = np.array([0.25, -0.28]), np.array([0.45, -0.12])  # m, the inside of the glass

cup = {"shape": "cup", "thickness": 0.05}
jug = {"name": "jug", "base": [0.075, -0.05], "radius": 0.075, "height": 0.25, "motion": "path"}
glass = {"name": "glass", "base": [0.35, -0.33], "radius": 0.1, "height": 0.21}
scene = cortado.Scene(
    name="poured jug",
    dimension=2,
    discretisation={"spacing": 0.0125},
    phase=[{"name": "syrup", "rest_density": 1000.0, "viscosity": 0.3}],
    fluid=[{"shape": "box", "lower": [0.0, 0.0], "upper": [0.15, 0.125], "phase": "syrup"}],
    container={"shape": "box", "lower": [-0.15, -0.33], "upper": [0.6, 0.35]},
    solid=[{**cup, **jug, "angular_velocity": 0.0}, {**cup, **glass}],
    solver={"kind": "projection", "time_step": 0.0022},
)


class Outside:
    """Mean squared distance to the inside of the glass [m2]."""

    def value(self, end):
        return self.value_and_adjoint(end)[0]

    def value_and_adjoint(self, end):
        apart = end.positions - np.clip(end.positions, LOWER, UPPER)
        return (apart**2).sum(axis=1).mean(), (2.0 * apart / len(apart), np.zeros_like(apart))


# From numbers of each block (BLOCKS,) to the angle [rad] and the place [m] after each step (STEPS,).
steadily = -2.4 / STEPS * np.arange(1, STEPS + 1)  # clockwise
so_far = np.cumsum(np.eye(BLOCKS)[np.arange(STEPS) * BLOCKS // STEPS], axis=0) * BLOCKS / STEPS
turn = Affine(steadily, -2.4 / BLOCKS * so_far)
aside = Affine(np.zeros((STEPS, 2)), 0.02 * np.einsum("sb,d->sdb", so_far, [1.0, 0.0]))
# Syrup that still falls is judged too, but not before a jug can have emptied itself: that would pay for haste.
loss = cortado.losses.Frames(dict.fromkeys(range(400, STEPS + 1, 50), Outside()))
problem = cortado.Problem(cortado.Simulation(scene), STEPS, loss)
search = Transformed(problem, {"jug.turn": turn, "jug.displacement": aside})
optimiser, gradient = cortado.optimisers.LineSearch(), cortado.gradients.AdjointViscosity()
start, bounds = (dict.fromkeys(search.coordinates, one) for one in (np.zeros(BLOCKS), (-1.0, 1.0)))
found = cortado.optimise(search, start, optimiser, 10, bounds, gradient=gradient)

for name, u in (("turned steadily", start), ("found", found.parameters)):
    syrup = problem.end(search.parameters(u)).positions
    inside = ((syrup > LOWER - 0.006) & (syrup < UPPER + 0.006)).all(axis=1)  # half a spacing
    print(f"{name}: loss {search.value(u):.3g} m2, {(~inside).sum()} of {len(syrup)} particles are not in the glass")
assert (~inside).sum() <= 6 and found.loss < 0.04 * search.value(start), "too much of the syrup is not in the glass"
run = problem.simulation.run(STEPS, search.parameters(found.parameters), record_every=50)
pictures = [problem.simulation.picture(run[k], width=400, height=380) for k in (0, 4, 6, 11)]
cortado.pictures.write_picture("poured_jug.png", np.concatenate(pictures, axis=1))
