"""A stirrer has so much time to mix honey so well: how fast must it turn, from one moment to the next, for the least
torque? What is searched is how far it has turned at a few times; it begins fast and ends slowly."""

import numpy as np

import cortado
from cortado.optimisation.transforms import TimeInterpolation, Transformed

STEPS, ITERATIONS, TIME_STEP = 120, 8, 0.005
NAME, BEGUN = "paddle.turn", np.array([0.0, 0.9, 1.4, 1.7, 1.8])  # rad

paddle = {"name": "paddle", "shape": "box", "lower": [0.15, 0.2], "upper": [0.45, 0.3], "slip": "no"}
scene = cortado.Scene(
    name="eased stirrer",
    dimension=2,
    discretisation={"spacing": 0.05},
    phase=[{"name": "honey", "rest_density": 1400.0, "viscosity": 9.0, "colour": [0.9, 0.55, 0.1]}],
    fluid=[{"shape": "box", "lower": [0.0, 0.0], "upper": [0.6, 0.5], "phase": "honey"}],
    container={"shape": "box", "lower": [0.0, 0.0], "upper": [0.6, 0.7], "slip": "no"},
    solid=[{**paddle, "motion": "path", "angular_velocity": 0.0}],
    solver={"kind": "projection", "time_step": TIME_STEP},
)
simulation, load = cortado.Simulation(scene, precision="float64"), cortado.sensors.SolidLoad("paddle")
left = simulation.positions[:, 0] < 0.3
shares = np.where(left, 1.0 / left.sum(), -1.0 / (~left).sum())[:, None]  # of what was left at first, and of the rest


class Apart:
    """How far the middle of what was left at first is from that of the rest, against what is wanted [m]."""

    def __init__(self, wanted):
        self.wanted = wanted

    def value(self, end):
        return 1e4 * (np.linalg.norm((shares * end.positions).sum(axis=0)) - self.wanted) ** 2

    def adjoint(self, end):
        way = (shares * end.positions).sum(axis=0)
        return shares * (2e4 * (1.0 - self.wanted / np.linalg.norm(way)) * way), np.zeros_like(end.velocities)


def stirred(u):
    """Torques after each step [N m a metre across], and how far both halves are apart in the end [m]."""
    run = simulation.run(STEPS, {NAME: turns.parameter(u)}, STEPS, sensors={"load": load})
    return run.sensors["load"]["torque"], np.linalg.norm((shares * run.positions[-1]).sum(axis=0)), run[-1]


turns, times = TimeInterpolation(STEPS, len(BEGUN)), TIME_STEP * np.arange(1, STEPS)
torques, apart, _ = stirred(BEGUN)
nothing = np.tile([np.nan, np.nan, 0.0], (STEPS - 1, 1))  # of two forces and a torque
least = cortado.losses.Series(load, times, nothing, TIME_STEP, every=4, scale=np.sqrt(np.mean(torques**2)))
problem = cortado.Problem(simulation, STEPS, cortado.losses.Frames({**least.losses, STEPS: Apart(apart)}))
bounds = {NAME: (np.zeros(len(BEGUN)), 4.0 * (BEGUN > 0.0))}
found = cortado.optimise(Transformed(problem, {NAME: turns}), {NAME: BEGUN}, "lbfgs", ITERATIONS, bounds, scale=0.3)

eased, apart_then, end = stirred(found.parameters[NAME])
less = 1.0 - np.mean(eased**2) / np.mean(torques**2)
print("turned by", np.round(found.parameters[NAME], 2), "rad;", f"halves {apart_then:.3f} m apart, {apart:.3f} wanted")
assert less > 0.1 and abs(apart_then / apart - 1.0) < 0.05, f"the mean square of the torque is {less:.0%} less"
cortado.pictures.write_picture("eased_stirrer.png", simulation.picture(end, width=640, height=400))
