"""The experiment of Lyapunov exponents: its picture and its verdict; `lyapunov_exponents` measures."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from cortado.pictures.plots import INK, PALETTE
from experiments.canvas import blank
from experiments.estimates import Estimate, Line
from experiments.experiment import ExperimentType
from experiments.lyapunov_exponents import LyapunovSettings, measure, window_steps
from experiments.tables import Table

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LOGARITHMIC = 20.0
"""Ratio of the greatest to the least x of a panel from which on its axis is logarithmic."""
SAME = 0.2
"""Relative difference up to which two methods count as equal."""


WAYS: dict[str, dict[str, Any]] = {
    "tangent": {"marker": "o", "linestyle": "-"},
    "pair": {"marker": "s", "markerfacecolor": "none", "linestyle": ":"},
}


def draw(table: Table, settings: LyapunovSettings) -> Figure:
    """A panel for each setting that was varied, and the spectrum."""
    figure = blank(16.0, 8.6)
    figure.suptitle(settings.title)
    panels = table.values("panel")
    columns = len(panels) // 2 + 1
    *grid, legend = figure.subplots(2, columns, squeeze=False).ravel()
    for axes, panel in zip(grid, panels, strict=False):
        rows = table.where(panel=panel)
        axes.set_title(panel)
        if panel == "spectrum":
            found = rows.where(way="tangent", window="all")
            axes.plot(found["index"] + 1, found["rate"], "o-", color=INK, markersize=3.5, linewidth=1.0)
        elif np.isnan(rows["x"]).any():
            _bars(axes, rows)
        else:
            _curves(axes, rows)
        axes.axhline(0.0, color=INK, linewidth=0.8)
        axes.set_ylim(None, 1.12 * axes.get_ylim()[1])
    for axes in grid[::columns]:
        axes.set_ylabel("Lyapunov exponent [1 / step]")
    for axes in grid[len(panels) :]:
        axes.set_visible(False)
    for k, (way, style) in enumerate(WAYS.items()):
        legend.plot([], [], color=PALETTE[k], linewidth=9, label=f"{way}s, bars")
        legend.plot([], [], color=INK, label=f"{way}s, curves", **style)
    legend.set_axis_off()
    legend.legend(loc="center")
    return figure


def _curves(axes: Any, rows: Table) -> None:
    labels = rows.values("label")
    for k, label in enumerate(labels):
        for way, style in WAYS.items():
            found = [(x, *_numbers(one)) for (x,), one in _leading(rows.where(label=label), way).groups("x")]
            x, values, errors = np.array(sorted(found)).T
            name = label if way == "tangent" else None
            shape = {"markersize": 4.5, "linewidth": 1.4, "capsize": 2.5, "color": PALETTE[k], **style}
            axes.errorbar(x, values, errors, label=name, **shape)
    if rows["x"].min() > 0.0 and rows["x"].max() > LOGARITHMIC * rows["x"].min():
        axes.set_xscale("log")
    if len(labels) > 1:
        axes.legend(fontsize=9)


def _bars(axes: Any, rows: Table) -> None:
    labels = rows.values("label")
    for k, (way, shift) in enumerate(zip(WAYS, (-0.19, 0.19), strict=True)):
        found = [_numbers(_leading(rows.where(label=label), way)) for label in labels]
        values, errors = np.array(found).T
        axes.bar(np.arange(len(labels)) + shift, values, 0.36, yerr=errors, color=PALETTE[k], capsize=2.5)
    axes.set_xticks(range(len(labels)), labels, fontsize=9, rotation=25, ha="right")


def verdict(table: Table, settings: LyapunovSettings) -> list[str]:
    """The exponent, whether two methods agree on it, and how it depends on the settings."""
    cases = list(_cases(table))
    base = next(rows for rows in cases if rows["label"][0] == "base")
    tangents, pairs = _estimate(base, "tangent"), _estimate(base, "pair")
    halves = [_estimate(base, "tangent", f"{half} half") for half in ("first", "second")]
    step = base["rate"][0] / base["rate_in_time"][0]
    sentences = [
        f"The scene's greatest exponent is {tangents} a step ({tangents.value / step:.0f} 1/s) from tangents, and "
        f"{pairs} from pairs of runs; in the halves of the window {halves[0]} and {halves[1]}."
    ]
    ratios = [
        _estimate(rows, "pair").value / _estimate(rows, "tangent").value
        for rows in cases
        if np.isfinite(_numbers(_leading(rows, "pair"))[0]) and _estimate(rows, "tangent").value > 0.003
    ]
    ratio = Estimate.of(ratios)
    agreeing = sum(abs(ratio - 1.0) <= SAME for ratio in ratios)
    sentences.append(
        f"Over {len(ratios)} variants the exponent from pairs is {ratio} times that from tangents, within "
        f"{SAME:.0%} in {agreeing} of them."
    )
    first, last = window_steps(settings, settings.scene)
    sentences += [*_powers(table), *_parts(table, tangents)]
    sentences.append(f"Growth in proportion to time would show as {np.log(last / first) / (last - first):.4f} a step.")
    spectrum = table.where(panel="spectrum", way="tangent", window="all")["rate"]
    sentences.append(
        f"Of the first {len(spectrum)} exponents {int((spectrum > 0.0).sum())} are positive, the last of them "
        f"{spectrum[-1] / spectrum[0]:.0%} of the first."
    )
    holds = tangents.value > 3.0 * tangents.error and agreeing > len(ratios) / 2
    sentences.append(
        f"Chaos: {'true' if holds else 'not confirmed'}: the exact derivative grows by {tangents} a step, at which "
        f"neighbouring runs diverge of which no derivative was taken ({pairs})."
    )
    return sentences


def _powers(table: Table) -> list[str]:
    """How the exponent depends on settings that are positive numbers."""
    sentences = []
    for (panel, label), rows in table.chosen(np.nan_to_num(table["x"]) > 0.0).groups("panel", "label"):
        found = [(x, _estimate(one, "tangent").value, _in_time(one)) for (x,), one in rows.groups("x")]
        if len(found) < 3 or min(rate for _, rate, _ in found) <= 0.0:
            continue
        x, rates, in_time = np.array(sorted(found)).T
        power = Line.through(np.log(x), np.log(in_time)).slope
        sentences.append(
            f"{panel[0].upper()}{panel[1:]}{'' if label == 'base' else f' ({label})'} from {x[0]:g} to {x[-1]:g}: "
            f"{rates[0]:.3f} to {rates[-1]:.3f} a step; in time it goes as the power {power}."
        )
    return sentences


def _parts(table: Table, base: Estimate) -> list[str]:
    """The exponents of the variants that are not numbers."""
    return [
        f"{label[0].upper()}{label[1:]}: {_estimate(rows, 'tangent')} a step from tangents"
        + (f", {_estimate(rows, 'pair')} from pairs" if len(_finite(_leading(rows, "pair"))) else "")
        + f" ({_estimate(rows, 'tangent').value / base.value:.0%} of the scene's)."
        for (panel, label), rows in table.chosen(np.isnan(table["x"])).groups("panel", "label")
        if panel != "spectrum" and label != "base"
    ]


def _cases(table: Table) -> Iterator[Table]:
    """The rows of every variant, once where it is in several panels."""
    varied = table.chosen(table["panel"] != "spectrum")
    numbers = varied.columns | {"x": np.nan_to_num(varied["x"], nan=-1.0)}  # nan is not itself
    found = {rows["rate"].tobytes(): rows for _, rows in Table(numbers).groups("panel", "label", "x")}
    yield from found.values()


def _leading(rows: Table, way: str, window: str = "all") -> Table:
    return rows.where(way=way, index=0, window=window)


def _finite(rows: Table) -> np.ndarray:
    return rows["rate"][np.isfinite(rows["rate"])]


def _estimate(rows: Table, way: str, window: str = "all") -> Estimate:
    return Estimate.of(_finite(_leading(rows, way, window)))


def _in_time(rows: Table) -> float:
    return float(_leading(rows, "tangent")["rate_in_time"].mean())


def _numbers(rows: Table) -> tuple[float, float]:
    """The exponent and its error; nan where it was not measured."""
    found = _finite(rows)
    estimate = Estimate.of(found) if len(found) else Estimate(np.nan, np.nan)
    return estimate.value, np.nan_to_num(estimate.error) if np.isfinite(estimate.value) else np.nan


LYAPUNOV = ExperimentType("lyapunov", LyapunovSettings, measure, draw, verdict)
