"""The rows of `validation/README.md`, which stand in `measured.csv` with the date, commit and machine of each figure.

A script of this folder prints a row by `Printer.row`. With ``--write`` it also replaces the figures of that row in
`measured.csv`. ``python validation/measured_rows.py`` then writes the tables of the page.
"""

import csv
import datetime
import platform
import re
import subprocess
import time
import warnings
from argparse import ArgumentParser, Namespace
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

from cortado.errors import CortadoWarning

FOLDER = Path(__file__).parent
DATA, PAGE = FOLDER / "measured.csv", FOLDER / "README.md"
Figures = dict[str, list[float]]
"""Of rows, by their names."""
HEAD = ("claim", "setting", "measured", "exact", "off", "command and when")
MEASURED = re.compile(r"\{([^}]*)\}")
"""Figures that the command of the row prints; the rest of a cell stays as it was written."""


@dataclass(frozen=True)
class Row:
    name: str
    section: str
    claim: str
    setting: str
    measured: str
    exact: str
    """A number for all figures, one for each, or nothing where no closed form is known."""
    off: str
    command: str
    date: str
    commit: str
    machine: str

    @property
    def figures(self) -> list[str]:
        return [figure for group in MEASURED.findall(self.measured) for figure in group.split(", ")]

    def measured_anew(self, values: Iterable[float]) -> "Row":
        """The row with other figures, as precise as those that it has."""
        values = iter(values)

        def rounded(figure: str) -> str:
            digits = len(figure.partition(".")[2])
            return f"{round(next(values), digits) + 0.0:,.{digits}f}"  # which is never -0.0

        def group(found: re.Match[str]) -> str:
            return "{" + ", ".join(map(rounded, found[1].split(", "))) + "}"

        row = replace(self, measured=MEASURED.sub(group, self.measured))
        if next(values, None) is not None:
            raise ValueError(f"The row {self.name} has {len(self.figures)} figures, and more were measured.")
        return row

    def off_by(self) -> str:
        """The greatest distance of a figure from what is exact, relative unless that is 0."""
        if not self.exact:
            return "no closed form"
        known = [float(one) for one in self.exact.split(", ")]
        figures = [float(figure.replace(",", "")) for figure in self.figures]
        known *= len(figures) if len(known) == 1 else 1
        return f"{max(abs(one - at) / (abs(at) or 1.0) for one, at in zip(figures, known, strict=True)):.3g}"

    def line(self) -> str:
        """The row of the page."""
        when = f"{self.date}, {self.commit}" if self.machine else f"*{self.date}, {self.commit}*"
        cells = asdict(self) | {"measured": MEASURED.sub(r"\1", self.measured)}
        return "| " + " | ".join(cells[name] or "—" for name in HEAD[:-1]) + f" | `{self.command}` {when} |"


def read() -> dict[str, Row]:
    with DATA.open(encoding="utf-8", newline="") as file:
        return {row["name"]: Row(**row) for row in csv.DictReader(file)}


def write(rows: dict[str, Row]) -> None:
    with DATA.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, [field.name for field in fields(Row)], lineterminator="\n")
        writer.writeheader()
        writer.writerows(map(asdict, rows.values()))


def page(text: str, rows: dict[str, Row]) -> str:
    """The page with the tables that the rows make, each in the section that they name."""
    head = "\n".join((f"| {' | '.join(HEAD)} |", "|" + len(HEAD) * "---|"))
    for section in dict.fromkeys(row.section for row in rows.values()):
        lines = [row.line() for row in rows.values() if row.section == section]
        table = re.compile(rf"(^## {re.escape(section)}\n(?:(?!^## |^\|).*\n)*)(?:^\|.*\n)+", re.MULTILINE)
        text, found = table.subn(lambda match, lines=lines: match[1] + "\n".join((head, *lines)) + "\n", text)
        if found != 1:
            raise ValueError(f"The page has no table under {section}.")
    return text


class Printer:
    """Prints rows in one form, and writes them to `measured.csv` where ``--write`` asks for it."""

    @staticmethod
    def add_to(parser: ArgumentParser) -> None:
        parser.add_argument("--write", action="store_true", help="replace the figures in validation/measured.csv")

    def __init__(self, given: Namespace) -> None:
        self.writes: bool = given.write
        device = getattr(given, "device", "cpu")
        self.machine = _processor() if device == "cpu" else device

    def row(self, name: str, values: Iterable[float]) -> None:
        rows = read()
        row = rows[name].measured_anew(values)
        measured = MEASURED.sub(r"\1", row.measured)
        print(
            f"ROW {row.claim} | {row.setting} | measured: {measured} | exact: {row.exact or '—'} | "
            f"off by: {row.off_by()} | in the page: {', '.join(rows[name].figures)}",
            flush=True,
        )
        if self.writes:
            today = datetime.datetime.now(datetime.UTC).date().isoformat()
            commit = subprocess.run(
                ("git", "rev-parse", "--short=8", "HEAD"), cwd=FOLDER, capture_output=True, text=True, check=True
            ).stdout.strip()
            write(rows | {name: replace(row, date=today, commit=commit, machine=self.machine)})

    def rows(self, figures: Figures) -> None:
        for name, values in figures.items():
            self.row(name, values)


@dataclass(frozen=True)
class Measure:
    """How the figures of a row come from what cases found."""

    cases: tuple[str, ...]
    """Their names, or what these begin with; then each stands for all cases whose names begin so, in their order."""
    figures: Callable[[list[Any]], Iterable[float]]


def run_cases(cases: Mapping[str, Callable[[], object]], measures: Mapping[str, Measure], given: Namespace) -> None:
    """Run the cases whose names begin with ``--only``, print what each found, and the rows all of whose cases ran."""
    warnings.simplefilter("ignore", CortadoWarning)
    printer, found = Printer(given), {}
    for name, case in cases.items():
        if name.startswith(given.only):
            begun = time.perf_counter()
            found[name] = case()
            print(f"{name}: {found[name]} ({time.perf_counter() - begun:.0f} s)", flush=True)
    for row, measure in measures.items():
        needed = [name for one in measure.cases for name in ([one] if one in cases else _begin(one, cases))]
        if found.keys() >= set(needed):
            printer.row(row, measure.figures([found[name] for name in needed]))


def _begin(beginning: str, names: Iterable[str]) -> list[str]:
    return [name for name in names if name.startswith(beginning)]


def _processor() -> str:
    """As Linux names it, or by its kind."""
    info = Path("/proc/cpuinfo")
    found = re.search(r"^model name\s*: (.*)$", info.read_text(), re.MULTILINE) if info.exists() else None
    return found[1] if found else platform.machine()


def main() -> None:
    PAGE.write_text(page(PAGE.read_text(encoding="utf-8"), read()), encoding="utf-8")


if __name__ == "__main__":
    main()
