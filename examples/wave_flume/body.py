"""A ship's section from how it moved: its centre of gravity, radius of gyration, springs and damping, with error bars.

    python examples/wave_flume/body.py                       # from run 3102_1; half a minute on a laptop
    python examples/wave_flume/body.py --check 100 --long 13.63 --device cuda:0     # with simulations of what was found

The model is linear theory of the whole flume (`panels.py`), with the slow force of waves that are sent back. Beside
the four numbers it searches a damping of roll, the gain of the flap, and by how much motions are late. Bars are two
standard deviations, three of each number: of noise alone; of residuals drawn again by blocks of two periods; and of a
discrepancy, a Gaussian process over time of each motion. The last is the one to quote. See docs/wave_flume.md.
"""

import argparse
from dataclasses import astuple, replace
from pathlib import Path

import numpy as np
from case import BEGIN, END, MOTIONS, PROBES, period, record_of, swing
from panels import LinearFlume
from scipy.optimize import least_squares, minimize
from section import MEASURED, Rig
from wave_flume import draw, on_section, simulated

EVERY, SINCE, DRAWS = 5, 3.0, 1000  # one sample in so many; the first that counts [s]; how often blocks are drawn
NAMES = "centre of gravity [m]", "radius of gyration [m]", "springs [N/m]", "damping [N s/m]"
OTHERS = "damping of roll [N m s]", "gain of the flap", "lateness [s]"
DRY = "dry friction [N]"


def moved(flume, times, stroke, u):
    """Motions (times, 3) by the logarithms of the numbers in `NAMES` and `OTHERS`, and of a dry friction if asked."""
    *rig, roll_damping, gain, late = np.exp(u[:7])
    friction = np.exp(u[7]) if len(u) > 7 else 0.0
    found = flume.motions(gain * stroke, Rig(*rig), roll_damping, friction)
    return np.stack([np.interp(times - late, times, one) for one in found.T], axis=1)


def covariance(lags, log_hyper, rate):
    """Of a discrepancy at lags (times,) [s]: a wave that comes and goes, a slow part (both Matern 3/2), and noise."""
    wave, lasts, slow, long, noise = np.exp(log_hyper)
    matern = [(1.0 + np.sqrt(3.0) * lags / one) * np.exp(-np.sqrt(3.0) * lags / one) for one in (lasts, long)]
    return wave**2 * matern[0] * np.cos(rate * lags) + slow**2 * matern[1] + np.where(lags == 0.0, noise**2, 0.0)


def whitening(covariances):
    """The matrix (times, times) that makes white noise of a series with such covariances of its lags (Durbin 1960).

    Each row is what a value is beside what those before it predict, over the deviation of that.
    """
    weights, variance = np.zeros(0), covariances[0]
    rows = np.diag(np.full(len(covariances), variance**-0.5))
    for n in range(1, len(covariances)):
        share = (covariances[n] - weights @ covariances[n - 1 : 0 : -1]) / variance
        weights = np.append(weights - share * weights[::-1], share)
        variance *= 1.0 - share**2
        rows[n, :n], rows[n, n] = -weights[::-1] / np.sqrt(variance), 1.0 / np.sqrt(variance)
    return rows


def discrepancy(times, left, rate):
    """The `whitening` under which residuals (times,) are likeliest."""
    lags, size = times - times[0], left.std()

    def unlikely(log_hyper):
        rows = whitening(covariance(lags, log_hyper, rate))
        prior = 0.5 * ((log_hyper[[1, 3]] - np.log([4.0, 2.0])) ** 2).sum()  # lengths between 1 and 10 s
        return 0.5 * (np.einsum("ij,j", rows, left) ** 2).sum() - np.log(np.diag(rows)).sum() + prior

    start = np.log([0.5 * size, 4.0, 0.5 * size, 2.0, 0.3 * size])
    limits = [(np.log(1e-3 * size), np.log(10.0 * size)), (-1.0, 3.5)] * 2 + [(np.log(1e-2 * size), np.log(2.0 * size))]
    return whitening(covariance(lags, minimize(unlikely, start, method="L-BFGS-B", bounds=limits).x, rate))


