"""What was found beside what was hidden, one panel a component."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from cortado.pictures.canvas import DASHED, FAINT, INK, PALETTE, drawing, whole_numbers


def panels(
    x: ArrayLike,
    found: ArrayLike,
    path: str | Path,
    *,
    names: Sequence[str],
    title: str,
    x_label: str,
    unit: str = "",
    true: ArrayLike | None = None,
    start: ArrayLike | None = None,
) -> Path:
    """Each component of what was found in a panel of its own, over whole numbers.

    Args:
        x: (k,) evaluations or steps.
        found: (k, c).
        names: c of them.
        true: (c,) or (k, c), dashed; None where it is not known.
        start: (c,) or (k, c), the first guess, faint.
    """
    x, found = np.asarray(x), np.asarray(found, dtype=float)
    count = found.shape[1]
    with drawing(path, height=1.6 + 1.9 * count) as figure:
        rows = figure.subplots(count, 1, sharex=True, squeeze=False)[:, 0]
        for k, axes in enumerate(rows):
            if start is not None:
                axes.plot(x, np.broadcast_to(start, found.shape)[:, k], color=FAINT, linewidth=1.2, label="first guess")
            axes.plot(x, found[:, k], color=PALETTE[k % len(PALETTE)], label="found")
            if true is not None:
                axes.plot(x, np.broadcast_to(true, found.shape)[:, k], **DASHED, color=INK, label="hidden")
            axes.set_ylabel(f"{names[k]} [{unit}]" if unit else names[k])
            axes.margins(x=0.02, y=0.15)
        rows[0].set_title(title, pad=26)
        rows[0].legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=3, borderaxespad=0.2)
        rows[-1].set_xlabel(x_label)
        whole_numbers(rows[-1].xaxis)
        figure.align_ylabels()
    return Path(path)
