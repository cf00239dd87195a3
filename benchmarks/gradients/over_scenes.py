"""Estimators over all scenes of a file of results: ``python -m benchmarks.gradients.over_scenes FILE``."""

import argparse
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from statistics import median

from cortado import InputError

from .cells import TRUTH, Cell, Record
from .results import Results
from .table import ceiling, score

ALL_LOSSES = "all of these"


def over_scenes(records: Iterable[Record], least_ceiling: float = 0.0) -> str:
    """A table in Markdown for each control, with a row for each loss (and for all of them), horizon and estimator: over
    scenes and seeds the median cosine to the truth [the least], the median size, and in how many cases; in the row of
    the truth, what the smoothed gradient itself would have. Left out are cases where that is below ``least_ceiling``.
    """
    known = {Cell.of(record): record for record in records}
    found: dict[str, dict[tuple[str, int, str], list[tuple[float, float]]]] = {}
    for cell, record in known.items():
        truth = known.get(cell.question, {})
        judged = score(record, truth)
        if judged is not None and ceiling(truth) >= least_ceiling:
            rows = found.setdefault(cell.control, {})
            for loss in (cell.loss, ALL_LOSSES):
                own = judged if record is not truth else (ceiling(truth), 1.0)
                rows.setdefault((loss, cell.horizon, cell.estimator), []).append(own)
    return "\n\n".join(f"**{control}**\n\n{_rows(found[control])}" for control in sorted(found))


def _rows(scores: dict[tuple[str, int, str], list[tuple[float, float]]]) -> str:
    lines = ["| loss | steps | estimator | cosine | size | cases |", "|---" * 6 + "|"]
    for loss, horizon, estimator in sorted(
        scores, key=lambda row: (row[0] == ALL_LOSSES, *row[:2], row[2] == TRUTH, row[2])
    ):
        own = scores[loss, horizon, estimator]
        cosines, sizes = zip(*own, strict=True)
        name, size = ("*at most*", "") if estimator == TRUTH else (estimator, f"{median(sizes):.2f}")
        score = f"{median(cosines):.2f} [{min(cosines):.2f}]"
        lines.append(f"| {loss} | {horizon:,} | {name} | {score} | {size} | {len(own)} |")
    return "\n".join(lines)


def main(words: Sequence[str]) -> int:
    """Prints the tables of a file of results; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.gradients.over_scenes", description=__doc__)
    parser.add_argument("file", type=Path, help="made by python -m benchmarks.gradients")
    parser.add_argument(
        "--truth",
        type=float,
        default=0.0,
        help="least cosine that the smoothed gradient would have to so noisy a truth",
    )
    chosen = parser.parse_args(words)
    try:
        print(over_scenes(Results(chosen.file).records.values(), chosen.truth))
    except InputError as error:
        print(error, file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
