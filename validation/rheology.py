"""``python validation/rheology.py`` finds the three numbers of a Herschel-Bulkley law from films on three slopes that
were run with 48 particles across, by films of 16 and of 24: an hour on one core. It prints
the row of `validation/README.md`, which ``--write`` keeps."""

import argparse
import sys
from pathlib import Path

import measured_rows as rows

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from yielding_films import LAW, found_law, observed

ROWS = ("three_films",)
"""Of `measured.csv`."""

if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    rows.Printer.add_to(parser)
    printer = rows.Printer(parser.parse_args())
    target = observed(48, LAW)
    start = {name: factor * LAW[name] for name, factor in zip(LAW, (1.3, 0.9, 0.7), strict=True)}
    for deep in (16, 24):
        found = found_law(deep, target, start)
        shares = {name: found[name] / LAW[name] for name in LAW}
        print(deep, shares, flush=True)
        if deep == 16:
            printer.row("three_films", shares.values())
