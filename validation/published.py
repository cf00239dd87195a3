"""Flows beside published numbers, a picture each: ``python validation/published.py [dam | cavity | channels] [OUT]``.

Each is at a size for a laptop, with the solver that scenes have by default, and prints a line with its verdict.
`docs/published.md` shows the pictures.
"""

import argparse
import csv
import sys
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np

matplotlib.use("Agg")
import matplotlib.pyplot as plt

from cortado import Scene, Simulation

DATA = Path(__file__).parents[1] / "tests" / "data"
GRAVITY, WIDE, GATES = 9.81, 0.146, 0.6  # [m/s2], of the column [m], longest time that a gate takes, in sqrt(L / 2 g)
CHANNEL, KINEMATIC, PUSH, PLATE = 1e-3, 1e-6, 2e-4, 1.25e-5  # [m], [m2/s], [m/s2], [m/s] of Morris et al. (1997)


def table(name: str) -> dict[str, np.ndarray]:
    """The columns of a file of published numbers, NaN where there is none."""
    lines = (DATA / name).read_text().splitlines()[1:]
    rows = list(csv.DictReader(lines))
    return {key: np.array([float(row[key] or "nan") for row in rows]) for key in rows[0]}


def scene(spacing: float, upper: list[float], container: dict[str, Any], viscosity=0.001, **tables: Any) -> Scene:
    """A fluid of 1000 kg/m3 in a box from the origin to ``upper``; ``viscosity`` [Pa s]."""
    return Scene(
        dimension=2,
        discretisation={"spacing": spacing},
        phase=[{"name": "fluid", "rest_density": 1000.0, "viscosity": viscosity}],
        fluid=[{"shape": "box", "lower": [0.0, 0.0], "upper": upper, "phase": "fluid"}],
        container={"shape": "box", "lower": [0.0, 0.0], **container},
        **tables,
    )


def dam(across: int) -> tuple[plt.Figure, str]:
    """The front of a column 2 L high that is set free, by Koshizuka and Oka (1996) and Martin and Moyce (1952)."""
    spacing, unit = WIDE / across, np.sqrt(WIDE / (2.0 * GRAVITY))
    step = 0.074 * spacing
    walls = {"upper": [8.0 * WIDE, 3.0 * WIDE]}
    flow = scene(spacing, [WIDE, 2.0 * WIDE], walls, solver={"kind": "projection", "time_step": step})
    run = Simulation(flow).run(int(5.2 * unit / step), record_every=4)
    low = run.positions[:, :, 1] < 2.0 * spacing
    place = (np.where(low, run.positions[:, :, 0], 0.0).max(axis=1) + 0.5 * spacing) / WIDE
    times = run.times / unit
    figure, axes = plt.subplots(layout="constrained", figsize=(6.0, 4.0))
    axes.plot(times, place, label=f"here, {run.positions.shape[1]} particles")
    said = []
    cases = (
        ("koshizuka_oka_1996", "Koshizuka and Oka", "o", 9),
        ("martin_moyce_1952_2.25in", "Martin and Moyce", "s", 8),
    )
    for name, who, mark, points in cases:
        known = {key: each[:points] for key, each in table(f"dam_break_{name}.csv").items()}
        lags = np.arange(0.0, GATES, 0.005)
        errors = [np.abs(np.interp(known["T"] - lag, times, place) / known["Z"] - 1.0).max() for lag in lags]
        lag, error = lags[int(np.argmin(errors))], min(errors)
        axes.plot(known["T"] - lag, known["Z"], mark, fillstyle="none", label=f"{who}, {lag:.2f} earlier")
        said.append(f"{who}: within {100.0 * error:.1f} %, with a gate that takes {1e3 * lag * unit:.0f} ms")
    axes.set(xlabel="t sqrt(2 g / L)", ylabel="front / L")
    return figure, "; ".join(said)