def drawn_again(left, jacobian, block, draws=DRAWS):
    """Standard deviations of a fit by residuals (times, 3) that are drawn again in blocks of so many times."""
    random, solve = np.random.default_rng(0), np.linalg.pinv(jacobian)
    starts = random.integers(0, len(left) - block, size=(draws, -(-len(left) // block)))
    new = [solve @ np.concatenate([left[s : s + block] for s in row])[: len(left)].ravel() for row in starts]
    return np.std(new, axis=0)


def fitted(flume, times, stroke, measured, long, start):
    """Logarithms of what fits, by least squares and with a discrepancy, and three standard deviations of each."""
    counted = np.flatnonzero((times >= SINCE) & (times <= END))[::EVERY]
    scale = measured[(times >= BEGIN) & (times <= END)].std(axis=0)

    def residuals(u):
        return ((moved(flume, times, stroke, u) - measured) / scale)[counted].ravel()

    first = least_squares(residuals, start, diff_step=1e-4)
    left, around = first.fun.reshape(-1, 3), np.linalg.inv(first.jac.T @ first.jac)
    noise = np.sqrt(np.diag(around) * 2.0 * first.cost / (left.size - len(start)))
    blocks = drawn_again(left, first.jac, round(2.0 * long / (times[EVERY] - times[0])))
    white = np.stack([discrepancy(times[counted], one, 2.0 * np.pi / long) for one in left.T])

    def whitened(u):
        return np.einsum("kij,jk->ki", white, residuals(u).reshape(-1, 3)).ravel()

    second = least_squares(whitened, first.x, diff_step=1e-4)
    bars = np.sqrt(np.diag(np.linalg.inv(second.jac.T @ second.jac)))
    return first.x, second.x, np.stack([noise, blocks, bars]), np.sqrt((left**2).mean(axis=0))


def compared(name, times, motions, measured, long):
    """A line of amplitudes over the measured ones, and phases after them."""
    late = (times >= BEGIN) & (times <= END)
    pairs = [[swing(times[late], one[late], long) for one in both] for both in zip(motions.T, measured.T, strict=True)]
    tall = ", ".join(f"{abs(own / true):.3f}" for own, true in pairs)
    turn = ", ".join(f"{np.degrees(np.angle(true / own)):.0f}" for own, true in pairs)
    print(f"{name}: sway, heave, roll {tall} of the measured ones, {turn} degrees after them")


def read(path):
    times, way, record = record_of(path)
    return times, -way, np.stack([record[name] for name in MOTIONS], axis=1), period(times, -way)


def arguments():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    here = Path(__file__).parent
    parser.add_argument("record", type=Path, nargs="?", default=here / "3102_1.csv", help="a CSV file")
    parser.add_argument("--other", type=Path, default=here / "3061_2.csv", help="one whose motions are not used")
    parser.add_argument("--dry", action="store_true", help="search a dry friction of the guides too")
    parser.add_argument("--check", type=int, default=0, help="particles in the depth of simulations of what was found")
    parser.add_argument("--long", type=float, default=8.0, help="length of their flume [m]")
    parser.add_argument("--end", type=float, default=22.0, help="when they end [s]")
    parser.add_argument("--device", default="cpu")
    return parser.parse_args()


def main():
    """Find the numbers, print them with bars, and say what they make of another run."""
    asked = arguments()
    flume = LinearFlume(PROBES.values(), MEASURED)
    times, stroke, measured, long = read(asked.record)
    told = [*astuple(MEASURED.rig), 0.2, 1.07, 0.05, *([0.35] if asked.dry else [])]
    first, best, bars, left = fitted(flume, times, stroke, measured, long, np.log(told))
    print(f"{asked.record.stem}: sway, heave and roll are left with {np.round(left, 2)} of their deviations")
    print("number, told, least squares, of noise, by blocks, with a discrepancy, its bar, in bars from told")
    for n, name in enumerate([*NAMES, *OTHERS, DRY][: len(told)]):
        value, bar = np.exp(best[n]), 2.0 * bars[:, n]
        print(f"{name:24} {told[n]:7.4g} {np.exp(first[n]):7.4g} {bar[0]:6.1%} {bar[1]:6.1%}", end=" ")
        print(f"{value:7.4g} {bar[2]:6.1%}", f"{abs(best[n] - np.log(told[n])) / bar[2]:5.1f}" if n < 4 else "")
    u_told = np.array([*np.log(told[:4]), -99.0, *best[5:7]])
    for path in (asked.record, asked.other):
        times, stroke, measured, long = read(path)
        compared(f"{path.stem} by told numbers", times, moved(flume, times, stroke, u_told), measured, long)
        motions = moved(flume, times, stroke, best)
        compared(f"{path.stem} by found numbers", times, motions, measured, long)
        if asked.check:
            asked.deep = asked.check
            section, gain = replace(MEASURED, rig=Rig(*np.exp(best[:4]))), np.exp(best[5])
            run = simulated(times, gain * stroke, [5.5], asked, section, often=0.04)
            motions = np.stack([np.interp(times, *one) for one in on_section(run, section).values()], axis=1)
            motions = motions[times <= asked.end]
            compared(f"{path.stem} simulated", times[: len(motions)], motions, measured[: len(motions)], long)
        rows = {name: (one[: len(motions)], own) for name, one, own in zip(MOTIONS, measured.T, motions.T, strict=True)}
        draw(times[: len(motions)], rows, times[len(motions) - 1], f"body_{path.stem}.png")


if __name__ == "__main__":
    main()
