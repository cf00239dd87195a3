"""How near is the projection to flows that are known? ``python validation/projection.py [--device cuda] [--only jet]``
prints a line for each case, some of which take minutes on one core, and the rows of `validation/README.md` that they
give; ``--write`` keeps these (see `measured_rows.py`)."""

import argparse
import sys
from collections.abc import Callable
from functools import partial
from itertools import product
from pathlib import Path

import measured_rows as rows
import numpy as np
from measured_rows import Measure

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from falling_jets import falling_jet
from oscillating_drops import C2, C4, CUBIC
from projected_flows import (
    PROJECTION,
    box,
    dam_break,
    elliptical_drop,
    hung_block,
    rotating_patch,
    simulated,
    taylor_green,
)
from sloping_films import sloping_film
from standing_waves import standing_wave
from still_fluids import still_water, two_layers
from viscous_flows import Channel

Case = Callable[[str], object]


def kolmogorov(across, device="cpu"):
    """A wave of shear along z in a full periodic cube: the greatest error of its energy over the first energy."""
    spacing, nu, k = 1.0 / across, 0.01, 2.0 * np.pi
    steps = int(np.ceil(1.0 / (0.2 * spacing)))
    simulation = simulated(
        spacing,
        3,
        "float32",
        phase=[{"name": "water", "rest_density": 1.0, "viscosity": nu}],
        fluid=[box([0.0] * 3, [1.0] * 3)],
        container={"shape": "box", "lower": [0.0] * 3, "upper": [1.0] * 3, "periodic": [True] * 3},
        forces={"gravity": [0.0] * 3, "viscosity": "stress"},
        solver={**PROJECTION, "time_step": 1.0 / steps},
        device=device,
    )
    x = simulation.positions
    v = np.zeros_like(x)
    v[:, 0] = np.sin(k * x[:, 2])
    run = simulation.run(steps, {"initial_velocities": v}, record_every=max(steps // 40, 1))
    energy = (run.velocities**2).sum((1, 2)) / (v**2).sum()
    return np.abs(energy - np.exp(-2.0 * nu * k**2 * run.times)).max()


def shut_box(across, time_step, iterations=2, steps=20, device="cpu"):
    """A box full of water, with a jitter, in which gravity is switched on along a side. After 1, 10 and 20 steps: the
    mean velocity along it, and the mean speed, over g t."""
    simulation = simulated(
        1.0 / across,
        fluid=[box([0.0, 0.0], [1.0, 1.0])],
        container={"shape": "box", "lower": [0.0, 0.0], "upper": [1.0, 1.0]},
        forces={"gravity": [9.81, 0.0]},
        discretisation={**C2, "jitter": 0.05},
        solver={**PROJECTION, "time_step": time_step, "iterations": iterations},
        device=device,
    )
    v = simulation.run(steps, record_every=1).velocities
    after = np.array([n for n in (1, 10, 20) if n <= steps])
    means = np.stack([v[after, :, 0].mean(axis=1), np.linalg.norm(v[after], axis=2).mean(axis=1)], axis=1)
    return means / (9.81 * time_step * after[:, None])


def channel(across: int, reynolds: float, low: float) -> Case:
    return lambda _: Channel(across, reynolds, low, "wendland_c2", solver="projection").run()


CASES: dict[str, Case] = {
    "vortices 32, 46, Re 100: energy, velocity": lambda _: [taylor_green(n, 100.0) for n in (32, 46)],
    "vortices 32, Re 10": lambda _: taylor_green(32, 10.0, 0.1),
    "wave of shear in space, 32": lambda device: kolmogorov(32, device=device),
    "ellipse 36": lambda device: elliptical_drop(36, device=device),
    "ball drawn out, 36": lambda device: elliptical_drop(36, 3, device=device),
    "square that turns, 36, 72: pieces, corner, energy, momentum, apart": lambda device: [
        rotating_patch(n, device=device) for n in (36, 72)
    ],
    **{
        f"jet, {'slot' if d == 2 else 'round'}, {n} across, {mu:g} Pa s: width at 1.5, 2, 2.5, 3; gap; in one piece": (
            lambda device, d=d, n=n, mu=mu: falling_jet(n, d, mu, device=device)
        )
        for d in (2, 3)
        for n in (7, 14)
        for mu in (0.0, 5.0)
    },
    **{
        f"film {n} deep, slope {slope:g}: flow; in sixths of the time": (
            lambda device, n=n, slope=slope: sloping_film(slope, n, device=device)
        )
        for n in (16, 32)
        for slope in (0.1, 0.01, 0.001, 0.0003)
    },
    **{
        f"{'Couette' if low else 'Poiseuille'}, {n} across, Re {re:g}": channel(n, re, low)
        for n in (20, 40)
        for low in (0.0, 0.45)
        for re in (0.1, 1.0, 10.0, 100.0)
    },
    "block under a lid: fall": lambda _: hung_block(),
    **{
        f"shut box, {n} across, {iterations} iterations, steps of {1000 * step:g} ms: mean velocity, speed over g t": (
            lambda device, own=(n, step, iterations, steps): shut_box(*own, device=device)
        )
        for n, step, iterations, steps in (
            *((n, step, 2, 20) for n in (20, 40, 80, 160) for step in (0.001, 0.0005)),
            (40, 0.002, 1000, 1),
            (80, 0.002, 1000, 1),
        )
    },
    "dam break, steps of 0.5, 1, 2, 3 ms: energy, compressions, nearer than s / 2": lambda _: [
        dam_break(time_step=step) for step in (0.0005, 0.001, 0.002, 0.003)
    ],
    **{
        f"water at rest, {n} deep, {kernel['kernel']}, after {seconds} s": (
            lambda device, n=n, seconds=seconds, kernel=kernel: still_water(
                n, seconds, discretisation=kernel, device=device
            )
        )
        for n, seconds, kernel in product((20, 40), (2.5, 10.0), (C2, CUBIC, C4))
    },
    **{
        f"standing wave, {n} deep, {long:g} depths long, {'between walls' if walls else 'periodic'}": (
            lambda device, n=n, long=long, walls=walls: standing_wave(
                n, long, walls, time_step=0.072 / n, device=device
            )
        )
        for n in (24, 48)
        for long, walls in ((2.0, False), (4.0, False), (4.0, True))
    },
    "water at rest in space, 20 deep": lambda device: still_water(20, device=device, dimension=3),
    **{
        f"layers, ratio {ratio}, steps of 1 ms: speed": (lambda device, r=ratio: two_layers(r, 0.001, device=device))
        for ratio in (2, 10, 100, 1000)
    },
}


def percent(values: object) -> list[float]:
    return (100.0 * np.ravel(values)).tolist()


def films(deep: int, *slopes: str) -> Measure:
    return Measure(tuple(f"film {deep} deep, slope {slope}:" for slope in slopes), lambda found: [f[0] for f in found])


def channels(name: str, figure: str) -> Measure:
    return Measure((f"{name}, 20 across",), lambda found: [one[figure] for one in found])


def waves(figure: str) -> Measure:
    """Each wave with 24 and 48 particles in the depth."""
    kinds = ("2 depths long, periodic", "4 depths long, periodic", "4 depths long, between walls")
    cases = tuple(f"standing wave, {deep} deep, {kind}" for kind in kinds for deep in (24, 48))
    return Measure(cases, lambda found: [getattr(one, figure) for one in found])


STILL = tuple(f"water at rest, {deep} deep, wendland_c2, after {s} s" for s in (2.5, 10.0) for deep in (20, 40))
JETS = tuple(f"jet, {name}, {n} across, 0 Pa s" for name in ("slot", "round") for n in (7, 14))
DAM = ("dam break",)
ROWS = {
    "vortices": Measure(("vortices 32, 46",), lambda found: percent(np.transpose(found[0]))),
    "vortices_thick": Measure(("vortices 32, Re 10",), lambda found: percent(found[0][0])),
    "wave": Measure(("wave of shear",), percent),
    "square": Measure(("square that turns",), lambda found: [one[0] for one in found[0]]),
    "ellipse": Measure(("ellipse 36",), lambda found: percent(found[0] - 1.0)),
    "ball": Measure(("ball drawn out",), lambda found: percent(found[0] - 1.0)),
    "jet_slot": Measure(JETS[:2], lambda found: np.ravel([one[0] for one in found])),
    "jet_round": Measure(JETS[2:], lambda found: np.ravel([one[0] for one in found])),
    "jet_honey": Measure(("jet, slot, 7 across, 5 Pa s",), lambda found: found[0][0]),
    "jets_whole": Measure(("jet, ",), lambda found: [f([one[1] for one in found]) for f in (min, max)]),
    "film": films(16, "0.1", "0.01", "0.001", "0.0003"),
    "film_deeper": films(32, "0.1", "0.01", "0.001"),
    "block": Measure(("block",), lambda found: found),
    "dam_energy": Measure(DAM, lambda found: [one[0] for one in found[0]]),
    "dam_compression": Measure(DAM, lambda found: percent([one[1] for one in found[0]])),
    "standing_frequency": waves("frequency"),
    "standing_damping": waves("damping"),
    "rest_speed": Measure(STILL, lambda found: [one.speed for one in found]),
    "rest_pressure": Measure(STILL[:2], lambda found: percent([one.pressure for one in found])),
    "rest_space": Measure(("water at rest in space",), lambda found: [found[0].speed, *percent(found[0].pressure)]),
    "layers": Measure(("layers",), lambda found: found),
    "poiseuille": channels("Poiseuille", "flow"),
    "couette": channels("Couette", "slope"),
}
"""Of `measured.csv`, from what cases found."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--device", default="cpu", help="as Warp names it")
    parser.add_argument("--only", default="", help="cases whose names begin so")
    rows.Printer.add_to(parser)
    given = parser.parse_args()
    np.set_printoptions(precision=4, suppress=True)
    rows.run_cases({name: partial(case, given.device) for name, case in CASES.items()}, ROWS, given)


if __name__ == "__main__":
    main()
