"""How near are flows beside solids to what is known, and do solids hold water? ``python validation/solids.py [--only
cavity] [--device cuda:0]`` prints what each case found and the rows of `validation/README.md` that they give, which
``--write`` keeps (see `measured_rows.py`); 7 minutes on one core for the cavity at a Reynolds number of
400, half an hour where velocities follow."""

import argparse
import csv
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import measured_rows as rows
import numpy as np
from measured_rows import Measure

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from loads import LOADS
from moving_bodies import added_mass, heeled_box, rolling_under_oil, settling_ball, swinging_box
from piston_waves import piston

from baffles import held
from cortado import Scene, Simulation
from floating_bodies import disc_in_a_round_tank, floating_box, settling_disc, stopping_cylinder
from held_water import MESHES, cup_turned, meshes, stirred
from scenes import box, pool

DATA = Path(__file__).parents[1] / "tests" / "data"
LATE = 0.8
"""Of a run, from where on velocities are averaged."""


def cavity(across: int, reynolds: int, duration: float, device: str, follow: bool = False) -> dict[str, float]:
    """A square cavity whose lid slides, against Ghia, Ghia and Shin (1982): for each of the centre lines the greatest
    error of the velocity across it, over the lid's speed. ``duration`` in sides over that speed; velocities ``follow``
    the shift, in steps of a quarter."""
    spacing, viscosity = 1.0 / across, 1.0 / reynolds
    step = min((0.025 if follow else 0.1) * spacing, 0.09 * spacing**2 / viscosity)
    edge = 5.0 * spacing
    scene = Scene(
        dimension=2,
        discretisation={"spacing": spacing},
        phase=[{"name": "water", "rest_density": 1000.0, "viscosity": 1000.0 * viscosity}],
        fluid=[{"shape": "box", "lower": [0.0, 0.0], "upper": [1.0, 1.0], "phase": "water"}],
        container={"shape": "box", "lower": [0.0, 0.0], "upper": [1.0, 2.0], "slip": "no"},
        solid=[
            {
                "name": "lid",
                "shape": "box",
                "lower": [-edge, 1.0],
                "upper": [1.0 + edge, 1.0 + edge],
                "slip": "no",
                "surface_velocity": [1.0, 0.0],
            }
        ],
        forces={"gravity": [0.0, 0.0]},
        solver={"kind": "projection", "time_step": step, "velocities_follow": follow},
    )
    run = Simulation(scene, device).run(int(duration / step), record_every=max(int(0.05 / step), 1))
    late = run.times > LATE * run.times[-1]
    x, v = (array[late].reshape(-1, 2).astype(np.float64) for array in (run.positions, run.velocities))
    found = {}
    for name, along, component in (("u", 1, 0), ("v", 0, 1)):
        lines = (DATA / f"cavity_ghia_1982_{name}.csv").read_text().splitlines()[1:]
        rows = [(float(row["xy"[along]]), row[f"Re{reynolds}"]) for row in csv.DictReader(lines)]
        errors = []
        for place, known in rows:
            if known and 0.0 < place < 1.0:
                point = np.full(2, 0.5)
                point[along] = place
                errors.append(abs(_at(point, x, v[:, component], 0.5 * spacing) - float(known)))
        found[name] = max(errors)
    return found


def _at(point: np.ndarray, x: np.ndarray, values: np.ndarray, width: float) -> float:
    """Values (n,) of particles at (n, 2) at a point (2,), by a parabola through those near it."""
    apart = x - point
    weights = np.exp(-(apart**2).sum(axis=1) / (2.0 * width**2))
    near = weights > 1e-4
    a, b = apart[near].T
    root, terms = np.sqrt(weights[near]), np.stack([np.ones_like(a), a, b, a * a, a * b, b * b], axis=1)
    return float(np.linalg.lstsq(terms * root[:, None], values[near] * root, rcond=None)[0][0])


