"""``cortado convergence``: the same scene at several resolutions: the order of convergence, and the limit."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from cortado.cli.commands.compare import SAME_TIME
from cortado.cli.commands.named_runs import named_runs
from cortado.cli.commands.own_quantity import OwnQuantity
from cortado.errors import InputError, warn
from cortado.optimisation.sweep import Extrapolation
from cortado.pictures.side_by_side import differences
from cortado.runs.run_files import read_json
from cortado.runs.run_folder import RunFolder
from cortado.runs.sensors.readings import summary
from cortado.runs.trajectory import Trajectory

SPACING, TIME_STEP = "discretisation.spacing", "solver.time_step"
UNITS = {SPACING: "m", TIME_STEP: "s"}
LEAST = 3
"""Runs that an order takes."""
SAME_MASS = 0.005
"""Relative: masses of fluid that differ by less are the same."""


@dataclass(frozen=True)
class Resolved:
    """One of the runs."""

    path: Path
    scene: dict[str, Any]
    precision: str
    end: float
    """[s]"""
    mass: float
    """Of all fluid [kg], in 2-D of a layer 1 m thick."""
    numbers: dict[str, tuple[str, float]]
    """The unit and the value of each, by name."""

    @classmethod
    def read(cls, folder: RunFolder, quantities: Sequence[OwnQuantity]) -> "Resolved":
        """With ``quantities`` of the user's own. Raises `InputError` for a run that has not ended well."""
        result = folder.read_result()
        if result is None or result["failures"] or "energy" not in result or not folder.trajectory.exists():
            raise InputError(f"{folder.path} is no run that has ended well, but all of them must be.")
        trajectory = Trajectory.load(folder.trajectory)
        last = trajectory[-1:]
        numbers = {f"{kind} energy": ("J", float(result["energy"]["last"][kind])) for kind in ("kinetic", "potential")}
        scene, masses = read_json(folder.scene), last.constants["reference_density"].astype(np.float64)
        centre = masses @ last.positions[0].astype(np.float64) / masses.sum()
        numbers |= {f"centre of mass, {axis}": ("m", float(x)) for axis, x in zip("xyz", centre, strict=False)}
        readings = folder.read_sensors()
        for name, columns in summary(readings).items():
            for column, found in columns.items():
                unit = readings[name].units[column]
                numbers |= {f"{name} {column}": (unit, found["last"]), f"{name} {column}, mean": (unit, found["mean"])}
        numbers |= {one.name: ("", one(trajectory)) for one in quantities}
        precision = read_json(folder.environment).get("settings", {}).get("precision", "")
        mass = float(masses.sum()) * float(scene["discretisation"]["spacing"]) ** last.dimension
        return cls(folder.path, scene, precision, float(last.times[0]), mass, numbers)

    def size(self, key: str) -> float:
        """The spacing [m] or the time step [s]; raises `InputError` for one that is chosen."""
        table, name = key.split(".")
        value = self.scene[table][name]
        if not isinstance(value, float | int):
            raise InputError(f"{self.path} chooses its {name}, but must have one that is fixed.")
        return float(value)


