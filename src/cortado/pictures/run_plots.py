"""Plots of a run and of a certificate: how steps converged, what sensors have read, whether gradients are right."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from cortado.pictures.plots import DASHED, FAINT, INK, PALETTE, drawing, whole_numbers
from cortado.runs.sensors.readings import MeasuredColumn, Readings
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


def beside_measured(found: Mapping[str, Readings], measured: Sequence[MeasuredColumn], path: str | Path) -> Path:
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


if TYPE_CHECKING:
    from cortado.certificate import Certificate
    from cortado.certificate.horizon import Alignment, Horizon


def gradient_check(certificate: Certificate, path: str | Path) -> Path:
    """Four panels: central differences against forward mode, the adjoint's growth, the horizon, and the estimators.

    The horizon is that of the parameter with the shortest one. Where the adjoint is wrong, the last two panels are
    empty.
    """
    with drawing(path, 12.0, 8.4) as figure:
        (differences, growth), (horizon, estimators) = figure.subplots(2, 2)
        _differences(differences, certificate)
        _growth(growth, certificate)
        _horizon(horizon, min(certificate.horizons, key=lambda one: one.measured, default=None))
        _estimators(estimators, certificate.alignment)
        verdict = "right" if certificate.right else "WRONG"
        figure.suptitle(
            f"The adjoint is {verdict}; {certificate.particles} particles, {certificate.steps} steps", weight="bold"
        )
    return Path(path)


def _differences(axes: Any, certificate: Certificate) -> None:
    c = certificate.consistency
    if not len(c.steps):
        _empty(axes, f"reverse and forward mode differ by {c.disagreement:.1e}")
        return
    steps, misses = c.steps, c.misses
    shown = sorted({*np.linspace(0, len(c.sample_steps) - 1, 4).round().astype(int)})
    for colour, k in zip(PALETTE, shown, strict=False):
        axes.loglog(steps, np.maximum(misses[:, k], 1e-16), "o-", color=colour, label=str(c.sample_steps[k]))
    axes.axhline(max(c.disagreement, 1e-16), **DASHED, color=FAINT)
    axes.text(steps[-1], max(c.disagreement, 1e-16), "reverse mode", color=FAINT, va="bottom")
    axes.set(title="Central differences against forward mode", xlabel="step of the difference")
    axes.set_ylabel("relative distance")
    axes.legend(title="after step", loc="best", ncols=2, fontsize=9)


def _growth(axes: Any, certificate: Certificate) -> None:
    steps = np.arange(certificate.steps + 1)
    there = certificate.norms > 0.0
    axes.semilogy(steps[there], certificate.norms[there], color=PALETTE[0])
    if there.any():
        logs = np.log(certificate.norms[there])
        line = logs.mean() - certificate.growth * (steps[there] - steps[there].mean())
        axes.semilogy(steps[there], np.exp(line), **DASHED, color=PALETTE[6])
    axes.set(title=f"The adjoint grows by e^({certificate.growth:.3g}) a step, backwards", xlabel="step")
    axes.set_ylabel("norm of the adjoint of a state")


def _horizon(axes: Any, horizon: Horizon | None) -> None:
    if horizon is None:
        _empty(axes, "no horizon of a wrong adjoint")
        return
    for values, label, colour in ((horizon.exact, "exact", 6), (horizon.difference, "of a meaningful perturbation", 0)):
        size = np.abs(values)
        there = size > 0.0
        axes.semilogy(
            horizon.sample_steps[there], size[there], "o-", markersize=3.5, color=PALETTE[colour], label=label
        )
    for step, label, shade in ((horizon.measured, "measured", INK), (horizon.predicted, "predicted", FAINT)):
        if step is not None:
            axes.axvline(step, **DASHED, color=shade, label=f"{label} horizon: {step}")
    axes.set(title=f"Derivative of the loss along {horizon.parameter}", xlabel="step at which the run ends")
    axes.set_ylabel("size")
    axes.legend(loc="lower right", fontsize=9, frameon=True, framealpha=1.0, edgecolor="none")


def _estimators(axes: Any, alignment: Alignment | None) -> None:
    if alignment is None:
        _empty(axes, "no smoothed gradient to compare with")
        return
    for k, judged in enumerate(alignment.estimators):
        axes.barh(-k, judged.cosine, color=PALETTE[k], height=0.42)
        axes.text(-1.0, -k + 0.25, f"{judged.estimator}: {judged.cosine:.2f}, size x {judged.size:.2g}", va="bottom")
    axes.axvline(0.0, color=FAINT, linewidth=1.0)
    axes.set(title="Gradients against the smoothed one", xlabel="cosine", xlim=(-1.02, 1.02), yticks=[])
    axes.set_ylim(0.6 - len(alignment.estimators), 0.6)


def _empty(axes: Any, words: str) -> None:
    axes.set_axis_off()
    axes.text(0.5, 0.5, words, ha="center", color=FAINT, transform=axes.transAxes)
