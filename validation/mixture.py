"""Redraw the comparisons of tests/test_validation_mixture.py, and the long runs of coarsening that it leaves out.

``python validation/mixture.py`` writes PNGs to runs/validation (10 minutes on two free cores, most of it coarsening).
It prints the rows of `validation/README.md` that they give too, which ``--write`` keeps (see `measured_rows.py`).
"""

import argparse
import sys
from collections.abc import Callable
from pathlib import Path

import matplotlib
import measured_rows as rows
import numpy as np

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.colors import LinearSegmentedColormap, to_rgb
from matplotlib.ticker import LogLocator, NullLocator

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
import test_validation_mixture as validation
from cortado.files.terminal import track

COLOURS = np.array([to_rgb(name) for name in ("#20364b", "#f0e2c4", "#b5523b", "#5b8a5a")])
"""Of pure phases."""
ROWS = ("growth_fastest", "growth_others", "interface", "mixing", "coarsening")
"""Of `measured.csv`, which `main` prints."""


# ---- closed forms ----------------------------------------------------------------------------------------------------

WAVELENGTHS = (8, 12, 16, 24)
"""Particles in a wave."""
INTERFACES = WAVELENGTHS[:3]
"""The last would take 70,000 substeps."""


def closed_forms(folder: Path) -> rows.Figures:
    """Growth rates, an interface and the decay of a wave: above each against its closed form, below its error."""
    with track(2 * len(WAVELENGTHS) + len(INTERFACES), "closed forms") as advance:

        def each(compute: Callable, wavelengths: tuple[int, ...]) -> list:
            return [(compute(wavelength), advance())[0] for wavelength in wavelengths]

        rates = np.array(each(validation.growth, WAVELENGTHS))
        interfaces = each(validation.interface, INTERFACES)
        decays = each(
            lambda wavelength: (validation.mixing(wavelength), validation.mixing(wavelength, 400)), WAVELENGTHS
        )

    figure, axes = plt.subplots(2, 3, figsize=(15, 9), layout="constrained")
    _growth(axes[:, 0], rates)
    _interface(axes[:, 1], interfaces)
    _decay(axes[:, 2], decays)
    for axis in axes[1]:
        order = axis.lines[-1].get_ydata()[0] * (WAVELENGTHS[0] / np.array(WAVELENGTHS)) ** 2
        axis.loglog(WAVELENGTHS, order, "k--", label="second order")
        axis.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axis.yaxis.set_major_formatter("{x:g}")
        axis.set_xticks(WAVELENGTHS, [str(wavelength) for wavelength in WAVELENGTHS])
        axis.minorticks_off()
        axis.legend()
    _save(figure, folder / "mixture_closed_forms.png")
    return {
        "growth_fastest": (100.0 * (rates[:, -1] - 1.0)).tolist(),
        "growth_others": (100.0 * (rates[0, :-1] - 1.0)).tolist(),
        "interface": [100.0 * one.error for one in interfaces],
        "mixing": [_decay_error(*runs[0]) for runs in decays[1:]],
    }


def _growth(axes: np.ndarray, rates: np.ndarray) -> None:
    above, below = axes
    exact = _rate(validation.RATIOS)
    k = np.linspace(0.0, 1.1, 200)
    above.plot(k, _rate(k), "k-", label="k^2 (1 / 2 - eps^2 k^2)")
    for wavelength, rate, mark in zip(WAVELENGTHS, rates, "^so+", strict=True):
        print(f"growth, {wavelength} particles in the fastest wave: errors {100.0 * (rate - 1.0)} %")
        above.plot(validation.RATIOS, exact * rate, mark, label=f"{wavelength} particles in the fastest wave")
    above.set(
        xlabel="k / k*, k* = 1 / (2 eps)", ylabel="growth rate [M alpha^2 / eps^2]", title="An even mixture falls apart"
    )
    above.legend()
    for number, ratio in enumerate(validation.RATIOS):
        below.loglog(WAVELENGTHS, 100.0 * np.abs(rates[:, number] - 1.0), "o-", label=f"k / k* = {ratio:g}")
    below.set(xlabel="particles in the fastest wave, 4 pi eps", ylabel="error [%]")


def _rate(ratio: np.ndarray) -> np.ndarray:
    """[1 / epsilon^2] for wave numbers in that of the fastest wave."""
    return (0.5 * ratio) ** 2 * (0.5 - (0.5 * ratio) ** 2)


