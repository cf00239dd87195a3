"""The command line of the fuzz tier."""

import sys
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from tyro.conf import UseAppendAction, arg

from fuzz.campaign import Campaign
from fuzz.families import FAMILIES
from fuzz.ledger import Entry
from fuzz.warm import warm


@dataclass(frozen=True)
class Options:
    """Fuzz Cortado: go on with the cases of a seed, those that failed before last."""

    minutes: float | None = None
    """Begin no case after this time; all of them if left out."""
    only: Annotated[UseAppendAction[tuple[str, ...]], arg(metavar="FAMILY")] = ()
    """The name of a family, as the table at the end lists them; may be given again."""
    seed: int = 1
    """What all cases are drawn from."""
    jobs: int = 2
    """Cases at a time."""
    again: Annotated[UseAppendAction[tuple[str, ...]], arg(metavar="FAMILY:NUMBER")] = ()
    """Run these cases alone, even if they passed; may be given again."""
    failed: bool = False
    """Run the cases that failed before, and no others."""
    fresh: bool = False
    """Forget what is done and begin again."""
    folder: Path = Path("runs/fuzz")
    """Where the ledger is, and the files of cases that failed."""


def main() -> None:
    """Run the cases that are left; the exit code is 1 if one of the seed has failed, or one of those named."""
    options = tyro.cli(Options, config=(tyro.conf.OmitArgPrefixes, tyro.conf.FlagCreatePairsOff))
    _check(options)
    campaign = Campaign(FAMILIES, options.seed, options.folder)
    if options.fresh:
        campaign.ledger.clear()
    names = list(options.again) or campaign.open_cases(options.only)
    if options.failed:
        names = [name for name in names if name in campaign.ledger.entries]
    print(f"seed {options.seed}: {len(names)} cases to run, {len(campaign.ledger.entries)} in the ledger", flush=True)
    warm()
    try:
        campaign.run(names, options.jobs, None if options.minutes is None else 60.0 * options.minutes)
    except KeyboardInterrupt:
        print("Interrupted; the same command goes on.")
    print(_table(list(campaign.ledger.entries.values())))
    failed = [entry.case for entry in campaign.ledger.failed()]
    sys.exit(1 if set(options.again or failed) & set(failed) else 0)


def _check(options: Options) -> None:
    for name in (*options.only, *options.again):
        family, colon, number = name.partition(":")
        wanted, right = ("case", number.isdecimal()) if name in options.again else ("family", not colon)
        if family not in FAMILIES or not right:
            sys.exit(f"{name!r} is no {wanted}; families are {', '.join(FAMILIES)}.")


def _table(entries: list[Entry]) -> str:
    """How far every family is, and what its commands did."""
    lines = [
        f"{'family':15} {'done':>5} {'of':>5} {'failed':>6} {'longest':>8} {'computed':>9} {'memory':>7}  exit codes"
    ]
    for name, family in FAMILIES.items():
        own = [entry for entry in entries if entry.case.partition(":")[0] == name]
        codes = Counter(code for entry in own for code in entry.codes)
        lines.append(
            f"{name:15} {len(own):5} {family.cases:5} {sum(bool(entry.complaints) for entry in own):6} "
            f"{max((entry.seconds for entry in own), default=0.0):6.1f} s "
            f"{sum(entry.computed for entry in own):7.0f} s "
            f"{max((entry.memory for entry in own), default=0) / 1e9:4.1f} GB  "
            f"{', '.join(f'{code}: {count}' for code, count in sorted(codes.items()))}"
        )
    return "\n".join(lines)
