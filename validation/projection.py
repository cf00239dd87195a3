"""How near is the projection to flows that are known? ``python validation/projection.py [--device cuda] [--only jet]``
prints a line for each case of `validation/README.md` and more, some of which take minutes on one core."""

import argparse
import sys
import time
import warnings
from collections.abc import Callable
from itertools import product
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from cortado.errors import CortadoWarning
from falling_jets import falling_jet
from oscillating_drops import C2, C4, CUBIC
from projected_flows import dam_break, elliptical_drop, hung_block, kolmogorov, rotating_patch, shut_box, taylor_green
from sloping_films import sloping_film
from standing_waves import standing_wave
from still_fluids import still_water, two_layers
from viscous_flows import Channel

Case = Callable[[str], object]


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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--device", default="cpu", help="as Warp names it")
    parser.add_argument("--only", default="", help="cases whose names begin so")
    given = parser.parse_args()
    warnings.simplefilter("ignore", CortadoWarning)
    np.set_printoptions(precision=4, suppress=True)
    chosen = {name: case for name, case in CASES.items() if name.startswith(given.only)}
    for number, (name, case) in enumerate(chosen.items(), 1):
        begun = time.perf_counter()
        found = case(given.device)
        print(f"[{number}/{len(chosen)}] {name}: {found} ({time.perf_counter() - begun:.0f} s)", flush=True)


if __name__ == "__main__":
    main()