def _interface(axes: np.ndarray, interfaces: list[validation.Interface]) -> None:
    above, below = axes
    x = np.linspace(-9.4, 9.4, 300)
    above.plot(x, validation.Interface.exact(1.0 / 1.5 * x), "k:", label="at the start")
    above.plot(x, validation.Interface.exact(x), "k-", label="(1 - tanh(x / (2 eps))) / 2")
    for wavelength, result, mark in zip(INTERFACES, interfaces, "^so", strict=True):
        label = f"{wavelength / (4.0 * np.pi):.2f} spacings in eps: RMS {100.0 * result.error:.2f} %"
        print(f"interface, {label}")
        distances, first = np.unique(result.distances.round(6), return_index=True)
        above.plot(distances, result.fractions[first], mark, ms=5, label=label)
    above.set(
        xlim=(-9.5, 9.5),
        ylim=(-0.04, 1.5),
        xlabel="x / eps",
        ylabel="c",
        title="An interface, after 200 eps^2 / (M alpha^2)",
    )
    above.legend(loc="upper right")
    below.loglog(INTERFACES, [100.0 * result.error for result in interfaces], "o-", label="RMS, |x| < 4.39 eps")
    below.set(xlabel="particles in 4 pi eps", ylabel="error of c [%]")


def _decay(axes: np.ndarray, decays: list) -> None:
    above, below = axes
    errors = []
    for wavelength, runs, mark in zip(WAVELENGTHS, decays, "^so+", strict=True):
        errors.append([_decay_error(times, variance) for times, variance in runs])
        times, variance = runs[1]
        above.semilogy(times[::40], variance[::40], mark, label=f"{wavelength} particles in the wave")
        print(f"decay, {wavelength} particles: error {errors[-1][0]:.2f} %, in short substeps {errors[-1][1]:.2f} %")
    above.semilogy(times, np.exp(-times), "k-", label="exp(-2 M alpha k^2 t)")
    above.set(xlabel="2 M alpha k^2 t", ylabel="variance / first variance", title="Miscible phases mix")
    above.set_yticks([1.0, 0.8, 0.6, 0.4], ["1", "0.8", "0.6", "0.4"])
    above.minorticks_off()
    above.legend()
    errors = np.abs(errors).T
    below.loglog(WAVELENGTHS, errors[0], "o-", label="the engine's substeps")
    below.loglog(WAVELENGTHS, errors[1], "s-", label="short substeps: of the lattice alone")
    below.set(xlabel="particles in the wave", ylabel="error of the variance after one e-fold [%]")


def _decay_error(times: np.ndarray, variance: np.ndarray) -> float:
    """[%] of the last variance."""
    return 100.0 * float(variance[-1] / np.exp(-times[-1]) - 1.0)


# ---- coarsening ------------------------------------------------------------------------------------------------------

ACROSS = 96
RUNS = {
    "constant": {"until": 2400.0, "steps": 96, "seeds": 4, "windows": ((300.0, 2400.0),)},
    "degenerate": {"until": 24000.0, "steps": 240, "seeds": 2, "windows": ((1000.0, 12000.0), (6000.0, 24000.0))},
}
THEORY = {"constant": 1.0 / 3.0, "degenerate": 0.25}
"""Exponents at late times: of diffusion through the phases, and of that along their interfaces."""

Runs = dict[str, list[validation.Coarsening]]


def coarsening_runs(device: str) -> Runs:
    """Of each mobility, from different noise."""
    results: Runs = {}
    with track(sum(run["steps"] * run["seeds"] for run in RUNS.values()), "coarsening") as advance:
        for form, run in RUNS.items():
            results[form] = [
                validation.coarsening(ACROSS, form, run["until"], seed, run["steps"], advance=advance, device=device)
                for seed in range(1, run["seeds"] + 1)
            ]
    return results


def coarsening(folder: Path, results: Runs) -> rows.Figures:
    """The distance between interfaces over time, with its exponents, and what the mixtures look like."""
    figure = plt.figure(figsize=(13, 13), layout="constrained")
    above, below = figure.subfigures(2, 1, height_ratios=(1.0, 1.45))
    for axis, (form, seeds) in zip(above.subplots(1, 2), results.items(), strict=True):
        _exponents(axis, form, seeds)
    rows = below.subplots(2, 4)
    for row, (form, seeds) in zip(rows, results.items(), strict=True):
        times = seeds[0].times
        for axis, wanted in zip(row, np.geomspace(times[-1] / 27.0, times[-1], 4), strict=True):
            number = int(np.abs(times - wanted).argmin())
            pixels = seeds[0].fractions[number].reshape(ACROSS, ACROSS).T
            shown = axis.imshow(pixels, origin="lower", vmin=0.0, vmax=1.0, cmap=_two_phases())
            axis.set(xticks=[], yticks=[], title=f"{form}, {times[number]:.0f} eps^2")
    below.colorbar(shown, ax=rows, label="c", orientation="horizontal", shrink=0.3, aspect=30)
    _save(figure, folder / "mixture_coarsening.png")
    window = RUNS["constant"]["windows"][0]
    return {"coarsening": [float(np.mean([one.exponent(*window) for one in results["constant"]]))]}


