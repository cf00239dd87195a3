"""A first gradient: under which gravity did this dam break end where it did?

A dam break runs under a gravity that we then pretend not to know. The gradient of the mean squared distance to its last
positions, with respect to gravity, leads back to it.
"""

import numpy as np

import cortado

scene = cortado.Scene(
    name="dam break",
    dimension=2,
    discretisation={"spacing": 0.025},
    phase=[{"name": "water", "rest_density": 1000.0, "viscosity": 0.05}],
    fluid=[{"shape": "box", "lower": [0.0, 0.0], "upper": [0.3, 0.3], "phase": "water"}],
    container={"shape": "box", "lower": [0.0, 0.0], "upper": [0.6, 0.6]},
    solver={"time_step": 0.002},
)
simulation = cortado.Simulation(scene, precision="float64")

true_gravity = np.array([1.5, -9.0])  # m/s2
target = simulation.run(steps=60, controls={"gravity": true_gravity})[-1].positions

# A loss and its gradient, which has the shape of gravity.
problem = cortado.Problem(simulation, steps=60, loss=cortado.losses.FinalPositions(target))
guess = np.array([0.0, -9.81])
loss, gradient = problem.value_and_gradient({"gravity": guess})
print(f"at {guess} m/s2 the loss is {loss:.3g} m2, its gradient {gradient['gravity']}")

# Is it right? The loss itself, a little to either side, has to say the same. Water that begins at rest is on corners of
# its pressure, where that holds to four digits.
step = np.array([1e-5, 0.0])
slope = (problem.value({"gravity": guess + step}) - problem.value({"gravity": guess - step})) / 2e-5
assert abs(slope - gradient["gravity"][0]) < 1e-4 * abs(slope), "the gradient is not the slope of the loss"

# Down the gradient, to the true gravity.
result = cortado.optimise(problem, {"gravity": guess}, "lbfgs", iterations=12)
print(result)
estimate = result.parameters["gravity"]
assert np.abs(estimate - true_gravity).max() < 1e-3, f"gravity is {true_gravity}, but its estimate {estimate}"
print(f"the estimate is {estimate} m/s2")
