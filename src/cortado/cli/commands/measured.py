"""``cortado compare RUN DATA.csv``: what sensors read beside what was measured, in a plot, with errors."""

import json
from pathlib import Path

from cortado.errors import InputError
from cortado.pictures.run_plots import beside_measured
from cortado.runs.run_folder import RunFolder
from cortado.runs.sensors.readings import MeasuredColumn, measured_beside


def compare_with_data(run: Path, data: Path, as_json: bool) -> str:
    """The errors, as text or as JSON; the plot is written into the run's figures."""
    folder = RunFolder.open(run)
    readings = folder.read_sensors()
    if not readings:
        raise InputError(f"{folder.path} has no sensors.csv, but must be a run of a scene with [[sensor]]s.")
    found = measured_beside(data, readings)
    plot = beside_measured(readings, found, folder.figures / "measured.png")
    if as_json:
        each = {one.name: {"unit": one.unit, "points": len(one.times), **one.errors} for one in found}
        return json.dumps({"run": str(folder.path), "data": str(data), "plot": str(plot), "errors": each}, indent=2)
    return "\n".join([*map(_line, found), f"The plot is {plot}."])


def _line(one: MeasuredColumn) -> str:
    errors, unit = one.errors, one.unit
    left_out = f", {one.left_out} more are outside of the run" if one.left_out else ""
    return (
        f"{one.name}: simulated less measured {errors['root_mean_square']:.3g} {unit} (root mean square), mean "
        f"{errors['mean']:.3g} {unit}, at most {errors['greatest']:.3g} {unit} at {errors['greatest_at_s']:g} s; "
        f"{len(one.times)} points{left_out}"
    )