def _exponents(axis: plt.Axes, form: str, seeds: list[validation.Coarsening]) -> None:
    for result in seeds:
        axis.loglog(result.times[1:], result.lengths[1:], "-", color="0.7", lw=1.0)
        print(f"coarsening, {form}: c from {result.fractions.min():.3f} to {result.fractions.max():.3f}")
    times, lengths = seeds[0].times, np.mean([result.lengths for result in seeds], axis=0)
    axis.loglog(times[1:], lengths[1:], "k-", label=f"mean of {len(seeds)} runs (grey)")
    for number, (begin, end) in enumerate(RUNS[form]["windows"]):
        found = np.array([result.exponent(begin, end) for result in seeds])
        print(f"coarsening, {form}, {begin:g} to {end:g} eps^2: exponents {found.round(3)}, mean {found.mean():.3f}")
        moments = np.geomspace(begin, end, 2)
        middle = np.sqrt(begin * end)
        fit = 1.12 * np.interp(middle, times, lengths) * (moments / middle) ** found.mean()
        label = f"t^{found.mean():.3f} ({found.min():.3f} to {found.max():.3f}), {begin:g} to {end:g} eps^2"
        axis.loglog(moments, fit, f"C{number}--", lw=2.5, label=label)
    axis.set(xlabel="t [eps^2 / (M alpha^2)]", ylabel="distance between interfaces, eps / (3 E)  [eps]")
    theory = 0.88 * np.interp(middle, times, lengths) * (moments / middle) ** THEORY[form]
    axis.loglog(moments, theory, "k:", label=f"t^(1 / {1.0 / THEORY[form]:.0f}), the theory for late times")
    axis.set_title(f"{form} mobility")
    axis.set(xlim=(times[-1] / 100.0, 1.2 * times[-1]), ylim=(4.5, 22.0))
    axis.set_yticks([5.0, 7.0, 10.0, 15.0, 20.0], ["5", "7", "10", "15", "20"])
    axis.yaxis.set_minor_locator(NullLocator())
    axis.legend(loc="upper left")


def _two_phases() -> LinearSegmentedColormap:
    return LinearSegmentedColormap.from_list("two phases", [COLOURS[1], COLOURS[0]])


# ---- more phases -----------------------------------------------------------------------------------------------------


def phases(folder: Path, across: int = 64, until: float = 1600.0, steps: int = 32) -> None:
    """Two, three and four phases that separate."""
    shown = (0, 2, 6, 16, steps)
    counts = (2, 3, 4)
    with track(len(counts) * steps, "phases") as advance:
        runs = [validation.separating(count, until, across, steps, advance) for count in counts]
    figure, axes = plt.subplots(len(counts), len(shown), figsize=(15, 9.5), layout="constrained")
    for row, count, fractions in zip(axes, counts, runs, strict=True):
        miss = np.abs(fractions.sum(axis=2) - 1.0).max()
        print(f"{count} phases: c from {fractions.min():.4f} to {fractions.max():.4f}, sum c - 1 at most {miss:.1e}")
        for axis, number in zip(row, shown, strict=True):
            colours = np.clip(fractions[number] @ COLOURS[:count], 0.0, 1.0)
            axis.imshow(colours.reshape(across, across, 3).transpose(1, 0, 2), origin="lower")
            axis.set(xticks=[], yticks=[], title=f"{number * until / steps:.0f} eps^2")
        row[0].set_ylabel(f"{count} phases")
    _save(figure, folder / "mixture_phases.png")


# ---- the command -----------------------------------------------------------------------------------------------------


def _save(figure: plt.Figure, path: Path) -> None:
    figure.savefig(path, dpi=100)
    plt.close(figure)
    print(path)


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("runs/validation"), help="where the PNGs go")
    parser.add_argument("--device", default="cpu", help="where the coarsening runs, such as cuda:0")
    rows.Printer.add_to(parser)
    arguments = parser.parse_args()
    printer = rows.Printer(arguments)
    arguments.out.mkdir(parents=True, exist_ok=True)
    printer.rows(closed_forms(arguments.out))
    phases(arguments.out)
    printer.rows(coarsening(arguments.out, coarsening_runs(arguments.device)))


if __name__ == "__main__":
    main()