def cavity(across: int) -> tuple[plt.Figure, str]:
    """Velocities across the middle of a cavity whose lid slides, at Re 100, by Ghia, Ghia and Shin (1982)."""
    spacing = 1.0 / across
    edge = 5.0 * spacing
    lid = {"name": "lid", "shape": "box", "lower": [-edge, 1.0], "upper": [1.0 + edge, 1.0 + edge]}
    flow = scene(
        spacing,
        [1.0, 1.0],
        {"upper": [1.0, 2.0], "slip": "no"},
        viscosity=10.0,
        solid=[{**lid, "slip": "no", "surface_velocity": [1.0, 0.0]}],
        forces={"gravity": [0.0, 0.0]},
        solver={"kind": "projection", "time_step": 0.1 * spacing},
    )
    run = Simulation(flow).run(int(15.0 / (0.1 * spacing)), record_every=10)
    late = run.times > 12.0
    x, v = (each[late].reshape(-1, 2) for each in (run.positions, run.velocities))
    figure, axes = plt.subplots(1, 2, layout="constrained", figsize=(8.0, 3.6))
    worst = []
    for axis, (name, along, component) in zip(axes, (("u", 1, 0), ("v", 0, 1)), strict=True):
        known = table(f"cavity_ghia_1982_{name}.csv")
        places, speeds = known["xy"[along]], known["Re100"]
        middle = np.abs(x[:, 1 - along] - 0.5) < spacing
        bins = np.arange(0.0, 1.0 + spacing, spacing)
        count, total = (np.histogram(x[middle, along], bins, weights=w)[0] for w in (None, v[middle, component]))
        heights, found = 0.5 * (bins[1:] + bins[:-1]), total / count
        inside = (places > heights[0]) & (places < heights[-1])
        worst.append(np.abs(np.interp(places, heights, found) - speeds)[inside].max())
        axis.plot(heights, found, label=f"here, {across} x {across}")
        axis.plot(places, speeds, "o", fillstyle="none", label="Ghia, Ghia and Shin")
        axis.set(xlabel="xy"[along], ylabel=f"{name} / speed of the lid")
    return figure, f"u within {100.0 * worst[0]:.1f} %, v within {100.0 * worst[1]:.1f} % of the speed of the lid"


def channels(across: int) -> tuple[plt.Figure, str]:
    """Water between plates that starts to flow, pushed along or drawn by a plate, by Morris, Fox and Zhu (1997)."""
    spacing = CHANNEL / across
    length, interval = 8.0 * spacing, 0.0225
    step = interval / np.ceil(interval / (0.12 * spacing**2 / KINEMATIC))
    walls = {"upper": [length, CHANNEL], "periodic": [True, False], "slip": "no"}
    solver = {"kind": "projection", "time_step": step}
    plate = {"name": "plate", "shape": "box", "lower": [-spacing, CHANNEL], "upper": [length + spacing, 1.2 * CHANNEL]}
    high = {**walls, "upper": [length, 2.0 * CHANNEL]}
    drawn = [{**plate, "slip": "no", "surface_velocity": [PLATE, 0.0]}]
    flows = {
        "poiseuille": (scene(spacing, [length, CHANNEL], walls, solver=solver, forces={"gravity": [PUSH, 0.0]}), 0.25),
        "couette": (
            scene(spacing, [length, CHANNEL], high, solver=solver, solid=drawn, forces={"gravity": [0, 0]}),
            0.75,
        ),
    }
    figure, axes = plt.subplots(1, 2, layout="constrained", figsize=(8.0, 3.6), sharey=True)
    said = []
    for axis, (name, (flow, share)) in zip(axes, flows.items(), strict=True):
        simulation = Simulation(flow, precision="float64")
        known = table(f"{name}_morris_1997.csv")
        moments = known["t_s"][np.isfinite(known["t_s"])]
        run = simulation.run(round(moments[-1] / step), record_every=round(interval / step))
        errors, largest = [], max(known["u_half"].max(), PLATE)
        heights = np.unique(run.positions[0, :, 1].round(9))
        row = np.searchsorted(heights, run.positions[0, :, 1] - 1e-9)
        for moment, *speeds in zip(moments, *list(known.values())[1:], strict=False):
            v = run.velocities[int(np.argmin(np.abs(run.times - moment))), :, 0]
            found = np.bincount(row, v) / np.bincount(row)
            errors += list(np.interp([0.5 * CHANNEL, share * CHANNEL], heights, found) - speeds)
            axis.plot(found, heights / CHANNEL, label=f"here, {moment:g} s")
            axis.plot(speeds, [0.5, share], "ko", fillstyle="none")
        axis.set(xlabel="speed [m/s]", title=name.capitalize())
        said.append(f"{name.capitalize()}: within {100.0 * np.abs(errors).max() / largest:.2f} % of the largest speed")
    axes[0].set_ylabel("height / width")
    return figure, "; ".join(said)


FLOWS = {"dam": (dam, 20), "cavity": (cavity, 32), "channels": (channels, 20)}
"""What is drawn, and with how many particles across."""


def main() -> None:
    """Print the verdicts, and draw the pictures where a folder is given."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("flow", nargs="?", choices=list(FLOWS), help="one of them")
    parser.add_argument("folder", type=Path, nargs="?", default=Path(), help="where the pictures go")
    parser.add_argument("--across", type=int, help="particles across the column, the cavity or the channel")
    asked = parser.parse_args()
    for name in [asked.flow] if asked.flow else list(FLOWS):
        draw, across = FLOWS[name]
        figure, verdict = draw(asked.across or across)
        for axis in figure.axes:
            axis.grid(alpha=0.3)
        figure.axes[0].legend(fontsize="small")
        path = asked.folder / f"published_{name}.png"
        figure.savefig(path, dpi=130)
        print(f"{verdict}. {path}")


if __name__ == "__main__":
    sys.exit(main())
