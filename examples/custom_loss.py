"""A loss of your own, in NumPy: how far must a tank lean for a third of the water to be past a line?

A loss is an object with a value and an adjoint, its derivatives with respect to positions and velocities. It needs no
other library, and Cortado does the rest: from there back through the simulation to whatever is to be found.
"""

import numpy as np

import cortado

LINE, WIDTH = 0.4, 0.05  # m


class ShareBeyond:
    """(share of the water beyond the line - wanted)^2, with an edge that is smooth so that it has a derivative."""

    def __init__(self, wanted):
        self.wanted = wanted

    def share(self, positions):
        """Of the particles (n, 2), and its derivative with respect to their x, (n,)."""
        beyond = 1.0 / (1.0 + np.exp((LINE - positions[:, 0]) / WIDTH))
        return beyond.mean(), beyond * (1.0 - beyond) / WIDTH / len(beyond)

    def value(self, end):
        return (self.share(end.positions)[0] - self.wanted) ** 2

    def adjoint(self, end):
        share, slope = self.share(end.positions)
        along_x = 2.0 * (share - self.wanted) * slope
        return along_x[:, None] * [1.0, 0.0], np.zeros_like(end.velocities)


scene = cortado.Scene(
    name="leaning tank",
    dimension=2,
    discretisation={"spacing": 0.025},
    phase=[{"name": "water", "rest_density": 1000.0, "viscosity": 0.05}],
    fluid=[{"shape": "box", "lower": [0.0, 0.0], "upper": [0.3, 0.3], "phase": "water"}],
    container={"shape": "box", "lower": [0.0, 0.0], "upper": [1.2, 0.6]},
    solver={"time_step": 0.002},
)
loss = ShareBeyond(wanted=1 / 3)
problem = cortado.Problem(cortado.Simulation(scene, precision="float64"), steps=120, loss=loss)
start = {"tilt": np.array([0.0])}  # degrees by which gravity leans towards x, as the tank feels it

# The adjoint of the loss is held against differences of its values, and the simulation's with it.
certificate = cortado.certify(problem, start)
print(certificate)
assert certificate.right, "the adjoint is not the derivative of the value"

result = cortado.optimise(problem, start, "lbfgs", iterations=10, scale=10.0)
share, _ = loss.share(problem.end(result.parameters).positions)
print(f"leaning by {result.parameters['tilt'][0]:.2f} degrees, a share of {share:.4f} is past the line")
assert abs(share - loss.wanted) < 1e-3, f"a third of the water was to be past the line, but {share:.4f} of it is"
