"""The leaderboard as Markdown: a table for each scene, control and loss, made from records."""

from collections.abc import Iterable
from statistics import median

import numpy as np

from .cells import TRUTH, Cell, Record
from .estimators import ESTIMATORS


def cosine(a: np.ndarray, b: np.ndarray) -> float:
    """Of the angle between two vectors, whatever their sizes."""
    a, b = (one / max(np.abs(one).max(), np.finfo(float).tiny) for one in (a, b))
    return float(a @ b / max(np.linalg.norm(a) * np.linalg.norm(b), np.finfo(float).tiny))


def ceiling(truth: Record) -> float:
    """The cosine that the smoothed gradient itself would have to the truth, whose noise has a known size."""
    size, noise = (float(np.square(truth[name]).sum()) for name in ("derivatives", "standard_errors"))
    return float(np.sqrt(max(1.0 - noise / max(size, np.finfo(float).tiny), 0.0)))


def table(records: Iterable[Record]) -> str:
    """Of every estimator and horizon the median cosine over seeds [the least] and the median size; and the cost at the
    longest."""
    known = {Cell.of(record): record for record in records}
    parts: dict[tuple[str, str, str], dict[Cell, Record]] = {}
    for cell, record in known.items():
        parts.setdefault((cell.scene, cell.control, cell.loss), {})[cell] = record
    return "\n\n".join(f"**{', '.join(names)}**\n\n{_rows(parts[names])}" for names in sorted(parts))


def _rows(known: dict[Cell, Record]) -> str:
    horizons = sorted({cell.horizon for cell in known})
    present = {cell.estimator for cell in known} - {TRUTH}
    names = [name for name in ESTIMATORS if name in present] + sorted(present - ESTIMATORS.keys())
    lines = [
        "| estimator | " + " | ".join(f"{horizon:,} steps" for horizon in horizons) + " | cost |",
        "|---" * (len(horizons) + 2) + "|",
    ]
    for name in names:
        own = {cell: record for cell, record in known.items() if cell.estimator == name}
        texts = [_score({c: r for c, r in own.items() if c.horizon == horizon}, known) for horizon in horizons]
        longest = max((cell.horizon for cell, record in own.items() if record.get("derivatives")), default=0)
        costs = [record["cost"] / longest for cell, record in own.items() if cell.horizon == longest]
        lines.append(f"| {name} | {' | '.join(texts)} | {f'{median(costs):.0f}' if costs else '-'} |")
    texts = [_limit([r for c, r in known.items() if c == c.question and c.horizon == horizon]) for horizon in horizons]
    return "\n".join([*lines, f"| *at most* | {' | '.join(texts)} | |"])


def _score(own: dict[Cell, Record], known: dict[Cell, Record]) -> str:
    """Of one estimator at one horizon, over seeds."""
    cosines, sizes, missing = [], [], 0
    for cell, record in own.items():
        truth = known.get(cell.question, {}).get("derivatives")
        if truth is None or not record.get("derivatives"):
            missing += truth is not None
            continue
        found, wanted = np.array(record["derivatives"]), np.array(truth)
        cosines.append(cosine(found, wanted))
        sizes.append(float(np.linalg.norm(found) / np.linalg.norm(wanted)))
    none = f", {missing} without" if missing and cosines else ""
    return f"{median(cosines):.2f} [{min(cosines):.2f}] {median(sizes):.2g}{none}" if cosines else "-"


def _limit(truths: list[Record]) -> str:
    limits = [ceiling(truth) for truth in truths if truth.get("derivatives") and truth.get("standard_errors")]
    return f"{median(limits):.2f} [{min(limits):.2f}]" if limits else "-"
