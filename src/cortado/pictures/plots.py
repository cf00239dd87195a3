"""Plots with matplotlib in a common style."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from io import BytesIO
from math import ceil, sqrt
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cortado.discretise.shapes import Points
from cortado.errors import InputError
from cortado.files.disk import write_atomically
from cortado.files.image_encoding import srgb_bytes, to_srgb

PALETTE = ("#3d6b8e", "#c0763b", "#5b8a5a", "#8c5f7d", "#a89a4b", "#6b7a80", "#a8504f", "#4f8f8b")
"""Muted colours that most colour-blind readers can distinguish."""
INK, FAINT = "#2b2a28", "#8a857c"
DASHED: dict[str, Any] = {"linestyle": (0, (5, 4)), "linewidth": 1.2}
STYLE: dict[str, Any] = {
    **dict.fromkeys(("axes.labelcolor", "text.color", "xtick.labelcolor", "ytick.labelcolor"), INK),
    **dict.fromkeys(("axes.edgecolor", "xtick.color", "ytick.color"), FAINT),
    **dict.fromkeys(("axes.spines.top", "axes.spines.right", "legend.frameon"), False),
    **dict.fromkeys(("axes.grid", "axes.axisbelow"), True),
    **{"font.size": 11, "axes.titlesize": 12, "lines.linewidth": 1.8, "grid.color": "#ece8e1"},
}


@contextmanager
def drawing(path: str | Path, width: float = 9.0, height: float = 5.2) -> Iterator[Any]:
    """Open a figure of ``width`` and ``height`` [inch], which is saved if the ``with`` block ends without an error."""
    import matplotlib
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    content = BytesIO()
    with matplotlib.rc_context(STYLE):
        layout = ConstrainedLayoutEngine(w_pad=0.12, h_pad=0.12)
        figure = Figure(figsize=(width, height), dpi=150, layout=layout)
        FigureCanvasAgg(figure)
        yield figure
        figure.savefig(content, format="png")
    write_atomically(Path(path), content.getvalue())


def whole_numbers(axis: Any) -> None:
    from matplotlib.ticker import MaxNLocator

    axis.set_major_locator(MaxNLocator(integer=True, steps=[1, 2, 5, 10]))


def loss_curve(losses: ArrayLike, path: str | Path, *, label: str = "loss") -> Path:
    """Plot losses. The axis of the losses is logarithmic if any loss is positive."""
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
        axes.set(title="Loss", xlabel="evaluation", ylabel=label)
        whole_numbers(axes.xaxis)
    return Path(path)


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
    """Plot ``found`` (k, c) against ``x`` (k,). Curves ``true`` and ``start`` are (k, c), or (c,) if constant."""
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


def images(images: Iterable[ArrayLike], titles: Sequence[str], path: str | Path) -> Path:
    """Plot images of linear colours (rows, columns, 3). More than four images form a grid."""
    shown = [to_srgb(image) for image in images]
    if not shown or len(shown) != len(titles):
        raise InputError(f"There are {len(shown)} images and {len(titles)} titles; give one title for each image.")
    across = len(shown) if len(shown) <= 4 else ceil(sqrt(len(shown)))
    down = -(-len(shown) // across)
    tallness = max(image.shape[0] / image.shape[1] for image in shown)
    panel = min(6.0, 11.0 / across, 7.0 / tallness)  # width [inch]
    height = down * (panel * tallness + 0.35) + 0.25
    with drawing(path, max(across * (panel + 0.1), 8.0), max(height, 2.4)) as figure:
        panels = figure.subplots(down, across, squeeze=False).ravel()
        for axes in panels:
            axes.set_axis_off()
        for axes, image, name in zip(panels, shown, titles, strict=False):
            axes.imshow(image)
            axes.set_title(name)
    return Path(path)


def particles(
    positions: Sequence[ArrayLike],
    titles: Sequence[str],
    path: str | Path,
    *,
    colours: Sequence[ArrayLike] | None = None,
    colour_label: str = "",
    container: tuple[ArrayLike, ArrayLike] | None = None,
    lines: Sequence[ArrayLike] | None = None,
) -> Path:
    """Plot particle sets (n, d) [m] side by side. In 3-D the camera looks along the z axis, and y points up.
    ``colours`` are linear colours (n, 3), or numbers (n,) on a colour scale of all panels. Without colours, particles
    are shaded by depth. ``container`` has two corners (d,) [m]. ``lines`` (k, 2, d) [m] of each panel are end points of
    lines. Above 150 000 particles, only every k-th particle is drawn."""
    from matplotlib.collections import LineCollection
    from matplotlib.patches import Rectangle

    sets = [np.asarray(one, dtype=float) for one in positions]
    values = [None] * len(sets) if colours is None else [np.asarray(one, dtype=float) for one in colours]
    ends = [np.asarray(one, dtype=float)[:, :, :2] for one in lines or [np.zeros((0, 2, 2))] * len(sets)]
    lower, upper = _bounds([*sets, *(one.reshape(-1, 2) for one in ends)], container)
    across, up = upper - lower
    panel = min(5.5 if len(sets) > 1 else 8.0, 11.0 / len(sets), 7.0 * across / up)  # width [inch]
    width, height = max(panel * len(sets) + 1.2, 8.0), max(panel * up / across + 1.2, 3.6)
    with drawing(path, width, height) as figure:
        panels = figure.subplots(1, len(sets), sharex=True, sharey=True, squeeze=False)[0]
        shades, mappable, extend = _colour_scale(sets, values)
        for axes, points, own, title, drawn in zip(panels, sets, shades, titles, ends, strict=True):
            _draw_set(axes, points, own, title)
            if container is not None:
                low, high = np.asarray(container, dtype=float)[:, :2]
                axes.add_patch(Rectangle(low, *(high - low), fill=False, edgecolor=FAINT, linewidth=1.4))
            if len(drawn):
                axes.add_collection(LineCollection(list(drawn), colors=INK, linewidths=1.2))
            axes.set(xlim=(lower[0], upper[0]), ylim=(lower[1], upper[1]), aspect="equal", xlabel="x [m]")
            axes.grid(False)
        panels[0].set_ylabel("y [m]")
        if mappable is not None:
            style = {"shrink": 0.8, "aspect": 30, "pad": 0.015, "extend": extend}
            figure.colorbar(mappable, ax=panels, label=colour_label, **style)
    return Path(path)


def _bounds(sets: list[Points], container: tuple[ArrayLike, ArrayLike] | None) -> tuple[Points, Points]:
    corners = [points[np.isfinite(points).all(axis=1), :2] for points in sets]
    if container is not None:
        corners.append(np.asarray(container, dtype=float)[:, :2])
    everything = np.concatenate([*corners, np.zeros((0, 2))])
    if not len(everything):
        return np.zeros(2), np.ones(2)
    lower, upper = everything.min(axis=0), everything.max(axis=0)
    margin = 0.04 * max(float((upper - lower).max()), 1e-9)
    return lower - margin, upper + margin


def _colour_scale(sets: list[Points], colours: Sequence[NDArray | None]) -> tuple[list[NDArray], Any, str]:
    """Return colours (n, 3) of each panel, the colour bar's scale or None, and "max" if values exceed the scale."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import LinearSegmentedColormap, Normalize

    numbers = [one for one in colours if one is not None and one.ndim == 1]
    shown = [_depth(points) if one is None else one for points, one in zip(sets, colours, strict=True)]
    values = np.concatenate(numbers or [_depth(points) for points in sets])
    values = values[np.isfinite(values)]
    low, high = np.percentile(values, (0.0, 99.5)) if len(values) else (0.0, 1.0)
    flat = high - low <= 1e-12 * max(abs(high), abs(low))  # one value, or plane: the near colour
    by_depth = LinearSegmentedColormap.from_list("depth", ["#c9d9e4", "#27506f"])
    scale = ScalarMappable(Normalize(low - 1.0 if flat else low, high), "viridis" if numbers else by_depth)
    shades = [srgb_bytes(one) / 255.0 if one.ndim == 2 else scale.to_rgba(one)[:, :3] for one in shown]
    return shades, scale if numbers else None, "max" if len(values) and values.max() > high else "neither"


