"""Waves of a measured flume from the recorded motion of its flap, beside linear theory and what was measured:
``python validation/wave_flume.py [--deep 100] [--device cuda:0]`` prints a row for each wave probe.

The flume is 13.63 m long and filled 1 m deep. A flap above a sill, hinged 0.1 m above the floor, makes waves with a
period of 1.158 s, and a beach takes them away. The record is run 1062 of Sundsdal, Greco, Hanssen and Lugni (2025,
Ocean Engineering; CC0), `tests/data/wave_flume_1062.csv`. Linear theory is that of a flap which moves in any way, in a
channel with two walls (Dean and Dalrymple 1991), so that fronts that pass are compared with fronts.

22 s take 40 s on an H200 with 100 particles in the depth, and a quarter of an hour on one core with 25.
"""

import argparse
from pathlib import Path

import numpy as np
import warp as wp

from cortado import Scene, Simulation, forces

RECORD = Path(__file__).parents[1] / "tests" / "data" / "wave_flume_1062.csv"
LENGTH, DEPTH, HINGE, FOOT, GRAVITY = 13.63, 1.0, 0.1, 0.05, 9.81
"""Of the flume, its water, the height of the hinge, and how far the flap reaches into the sill [m]; [m/s2]."""
PROBES = {3.0: "probe_1_m", 4.95: "probe_2_m", 5.2: "probe_3_m", 5.5: "probe_4_m", 8.5: "probe_6_m"}
BEGIN, END = 13.0, 22.0
"""Of the time in which heights are compared [s]."""
MODES = 1500


def beach(x, v, t, k):
    """A force that takes velocities away, the further up the beach the more."""
    way = wp.max((x[0] - 11.33) / 2.3, 0.0)
    return -k * way * way * v


def flume(times: np.ndarray, stroke: np.ndarray, deep: int, step: float) -> Scene:
    """The flume with ``deep`` particles in its depth; ``stroke`` (times,) is that of the flap at the surface [m]."""
    spacing, angle, arm = 1.0 / deep, -np.arctan2(stroke, DEPTH - HINGE), np.array([-0.1, 0.5 * (1.3 - HINGE - FOOT)])
    cos, sin = np.cos(angle), np.sin(angle)
    turned = np.stack([cos * arm[0] - sin * arm[1], sin * arm[0] + cos * arm[1]], axis=1)
    flap = {"shape": "box", "lower": [-0.2, HINGE - FOOT], "upper": [0.0, 1.3], "name": "flap", "motion": "path"}
    return Scene(
        dimension=2,
        discretisation={"spacing": spacing},
        phase=[{"name": "water", "rest_density": 1000.0, "viscosity": 0.001}],
        fluid=[{"shape": "box", "lower": [0.0, 0.0], "upper": [LENGTH, DEPTH], "phase": "water"}],
        container={"shape": "box", "lower": [-0.8, 0.0], "upper": [LENGTH, 2.0]},
        solid=[
            {"shape": "box", "lower": [-0.4, -5.0 * spacing], "upper": [0.0, HINGE], "name": "sill"},
            {**flap, "times": times.tolist(), "positions": [0.0, HINGE] + turned, "rotations": angle.tolist()},
        ],
        solver={"kind": "projection", "time_step": step},
    )


def theory(times: np.ndarray, stroke: np.ndarray, places: np.ndarray) -> np.ndarray:
    """The surface (times, places) [m] by linear theory in a channel, mode by mode: E'' + w^2 E = S stroke''."""
    k = np.arange(MODES) * np.pi / LENGTH
    w, y = np.sqrt(GRAVITY * k * np.tanh(k * DEPTH)), np.linspace(HINGE, DEPTH, 2001)
    profile = np.exp(np.multiply.outer(k, y - DEPTH)) + np.exp(-np.multiply.outer(k, y + DEPTH))
    profile /= (1.0 + np.exp(-2.0 * k * DEPTH))[:, None]
    source = np.trapezoid((y - HINGE) / (DEPTH - HINGE) * profile, y, axis=1)
    step, speed = times[1] - times[0], np.gradient(stroke, times)
    cos, sin, one = np.cos(w * step), np.sin(w * step), np.where(w > 0.0, w, 1.0)
    level, rate, shapes = np.zeros(MODES), np.zeros(MODES), np.cos(np.multiply.outer(places, k))
    found = np.zeros((len(times), len(places)))
    for n in range(len(times) - 1):
        push = 0.25 * step * (speed[n] + speed[n + 1]) * source
        level = level + push
        level, rate = cos * level + np.where(w > 0.0, sin / one, 0.0) * rate, cos * rate - w * sin * level
        level = level + push
        found[n + 1] = (level[0] + 2.0 * shapes[:, 1:] @ level[1:]) / LENGTH
    return found


def height(surface: np.ndarray) -> float:
    """Of a wave with this surface over time [m]."""
    return float(2.0 * np.sqrt(2.0) * surface.std())


def main() -> None:
    """Run the flume and print what its probes say."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--deep", type=int, default=25, help="particles in the depth")
    parser.add_argument("--device", default="cpu")
    asked = parser.parse_args()
    record = np.genfromtxt(RECORD, delimiter=",", names=True)
    times, places = record["time_s"][record["time_s"] <= END], np.array(list(PROBES))
    stroke = -record["wavemaker_m"][: len(times)]  # recorded positive away from the water
    step, width = 0.1 / asked.deep, 4.0 / asked.deep
    scene = flume(times, stroke, asked.deep, step)
    run = Simulation(scene, asked.device, forces=[forces.Body(beach, k=6.0)]).run(
        round(END / step), record_every=max(round(0.02 / step), 1)
    )
    reach = np.maximum(1.0 - np.abs(run.positions[:, :, :1] - places) / width, 0.0).sum(axis=1)
    found, late = (reach - reach[0]) / asked.deep**2 / width, run.times >= BEGIN
    fine = np.arange(0.0, END + 1e-3, 2e-3)
    exact = theory(fine, np.interp(fine, times, stroke), places)
    print("probe [m]  height [m]  over linear theory  correlation with what was measured")
    for number, (place, name) in enumerate(PROBES.items()):
        linear = height(np.interp(run.times[late], fine, exact[:, number]))
        measured = np.interp(run.times, record["time_s"], record[name])
        same = np.corrcoef(measured[run.times > 6.0], found[run.times > 6.0, number])[0, 1]
        own = height(found[late, number])
        print(f"{place:9.2f}  {own:10.4f}  {own / linear:18.3f}  {same:34.3f}")


if __name__ == "__main__":
    main()
