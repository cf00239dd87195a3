"""Figures of a run: how its steps converged, and what its sensors have read."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from cortado.pictures.plots import DASHED, FAINT, PALETTE, drawing, whole_numbers
from cortado.runs.sensors.log import Readings
from cortado.runs.sensors.measured import Measured
from cortado.runs.trajectory import Trajectory


def density_errors(trajectory: Trajectory, path: str | Path, *, tolerance: float | None = None) -> Path:
    """Density error [%] and iterations, of each loop of the solver, of every step; steps that did not converge are
    marked.

    Args:
        tolerance: the solver's, drawn as a line [-].
    """
    steps = np.arange(1, len(trajectory.converged) + 1)
    loops = {name: column for name, column in trajectory.diagnostics.items() if column.dtype.kind == "i"}
    errors = 100.0 * trajectory.density_errors
    failed = ~trajectory.converged
    with drawing(path, height=6.0) as figure:
        upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(2, 1))
        upper.plot(steps, errors, color=PALETTE[0], linewidth=1.4, label="density error")
        if failed.any():
            label = f"not converged ({failed.sum()} of {len(steps)} steps)"
            upper.plot(steps[failed], errors[failed], "o", color=PALETTE[6], markersize=3.5, label=label)
        if tolerance is not None:
            upper.axhline(100.0 * tolerance, **DASHED, color=FAINT, label="tolerance")
        upper.set_title("Density error and pressure iterations", pad=32)
        upper.set_ylabel("average density\nerror [%]")
        upper.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=3, borderaxespad=0.2)
        for number, (name, iterations) in enumerate(loops.items(), 1):
            style = {"color": PALETTE[number % len(PALETTE)], "label": name.replace("_", " ")}
            lower.step(steps, iterations, where="mid", linewidth=1.2, **style)
        if len(loops) > 1:
            lower.legend(loc="center left", bbox_to_anchor=(1.01, 0.5))
        lower.set(xlabel="step", ylabel="pressure\niterations", ylim=(0, None))
        whole_numbers(lower.xaxis)
        whole_numbers(lower.yaxis)
        figure.align_ylabels()
    return Path(path)


def readings(found: Mapping[str, Readings], path: str | Path) -> Path:
    """A curve for each number of each sensor, those of one unit in one panel."""
    each = [(name, own, column, unit) for name, own in found.items() for column, unit in own.units.items()]
    lines = [(f"{name} {column}", unit, own, column) for name, own, column, unit in each]
    units = list(dict.fromkeys(unit for _, unit, _, _ in lines))
    with drawing(path, height=1.5 + 2.5 * len(units)) as figure:
        panels = figure.subplots(len(units), 1, sharex=True, squeeze=False)[:, 0]
        for panel, unit in zip(panels, units, strict=True):
            shown = [line for line in lines if line[1] == unit]
            for k, (label, _, own, column) in enumerate(shown):
                label = label.replace("_", " ")
                panel.plot(own.times, own[column], color=PALETTE[k % len(PALETTE)], linewidth=1.3, label=label)
            panel.set_ylabel(f"[{unit}]")
            panel.legend(loc="center left", bbox_to_anchor=(1.01, 0.5))
        panels[-1].set_xlabel("time [s]")
    return Path(path)


def beside_measured(found: Mapping[str, Readings], measured: Sequence[Measured], path: str | Path) -> Path:
    """A panel for each number that was measured: its points, the curve of the sensor, and the error in the title."""
    with drawing(path, height=1.5 + 2.5 * len(measured)) as figure:
        panels = figure.subplots(len(measured), 1, sharex=True, squeeze=False)[:, 0]
        for panel, one in zip(panels, measured, strict=True):
            name, _, column = one.name.rpartition(".")
            panel.plot(found[name].times, found[name][column], color=PALETTE[0], linewidth=1.3, label="simulated")
            panel.plot(one.times, one.values, "o", color=PALETTE[6], markersize=3.5, label="measured")
            error = f"apart by {one.errors['root_mean_square']:.3g} {one.unit} (root mean square)"
            panel.set_title(f"{name} {column}: {error}".replace("_", " "))
            panel.set_ylabel(f"[{one.unit}]")
            panel.legend(loc="center left", bbox_to_anchor=(1.01, 0.5))
        panels[-1].set_xlabel("time [s]")
    return Path(path)
