"""How viscous is a fluid? ``python validation/viscosity.py OUT`` writes figures as PNGs: waves of shear, bodies,
layers and channels, which `tests/test_validation_flows.py` compares. It prints the rows of `validation/README.md` that
they give, which ``--write`` keeps (see `measured_rows.py`)."""

import argparse
import sys
import warnings
from pathlib import Path

import matplotlib
import measured_rows as rows
import numpy as np

matplotlib.use("Agg")
import matplotlib.pyplot as plt

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
import test_validation_flows as validation
from cortado.errors import CortadoWarning
from viscous_flows import Channel, turning
from viscous_layers import by_engine, by_hand, exact, profile, profile_error, two_layers

FORMS = {"stress": "C0", "pairwise": "C3"}
ROWS = ("shear_lattice", "shear_stirred", "turning", "layers_of_shear", "channel")
"""Of `measured.csv`, which `main` prints."""


def waves(folder: Path) -> rows.Figures:
    """Effective viscosity over the particles across, in four directions."""
    figures: rows.Figures = {}
    figure, axes = plt.subplots(1, 2, figsize=(11, 4.5), layout="constrained", sharey=True)
    counts = (20, 40, 80)
    for axis, disorder, title in (axes[0], 0.0, "lattice"), (axes[1], None, "stirred"):
        for form, colour in FORMS.items():
            found = np.array([validation.errors_of_waves(n, "cubic_spline", disorder, form=form) for n in counts])
            if form == "stress":
                figures[f"shear_{title}"] = (1.0 + found[1]).tolist()
            for number, (one, mark) in enumerate(zip(found.T, "osD^", strict=True)):
                axis.semilogx(counts, 1.0 + one, f"{colour}{mark}-", label=None if number else form)
        axis.axhspan(0.97, 1.03, color="0.9")
        axis.set(xlabel="particles in a side of the box", title=title, xticks=counts, xticklabels=counts)
        axis.minorticks_off()
    axes[0].set_ylabel("effective over asked viscosity")
    axes[1].legend()
    _save(figure, folder / "viscosity_waves.png")
    return figures


def bodies(folder: Path) -> rows.Figures:
    """Angular momentum of a disc and a ball over time."""
    changes = []
    figure, axes = plt.subplots(1, 2, figsize=(11, 4.5), layout="constrained", sharey=True)
    for axis, dimension, across in (axes[0], 2, 24), (axes[1], 3, 10):
        for (form, colour), style in zip(FORMS.items(), ("-", "--"), strict=True):
            momentum = turning(dimension, across, form)
            changes += [float(np.abs(momentum - 1.0).max())] if form == "stress" else []
            axis.plot(np.linspace(0.0, 2.0, 11), momentum, colour + style, label=form)
        axis.set(xlabel="t [s]", title=("a disc", "a ball")[dimension - 2] + " that turns alone")
    axes[0].set_ylabel("angular momentum over the first")
    axes[0].legend()
    _save(figure, folder / "viscosity_turning.png")
    return {"turning": [max(changes)]}


def layers(folder: Path) -> rows.Figures:
    """Profiles of two fluids that shear each other."""
    errors = []
    figure, axes = plt.subplots(1, 2, figsize=(11, 4.5), layout="constrained", sharey=True)
    fine = np.linspace(0.0, 1.0, 1001)
    for axis, ratio in zip(axes, (5.0, 50.0), strict=True):
        one = two_layers(40, ratio)
        errors.append(100.0 * profile_error(one, ratio, by_engine(one)))
        cases = (
            ("stress, harmonic mean", by_engine(one), "C0o"),
            ("stress, arithmetic mean", by_hand(one, "arithmetic"), "C2^"),
            ("pairwise", by_engine(two_layers(40, ratio, "pairwise")), "C3x"),
        )
        axis.plot(exact(fine, ratio), fine, "k-", label="closed form")
        for label, force, mark in cases:
            y, u = profile(one, force)
            axis.plot(u + np.mean(exact(y, ratio) - u), y, mark, ms=4, label=label)
        axis.axhline(0.5, color="0.7", lw=0.8)
        axis.set(xlabel="u [m/s]", title=f"the upper half {ratio:g} times as viscous")
    axes[0].set_ylabel("y [m]")
    axes[0].legend()
    _save(figure, folder / "viscosity_layers.png")
    return {"layers_of_shear": errors}


def channels(folder: Path) -> rows.Figures:
    """Flow between plates and its derivative by the viscosity, without pressure."""
    figure, axis = plt.subplots(figsize=(7, 4.5), layout="constrained")
    counts, flows = (10, 20, 40), {}
    for low, name, mark in (0.0, "Poiseuille", "o"), (0.45, "Couette", "s"):
        own = [n for n in counts if low == 0.0 or n > 10]  # the band that is pushed is a tenth of the width
        found = [Channel(n, 1.0, low, pressure=False).run() for n in own]
        flows[name] = [one["flow"] for one in found]
        for quantity, label, style in ("flow", "flow", "-"), ("slope", "its derivative", "--"):
            errors = [abs(one[quantity] - 1.0) for one in found]
            axis.loglog(own, errors, mark + style, label=f"{name}, {label}")
    axis.loglog(counts, 1.0 / np.array(counts) ** 2.0, "k:", label="second order")
    axis.set(xlabel="particles across", ylabel="error", title="Flow between plates, Re = 1")
    axis.set_xticks(counts, [str(n) for n in counts])
    axis.minorticks_off()
    axis.legend()
    _save(figure, folder / "viscosity_channels.png")
    return {"channel": flows["Poiseuille"][1:]}


def _save(figure, path: Path) -> None:
    figure.savefig(path, dpi=150)
    plt.close(figure)
    print(path, flush=True)


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, help="where the PNGs go")
    rows.Printer.add_to(parser)
    given = parser.parse_args()
    printer, folder = rows.Printer(given), given.folder
    folder.mkdir(parents=True, exist_ok=True)
    warnings.simplefilter("ignore", CortadoWarning)  # of the forms that are compared
    for draw in waves, bodies, layers, channels:
        printer.rows(draw(folder))


if __name__ == "__main__":
    main()
