"""Pictures of a run. Every function draws one PNG, 1200 pixels wide or more, and returns its path."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cortado.errors import InputError
from cortado.trajectory import Trajectory

PALETTE = ("#3d6b8e", "#c0763b", "#5b8a5a", "#8c5f7d", "#a89a4b", "#6b7a80", "#a8504f", "#4f8f8b")
"""Muted colours that stay apart in print and for most eyes."""
_INK, _FAINT = "#2b2a28", "#8a857c"
_FAR, _NEAR = "#c9d9e4", "#27506f"
_MOST_DRAWN = 150_000
_SHOWN_RANGE = (0.0, 99.5)
"""Percentiles at the ends of a colour scale, so that a few fast drops do not darken all the others."""
_DASHED: dict[str, Any] = {"linestyle": (0, (5, 4)), "linewidth": 1.2}
_STYLE = {
    "font.size": 11,
    "axes.titlesize": 12,
    "axes.edgecolor": _FAINT,
    "axes.labelcolor": _INK,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#ece8e1",
    "text.color": _INK,
    "xtick.color": _FAINT,
    "ytick.color": _FAINT,
    "xtick.labelcolor": _INK,
    "ytick.labelcolor": _INK,
    "lines.linewidth": 1.8,
    "legend.frameon": False,
}


def loss_curve(losses: ArrayLike, path: str | Path, *, title: str = "Loss", label: str = "loss") -> Path:
    """Losses (iterations,) over the iterations, on a logarithmic scale where any is positive."""
    values = np.asarray(losses, dtype=float)
    shown = np.isfinite(values)
    with _drawing(path) as figure:
        axes = figure.subplots()
        if np.any(values[shown] > 0.0):
            axes.set_yscale("log")
            shown &= values > 0.0
        iterations, values = np.flatnonzero(shown), values[shown]
        axes.plot(iterations, values, color=PALETTE[0], marker="o", markersize=4 if len(values) <= 40 else 0)
        labels = {0: {"xytext": (0, 9), "ha": "center"}, len(values) - 1: {"xytext": (9, 0), "va": "center"}}
        for k, place in labels.items() if len(values) else ():
            end = (iterations[k], values[k])
            axes.plot(*end, "o", color=PALETTE[0], markersize=7)
            axes.annotate(f"{values[k]:.3g}", end, textcoords="offset points", weight="bold", **place)
        axes.margins(x=0.06, y=0.14)
        axes.set(title=title, xlabel="iteration", ylabel=label)
        _whole_numbers(axes.xaxis)
    return Path(path)


def particles(
    positions: Sequence[ArrayLike],
    titles: Sequence[str],
    path: str | Path,
    *,
    colours: Sequence[ArrayLike] | None = None,
    colour_label: str = "",
    container: tuple[ArrayLike, ArrayLike] | None = None,
    dimension: int | None = None,
) -> Path:
    """Particle sets side by side, such as before, after and target.

    In 3-D one looks along the third axis: x to the right, y upwards, larger z nearer, nearer particles over
    farther ones. All panels share their scale. Above 150 000 particles, only every k-th is drawn.

    Args:
        positions: one (n, d) [m] for each panel.
        titles: one for each panel.
        colours: for each panel (n,) numbers, drawn with one scale (speed, density), or (n, 3) red, green,
            blue in [0, 1]; None shades by depth.
        colour_label: beside the scale, with its unit.
        container: lower and upper corner (d,) [m], outlined.
        dimension: 2 or 3; that of the first set when left out. In 2-D a third component is ignored.
    """
    sets = [np.asarray(one, dtype=float)[:, :dimension] for one in positions]
    tints = [None] * len(sets) if colours is None else [np.asarray(one, dtype=float) for one in colours]
    lower, upper = _bounds(sets, container)
    across, up = upper - lower
    panel = min(5.5 if len(sets) > 1 else 8.0, 11.0 / len(sets), 7.0 * across / up)  # width [inch]
    width, height = max(panel * len(sets) + 1.2, 8.0), max(panel * up / across + 1.2, 3.6)
    with _drawing(path, width, height) as figure:
        panels = figure.subplots(1, len(sets), sharex=True, sharey=True, squeeze=False)[0]
        scale = _ColourScale(sets, tints)
        for axes, points, tint, title in zip(panels, sets, tints, titles, strict=True):
            _draw_set(axes, points, scale.rgb(points, tint), title)
            if container is not None:
                _outline(axes, container)
            axes.set(xlim=(lower[0], upper[0]), ylim=(lower[1], upper[1]), aspect="equal", xlabel="x [m]")
            axes.grid(False)
        panels[0].set_ylabel("y [m]")
        if scale.mappable is not None:
            extend = "max" if scale.clips else "neither"
            style = {"shrink": 0.8, "aspect": 30, "pad": 0.015, "extend": extend}
            figure.colorbar(scale.mappable, ax=panels, label=colour_label, **style)
    return Path(path)


def parameters(
    history: ArrayLike,
    hidden: ArrayLike | None,
    path: str | Path,
    *,
    names: Sequence[str] | None = None,
    unit: str = "",
    title: str = "Recovered parameters",
) -> Path:
    """Every component of the parameters over the iterations (solid), against the hidden ones (dashed).

    Args:
        history: (iterations, k), or (iterations, ...) with k components in all.
        hidden: (k,) or the same shape as one iteration; None where nobody knows.
        names: k of them; by default x, y, z for up to three, numbers for more.
    """
    values = np.asarray(history, dtype=float)
    values = values.reshape(len(values), -1)
    count = values.shape[1]
    truth = None if hidden is None else np.broadcast_to(np.ravel(np.asarray(hidden, dtype=float)), (count,))
    labels = names or (["x", "y", "z"][:count] if count <= 3 else [str(k + 1) for k in range(count)])
    with _drawing(path) as figure:
        axes = figure.subplots()
        for k in range(count):
            colour, faint = PALETTE[k % len(PALETTE)], 1.0 if count <= len(PALETTE) else 0.55
            axes.plot(values[:, k], color=colour, alpha=faint, label=labels[k])
            if truth is not None:
                axes.axhline(truth[k], **_DASHED, color=colour, alpha=faint)
        axes.set(title=title, xlabel="iteration", ylabel=f"value [{unit}]" if unit else "value")
        axes.margins(x=0.02, y=0.08)
        _whole_numbers(axes.xaxis)
        if truth is not None:
            axes.plot([], [], **_DASHED, color=_FAINT, label="hidden")
        if count <= len(PALETTE):
            axes.legend(loc="center left", bbox_to_anchor=(1.01, 0.5))
    return Path(path)


def density_errors(trajectory: Trajectory, path: str | Path, *, tolerance: float | None = None) -> Path:
    """Density error [%] and pressure iterations of every step; steps that did not converge are marked.

    Args:
        tolerance: the solver's, drawn as a line [-].
    """
    steps = np.arange(1, len(trajectory.iterations) + 1)
    errors = 100.0 * trajectory.density_errors
    failed = ~trajectory.converged
    with _drawing(path, height=6.0) as figure:
        upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(2, 1))
        upper.plot(steps, errors, color=PALETTE[0], linewidth=1.4, label="density error")
        if failed.any():
            label = f"not converged ({failed.sum()} of {len(steps)} steps)"
            upper.plot(steps[failed], errors[failed], "o", color=PALETTE[6], markersize=3.5, label=label)
        if tolerance is not None:
            upper.axhline(100.0 * tolerance, **_DASHED, color=_FAINT, label="tolerance")
        upper.set_title("Density error and pressure iterations", pad=32)
        upper.set_ylabel("average density\nerror [%]")
        upper.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=3, borderaxespad=0.2)
        lower.step(steps, trajectory.iterations, color=PALETTE[1], where="mid", linewidth=1.2)
        lower.set(xlabel="step", ylabel="pressure\niterations", ylim=(0, None))
        _whole_numbers(lower.xaxis)
        _whole_numbers(lower.yaxis)
        figure.align_ylabels()
    return Path(path)


@contextmanager
def _drawing(path: str | Path, width: float = 9.0, height: float = 5.2) -> Iterator[Any]:
    """A figure of so many inches, saved under `path` in one go when the block ends well."""
    import matplotlib
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    path = Path(path)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    with matplotlib.rc_context(_STYLE):
        layout = ConstrainedLayoutEngine(w_pad=0.12, h_pad=0.12)
        figure = Figure(figsize=(width, height), dpi=150, layout=layout)
        FigureCanvasAgg(figure)
        yield figure
        try:
            figure.savefig(temporary, format="png")
            os.replace(temporary, path)
        except OSError as problem:
            raise InputError(f"The picture {path} cannot be written: {problem}.") from problem


def _whole_numbers(axis: Any) -> None:
    from matplotlib.ticker import MaxNLocator

    axis.set_major_locator(MaxNLocator(integer=True, steps=[1, 2, 5, 10]))


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

    def __init__(self, sets: list[NDArray[Any]], tints: Sequence[NDArray[Any] | None]) -> None:
        from matplotlib.cm import ScalarMappable
        from matplotlib.colors import LinearSegmentedColormap, Normalize

        numbers = [tint for tint in tints if tint is not None and tint.ndim == 1]
        depths = [_depth(points) for points in sets]
        values = np.concatenate(numbers or depths)
        values = values[np.isfinite(values)]
        low, high = np.percentile(values, _SHOWN_RANGE) if len(values) else (0.0, 1.0)
        self.clips = bool(len(values) and values.max() > high)
        flat = high - low <= 1e-12 * max(abs(high), abs(low))  # one value, or plane: the near colour
        shades = LinearSegmentedColormap.from_list("depth", [_FAR, _NEAR])
        self._map = ScalarMappable(Normalize(low - 1.0 if flat else low, high), "cividis" if numbers else shades)
        self.mappable = self._map if numbers else None

    def rgb(self, points: NDArray[Any], tint: NDArray[Any] | None) -> NDArray[Any]:
        """(n, 3) in [0, 1]"""
        if tint is not None and tint.ndim == 2:
            return np.clip(tint, 0.0, 1.0)
        return self._map.to_rgba(_depth(points) if tint is None else tint)[:, :3]


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
    axes.add_patch(Rectangle(lower, *(upper - lower), fill=False, edgecolor=_FAINT, linewidth=1.4))
