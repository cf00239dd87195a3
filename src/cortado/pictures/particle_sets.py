"""Particles side by side, seen along the third axis."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cortado.files.srgb import to_srgb
from cortado.pictures.canvas import FAINT, INK, drawing

_FAR, _NEAR = "#c9d9e4", "#27506f"
_MOST_DRAWN = 150_000
_SHOWN_RANGE = (0.0, 99.5)
"""Percentiles at the ends of a colour scale, so that a few fast drops do not darken all the others."""


def particles(
    positions: Sequence[ArrayLike],
    titles: Sequence[str],
    path: str | Path,
    *,
    colours: Sequence[ArrayLike] | None = None,
    colour_label: str = "",
    container: tuple[ArrayLike, ArrayLike] | None = None,
    lines: Sequence[ArrayLike] | None = None,
    dimension: int | None = None,
) -> Path:
    """Particle sets side by side, such as before, after and target.

    In 3-D one looks along the third axis: x to the right, y upwards, larger z nearer, nearer particles over
    farther ones. All panels share their scale. Above 150 000 particles, only every k-th is drawn.

    Args:
        positions: one (n, d) [m] for each panel.
        titles: one for each panel.
        colours: for each panel (n,) numbers, drawn with one scale (speed, density), or (n, 3) red, green,
            blue, linear light in [0, 1]; None shades by depth.
        colour_label: beside the scale, with its unit.
        container: lower and upper corner (d,) [m], outlined.
        lines: for each panel (k, 2, d) ends of lines [m] that are drawn over the particles, such as those of solids.
        dimension: 2 or 3; that of the first set when left out. In 2-D a third component is ignored.
    """
    from matplotlib.collections import LineCollection

    sets = [np.asarray(one, dtype=float)[:, :dimension] for one in positions]
    values = [None] * len(sets) if colours is None else [np.asarray(one, dtype=float) for one in colours]
    ends = [np.asarray(one, dtype=float)[:, :, :2] for one in lines or [np.zeros((0, 2, 2))] * len(sets)]
    lower, upper = _bounds([*sets, *(one.reshape(-1, 2) for one in ends)], container)
    across, up = upper - lower
    panel = min(5.5 if len(sets) > 1 else 8.0, 11.0 / len(sets), 7.0 * across / up)  # width [inch]
    width, height = max(panel * len(sets) + 1.2, 8.0), max(panel * up / across + 1.2, 3.6)
    with drawing(path, width, height) as figure:
        panels = figure.subplots(1, len(sets), sharex=True, sharey=True, squeeze=False)[0]
        scale = _ColourScale(sets, values)
        for axes, points, own, title, drawn in zip(panels, sets, values, titles, ends, strict=True):
            _draw_set(axes, points, scale.rgb(points, own), title)
            if container is not None:
                _outline(axes, container)
            if len(drawn):
                axes.add_collection(LineCollection(list(drawn), colors=INK, linewidths=1.2))
            axes.set(xlim=(lower[0], upper[0]), ylim=(lower[1], upper[1]), aspect="equal", xlabel="x [m]")
            axes.grid(False)
        panels[0].set_ylabel("y [m]")
        if scale.mappable is not None:
            extend = "max" if scale.clips else "neither"
            style = {"shrink": 0.8, "aspect": 30, "pad": 0.015, "extend": extend}
            figure.colorbar(scale.mappable, ax=panels, label=colour_label, **style)
    return Path(path)


def _bounds(
    sets: list[NDArray[Any]], container: tuple[ArrayLike, ArrayLike] | None
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Lower and upper corner (2,) [m] of what is to be seen, with a margin."""
    corners = [points[np.isfinite(points).all(axis=1), :2] for points in sets]
    if container is not None:
        corners.append(np.asarray(container, dtype=float)[:, :2])
    everything = np.concatenate([*corners, np.zeros((0, 2))])
    if not len(everything):
        return np.zeros(2), np.ones(2)
    lower, upper = everything.min(axis=0), everything.max(axis=0)
    margin = 0.04 * max(float((upper - lower).max()), 1e-9)
    return lower - margin, upper + margin


class _ColourScale:
    """Turns what the caller gave for colours into red, green, blue, with one scale for all panels."""

    def __init__(self, sets: list[NDArray[Any]], colours: Sequence[NDArray[Any] | None]) -> None:
        from matplotlib.cm import ScalarMappable
        from matplotlib.colors import LinearSegmentedColormap, Normalize

        numbers = [one for one in colours if one is not None and one.ndim == 1]
        depths = [_depth(points) for points in sets]
        values = np.concatenate(numbers or depths)
        values = values[np.isfinite(values)]
        low, high = np.percentile(values, _SHOWN_RANGE) if len(values) else (0.0, 1.0)
        self.clips = bool(len(values) and values.max() > high)
        flat = high - low <= 1e-12 * max(abs(high), abs(low))  # one value, or plane: the near colour
        by_depth = LinearSegmentedColormap.from_list("depth", [_FAR, _NEAR])
        self._map = ScalarMappable(Normalize(low - 1.0 if flat else low, high), "cividis" if numbers else by_depth)
        self.mappable = self._map if numbers else None

    def rgb(self, points: NDArray[Any], colours: NDArray[Any] | None) -> NDArray[Any]:
        """(n, 3) in [0, 1]"""
        if colours is not None and colours.ndim == 2:
            return to_srgb(colours[None])[0] / 255.0
        return self._map.to_rgba(_depth(points) if colours is None else colours)[:, :3]


def _depth(points: NDArray[Any]) -> NDArray[Any]:
    """(n,) [m] the third component, zero in 2-D"""
    return points[:, 2] if points.shape[1] == 3 else np.zeros(len(points))


def _draw_set(axes: Any, points: NDArray[Any], colours: NDArray[Any], title: str) -> None:
    """Discs as large as the particles are apart, the nearer over the farther."""
    from matplotlib.collections import EllipseCollection

    kept = np.flatnonzero(np.isfinite(points).all(axis=1))
    notes = [f"{len(points) - len(kept)} not finite"] if len(kept) < len(points) else []
    every = -(-len(kept) // _MOST_DRAWN) or 1
    if every > 1:
        notes.append(f"one in {every} drawn")
    axes.set_title("\n".join([title, *notes]))
    kept = kept[::every]
    kept = kept[np.argsort(_depth(points)[kept], kind="stable")]
    size, fill = np.full(len(kept), _spacing(points[kept])), colours[kept]
    place = {"offsets": points[kept, :2], "offset_transform": axes.transData, "units": "xy"}
    discs = EllipseCollection(size, size, 0.0 * size, **place, facecolors=fill, edgecolors=0.82 * fill, linewidths=0.25)
    axes.add_collection(discs)


def _spacing(points: NDArray[Any]) -> float:
    """Median distance to the nearest neighbour [m], of at most a thousand particles."""
    from scipy.spatial import cKDTree

    if len(points) < 2:
        return 0.02
    chosen = points[:: -(-len(points) // 1000)]
    return float(np.median(cKDTree(points).query(chosen, k=2)[0][:, 1])) or 0.02


def _outline(axes: Any, container: tuple[ArrayLike, ArrayLike]) -> None:
    from matplotlib.patches import Rectangle

    lower, upper = np.asarray(container, dtype=float)[:, :2]
    axes.add_patch(Rectangle(lower, *(upper - lower), fill=False, edgecolor=FAINT, linewidth=1.4))
