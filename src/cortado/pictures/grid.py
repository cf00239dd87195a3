"""Several pictures in a grid: how many go into a row, and one camera for all of them."""

from collections.abc import Sequence

import numpy as np

from cortado.discretise.shapes import Points
from cortado.errors import InputError
from cortado.pictures.plane_stage import PlaneStage
from cortado.pictures.stage import Stage
from cortado.scene.picture import Picture

MOST = 9
"""Pictures; in more of them one sees nothing."""
LEAST = 64
"""Pixels of each picture, along either side."""
AIR = 1.25
"""How much higher a picture is, at least, than what it shows would be if it were as wide as the picture."""


def framed_together(stages: Sequence[PlaneStage | Stage], spare: int = 0) -> tuple[list[PlaneStage | Stage], int]:
    """Stages of one dimension, each in its part of a page as wide as the first one's picture but for some ``spare``
    columns and no higher, all in the same scale, seen by a camera that sees all that any of them shows; and how many go
    into a row. Raises `InputError` where parts are too small."""
    whole, count = stages[0].picture, len(stages)
    page = whole.model_copy(update={"width": max(whole.width - spare, 1)})
    lower, upper = (np.array(ends) for ends in zip(*(stage.ends for stage in stages), strict=True))
    ends = lower.min(axis=0), upper.max(axis=0)
    shown = stages[0].framed(ends, page).seen_size
    across = in_a_row(count, shown, page)
    width, height = page.width // across, page.height // -(-count // across)
    size = {"width": width, "height": min(height, round(AIR * width * shown[1] / shown[0]))}
    if min(size.values()) < LEAST:
        found = f"{count} pictures of {size['width']} x {size['height']} pixels fit into {page.width} x {page.height}"
        raise InputError(f"{found}, but each must have {LEAST} x {LEAST}: ask for more lines, or for fewer runs.")
    return [stage.framed(ends, stage.picture.model_copy(update=size)) for stage in stages], across


def in_a_row(count: int, size: Points, page: Picture) -> int:
    """How many of ``count`` pictures go into a row of a page, so that something as wide and high as ``size`` (2,) is
    large in them, and few places are empty."""

    def gain(across: int) -> float:
        down = -(-count // across)
        scale = min(page.width / across / size[0], page.height / down / size[1])
        return float(scale * count / (across * down))

    return max(range(1, count + 1), key=gain)
