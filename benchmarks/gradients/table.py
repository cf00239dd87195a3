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
    return float(np.sqrt(1.0 - noise / size)) if size > noise else 0.0


def score(record: Record, truth: Record) -> tuple[float, float] | None:
    """The cosine and the relative size of what a record has to a truth; None where one of them has no gradient, and
    where the truth is 0, to which nothing has a direction."""
    if not record.get("derivatives") or not any(truth.get("derivatives") or ()):
        return None
    found, wanted = np.array(record["derivatives"]), np.array(truth["derivatives"])
    return cosine(found, wanted), float(np.linalg.norm(found) / np.linalg.norm(wanted))


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
        texts = [_texts({c: r for c, r in own.items() if c.horizon == horizon}, known) for horizon in horizons]
        longest = max((cell.horizon for cell, record in own.items() if record.get("derivatives")), default=0)
        costs = [record["cost"] / longest for cell, record in own.items() if cell.horizon == longest]
        lines.append(f"| {name} | {' | '.join(texts)} | {f'{median(costs):.0f}' if costs else '-'} |")
    texts = [_limit([r for c, r in known.items() if c == c.question and c.horizon == horizon]) for horizon in horizons]
    return "\n".join([*lines, f"| *at most* | {' | '.join(texts)} | |"])


def _texts(own: dict[Cell, Record], known: dict[Cell, Record]) -> str:
    """Of one estimator at one horizon, over seeds."""
    truths = {cell: known.get(cell.question, {}) for cell in own}
    judged = {
        cell: score(record, truths[cell]) for cell, record in own.items() if any(truths[cell].get("derivatives") or ())
    }
    scores = [one for one in judged.values() if one is not None]
    if not scores:
        return "-"
    cosines, sizes = zip(*scores, strict=True)
    missing = len(judged) - len(scores)
    return f"{median(cosines):.2f} [{min(cosines):.2f}] {median(sizes):.2g}{f', {missing} without' if missing else ''}"


def _limit(truths: list[Record]) -> str:
    limits = [ceiling(truth) for truth in truths if truth.get("derivatives") and truth.get("standard_errors")]
    return f"{median(limits):.2f} [{min(limits):.2f}]" if limits else "-"
