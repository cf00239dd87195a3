"""A jug is turned: how fast, and when, so that its water ends in the glass?

What is searched is by how much faster or slower than steadily it turns, in blocks of time; it may turn back.
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

    def apart(self, end):
        return end.positions - np.clip(end.positions, LOWER, UPPER)

    def value(self, end):
        return (self.apart(end) ** 2).sum(axis=1).mean()

    def adjoint(self, end):
        return 2.0 * self.apart(end) / len(end.positions), np.zeros_like(end.velocities)


# From how much faster it turns in each block (BLOCKS,) to the angle after each step (STEPS,) [rad].
steadily = -2.4 / STEPS * np.arange(1, STEPS + 1)  # clockwise
blocks = np.eye(BLOCKS)[np.arange(STEPS) * BLOCKS // STEPS]
turn = Affine(steadily, 2.0 * steadily[0] * np.cumsum(blocks, axis=0))

problem = cortado.Problem(cortado.Simulation(scene), STEPS, Outside())
search = Transformed(problem, {"jug.turn": turn})
optimiser, gradient = cortado.optimisers.LineSearch(), cortado.gradients.AdjointViscosity()
start, bounds = {"jug.turn": np.zeros(BLOCKS)}, {"jug.turn": (-1.0, 1.0)}
found = cortado.optimise(search, start, optimiser, 12, bounds, gradient=gradient)

for name, u in (("steadily", start), ("found", found.parameters)):
    syrup = problem.end(search.parameters(u)).positions
    inside = ((syrup > LOWER - 0.006) & (syrup < UPPER + 0.006)).all(axis=1)  # half a spacing
    print(f"{name}: loss {search.value(u):.3g} m2, {(~inside).sum()} of {len(syrup)} particles are not in the glass")
assert found.loss < 0.6 * search.value(start), "too much of the syrup is not in the glass"
run = problem.simulation.run(STEPS, search.parameters(found.parameters), record_every=50)
pictures = [problem.simulation.picture(run[k], width=400, height=380) for k in (0, 4, 6, 11)]
cortado.pictures.write_picture("poured_jug.png", np.concatenate(pictures, axis=1))
