"""Rayleigh-Taylor against theory: ``python validation/rayleigh_taylor.py --out runs/validation`` (5 CPU minutes).

Writes `rayleigh_taylor_growth.png` (amplitudes, and growth rates over what the lattice of each kernel adds) and
`rayleigh_taylor.png` (the instability at four times), and prints the growth rates.
"""

import argparse
import sys
from pathlib import Path

import matplotlib
import measured_rows as rows
import numpy as np

matplotlib.use("Agg")
import matplotlib.pyplot as plt

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
import test_validation_rayleigh_taylor as validation

KERNELS = (
    ("cubic_spline", (2.0, 2.5, 3.0)),
    ("wendland_c2", (2.6, 3.0, 3.5)),
    ("wendland_c4", (3.0, 3.5, 4.0)),
)
TIMES = (0.0, 2.0, 3.0, 4.4)
"""Of the pictures [s]."""
ROWS = ("rayleigh_taylor",)
"""Of `measured.csv`, which `main` prints, and keeps with ``--write``."""


def reported(label: str, growth: validation.Growth) -> validation.Growth:
    """The same, printed."""
    mode = growth.mode
    against = 100.0 * (growth.rate / mode.closed_form - 1.0)
    print(
        f"{label}: {growth.rate:.4f} 1/s, exact {mode.growth:.4f} ({100.0 * growth.error:+.1f} %), "
        f"closed form {mode.closed_form:.4f} ({against:+.1f} %), inviscid {mode.inviscid:.4f}",
        flush=True,
    )
    return growth


def growth(folder: Path) -> rows.Figures:
    """Amplitudes by resolution, wave number and viscosity; rates by kernel."""
    figure, axes = plt.subplots(1, 3, figsize=(15, 5), layout="constrained")
    cases = (
        (axes[0], 1, 0.1, (16, 32, 48)),
        (axes[1], 2, 0.1, (32, 48)),
        (axes[1], 1, 0.02, (32,)),
        (axes[1], 1, 0.3, (32,)),
    )
    errors = []
    for axis, waves, damping, resolutions in cases:
        for across in resolutions:
            label = f"k = {waves} x 2 pi, nu k² = {damping:g} of the rate, {across // waves} per wave"
            result = reported(label, validation.rayleigh_taylor(across, waves, damping=damping))
            errors += [100.0 * result.error] if axis is axes[0] else []
            time = result.times * result.mode.inviscid
            axis.semilogy(time, result.amplitudes, label=f"{label} ({100.0 * result.error:+.1f} %)")
        theory = result.amplitudes[0] * np.exp(result.mode.growth * result.times)
        axis.semilogy(time, theory, "k--", lw=0.8)
    for axis in axes[:2]:
        axis.axhspan(*validation.WINDOW, color="0.93")
        axis.set(xlabel="t sqrt(At g k)", ylabel="amplitude / wavelength", title="dashed: theory; grey: the window")
        axis.legend(fontsize="small", loc="lower right")
    kernels(axes[2])
    figure.savefig(folder / "rayleigh_taylor_growth.png", dpi=100)
    plt.close(figure)
    print(folder / "rayleigh_taylor_growth.png")
    return {"rayleigh_taylor": errors}


def kernels(axis: plt.Axes) -> None:
    """Rates over the part of gravity's push that the lattice takes."""
    for (kernel, supports), mark in zip(KERNELS, "sD^", strict=True):
        taken = [validation.lattice_correction(kernel, support, 0.5) for support in supports]
        results = [
            reported(
                f"{kernel} {support}, lattice takes {part:.2f}",
                validation.rayleigh_taylor(24, 1, 0.5, 0.1, kernel, support),
            )
            for support, part in zip(supports, taken, strict=True)
        ]
        axis.plot(taken, [1.0 + result.error for result in results], mark, label=kernel)
        for part, support, result in zip(taken, supports, results, strict=True):
            side = "right" if mark == "^" else "left"
            axis.annotate(f"  {support}  ", (part, 1.0 + result.error), ha=side, va="center", fontsize="small")
    push = 1.0 - np.linspace(-4.0, 1.0, 200)
    axis.plot(1.0 - push, (np.sqrt(push + 0.01) - 0.1) / (np.sqrt(1.01) - 0.1), "k--", label="closed form, less push")
    axis.axhspan(0.75, 1.25, color="0.93")
    axis.set(
        xlabel="part of gravity's push that the lattice takes, to first order",
        ylabel="growth rate / exact",
        title="24 particles a wave; supports beside the marks",
    )
    axis.legend()


def pictures(folder: Path) -> None:
    """The instability at four times, to the mushroom."""
    across, depth = 48, 1.0
    result = validation.rayleigh_taylor(across, depth=depth, damping=0.02, pictures=TIMES, until=TIMES[-1])
    figure, axes = plt.subplots(1, len(TIMES), figsize=(2.4 * len(TIMES), 5.2), layout="constrained", sharey=True)
    for axis, time in zip(axes, TIMES, strict=True):
        x, y = result.pictures[time].T
        for phase, colour, name in (
            (result.heavy, "#1b3a57", "heavy, 1800 kg/m³"),
            (~result.heavy, "#e8a33d", "light, 1000 kg/m³"),
        ):
            axis.scatter(x[phase] % 1.0, y[phase], s=7, color=colour, linewidths=0, label=name)
        axis.set(aspect="equal", xlim=(0.0, 1.0), ylim=(-depth, depth), title=f"t = {time:g} s", xlabel="x [m]")
    axes[0].set_ylabel("y [m]")
    figure.legend(
        *axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=2, markerscale=3, frameon=False
    )
    figure.savefig(folder / "rayleigh_taylor.png", dpi=150)
    plt.close(figure)
    print(folder / "rayleigh_taylor.png")


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("runs/validation"), help="where the PNGs go")
    rows.Printer.add_to(parser)
    given = parser.parse_args()
    folder = given.out
    folder.mkdir(parents=True, exist_ok=True)
    pictures(folder)
    rows.Printer(given).rows(growth(folder))


if __name__ == "__main__":
    main()
