"""Tracks that somebody wrote down: what is wrong with a table is said in a sentence, and it is never used."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

import cortado
from cortado.optimisation.solved_task import observation
from cortado.optimisation.task_tables import TracksTable
from fuzz.cases import Case
from fuzz.files import PLANE
from fuzz.oddities import Random

TRACERS, TIMES = 3, 5
STEP = 0.01
"""[s] between two lines of a tracer."""
Row = list[str]
Damage = Callable[[list[Row], Random], list[Row]]


def good(random: Random) -> list[Row]:
    """The head of a table, and a line for each tracer and time."""
    first = random.uniform(0.1, 0.3, (TRACERS, 2))
    lines = [
        [f"{STEP * k:g}", str(n), *(f"{place:.5f}" for place in first[n] - [0.0, 0.01 * k])]
        for k in range(TIMES)
        for n in range(TRACERS)
    ]
    return [["time", "tracer", "x", "y"], *lines]


def _in_another_order(table: list[Row], random: Random) -> list[Row]:
    return [table[0], *(table[1 + k] for k in random.permutation(len(table) - 1))]


def _columns_in_another_order(table: list[Row], random: Random) -> list[Row]:
    order = random.permutation(4)
    return [[row[k] for k in order] for row in table]


def _numbers_from_another_start(table: list[Row], random: Random) -> list[Row]:
    return [table[0], *([time, str(int(who) + 7), *place] for time, who, *place in table[1:])]


def _twice_at_one_time(table: list[Row], random: Random) -> list[Row]:
    time, who, x, y = table[int(random.integers(1, len(table)))]
    return [*table, [time, who, f"{float(x) + 0.1:.5f}", y]]


def _the_same_line_twice(table: list[Row], random: Random) -> list[Row]:
    return [*table, table[int(random.integers(1, len(table)))]]


def _nearly_at_one_time(table: list[Row], random: Random) -> list[Row]:
    time, who, x, y = table[int(random.integers(1, len(table)))]
    return [*table, [f"{float(time) + 1e-12:.13f}", who, f"{float(x) + 0.1:.5f}", y]]


def _without(column: int) -> Damage:
    def damaged(table: list[Row], random: Random) -> list[Row]:
        row = int(random.integers(1, len(table)))
        return [[*own[:column], "", *own[column + 1 :]] if k == row else own for k, own in enumerate(table)]

    damaged.__name__ = f"without {('time', 'tracer')[column]}"
    return damaged


def _half_a_tracer(table: list[Row], random: Random) -> list[Row]:
    row = int(random.integers(1, len(table)))
    return [[own[0], "0.5", *own[2:]] if k == row else own for k, own in enumerate(table)]


def _a_column_twice(table: list[Row], random: Random) -> list[Row]:
    column = int(random.integers(4))
    return [[*row, row[column]] for row in table]


HARMLESS: tuple[Damage, ...] = (_in_another_order, _columns_in_another_order, _numbers_from_another_start)
WRONG: tuple[Damage, ...] = (
    _twice_at_one_time,
    _the_same_line_twice,
    _nearly_at_one_time,
    _without(0),
    _without(1),
    _half_a_tracer,
    _a_column_twice,
)


def read_tracks(case: Case) -> None:
    """A table that is only written in another way is read as the good one; one with a mistake is refused."""
    whole, is_harmless = good(case.random), bool(case.random.random() < 0.4)
    damages = HARMLESS if is_harmless else WRONG
    damage = damages[int(case.random.integers(len(damages)))]
    table = damage(whole, case.random)
    case.notes.append(damage.__name__.strip("_").replace("_", " "))
    for name, rows in (("good", whole), ("tracks", table)):
        (case.folder / f"{name}.csv").write_text("".join(",".join(row) + "\n" for row in rows))

    def compare(folder: Path) -> None:
        block = {"shape": "box", "lower": [0.0, 0.0], "upper": [0.4, 0.4], "phase": "water"}
        simulation = cortado.Simulation(cortado.Scene(**{**PLANE, "fluid": [block]}))
        wanted, found = (
            observation(TracksTable(kind="tracks", name=name, file=f"{name}.csv"), simulation, folder, 1.0)
            for name in ("good", "tracks")
        )
        if not is_harmless or not np.array_equal(found.measured, wanted.measured, equal_nan=True):
            raise SystemExit(3)

    outcome = case.read(compare, case.folder, codes=(0, 1, 3))
    if outcome.code == 3:
        case.complaints.append(
            "tracks were read that mean nothing" if not is_harmless else "tracks were read as others"
        )
    if outcome.code == 1 and is_harmless:
        case.complaints.append(f"good tracks were refused: {outcome.err.strip()}")
