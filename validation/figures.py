"""Redraw the comparisons of tests/test_validation.py: ``python validation/figures.py OUT`` writes PNGs (1 minute).

It prints the rows of `validation/README.md` that they give, which ``--write`` keeps (see `measured_rows.py`).

``python validation/figures.py --containment`` instead prints what happens in a dam break with 8,000 particles.
"""

import argparse
import sys
import tempfile
import time
from pathlib import Path

import matplotlib
import measured_rows as rows
import numpy as np

matplotlib.use("Agg")
import matplotlib.pyplot as plt

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
import potential_flow
import test_containment as containment
import test_validation as validation
from cortado import Simulation

KERNELS = {"cubic_spline": 2.0, "wendland_c2": 2.6, "wendland_c4": 3.0}
ROWS = ("front_theory", "front_koshizuka", "poiseuille_pcisph", "vortices_pcisph", "contained")
"""Of `measured.csv`, which `main` prints."""


def column(folder: Path) -> rows.Figures:
    """Water at rest: pressure over height, and where it is wrong."""
    figure, axes = plt.subplots(2, 3, figsize=(12, 9), layout="constrained")
    for (kernel, support), (above, below) in zip(KERNELS.items(), axes.T, strict=True):
        rest = validation.column_at_rest(30, kernel, support)
        x, y = rest.positions.T
        for chosen, label in (rest.interior, "interior"), (~rest.interior, "near a wall or the surface"):
            above.plot(rest.pressures[chosen], y[chosen], ".", label=label)
        above.plot([1.0, 0.0], [0.0, 1.0], "k-", label="1 - y / H")
        everywhere = np.sqrt(np.mean(rest.errors**2))
        print(f"column, {kernel} {support}: RMS {rest.error:.4f} in the interior, {everywhere:.4f} everywhere")
        above.set(xlabel="p / (rho g H)", ylabel="y / H", title=f"{kernel}, {support}: RMS {100 * rest.error:.1f} %")
        above.legend()
        points = below.scatter(x, y, c=rest.errors, s=16, cmap="RdBu", vmin=-0.2, vmax=0.2)
        below.set(aspect="equal", xlabel="x / H", ylabel="y / H")
    figure.colorbar(points, ax=axes[1], label="error / (rho g H)")
    _save(figure, folder / "column_at_rest.png")
    return {}


def front(folder: Path) -> rows.Figures:
    """Dam break: the front, that of potential flow, and the measured ones with their lags taken off."""
    exact = potential_flow.dam_break(2.75)[:, :2]
    theory, delayed = [], {}
    figure, (left, right) = plt.subplots(1, 2, figsize=(12, 5), layout="constrained")
    cases = (
        (left, validation.KOSHIZUKA_OKA, "Koshizuka and Oka 1996", 9, 4.0, 3.15),
        (right, validation.MARTIN_MOYCE, "Martin and Moyce 1952", 8, 8.0, 5.2),
    )
    for axis, name, title, points, length, until in cases:
        measured = validation.published(name)[:points]
        for across in 10, 20, 30:
            result = validation.dam_break(across, length, until)
            axis.plot(result.times, result.places, label=f"{2 * across**2} particles")
            lag = result.lag(measured)
            errors = np.abs(result.errors(measured)).max(), np.abs(result.errors(measured, lag)).max()
            print(f"{title}, L / {across}: error {errors[0]:.3f}, with a lag of {lag:.3f} {errors[1]:.3f}")
            seen = (exact[:, 0] > 0.2) & (exact[:, 0] < 2.7)
            away = np.interp(exact[seen, 0], result.times, result.places) / exact[seen, 1] - 1.0
            print(f"    from potential flow {np.abs(away).max():.3f}")
            if axis is left:
                theory.append(100.0 * float(np.abs(away).max()))
                delayed[across] = 100.0 * float(errors[1])
        axis.plot(*exact.T, "k--", label="potential flow")
        axis.plot(*measured.T, "ko", label="measured")
        axis.plot(measured[:, 0] - lag, measured[:, 1], "kx", label=f"measured, a lag of {lag:.2f} taken off")
        axis.set(xlabel="t sqrt(2 g / L)", ylabel="front / L", title=title)
        axis.legend()
    _save(figure, folder / "dam_break_front.png")
    return {"front_theory": theory, "front_koshizuka": [delayed[20]]}


