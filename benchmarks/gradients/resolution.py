"""``python -m benchmarks.gradients.resolution RESULTS``: how far gradients reach as one flow is resolved more finely.

The scenes are dams of one size whose spacing is halved again and again, so that a time is another number of steps in
each. Compute them first, with the same times in seconds for all, such as 0.2 and 0.4 s:

    python -m benchmarks.gradients RESULTS --scenes plane-144 --horizons 200 400 --controls gravity-4 \\
        --losses centre-of-mass --estimators exact adjoint-viscosity
    python -m benchmarks.gradients RESULTS --scenes plane-576 --horizons 400 800 ...
"""

import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from statistics import median

from cortado import InputError

from .cells import TRUTH, Cell, Record
from .results import Results
from .scenes import scene
from .table import score

USEFUL = 0.9
"""The median cosine to the smoothed gradient down to which a gradient counts as useful."""


def resolution(records: Iterable[Record]) -> str:
    """For each estimator and loss a table in Markdown, with a row for each scene: the median cosine at each time [the
    size], and the last time up to which the cosine is `USEFUL`."""
    known = {Cell.of(record): record for record in records}
    kinds = sorted({(cell.estimator, cell.loss) for cell in known if cell.estimator != TRUTH})
    return "\n\n".join(f"**{', '.join(kind)}**\n\n{_table(*kind, known)}" for kind in kinds)


def _table(estimator: str, loss: str, known: dict[Cell, Record]) -> str:
    own: dict[str, dict[float, list[tuple[float, float]]]] = {}
    for cell, record in known.items():
        asked = (cell.estimator, cell.loss) == (estimator, loss)
        judged = score(record, known.get(cell.question, {})) if asked else None
        if judged is not None:
            own.setdefault(cell.scene, {}).setdefault(_time(cell), []).append(judged)
    times = sorted({time for scores in own.values() for time in scores})
    lines = [
        "| scene | spacing [mm] | " + " | ".join(f"{time:g} s" for time in times) + " | useful up to |",
        "|---" * (len(times) + 3) + "|",
    ]
    for name in sorted(own, key=_spacing, reverse=True):
        scores = own[name]
        texts = [_score(scores[time]) if time in scores else "-" for time in times]
        lines.append(f"| {name} | {1e3 * _spacing(name):g} | {' | '.join(texts)} | {_reach(scores)} |")
    return "\n".join(lines)


def _score(scores: list[tuple[float, float]]) -> str:
    return f"{median(c for c, _ in scores):.2f} [{median(s for _, s in scores):.2g}]"


def _reach(scores: dict[float, list[tuple[float, float]]]) -> str:
    """The time at which the median cosine falls below `USEFUL`, interpolated between the times that were computed."""
    times = sorted(scores)
    cosines = [median(c for c, _ in scores[time]) for time in times]
    below = next((k for k, value in enumerate(cosines) if value < USEFUL), None)
    if below is None:
        return f"more than {times[-1]:g} s"
    if below == 0:
        return f"less than {times[0]:g} s"
    (a, b), (t, u) = cosines[below - 1 : below + 1], times[below - 1 : below + 1]
    return f"{t + (a - USEFUL) / (a - b) * (u - t):.2f} s"


def _time(cell: Cell) -> float:
    return round(cell.horizon * scene(cell.scene).solver.fixed_time_step("a benchmark"), 9)


def _spacing(name: str) -> float:
    return scene(name).discretisation.spacing


def main(words: Sequence[str]) -> int:
    """Prints the tables of a file of results; returns the exit code."""
    if len(words) != 1:
        print(__doc__, file=sys.stderr)
        return 2
    try:
        print(resolution(Results(Path(words[0])).records.values()))
    except InputError as error:
        print(error, file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
