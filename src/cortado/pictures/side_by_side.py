"""Images side by side."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from math import ceil, sqrt
from pathlib import Path

from numpy.typing import ArrayLike

from cortado.errors import InputError
from cortado.files.srgb import to_srgb
from cortado.pictures.canvas import drawing

_MOST_IN_A_ROW = 4


def images(images: Iterable[ArrayLike], titles: Sequence[str], path: str | Path, title: str = "") -> Path:
    """Images in a row, such as start, target and result; more than 4 in a grid, such as moments on the way.

    Args:
        images: one (rows, columns, 3) linear image for each panel, from 0 to 1; the first row is at the top.
        titles: one for each panel.
        title: of the whole.
    """
    shown = [to_srgb(image) for image in images]
    if not shown or len(shown) != len(titles):
        raise InputError(f"There are {len(shown)} images and {len(titles)} titles; give at least one of each, paired.")
    across = len(shown) if len(shown) <= _MOST_IN_A_ROW else ceil(sqrt(len(shown)))
    down = -(-len(shown) // across)
    tallness = max(image.shape[0] / image.shape[1] for image in shown)
    panel = min(6.0, 11.0 / across, 7.0 / tallness)  # width [inch]
    height = down * (panel * tallness + 0.35) + (0.6 if title else 0.25)
    with drawing(path, max(across * (panel + 0.1), 8.0), max(height, 2.4)) as figure:
        panels = figure.subplots(down, across, squeeze=False).ravel()
        for axes in panels:
            axes.set_axis_off()
        for axes, image, name in zip(panels, shown, titles, strict=False):
            axes.imshow(image)
            axes.set_title(name)
        if title:
            figure.suptitle(title, weight="bold")
    return Path(path)