def disc(density: float, across: int, iterations: int) -> np.ndarray:
    """How much faster a disc in the middle of a full round tank gets in each of six steps, over theory."""
    with TemporaryDirectory() as folder:
        return disc_in_a_round_tank(density, f"{folder}/rings.npy", 0.3 / across, 6, iterations=iterations)


LENGTH, DEPTH, HEIGHT = 1.2, 0.4, 0.24
"""Of a tank, of its water, and of a baffle in its middle [m]."""


def sloshed(thickness, spacing, duration=6.0):
    """Water in a tank with a baffle of a thickness [m], or a sheet where it is 0, that begins in its first mode: the
    rate at which the greatest distances of its middle from the tank's fall [1/s], and the period [s]."""
    middle, wave = 0.5 * LENGTH, np.pi / LENGTH
    ends = [middle - 0.5 * thickness, -0.1], [middle + 0.5 * thickness, HEIGHT]
    sheet = {"shape": "sheet", "corners": [[middle, -0.1], [middle, HEIGHT]]}
    baffle = {"name": "baffle", **(sheet if thickness == 0.0 else box(*ends))}
    scene = pool(
        [LENGTH, DEPTH],
        [LENGTH, 0.8],
        phase=[{"name": "water", "rest_density": 1000.0, "viscosity": 0.001}],
        solid=[baffle],
        discretisation={"spacing": spacing},
        solver={"kind": "projection", "time_step": 0.1 * spacing},
    )
    simulation = Simulation(scene, precision="float64")
    x, y = simulation.positions.T
    moving = np.stack([np.sin(wave * x) * np.cosh(wave * y), -np.cos(wave * x) * np.sinh(wave * y)], axis=1)
    first = {"initial_velocities": 0.2 * moving / np.cosh(wave * DEPTH)}
    run = simulation.run(round(duration / scene.solver.time_step), first, record_every=5)
    away = np.abs(run.positions[:, :, 0].mean(axis=1) - middle)
    peaks = 1 + np.flatnonzero((away[1:-1] >= away[:-2]) & (away[1:-1] > away[2:]) & (away[1:-1] > 3e-4))
    rate = -np.polyfit(run.times[peaks], np.log(away[peaks]), 1)[0]
    return float(rate), float(2.0 * np.diff(run.times[peaks]).mean())


