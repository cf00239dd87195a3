"""``python validation/rheology.py`` finds the three numbers of a Herschel-Bulkley law from films on three slopes that
were run with 48 particles across, by films of 16 and of 24: an hour on one core. It prints
the row of `validation/README.md`, which ``--write`` keeps."""

import argparse
import sys
from pathlib import Path

import measured_rows as rows
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from cortado import Problem
from cortado.losses import CentreOfMass
from yielding_films import LAW, SLOPES, film, observed, speeds

ROWS = ("three_films",)
"""Of `measured.csv`."""


def sensitivities(deep: int, law: dict[str, float]) -> np.ndarray:
    """(2 slopes, 3) derivatives of the logarithms of what is observed by those of the numbers of the law."""
    rows = []
    for slope in SLOPES:
        simulation, steps = film(slope, deep)
        problem, heights = Problem(simulation, steps, CentreOfMass(np.zeros(2))), simulation.positions[:, 1]
        columns = []
        for name, value in law.items():
            tangents = []
            end = problem.tangents(
                law, {name: value}, lambda _, dot, to=tangents: to.append(dot.numpy(2)["velocities"]), [steps]
            )
            columns.append(speeds(tangents[-1], heights) / speeds(end[steps].velocities, heights))
        rows.append(np.array(columns).T)
    return np.concatenate(rows)


def found_law(deep: int, target: np.ndarray, start: dict[str, float]) -> dict[str, float]:
    """By Gauss and Newton from films so many particles deep; derivatives are taken in the first and the third step."""
    law = dict(start)
    for k in range(7):
        if k in (0, 2):
            slopes = sensitivities(deep, law)
        change = np.linalg.lstsq(slopes, np.log(target / observed(deep, law)), rcond=None)[0]
        law = {name: law[name] * float(np.exp(by)) for name, by in zip(law, np.clip(change, -0.4, 0.4), strict=True)}
    return law


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    rows.Printer.add_to(parser)
    printer = rows.Printer(parser.parse_args())
    target = observed(48, LAW)
    start = {name: factor * LAW[name] for name, factor in zip(LAW, (1.3, 0.9, 0.7), strict=True)}
    for deep in (16, 24):
        found = found_law(deep, target, start)
        shares = {name: found[name] / LAW[name] for name in LAW}
        print(deep, shares, flush=True)
        if deep == 16:
            printer.row("three_films", shares.values())
