"""The picture of a certificate: whether the adjoint is right, and up to which step it is useful."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from cortado.pictures.plots import DASHED, FAINT, INK, PALETTE, drawing

if TYPE_CHECKING:
    from cortado.certificate import Certificate
    from cortado.certificate.alignment import Alignment
    from cortado.certificate.horizon import Horizon


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