def cases(device: str) -> dict[str, Callable[[], object]]:
    """By name; the cavity, the piston, and bodies that settle, swing and roll run on the device."""
    found: dict[str, Callable[[], object]] = {}
    for reynolds, across, duration in ((100, 50, 15.0), (400, 50, 50.0), (400, 100, 50.0)):
        for follow, name in ((False, ""), (True, ", velocities follow")):
            case = partial(cavity, across, reynolds, duration, device, follow)
            found[f"cavity, Re {reynolds}, {across} x {across}{name}"] = case
    found |= {f"meshes, 500 steps, {name}": partial(meshes, 500, name) for name in MESHES}
    return {
        **found,
        "stirred, 8,000 particles": lambda: stirred(92, 2000),
        "cup-turned, 8,000 particles": lambda: cup_turned(100, 6000),
        "sheet, two levels, 1,000 steps": lambda: held(1000, 0.001),
        **{
            f"baffle, {1000.0 * thickness:g} mm, {1000.0 * spacing:g} mm apart": partial(sloshed, thickness, spacing)
            for spacing in (0.02, 0.01)
            for thickness in (0.0, 0.06)
        },
        "piston, kd = 1.5, 20 deep": lambda: piston(20, 1.5, 0.03, device),
        "piston, kd = 1.5, 60 deep": lambda: piston(60, 1.5, 0.03, device),
        **{f"stopping-cylinder, {across} across": partial(stopping_cylinder, across) for across in (8, 12, 24)},
        "settling-disc, 12 across": partial(settling_disc, 12, 1.73e-4, 0.15, device),
        "settling-disc, 24 across": partial(settling_disc, 24, 4.34e-5, 0.15, device),
        "settling-ball, b/a = 2, 12 across": partial(settling_ball, 12, 2.0, 1.73e-4, 0.15, device, 0.6),
        "settling-ball, b/a = 2, 24 across": partial(settling_ball, 24, 2.0, 4.34e-5, 0.15, device, 0.6),
        "settling-ball, b/a = 4, 12 across": partial(settling_ball, 12, 4.0, 1.73e-4, 0.15, device, 0.6),
        "floating-box, 16 particles long": lambda: floating_box(16),
        "floating-box, 32 particles long": lambda: floating_box(32),
        **{
            f"{name}, {long} particles long": partial(measure, long, device=device)
            for long in (16, 32, 64)
            for name, measure in (
                ("heaving-box", partial(swinging_box, rolls=False)),
                ("rolling-box", partial(swinging_box, rolls=True, duration=8.0)),
                ("heeled-box", heeled_box),
            )
        },
        **{f"rolling-disc, {across} across": partial(rolling_under_oil, across, device=device) for across in (8, 16)},
        **{
            f"rolling-ball, {across} across": partial(rolling_under_oil, across, flat=False, device=device)
            for across in (8, 12)
        },
        "added-mass, a sphere 8 across, 20 deep, 2 iterations": lambda: added_mass(8, 20, 100, 2),
        "added-mass, a sphere 8 across, 20 deep, 2 iterations, 10 steps": lambda: added_mass(8, 20, 100, 2, steps=10),
        "added-mass, a sphere 8 across, 20 deep, 16 iterations": lambda: added_mass(8, 20, 100, 16),
        "added-mass, a sphere 8 across, 20 deep, 32 iterations": lambda: added_mass(8, 20, 200, 32),
        **{
            f"disc, {density:g} kg/m3, {across} across, {iterations} iterations": partial(
                disc, density, across, iterations
            )
            for density in (50.0, 500.0)
            for across, iterations in ((10, 2), (20, 2), (20, 100), (30, 2), (30, 100))
        },
        **LOADS,
    }


def values(*names: str) -> Callable[[list[dict[str, float]]], list[float]]:
    """What each case found by these names."""
    return lambda found: [one[name] for one in found for name in names]


def _per_cent(found: list[dict[str, float]]) -> list[float]:
    return [100.0 * one[name] for one in found for name in ("u", "v")]


BODIES = "torus", "200,000 triangles", "bodies that overlap", "a torus that crosses itself"
TEN = "added-mass, a sphere 8 across, 20 deep, 2 iterations, 10 steps"
ROWS = {
    "cavity": Measure(("cavity, Re 100, 50 x 50",), _per_cent),
    "cavity_400": Measure(("cavity, Re 400, 50 x 50, velocities follow",), _per_cent),
    "stirred": Measure(("stirred",), values("deepest")),
    "cup": Measure(("cup-turned",), values("through its wall", "poured", "still in it")),
    "meshes": Measure(
        tuple(f"meshes, 500 steps, {name}" for name in BODIES),
        lambda found: [*(max(one["deepest"], 0.0) for one in found), max(one["energy"] for one in found)],
    ),
    "piston": Measure(("piston, kd = 1.5, 20 deep",), values("over theory")),
    "plunged_box": Measure(("plunged-box, 24",), values("upwards", "sideways")),
    "taylor_couette": Measure(("taylor-couette, 40 across",), lambda found: [-found[0]["inner"], found[0]["outer"]]),
    "turning_cup": Measure(("turning-cup",), values("rise")),
    "floating_box": Measure(("floating-box",), values("draft over the exact one")),
    "added_mass": Measure(
        (TEN, TEN.replace("2 iterations, 10 steps", "16 iterations")),
        values(*(f"at {density} kg/m3" for density in (500, 3000, 8000))),
    ),
}
"""Of `measured.csv`, from what cases found."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", default="", help="cases whose names begin so")
    parser.add_argument("--device", default="cpu", help="of cavity, piston, settling, swinging and rolling bodies")
    rows.Printer.add_to(parser)
    given = parser.parse_args()
    rows.run_cases(cases(given.device), ROWS, given)


if __name__ == "__main__":
    main()
