"""The motion of a flap from waves: from those that two probes measured, or for waves that shall meet at a place.

    python examples/wave_flume/backward.py flap --rounds 1     # from the first two probes of a record
    python examples/wave_flume/backward.py focus               # a crest of 36 mm at 5 m, after 14 s
    ... --deep 50 --check 100 --long 13.63 --device cuda:0     # found with 50 particles in the depth, checked with 100

Knots of the motion are found by least squares (Gauss-Newton). Surfaces are those of the simulation, and their
derivatives with respect to the knots those of linear theory, in closed form: derivatives of a free surface through
thousands of steps grow without bound. Each round also brings the simulation's noise into the motion. Waves of a coarse
simulation are too low, so a round makes its surface as high as linear theory's before it is compared.
The flume is that of `wave_flume.py`. See docs/wave_flume.md.
"""

import argparse
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from case import BEGIN, END, period, record_of, swing
from wave_flume import BEACH, draw, simulated, surface, theory

EVERY, STEADY, SMOOTH = 5, 0.3, 1.0  # samples between knots; weights [m per m] of their places and second differences
PLACE, FOCUS, CREST = 5.0, 14.0, 0.036  # where [m] and when [s] waves meet, and how high [m]
SLOWEST, FASTEST, WAVES = 1.8, 0.8, 16  # periods [s] of waves that meet, and their number


@dataclass
class Aim:
    """What a flap shall do: surfaces (times, places) [m] at places [m], where ``counted`` (times,) is true."""

    places: list
    wanted: np.ndarray
    counted: np.ndarray


def recorded(record, times, asked):
    """The aim of making what the first two probes of a record measured."""
    wanted = np.stack([record["probe_1_m"], record["probe_2_m"]], axis=1)
    return Aim([3.0, 4.95], wanted, (times > 2.0) & (times < asked.end))


def focused(times):
    """The aim of waves of one height each and of many periods that meet at a place."""
    rates = 2.0 * np.pi * np.linspace(1.0 / SLOWEST, 1.0 / FASTEST, WAVES)
    wanted = CREST * np.cos(np.multiply.outer(times - FOCUS, rates)).mean(axis=1)
    return Aim([PLACE], wanted[:, None], np.abs(times - FOCUS) < 4.0)


def found(times, aim, asked, others=()):
    """The stroke (times,) [m] of a flap that does what is asked, and the surfaces at its places and at others."""
    hat = np.interp(np.arange(len(times)), [0, EVERY, 2 * EVERY], [0.0, 1.0, 0.0])
    by_one = theory(times, hat, np.array(aim.places))
    later = [np.arange(len(times)) - n for n in range(0, len(times) - 2 * EVERY, EVERY)]
    hats = np.stack([np.where(n >= 0, hat[n], 0.0) for n in later], axis=1)
    slopes = [np.where(n >= 0, by_one[n].T, 0.0).T[aim.counted].ravel() for n in later]
    same = np.eye(hats.shape[1])
    rows = np.concatenate([np.stack(slopes, axis=1), STEADY * same, SMOOTH * np.diff(same, 2, axis=0)])
    knots, made, places = np.zeros(hats.shape[1]), np.zeros_like(aim.wanted), [*aim.places, *others]
    for n in range(asked.rounds + 1):
        left = (aim.wanted - made)[aim.counted]
        print(f"round {n}: {1e3 * left.std():.2f} mm (rms) are left of {1e3 * aim.wanted[aim.counted].std():.2f} mm")
        if n < asked.rounds:
            rest = [left.ravel(), -STEADY * knots, -SMOOTH * np.diff(knots, 2)]
            knots = knots + np.linalg.lstsq(rows, np.concatenate(rest), rcond=None)[0]
            everywhere = surface(simulated(times, hats @ knots, places, asked), times, places)
            made, exact = everywhere[:, : len(aim.places)], theory(times, hats @ knots, np.array(aim.places))
            made = made * ((exact**2)[aim.counted].sum() / (made * exact)[aim.counted].sum())
    return hats @ knots, everywhere