def channel(folder: Path) -> rows.Figures:
    """Poiseuille flow: profiles, and the error over the number of particles across."""
    table = validation.published(validation.MORRIS)
    times = np.where(np.isfinite(table[:, 0]), table[:, 0], validation.STEADY)
    figure, (left, right) = plt.subplots(1, 2, figsize=(12, 5), layout="constrained")
    y = np.linspace(0.0, validation.CHANNEL, 101)
    for number, moment in enumerate(times):
        label = "series" if number == 0 else None
        left.plot(
            validation.poiseuille_series(y, moment) / validation.FASTEST, y / validation.CHANNEL, "k-", label=label
        )
    counts, errors = (10, 20, 40), []
    for across, mark in zip(counts, "^so", strict=True):
        result = validation.poiseuille(times, across)
        error = np.abs(result.at(0.5, 0.25) - table[:, 1:]).max(axis=1) / validation.FASTEST
        errors.append(error)
        curvature, wider = result.parabola
        wider *= across / validation.CHANNEL
        print(f"channel, {across} across: {error.round(4)}, curvature {curvature:.4f}, {wider:.3f} spacings wider")
        for number, speeds in enumerate(result.speeds):
            label = f"{across} particles across" if number == 0 else None
            heights = result.heights / validation.CHANNEL
            left.plot(speeds / validation.FASTEST, heights, f"C{counts.index(across)}{mark}", ms=3, label=label)
    left.set(xlabel="u / greatest", ylabel="y / L", title="Morris et al. 1997: Poiseuille flow")
    left.legend()
    right.loglog(counts, np.array(errors), "o-", label=[f"t = {moment:g} s" for moment in times])
    right.loglog(counts, 2.0 / np.array(counts), "k--", label="first order")
    right.set(xlabel="particles across", ylabel="greatest error at L / 2 and L / 4, over the greatest u")
    right.legend()
    _save(figure, folder / "poiseuille.png")
    return {"poiseuille_pcisph": [100.0 * float(error.max()) for error in errors[:2]]}


def vortices(folder: Path) -> rows.Figures:
    """Taylor-Green: the energy, until a fifth is left."""
    figure, axes = plt.subplots(1, 2, figsize=(12, 5), layout="constrained", sharey=True)
    cases = (
        (axes[0], 10.0, ((10, 0.01, "cubic_spline"), (20, 0.01, "cubic_spline"), (40, 0.01, "cubic_spline"))),
        (axes[0], 10.0, ((20, 0.0, "cubic_spline"),)),
        (axes[1], 50.0, ((20, 0.01, "cubic_spline"), (20, 0.01, "wendland_c4"))),
    )
    found = []
    with tempfile.TemporaryDirectory() as scratch:
        for axis, reynolds, runs in cases:
            for across, room, kernel in runs:
                times, energies = validation.taylor_green(
                    Path(scratch), across, reynolds, room, kernel, KERNELS[kernel], until=reynolds / 100.0
                )
                error = validation.taylor_green_error(times, energies, reynolds)
                found.append(100.0 * error)
                label = f"{across} x {across}, {kernel}, room {100 * room:g} %"
                print(f"vortices, Re {reynolds:g}, {label}: {error:.4f}")
                axis.plot(times, energies, label=label)
            axis.set(xlabel="t U / L", ylabel="energy / first energy", title=f"Taylor-Green, Re = {reynolds:g}")
    for axis, reynolds in zip(axes, (10.0, 50.0), strict=True):
        times = np.linspace(0.0, reynolds / 100.0)
        axis.plot(times, validation.exact_energies(times, reynolds), "k--", label="exp(-16 pi^2 t / Re)")
        axis.legend()
    _save(figure, folder / "taylor_green.png")
    return {"vortices_pcisph": found[:3]}


def contain(particles: int = 8000, steps: int = 2000) -> rows.Figures:
    """Print how many particles a dam break loses, and its greatest average density error after the first 10 steps."""
    scene = containment.box(particles)
    simulation = Simulation(scene)
    rollout, outside, nearest = simulation.rollout(steps), 0, np.inf
    lower, upper = scene.container.extent()

    def observe(step, state) -> None:
        nonlocal outside, nearest
        x = state.numpy(3)["positions"].astype(np.float64)
        outside += np.count_nonzero(~scene.container.contains(x, 0.0))
        nearest = min(nearest, (x - lower).min(), (upper - x).min())

    started = time.perf_counter()
    rollout.forward(observe, keep=False)
    seconds = time.perf_counter() - started
    errors = rollout.diagnostics
    average, greatest = errors["density_errors"][10:].max(), errors["greatest_density_errors"][10:].max()
    print(
        f"{simulation.particles} particles, {steps} steps, {seconds:.0f} s: {outside} times outside, "
        f"nearest {nearest / scene.discretisation.spacing:.3f} spacings from a wall; "
        f"density error {average:.5f} on average, {greatest:.4f} at most"
    )
    return {"contained": [outside, nearest / scene.discretisation.spacing]}


def _save(figure, path: Path) -> None:
    figure.savefig(path, dpi=100)
    plt.close(figure)
    print(path)


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, nargs="?", help="where the PNGs go")
    parser.add_argument("--containment", action="store_true", help="print the long dam break's figures")
    rows.Printer.add_to(parser)
    arguments = parser.parse_args()
    printer = rows.Printer(arguments)
    if arguments.containment:
        printer.rows(contain())
    if arguments.folder:
        arguments.folder.mkdir(parents=True, exist_ok=True)
        for draw in column, front, channel, vortices:
            printer.rows(draw(arguments.folder))
    elif not arguments.containment:
        parser.error("a folder or --containment is needed")


if __name__ == "__main__":
    main()