def _depth(points: NDArray[Any]) -> NDArray[Any]:
    return points[:, 2] if points.shape[1] == 3 else np.zeros(len(points))


def _draw_set(axes: Any, points: NDArray[Any], colours: NDArray[Any], title: str) -> None:
    from matplotlib.collections import EllipseCollection

    kept = np.flatnonzero(np.isfinite(points).all(axis=1))
    notes = [f"{len(points) - len(kept)} not finite"] if len(kept) < len(points) else []
    every = -(-len(kept) // 150_000) or 1
    if every > 1:
        notes.append(f"one in {every} drawn")
    axes.set_title("\n".join([title, *notes]))
    kept = kept[::every]
    kept = kept[np.argsort(_depth(points)[kept], kind="stable")]
    size, fill = np.full(len(kept), spacing_of(points[kept])), colours[kept]
    place = {"offsets": points[kept, :2], "offset_transform": axes.transData, "units": "xy"}
    discs = EllipseCollection(size, size, 0.0 * size, **place, facecolors=fill, edgecolors=0.82 * fill, linewidths=0.25)
    axes.add_collection(discs)


def spacing_of(points: NDArray[Any], otherwise: float = 0.02) -> float:
    """Return the median distance to the nearest neighbour [m], or ``otherwise`` for a single point."""
    from scipy.spatial import cKDTree

    if len(points) < 2:
        return otherwise
    chosen = points[:: -(-len(points) // 1000)]
    return float(np.median(cKDTree(points).query(chosen, k=2)[0][:, 1])) or otherwise
