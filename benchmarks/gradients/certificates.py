"""``python -m benchmarks.gradients.certificates``: the certificates of scenes, at the places that seeds draw.

The parameter is gravity in 4 blocks of time, the loss is the distance of the centre of mass, on a CPU in float64.
"""

import argparse
import sys
from collections.abc import Iterable, Sequence
from statistics import median

from cortado import certify
from cortado.certificate.certificate import Certificate

from .cells import Bench, Cell
from .scenes import SCENES


def certificate(scene: str, steps: int, seed: int) -> Certificate:
    """At the gravity that a seed draws, about the distance from the run that it hides."""
    cell = Cell(scene, "gravity-4", "centre-of-mass", steps, seed, "exact")
    problem, u = Bench("cpu", "float64").posed(cell)
    return certify(problem.problem, problem.parameters({"gravity": u}), seed=seed)


def row(scene: str, found: Iterable[Certificate]) -> str:
    """Of a table in Markdown: how many certificates of a scene say that the adjoint is right; of these the median [the
    least, the greatest] of the measured horizons and of the e-folds of the adjoint over the whole run."""
    all_of_them = list(found)
    right = [one for one in all_of_them if one.right]
    numbers = ([one.horizon for one in right], [one.growth * one.steps for one in right])
    texts = [f"{median(n):.3g} [{min(n):.3g}, {max(n):.3g}]" if n else "-" for n in numbers]
    return f"| {scene} | {len(right)} of {len(all_of_them)} | {' | '.join(texts)} |"


def main(words: Sequence[str] | None = None) -> int:
    """Prints the table, a row as soon as it is known; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.gradients.certificates", description=__doc__)
    known = list(SCENES)
    parser.add_argument("--scenes", nargs="+", choices=known, default=known, metavar="NAME", help=", ".join(known))
    parser.add_argument("--steps", type=int, default=480)
    parser.add_argument("--seeds", type=int, nargs="+", default=list(range(8)), help="of places and hidden runs")
    chosen = parser.parse_args(words)
    print("| scene | right | horizon in steps | e-folds |", "|---" * 4 + "|", sep="\n")
    for scene in chosen.scenes:
        print(row(scene, (certificate(scene, chosen.steps, seed) for seed in chosen.seeds)), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
