"""Figures and the HTML page of a fit: fitted numbers, residuals, profiles, and videos beside the simulation."""

from collections.abc import Sequence
from html import escape
from pathlib import Path

import numpy as np

from cortado.optimisation.fitting.fit import NOISE_ALONE, Fit, Profile, unit_of, with_error
from cortado.optimisation.fitting.observations import Video
from cortado.pictures.pages import Figures, picture, table
from cortado.pictures.plots import DASHED, FAINT, INK, PALETTE, drawing, images

AGREE = 0.2
"""Brightness of pixels where two pictures agree."""


def residual_figure(fitted: Fit, path: Path) -> Figures:
    with drawing(path, height=1.4 + 2.3 * len(fitted.parts)) as figure:
        rows = figure.subplots(len(fitted.parts), 1, squeeze=False)[:, 0]
        for axes, part in zip(rows, fitted.parts, strict=True):
            times, r = part.part.observation.times, part.residuals
            if r.shape[1] <= 4:
                for k, series in enumerate(r.T):
                    axes.plot(times, series, marker="o", markersize=3, color=PALETTE[k % len(PALETTE)])
            else:
                size = np.sqrt((r**2).mean(axis=1))
                axes.plot(times, size, marker="o", color=PALETTE[0], label="root mean square")
                axes.plot(times, r.mean(axis=1), marker="o", color=PALETTE[1], label="mean")
                axes.legend(loc="upper left")
            axes.axhline(0.0, color=FAINT, linewidth=1.0)
            axes.set(title=part.label, ylabel=f"residual [{part.part.observation.unit}]")
        rows[-1].set_xlabel("time [s]")
    words = "Residuals, predicted minus measured. Noise scatters around 0; residuals on one side are model errors."
    return [(words, path)]


def profile_figure(profiles: Sequence[Profile], path: Path) -> Figures:
    if not profiles:
        return []
    columns = min(len(profiles), 3)
    rows = -(-len(profiles) // columns)
    with drawing(path, width=3.6 * columns + 1.0, height=0.6 + 3.0 * rows) as figure:
        panels = figure.subplots(rows, columns, squeeze=False).ravel()
        for axes, one in zip(panels, profiles, strict=False):
            axes.plot(one.values, one.expected, **DASHED, color=INK, label="of a linear model")
            axes.plot(one.values, one.deviance, marker="o", color=PALETTE[0], label="found")
            axes.axhline(4.0, color=FAINT, linewidth=1.0)
            unit = unit_of(one.label)
            axes.set(xlabel=f"{one.label.replace('_', ' ')}{f' [{unit}]' if unit else ''}", ylim=(-0.3, 8.0))
        for axes in panels[len(profiles) :]:
            axes.set_visible(False)
        panels[0].set_ylabel("squared standard errors")
        panels[0].legend(loc="upper center")
    words = "Growth of the sum of squares from its minimum. The faint line is at two standard errors."
    return [(words, path)]


def video_figures(fitted: Fit, folder: Path) -> Figures:
    found: Figures = []
    for number, part in enumerate(fitted.parts):
        video = part.part.observation
        if isinstance(video, Video):
            pictures, titles = list[np.ndarray](), list[str]()
            for k in (0, len(video.times) // 2, -1):
                measured, off = video.measured[k], part.residuals[k]
                shown = {"measured": measured, "found": measured + off, "found less measured": AGREE + off}
                for title, light in shown.items():
                    picture = np.ones(video.renderer.shape)
                    picture[video.mask] = np.clip(np.nan_to_num(light), 0.0, 1.0).reshape(-1, 3)
                    pictures.append(picture)
                    titles.append(f"{title}, {video.times[k]:.3g} s")
            path = images(pictures, titles, folder / f"measured_{number}.png")
            words = "In the right picture, grey pixels agree, and light pixels are too bright in the simulation."
            found.append((f"Frames of {part.label}. {words}", path))
    return found


def fit_page(fitted: Fit) -> str:
    rows = []
    for one in fitted.numbers():
        label, unit = one.label.replace("_", " "), unit_of(one.label) or "-"
        start, lower, upper = (f"{number:.4g}" for number in (one.start, one.lower, one.upper))
        rows.append((label, unit, start, with_error(one.value, one.error), lower, upper))
    words = "".join(f"<p>{escape(sentence)}</p>" for sentence in (*fitted.cautions, NOISE_ALONE))
    head = ("parameter", "unit", "start", "found", "95 %, from", "to")
    return table(head, rows) + words + picture(fitted, lambda path: residual_figure(fitted, path))
