"""The table of a sweep, sweep.csv: a row for each combination that has ended, in the order asked for."""

import csv
import io
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from cortado.files.output_files import write_atomically
from cortado.optimisation.sweep.combinations import Combination

NAME = "sweep.csv"
MOST_NUMBERS = 12
"""Of a list that the table shows; longer ones are in the result.json of each folder alone."""


def write_table(folder: Path, combinations: Sequence[Combination], results: Mapping[int, Mapping[str, Any]]) -> None:
    """Write the table, whole or not at all.

    ``results``: what came out, as in result.json, by the number of the combination. Columns: the folder, every key that
    changes, "done" or "failed", every number that came out, and why it failed.
    """
    rows = [_row(combinations[number], results[number]) for number in sorted(results)]
    columns = list(dict.fromkeys(column for row in rows for column in row if column != "failures")) + ["failures"]
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write_atomically(folder / NAME, text.getvalue())


def folders_in(folder: Path) -> list[str]:
    """The names of the folders in the table of a sweep, in its order; none where there is no table that can be read."""
    try:
        with open(folder / NAME, newline="", encoding="utf-8") as file:
            return [row["folder"] for row in csv.DictReader(file)]
    except (OSError, ValueError, KeyError, csv.Error):
        return []


def failed(result: Mapping[str, Any]) -> bool:
    """Whether something did not come out as it should."""
    return bool(result["failures"])


def _row(combination: Combination, result: Mapping[str, Any]) -> dict[str, Any]:
    found = {name: value for name, value in result.items() if name != "failures"}
    return {
        "folder": combination.name,
        **dict(combination.values),
        "status": "failed" if failed(result) else "done",
        **_flat(found),
        "failures": " ".join(result["failures"]),
    }


def _flat(result: Mapping[str, Any], before: str = "") -> dict[str, Any]:
    """Tables within tables as one, their names joined by full stops; short lists as JSON, longer ones left out."""
    found: dict[str, Any] = {}
    for name, value in result.items():
        if isinstance(value, Mapping):
            found |= _flat(value, f"{before}{name}.")
        elif not isinstance(value, list):
            found[f"{before}{name}"] = value
        elif len(text := json.dumps(value)) and text.count(",") < MOST_NUMBERS:
            found[f"{before}{name}"] = text
    return found
