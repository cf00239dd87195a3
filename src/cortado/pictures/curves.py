"""The losses of a search."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from cortado.pictures.canvas import PALETTE, drawing, whole_numbers


def loss_curve(losses: ArrayLike, path: str | Path, *, title: str = "Loss", label: str = "loss") -> Path:
    """Losses (evaluations,) over the evaluations, on a logarithmic scale where any is positive. What is not finite, and
    on that scale what is not positive, is left out."""
    values = np.asarray(losses, dtype=float)
    shown = np.isfinite(values)
    logarithmic = bool(np.any(values[shown] > 0.0))
    shown &= (values > 0.0) | (not logarithmic)
    numbers, values = np.flatnonzero(shown), values[shown]
    with drawing(path) as figure:
        axes = figure.subplots()
        if logarithmic:
            axes.set_yscale("log")
        axes.plot(numbers, values, marker="o", markersize=4 if len(values) <= 40 else 0, color=PALETTE[0])
        labels = {0: {"xytext": (0, 9), "ha": "center"}, len(values) - 1: {"xytext": (9, 0), "va": "center"}}
        for k, place in labels.items() if len(values) else ():
            end = (numbers[k], values[k])
            axes.plot(*end, "o", color=PALETTE[0], markersize=7)
            axes.annotate(f"{values[k]:.3g}", end, textcoords="offset points", weight="bold", **place)
        axes.margins(x=0.06, y=0.14)
        axes.set(title=title, xlabel="evaluation", ylabel=label)
        whole_numbers(axes.xaxis)
    return Path(path)
