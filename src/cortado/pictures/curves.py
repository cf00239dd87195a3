"""Numbers over iterations, steps or anything else."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cortado.errors import InputError
from cortado.pictures.canvas import DASHED, FAINT, INK, PALETTE, drawing, whole_numbers


def loss_curve(losses: ArrayLike, path: str | Path, *, title: str = "Loss", label: str = "loss") -> Path:
    """Losses (evaluations,) over the evaluations, on a logarithmic scale where any is positive."""
    values = np.asarray(losses, dtype=float)
    with drawing(path) as figure:
        axes = figure.subplots()
        numbers, values = _line(axes, np.arange(len(values)), values, _any_positive(values), color=PALETTE[0])
        labels = {0: {"xytext": (0, 9), "ha": "center"}, len(values) - 1: {"xytext": (9, 0), "va": "center"}}
        for k, place in labels.items() if len(values) else ():
            end = (numbers[k], values[k])
            axes.plot(*end, "o", color=PALETTE[0], markersize=7)
            axes.annotate(f"{values[k]:.3g}", end, textcoords="offset points", weight="bold", **place)
        axes.margins(x=0.06, y=0.14)
        axes.set(title=title, xlabel="evaluation", ylabel=label)
        whole_numbers(axes.xaxis)
    return Path(path)


def curve(
    x: ArrayLike,
    series: Mapping[str, ArrayLike],
    path: str | Path,
    *,
    title: str,
    x_label: str,
    y_label: str,
    logarithmic: bool = False,
    true: Sequence[ArrayLike] = (),
) -> Path:
    """Several series over the same numbers.

    Args:
        x: (k,), at whole numbers only if they are integers.
        series: label -> (k,); what is not finite is left out. Labels are shown if there are two or more.
        logarithmic: scale of the series, where any is positive; zeros and negative numbers are left out.
        true: (k,) each, what the series should be, dashed on top of them.
    """
    x, lines = np.asarray(x), {label: np.asarray(values, dtype=float) for label, values in series.items()}
    for label, values in lines.items():
        if values.shape != x.shape or x.ndim != 1:
            raise InputError(f"The series {label!r} has shape {values.shape} over {x.shape}: both must be (k,).")
    logarithmic = logarithmic and any(_any_positive(values) for values in lines.values())
    with drawing(path) as figure:
        axes = figure.subplots()
        for k, (label, values) in enumerate(lines.items()):
            _line(axes, x, values, logarithmic, color=PALETTE[k % len(PALETTE)], label=label)
        for k, column in enumerate(true):
            axes.plot(x, np.asarray(column, dtype=float), **DASHED, color=INK, label=None if k else "true")
        axes.margins(x=0.03, y=0.08)
        axes.set(title=title, xlabel=x_label, ylabel=y_label)
        if np.issubdtype(x.dtype, np.integer):
            whole_numbers(axes.xaxis)
        if len(lines) + len(true) > 1:
            axes.legend(loc="center left", bbox_to_anchor=(1.01, 0.5))
    return Path(path)


def parameters(
    history: ArrayLike,
    true: ArrayLike | None,
    path: str | Path,
    *,
    names: Sequence[str] | None = None,
    unit: str = "",
    title: str = "Recovered parameters",
) -> Path:
    """Every component of the parameters over the evaluations (solid), against their true values (dashed).

    Args:
        history: (evaluations, k), or (evaluations, ...) with k components in all.
        true: (k,) or the same shape as one evaluation; None where they are not known.
        names: k of them; by default x, y, z for up to three, numbers for more.
    """
    values = np.asarray(history, dtype=float)
    values = values.reshape(len(values), -1)
    count = values.shape[1]
    levels = None if true is None else np.broadcast_to(np.ravel(np.asarray(true, dtype=float)), (count,))
    labels = names or (["x", "y", "z"][:count] if count <= 3 else [str(k + 1) for k in range(count)])
    with drawing(path) as figure:
        axes = figure.subplots()
        for k in range(count):
            colour, faint = PALETTE[k % len(PALETTE)], 1.0 if count <= len(PALETTE) else 0.55
            axes.plot(values[:, k], color=colour, alpha=faint, label=labels[k])
            if levels is not None:
                axes.axhline(levels[k], **DASHED, color=colour, alpha=faint)
        axes.set(title=title, xlabel="evaluation", ylabel=f"value [{unit}]" if unit else "value")
        axes.margins(x=0.02, y=0.08)
        whole_numbers(axes.xaxis)
        if levels is not None:
            axes.plot([], [], **DASHED, color=FAINT, label="true")
        if count <= len(PALETTE):
            axes.legend(loc="center left", bbox_to_anchor=(1.01, 0.5))
    return Path(path)


def _any_positive(values: NDArray[Any]) -> bool:
    return bool(np.any(values[np.isfinite(values)] > 0.0))


def _line(
    axes: Any, x: NDArray[Any], values: NDArray[Any], logarithmic: bool, **style: Any
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Draws what can be shown of a line, few points with marks, and returns it."""
    shown = np.isfinite(x) & np.isfinite(values)
    if logarithmic:
        axes.set_yscale("log")
        shown &= values > 0.0
    x, values = x[shown], values[shown]
    axes.plot(x, values, marker="o", markersize=4 if len(values) <= 40 else 0, **style)
    return x, values
