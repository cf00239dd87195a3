"""How does a drop oscillate? ``python validation/surface_tension.py`` prints the table of
`docs/records/surface_tension.md`: drops in the plane, drawn out by 8 %, against the linear problem, and in space.

Numbers are over the exact ones: frequency and damping of the mode 2, the derivative of the frequency with respect to
the surface tension by the tangent of two periods, and the pressure in the second half over (d - 1) sigma / R. The rest
is the root mean square of what a damped oscillation leaves, over the first stretch; the drift is the greatest speed of
the drop as a whole over the greatest root mean square of speeds.

It prints the rows of `validation/README.md` that they give too, which ``--write`` keeps (see `measured_rows.py`).
"""

import argparse
import math
import sys
import time
import warnings
from itertools import product
from pathlib import Path

import measured_rows as rows

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from cortado.errors import CortadoWarning
from oscillating_drops import C2, C4, CUBIC, PCISPH, Drop, disc_of_lattice, packed_disc

KERNELS = {"C4, 3": C4, "C2, 2.6": C2}
TURNS = (0.0, 45.0)
PARTICLES = {"of a lattice": disc_of_lattice, "packed": packed_disc}
ROWS = ("drop_frequency", "drop_damping")
"""Of `measured.csv`, which `main` prints with 48 particles across."""


def row(name: str, slope: bool = False, **options) -> tuple[float, float, float]:
    """Print a row; its frequency, damping and derivative."""
    begun = time.perf_counter()
    drop = Drop(slope=slope, **options)
    frequency, damping, rest = drop.fit()
    derivative = drop.frequency_slope() if slope else math.nan
    late = f"{drop.pressure[len(drop.time) // 2 :].mean():.3f}" if drop.pressure.any() else ""
    drift = drop.drift.max() / drop.speed.max()
    numbers = f"{frequency:.3f} | {damping:.3f} | {derivative:.3f} | {late} | {rest:.3f} | {drift:.0e}"
    print(f"| {name} | {numbers} | {time.perf_counter() - begun:.0f} s |", flush=True)
    return frequency, damping, derivative


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--across", type=int, nargs="*", default=[24, 48], help="particles across a drop in the plane")
    rows.Printer.add_to(parser)
    given = parser.parse_args()
    across, found = given.across, {}
    warnings.simplefilter("ignore", CortadoWarning)  # of forms and kernels that are compared
    print("| drop | frequency | damping | d omega / d sigma | pressure | rest | drift | time |\n|" + 8 * "---|")
    for number, (kernel, discretisation), (kind, particles), turned in product(
        across, KERNELS.items(), PARTICLES.items(), TURNS
    ):
        name = f"{number} across, {kernel}, {kind}, turned by {turned:g}"
        options = {"discretisation": discretisation, "particles": particles, "turned": turned}
        found[number, kernel, kind, turned] = row(name, slope=True, across=number, **options)
    if 48 in across:
        packed, cut = ([found[48, "C4, 3", kind, turned] for turned in TURNS] for kind in ("packed", "of a lattice"))
        figures = {"drop_frequency": [one[k] for k in (0, 2) for one in packed]}
        rows.Printer(given).rows(figures | {"drop_damping": [one[1] for one in (*packed, *cut)]})
    row("24 across, C4, stirred", across=24, turned=20.0, jitter=0.1, discretisation=C4)
    for support in (2.0, 2.6):
        row(f"24 across, cubic, {support:g}", across=24, discretisation={**CUBIC, "support": support})
    row("24 across, cubic, PCISPH", across=24, discretisation=CUBIC, solver=PCISPH, step=0.08)
    for ohnesorge in (0.05, 0.03, 0.02, 0.01):
        row(
            f"24 across, C4, turned by 20, Oh {ohnesorge:g}",
            across=24,
            turned=20.0,
            ohnesorge=ohnesorge,
            discretisation=C4,
        )
    row("space, 16 across, C2", across=16, dimension=3, discretisation=C2, ohnesorge=0.05)
    row("space, 16 across, C4", across=16, dimension=3, discretisation=C4, ohnesorge=0.05)


if __name__ == "__main__":
    main()