def convergence_table(folders: Sequence[Path], quantities: Sequence[str], as_json: bool) -> str:
    """The table, as text or as JSON; raises `InputError` for runs that do not belong together."""
    own = [OwnQuantity.named(one) for one in quantities]
    runs = [Resolved.read(folder, own) for folder in named_runs(folders)]
    if len(runs) < LEAST:
        raise InputError(f"RUN names {len(runs)} runs, but an order of convergence takes at least {LEAST}.")
    key = _varied(runs)
    runs.sort(key=lambda run: -run.size(key))
    sizes = [run.size(key) for run in runs]
    for coarse, fine in pairwise(runs):
        if coarse.size(key) == fine.size(key):
            raise InputError(f"{coarse.path} and {fine.path} have one {key}, but all of them must differ.")
        if abs(coarse.end - fine.end) > SAME_TIME * abs(fine.end):
            raise InputError(
                f"{coarse.path} ends at {coarse.end:g} s and {fine.path} at {fine.end:g} s, but all runs must end at "
                "the same time: choose a --time that is a multiple of every time step."
            )
    _warn_of_masses(runs)
    rows = []
    for name, (unit, _) in runs[0].numbers.items():
        values = [run.numbers[name][1] for run in runs]
        found = Extrapolation.of(sizes, values)
        rows.append({"name": name, "unit": unit, "values": values, **vars(found)})
    others = [
        other for other in (SPACING, TIME_STEP) if other != key and runs[0].scene["solver"]["time_step"] != "auto"
    ]
    told = {other: [run.size(other) for run in runs] for other in others}
    table = {
        "by": key,
        "end_s": runs[-1].end,
        "runs": [str(run.path) for run in runs],
        key: sizes,
        **told,
        "rows": rows,
    }
    return json.dumps(table, indent=2) if as_json else _as_text(table)


def _warn_of_masses(runs: Sequence[Resolved]) -> None:
    """Say where runs have unlike amounts of fluid, which no order of convergence is about."""
    least, most = (choose(runs, key=lambda run: run.mass) for choose in (min, max))
    if most.mass > (1.0 + SAME_MASS) * least.mass:
        warn(
            f"the runs do not have the same fluid: {least.mass:.4g} kg with a spacing of {least.size(SPACING):g} m, "
            f"{most.mass:.4g} kg with {most.size(SPACING):g} m. Choose spacings that divide the sizes of all bodies of "
            "fluid."
        )


def _varied(runs: Sequence[Resolved]) -> str:
    """What tells the runs apart: the spacing, or else the time step. Raises `InputError` where more does."""
    changed: set[str] = set()
    for run in runs[1:]:
        changed |= differences(runs[0].scene, run.scene).keys()
        if run.precision != runs[0].precision:
            raise InputError(f"{run.path} is in {run.precision}, but must be in {runs[0].precision} as {runs[0].path}.")
    if more := sorted(changed - UNITS.keys()):
        raise InputError(f"The runs differ in {', '.join(more)}, but must only differ in {SPACING} and {TIME_STEP}.")
    if not changed:
        raise InputError(f"The runs do not differ, but must differ in {SPACING} or {TIME_STEP}.")
    return SPACING if SPACING in changed else TIME_STEP


def _as_text(table: dict[str, Any]) -> str:
    """A line for each number, the finest run on the right."""
    key = table["by"]
    lines = [["", *(f"run {k}" for k in range(1, len(table["runs"]) + 1)), "order", "limit", "error", ""]]
    sizes = (key, *(other for other in UNITS if other != key and other in table))
    lines += [[f"{name} [{UNITS[name]}]", *(f"{size:g}" for size in table[name]), "", "", "", ""] for name in sizes]
    for row in table["rows"]:
        limit, error, finest = row["limit"], row["error"], row["values"][-1]
        share = f" ({100.0 * error / abs(finest):.2g} %)" if error is not None and finest else ""
        lines.append(
            [
                f"{row['name']} [{row['unit']}]" if row["unit"] else row["name"],
                *(f"{value:.6g}" for value in row["values"]),
                "" if row["order"] is None else f"{row['order']:.2f}",
                "" if limit is None else f"{limit:.6g}",
                "" if error is None else f"{error:.2g}{share}",
                row["flag"],
            ]
        )
    return "\n".join([f"{len(table['runs'])} runs until {table['end_s']:g} s, by {key}", *_aligned(lines)])


def _aligned(lines: Sequence[Sequence[str]]) -> list[str]:
    """In columns, the first one to the left."""
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    return ["  ".join([line[0].ljust(widths[0]), *map(str.rjust, line[1:], widths[1:])]).rstrip() for line in lines]
