"""Forces and torques on solids against closed forms, for `validation/solids.py`."""

import numpy as np

from cortado import Scene, Simulation
from cortado.sensors import WaveGauge

GRAVITY, DENSITY = 9.81, 1000.0


def late_load(simulation: Simulation, steps: int, *solids: str) -> np.ndarray:
    """Loads on solids: the mean over 60 states of the second half of a run."""
    run = simulation.run(steps, record_every=max(steps // 120, 1))
    states = [run[: k + 1].last_state for k in range(len(run) // 2, len(run))]
    found = [[simulation.quantity(f"{name}.load", state) for state in states] for name in solids]
    return np.squeeze(np.mean(found, axis=1))


def plunged_box(across: int, solver: str) -> dict[str, float]:
    """The force on a box in water at rest, 0.24 x 0.16 m and so many particles long, over the weight of the water that
    it displaces: the mean over the second half of two seconds."""
    spacing, lower, upper = 0.24 / across, np.array([0.36, 0.2]), np.array([0.6, 0.36])
    step = 0.05 * spacing
    scene = Scene(
        dimension=2,
        discretisation={"spacing": spacing},
        phase=[{"name": "water", "rest_density": DENSITY, "viscosity": 0.5}],
        fluid=[{"shape": "box", "lower": [0.0, 0.0], "upper": [0.96, 0.56], "phase": "water"}],
        container={"shape": "box", "lower": [0.0, 0.0], "upper": [0.96, 0.8]},
        solid=[{"name": "box", "shape": "box", "lower": lower.tolist(), "upper": upper.tolist()}],
        solver={"kind": solver, "time_step": step},
    )
    load = late_load(Simulation(scene), int(2.0 / step), "box") / (DENSITY * GRAVITY * np.prod(upper - lower))
    return {"upwards": float(load[1]), "sideways": float(load[0])}


def taylor_couette(across: int) -> dict[str, float]:
    """Torques on two cylinders, the inner of which turns in a very viscous fluid, over that of the closed form: the
    mean over the second half of a run that begins at rest. So many particles are between the cylinders."""
    r_1, r_2, omega, viscosity = 0.25, 0.5, 1.0, 300.0
    spacing = (r_2 - r_1) / across
    step, duration = 0.02 * spacing / (omega * r_1), 0.12
    middle = {"shape": "sphere", "centre": [0.0, 0.0], "slip": "no"}
    scene = Scene(
        dimension=2,
        discretisation={"spacing": spacing},
        phase=[{"name": "honey", "rest_density": DENSITY, "viscosity": viscosity}],
        fluid=[{"shape": "sphere", "centre": [0.0, 0.0], "radius": r_2, "phase": "honey"}],
        container={"shape": "none"},
        solid=[
            {**middle, "name": "inner", "radius": r_1, "motion": "path", "angular_velocity": omega},
            {**middle, "name": "outer", "radius": r_2, "side": "inside"},
        ],
        forces={"gravity": [0.0, 0.0]},
        solver={"kind": "projection", "time_step": step},
    )
    known = 4.0 * np.pi * viscosity * omega * r_1**2 * r_2**2 / (r_2**2 - r_1**2)
    inner, outer = late_load(Simulation(scene), int(duration / step), "inner", "outer")[:, 2] / known
    return {"inner": float(inner), "outer": float(outer)}


def turning_cup(across: int) -> dict[str, float]:
    """How the height of a fluid in a cup that turns rises with the square of the distance from the axis, over omega^2 /
    (2 g), from five gauges: the mean over the end of a run that begins at rest. So many particles are across."""
    radius, depth, omega = 0.2, 0.16, 6.0
    spacing = 2.0 * radius / across
    step, duration = 0.1 * spacing / (omega * radius), 1.0
    scene = Scene(
        dimension=3,
        discretisation={"spacing": spacing},
        phase=[{"name": "syrup", "rest_density": DENSITY, "viscosity": 20.0}],
        fluid=[
            {
                "shape": "cylinder",
                "base": [0.0, 0.0, 0.0],
                "radius": radius,
                "height": depth,
                "axis": "y",
                "phase": "syrup",
            }
        ],
        container={"shape": "none"},
        solid=[
            {
                "name": "cup",
                "shape": "cup",
                "base": [0.0, 0.0, 0.0],
                "radius": radius,
                "height": 0.36,
                "thickness": 3.0 * spacing,
                "motion": "path",
                "angular_velocity": [0.0, omega, 0.0],
                "slip": "no",
            }
        ],
        forces={"gravity": [0.0, -GRAVITY, 0.0]},
        solver={"kind": "projection", "time_step": step},
    )
    reach = 3.0 * spacing
    places = np.linspace(0.0, radius - reach, 5)
    sensors = {f"{place:.3f}": WaveGauge([place, 0.0, 0.0], radius=reach) for place in places}
    steps = int(duration / step)
    found = Simulation(scene).run(steps, record_every=steps, sensors=sensors).sensors
    heights = [read["height"][read.times > 0.6 * duration].mean() for read in found.values()]
    rise = np.polyfit(places**2, heights, 1)[0]
    return {"rise": float(rise * 2.0 * GRAVITY / omega**2)}


LOADS = {
    "plunged-box, 12 particles long, projection": lambda: plunged_box(12, "projection"),
    "plunged-box, 24 particles long, projection": lambda: plunged_box(24, "projection"),
    "plunged-box, 12 particles long, pcisph": lambda: plunged_box(12, "pcisph"),
    "taylor-couette, 10 across": lambda: taylor_couette(10),
    "taylor-couette, 20 across": lambda: taylor_couette(20),
    "taylor-couette, 40 across": lambda: taylor_couette(40),
    "turning-cup, 20 across": lambda: turning_cup(20),
}