def off(found, true):
    """The root mean square of a difference over that of what is true."""
    return np.sqrt(((found - true) ** 2).sum() / (true**2).sum())


def say_flap(record, times, stroke, here, others, asked):
    """Print how near a flap that was found comes to the recorded one, and what it makes at other probes."""
    seen = (times > 6.0) & (times < 16.0)
    true = -record["wavemaker_m"]
    gain = stroke[seen] @ true[seen] / (true[seen] ** 2).sum()
    late, long = (times >= BEGIN) & (times <= asked.end), period(times, true)
    late_by = np.degrees(np.angle(swing(times[seen], true[seen], long) / swing(times[seen], stroke[seen], long)))
    print(f"the flap moves {gain:.3f} times its record, {late_by:.1f} degrees after it", end="; ")
    print(f"from 6 to 16 s it is {off(stroke[seen], gain * true[seen]):.3f} off (rms) beside that")
    for name, place, each in zip(("probe_3_m", "probe_4_m", "probe_6_m"), others, here[:, 2:].T, strict=False):
        own, there = each[late], record[name][late]
        tall = abs(swing(times[late], own, long) / swing(times[late], there, long))
        print(f"{place:g} m: {tall:.3f} of the height that was measured, {off(own, there):.3f} off (rms)")


def say_focus(times, here):
    """Print how high waves are where they shall meet, and when."""
    near = np.abs(times - FOCUS) < 0.5
    at = np.argmax(np.where(near, here, -1.0))
    fine = np.polynomial.Polynomial.fit(times[at - 2 : at + 3], here[at - 2 : at + 3], 2).convert()
    top = -0.5 * fine.coef[1] / fine.coef[2]
    print(f"a crest of {1e3 * fine(top):.1f} mm, {fine(top) / CREST:.3f} of what was asked", end=", ")
    print(f"{top - FOCUS:+.3f} s after it was due")


def arguments():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("aim", choices=("flap", "focus"))
    default = Path(__file__).parent / "1062.csv"
    parser.add_argument("--record", type=Path, default=default, help="a CSV file, for flap")
    parser.add_argument("--deep", type=int, default=20, help="particles in the depth")
    parser.add_argument("--check", type=int, help="particles in the depth of a last run, with what was found")
    parser.add_argument("--long", type=float, default=8.0, help="length of the flume [m]")
    parser.add_argument("--end", type=float, default=END, help="when a run ends [s]")
    parser.add_argument("--rounds", type=int, default=2, help="simulations; the first motion is linear theory's")
    parser.add_argument("--device", default="cpu")
    return parser.parse_args()


def main():
    """Find the motion of a flap, print how good it is, and draw it."""
    asked = arguments()
    times, _, record = record_of(asked.record)
    aim = recorded(record, times, asked) if asked.aim == "flap" else focused(times)
    others = [place for place in (5.2, 5.5, 8.5) if place < asked.long - BEACH] if asked.aim == "flap" else []
    stroke, here = found(times, aim, asked, others)
    if asked.check:
        asked.deep = asked.check
        here = surface(simulated(times, stroke, [*aim.places, *others], asked), times, [*aim.places, *others])
        print(f"with {asked.check} particles in the depth:")
    if asked.aim == "flap":
        say_flap(record, times, stroke, here, others, asked)
    else:
        say_focus(times, here[:, 0])
    rows = {
        f"{place:g} m [mm]": 1e3 * np.stack([a, b])
        for place, a, b in zip(aim.places, aim.wanted.T, here.T, strict=False)
    }
    true = -record["wavemaker_m"] if asked.aim == "flap" else np.full_like(times, np.nan)
    draw(times, rows | {"flap [mm]": 1e3 * np.stack([true, stroke])}, asked.end, "backward.png")


if __name__ == "__main__":
    main()
