"""How soft must the mooring of a raft be, so that waves pull at it with half the force?

    python examples/wave_flume/mooring.py      # a minute on a laptop

Searched is the stiffness of its line, by Newton's method. The slope is a gradient through the whole simulation.
"""

import numpy as np

import cortado

STEPS, TIME_STEP, PERIOD = 700, 0.004, 0.9  # a run, its steps [s], and its waves [s]
FIRST, SIZE, POWER, ROUNDS = 2000.0, 10.0, 8, 6  # first stiffness [N/m]; unit of forces [N]; a sum of powers; searches

times = np.arange(0.0, STEPS * TIME_STEP + 0.1, 0.03)
stroke = 0.025 * np.minimum(times / PERIOD, 1.0) * np.sin(2.0 * np.pi * times / PERIOD)
paddle = {"name": "paddle", "shape": "box", "lower": [-0.24, -0.1], "upper": [0.0, 0.7], "motion": "path"}
paddle |= {"times": times.tolist(), "positions": np.stack([stroke - 0.12, np.full_like(times, 0.3)], axis=1).tolist()}
raft = {"name": "raft", "shape": "box", "lower": [1.3, 0.32], "upper": [1.62, 0.48], "motion": "free", "density": 500.0}
line = {"name": "line", "solid": "raft", "point": [1.3, 0.4], "anchor": [0.5, 0.4], "stiffness": FIRST, "damping": 10.0}
scene = cortado.Scene(
    name="mooring",
    dimension=2,
    discretisation={"spacing": 0.04},
    phase=[{"name": "water", "rest_density": 1000.0, "viscosity": 0.001}],
    fluid=[{"shape": "box", "lower": [0.0, 0.0], "upper": [2.6, 0.4], "phase": "water"}],
    container={"shape": "box", "lower": [-0.3, 0.0], "upper": [2.6, 0.8]},
    solid=[paddle, raft],
    spring=[line],
    solver={"kind": "projection", "time_step": TIME_STEP},
)


class Strength:
    """The force in the line, to a high power, so that its sum over steps tells the largest."""

    def value(self, end):
        return float((end["line.load"][0] / SIZE) ** POWER)

    def adjoint(self, end):
        bar = np.zeros(3)
        bar[0] = POWER * (end["line.load"][0] / SIZE) ** (POWER - 1) / SIZE
        return {"line.load": bar}


simulation = cortado.Simulation(scene)
problem = cortado.Problem(simulation, STEPS, cortado.losses.Frames({n: Strength() for n in range(0, STEPS, 7)}))


def strongest(stiffness):
    """The largest force [N] in the line over the run, read at every step."""
    sensors = {"line": cortado.sensors.SpringForce("line")}
    read = simulation.run(STEPS, {"line.stiffness": stiffness}, record_every=STEPS, sensors=sensors).sensors["line"]
    return np.abs(read["force"]).max()


stiffness, wanted = FIRST, 0.5 * strongest(FIRST)
for _ in range(ROUNDS):
    force = strongest(stiffness)
    print(f"{stiffness:6.1f} N/m: {force:5.2f} N at most, {0.5 * force / wanted:.3f} of the first")
    if abs(force / wanted - 1.0) < 0.02:
        break
    powers, slope = problem.value_and_gradient({"line.stiffness": stiffness}, cortado.gradients.AdjointViscosity())
    rate = stiffness * slope["line.stiffness"] / (POWER * powers)  # by how many per cent the force changes with one
    stiffness *= float((wanted / force) ** (1.0 / max(rate, 0.3)))
assert abs(force / wanted - 1.0) < 0.05, "the line does not pull with half of its first force"
