"""The commands ``cortado compare``, for two runs or for a run and measured data, and ``cortado convergence``."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from math import isclose, log
from pathlib import Path
from typing import Any

import numpy as np

from cortado.cli.existing_runs import OwnQuantity, named_runs
from cortado.errors import InputError, shown, warn
from cortado.pictures.film import is_out
from cortado.pictures.run_pictures import beside_measured
from cortado.runs.run_folder import RunFolder, differences, read_json
from cortado.runs.sensor import measured_beside, summary
from cortado.runs.trajectory import Trajectory

IGNORED = ("command", "started", "resumed", "settings", "kind")
SAME_TIME = 1e-9
"""Relative difference below which two times count as equal."""
FIELD_UNITS = {"positions": "m", "velocities": "m/s", "mass_fractions": "-"}
SPACING, TIME_STEP = "discretisation.spacing", "solver.time_step"
SIZE_UNITS = {SPACING: "m", TIME_STEP: "s"}
LEAST_RUNS = 3
LEAST_ORDER, MOST_ORDER = 1e-3, 20.0
"""Range of possible orders of convergence."""
LOWEST, HIGHEST = 0.5, 2.0
"""Range of trusted orders of convergence."""
SAFE, UNSURE = 1.25, 3.0
"""Safety factors of the estimated error for a trusted order of convergence and for any other case (Roache 1994)."""


def compare_runs(first: Path, second: Path, as_json: bool) -> str:
    one, other = RunFolder.open(first), RunFolder.open(second)
    paths = (one.environment, other.environment, one.scene, other.scene)
    here, there, *scenes = (_table(read_json(path)) if path.exists() else {} for path in paths)
    environments = [{key: value for key, value in noted.items() if key not in IGNORED} for noted in (here, there)]
    settings = [{"kind": noted.get("kind"), **_table(noted.get("settings"))} for noted in (here, there)]
    unlike, state = partial(differences, missing="missing"), _last_states(one, other)
    found: dict[str, Any] = {
        "runs": [str(one.path), str(other.path)],
        "scene": unlike(*scenes),
        "settings": unlike(*settings),
        "environment": unlike(*environments),
        "result": unlike(one.read_result() or {}, other.read_result() or {}),
        "metrics": _metrics(one, other, settings, scenes),
        "last_state": state,
    }
    same_state = state is None or (
        "unlike" not in state
        and bool(_at_one_time(*state["times_s"]))
        and not any(field["greatest"] for field in state["fields"].values())
    )
    equal = same_state and not any(found[part] for part in ("scene", "settings", "result", "metrics"))
    if as_json:
        return json.dumps({"equal": equal, **found}, indent=2)
    lines = [f"first: {one.path}", f"second: {other.path}"]
    lines += [_part("scene", found["scene"]), _part("settings", found["settings"]), _state(state)]
    lines += [_metric_line(found["metrics"]), _part("result", found["result"])]
    lines += [_part("environment", found["environment"]), f"The two runs {'are equal' if equal else 'differ'}."]
    return "\n".join(lines)


def _table(value: Any) -> dict[str, Any]:
    return dict(value) if isinstance(value, Mapping) else {}


def _metrics(one: RunFolder, other: RunFolder, settings: list[dict[str, Any]], scenes: list[Any]) -> dict[str, Any]:
    steps = [_table(scene.get("solver")).get("time_step") for scene in scenes]
    same = steps[0] == steps[1] and (steps[0] != "auto" or scenes[0] == scenes[1])
    if not same and all(table["kind"] == "run" for table in settings):
        words = ["a length that is chosen" if step == "auto" else f"{step} s" for step in steps]
        return {"unlike": f"time steps of {words[0]} and {words[1]} cannot be compared one by one"}
    rows, others = one.read_metrics(), other.read_metrics()
    found: dict[str, Any] = {} if len(rows) == len(others) else {"lines": [len(rows), len(others)]}
    pairs = [(k, row, twin) for k, (row, twin) in enumerate(zip(rows, others, strict=False)) if row != twin]
    if pairs:
        found["first_different_line"] = pairs[0][0] + 1
        names = [name for name, value in rows[0].items() if isinstance(value, (int, float)) and name in others[0]]
        found["greatest_difference"] = {
            name: max(abs(row[name] - twin[name]) for _, row, twin in pairs if name in row and name in twin)
            for name in names
            if any(row.get(name) != twin.get(name) for _, row, twin in pairs)
        }
    return found


def _last_states(one: RunFolder, other: RunFolder) -> dict[str, Any] | None:
    """Compare the fields of two runs at the latest time at which both runs have a frame."""
    if not (one.trajectory.exists() and other.trajectory.exists()):
        return None
    runs = [Trajectory.load(folder.trajectory) for folder in (one, other)]
    if not all(map(len, runs)):
        return None
    frames = [run[-1] for run in runs]
    found: dict[str, Any] = {"times_s": [frame.time for frame in frames]}
    if not _at_one_time(*found["times_s"]):
        times, others = (run.times for run in runs)
        pairs = ((k, int(np.abs(others - times[k]).argmin())) for k in range(len(times) - 1, 0, -1))
        same = next(((k, near) for k, near in pairs if near and _at_one_time(times[k], others[near])), None)
        if same is None:  # but perhaps the first frames
            return {**found, "unlike": "these are different times, and no frames are at the same time", "fields": {}}
        frames = [run[k] for run, k in zip(runs, same, strict=True)]
    found["compared_at_s"] = frames[0].time
    shapes = [frame.positions.shape for frame in frames]
    if shapes[0] != shapes[1]:
        words = [f"{particles} particles in {dimension}-D" for particles, dimension in shapes]
        return {**found, "unlike": f"{words[0]} and {words[1]} cannot be compared one by one", "fields": {}}
    fields = {}
    for name, unit in FIELD_UNITS.items():
        values = [getattr(frame, name) for frame in frames]
        if all(value is not None for value in values) and values[0].shape == values[1].shape:
            apart = np.linalg.norm(values[0].astype(np.float64) - values[1].astype(np.float64), axis=1)
            sizes = {"root_mean_square": float(np.sqrt(np.mean(apart**2))), "greatest": float(apart.max())}
            fields[name] = {"unit": unit, **sizes, "particle": int(apart.argmax())}
    return {**found, "fields": fields}


def _at_one_time(one: Any, other: Any) -> Any:
    return np.isclose(one, other, rtol=SAME_TIME, atol=0.0)


def _part(name: str, differences: Mapping[str, list[Any]]) -> str:
    if not differences:
        return f"{name}: the same"
    rows = [f"    {key}: {shown(one)} | {shown(other)}" for key, (one, other) in differences.items()]
    return "\n".join([f"{name}: differs, first | second", *rows])


def _state(state: Mapping[str, Any] | None) -> str:
    if state is None:
        return "last state: not compared, as not both runs have a trajectory"
    first, second = state["times_s"]
    same = _at_one_time(first, second)
    at = f"at {first:g} s" if same else f"at {first:g} s | {second:g} s"
    if "unlike" in state:
        return f"last state {at}: {state['unlike']}"
    if not same:
        at += f", compared at {state['compared_at_s']:g} s"
    words = [
        f"{name} apart by {field['root_mean_square']:.3g} {field['unit']} (root mean square), at most "
        f"{field['greatest']:.3g} {field['unit']} (particle {field['particle']})"
        if field["greatest"]
        else f"{name} the same bit for bit"
        for name, field in state["fields"].items()
    ]
    return f"last state {at}: {'; '.join(words)}"


def _metric_line(metrics: Mapping[str, Any]) -> str:
    words = [metrics["unlike"]] if "unlike" in metrics else []
    words += [f"{metrics['lines'][0]} | {metrics['lines'][1]} lines"] if "lines" in metrics else []
    if "first_different_line" in metrics:
        greatest = ", ".join(f"{name} by {value:.3g}" for name, value in metrics["greatest_difference"].items())
        at_most = f", at most {greatest}" if greatest else ""
        words.append(f"the first that differs is line {metrics['first_different_line']}{at_most}")
    return f"metrics: {'; '.join(words) or 'the same'}"


def compare_with_data(run: Path, data: Path, as_json: bool) -> str:
    folder = RunFolder.open(run)
    readings = folder.read_sensors()
    if not readings:
        raise InputError(f"{folder.path} has no sensors.csv, but must be a run of a scene with [[sensor]]s.")
    found = measured_beside(data, readings)
    plot = beside_measured(readings, found, folder.figures / "measured.png")
    if as_json:
        each = {one.name: {"unit": one.unit, "points": len(one.times), **one.errors} for one in found}
        return json.dumps({"run": str(folder.path), "data": str(data), "plot": str(plot), "errors": each}, indent=2)
    lines = [
        f"{one.name}: simulated less measured {off['root_mean_square']:.3g} {one.unit} (root mean square), mean "
        f"{off['mean']:.3g} {one.unit}, at most {off['greatest']:.3g} {one.unit} at {off['greatest_at_s']:g} s; "
        f"{len(one.times)} points{f', {one.left_out} more are outside of the run' if one.left_out else ''}"
        for one, off in ((one, one.errors) for one in found)
    ]
    return "\n".join([*lines, f"The plot is {plot}."])


class Resolved:
    def __init__(self, folder: RunFolder, quantities: Sequence[OwnQuantity]):
        result = folder.read_result()
        if result is None or result["failures"] or "energy" not in result or not folder.trajectory.exists():
            raise InputError(f"{folder.path} is not the folder of a completed run, but each RUN must be one.")
        trajectory = Trajectory.load(folder.trajectory)
        last, self.path, self.scene = trajectory[-1:], folder.path, read_json(folder.scene)
        self.precision = read_json(folder.environment).get("settings", {}).get("precision", "")
        self.end = float(last.times[0])
        """End time of the run [s]."""
        masses = last.constants["reference_density"].astype(np.float64)
        self.mass = float(masses.sum()) * float(self.scene["discretisation"]["spacing"]) ** last.dimension
        """Mass of the fluid [kg], in 2-D of a layer 1 m thick."""
        numbers = {f"{kind} energy": ("J", float(result["energy"]["last"][kind])) for kind in ("kinetic", "potential")}
        if self.scene.get("emitter") or self.scene.get("drain"):  # in which particles rest far from the fluid
            masses = masses * is_out(folder.read_scene(), last[0].others, len(masses))
        centre = masses @ last.positions[0].astype(np.float64) / (masses.sum() or np.nan)
        numbers |= {f"centre of mass, {axis}": ("m", float(x)) for axis, x in zip("xyz", centre, strict=False)}
        readings = folder.read_sensors()
        for name, columns in summary(readings).items():
            for column, found in columns.items():
                unit = readings[name].units[column]
                numbers |= {f"{name} {column}": (unit, found["last"]), f"{name} {column}, mean": (unit, found["mean"])}
        self.numbers = numbers | {one.name: ("", one(trajectory)) for one in quantities}
        """Results of the run by name, each with its unit and value."""

    def size(self, key: str) -> float:
        """Return the spacing [m] or the time step [s]. Raises `InputError` if the solver chooses the time steps."""
        table, name = key.split(".")
        value = self.scene[table][name]
        if not isinstance(value, float | int):
            raise InputError(f"The solver of {self.path} chooses the {name}, but the {name} must be fixed.")
        return float(value)


def convergence_table(folders: Sequence[Path], quantities: Sequence[str], as_json: bool) -> str:
    own = [OwnQuantity(one) for one in quantities]
    runs = [Resolved(folder, own) for folder in named_runs(folders)]
    if len(runs) < LEAST_RUNS:
        raise InputError(f"RUN names {len(runs)} runs, but an order of convergence takes at least {LEAST_RUNS} runs.")
    key = _varied(runs)
    runs.sort(key=lambda run: -run.size(key))
    sizes = [run.size(key) for run in runs]
    for coarse, fine in pairwise(runs):
        if coarse.size(key) == fine.size(key):
            raise InputError(f"{coarse.path} and {fine.path} have the same {key}, but must differ.")
        if abs(coarse.end - fine.end) > SAME_TIME * abs(fine.end):
            found = f"{coarse.path} ends at {coarse.end:g} s and {fine.path} at {fine.end:g} s"
            advice = "choose a --time that is a multiple of every time step"
            raise InputError(f"{found}, but all runs must end at the same time: {advice}.")
    least, most = (choose(runs, key=lambda run: run.mass) for choose in (min, max))
    if most.mass > 1.005 * least.mass:  # an order of convergence does not describe that difference
        found = f"{least.mass:.4g} kg with a spacing of {least.size(SPACING):g} m, {most.mass:.4g} kg with"
        advice = "Choose spacings that divide the sizes of all bodies of fluid."
        warn(f"the runs do not have the same fluid: {found} {most.size(SPACING):g} m. {advice}")
    rows = []
    for name, (unit, _) in runs[0].numbers.items():
        values = [run.numbers[name][1] for run in runs]
        rows.append({"name": name, "unit": unit, "values": values, **vars(Extrapolation.of(sizes, values))})
    is_auto = runs[0].scene["solver"]["time_step"] == "auto"
    told = {other: [run.size(other) for run in runs] for other in SIZE_UNITS if other != key and not is_auto}
    paths = [str(run.path) for run in runs]
    table = {"by": key, "end_s": runs[-1].end, "runs": paths, key: sizes, **told, "rows": rows}
    return json.dumps(table, indent=2) if as_json else _convergence_in_words(table)


def _varied(runs: Sequence[Resolved]) -> str:
    """Return the key of the scene that differs between the runs: the spacing or the time step."""
    changed: set[str] = set()
    for run in runs[1:]:
        changed |= differences(runs[0].scene, run.scene).keys()
        if run.precision != runs[0].precision:
            raise InputError(f"{run.path} is in {run.precision}, but must be in {runs[0].precision} as {runs[0].path}.")
    if more := sorted(changed - SIZE_UNITS.keys()):
        raise InputError(f"The runs differ in {', '.join(more)}, but may differ only in {SPACING} and {TIME_STEP}.")
    if not changed:
        raise InputError(f"The runs do not differ, but must differ in {SPACING} or {TIME_STEP}.")
    return SPACING if SPACING in changed else TIME_STEP


def _convergence_in_words(table: dict[str, Any]) -> str:
    key = table["by"]
    lines = [["", *(f"run {k}" for k in range(1, len(table["runs"]) + 1)), "order", "limit", "error", ""]]
    sizes = (key, *(other for other in SIZE_UNITS if other != key and other in table))
    lines += [[f"{one} [{SIZE_UNITS[one]}]", *(f"{size:g}" for size in table[one]), "", "", "", ""] for one in sizes]
    for row in table["rows"]:
        limit, error, finest = row["limit"], row["error"], row["values"][-1]
        share = f" ({100.0 * error / abs(finest):.2g} %)" if error is not None and finest else ""
        name = f"{row['name']} [{row['unit']}]" if row["unit"] else row["name"]
        found = ["" if row["order"] is None else f"{row['order']:.2f}", "" if limit is None else f"{limit:.6g}"]
        found += ["" if error is None else f"{error:.2g}{share}", row["flag"]]
        lines.append([name, *(f"{value:.6g}" for value in row["values"]), *found])
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    aligned = ("  ".join([line[0].ljust(widths[0]), *map(str.rjust, line[1:], widths[1:])]).rstrip() for line in lines)
    return "\n".join([f"{len(table['runs'])} runs until {table['end_s']:g} s, by {key}", *aligned])


@dataclass(frozen=True)
class Extrapolation:
    """The extrapolation of a result to vanishing spacing or time step. The model f(h) = limit + C h^order of the result
    f at size h, with an unknown constant C, is fitted to the three finest sizes.

    Source: L. F. Richardson, Phil. Trans. R. Soc. A 210 (1911), 307; the grid convergence index of P. J. Roache, J.
    Fluids Eng. 116 (1994), 405; for sizes with different ratios, I. B. Celik et al., J. Fluids Eng. 130 (2008), 078001.
    Without an observed order, the error is three times the greatest difference between the results at the three sizes:
    L. Eca and M. Hoekstra, J. Comput. Phys. 262 (2014), 104."""

    order: float | None
    """Observed order of convergence, or None if the values do not converge."""
    limit: float | None
    """Extrapolated value, or None. The extrapolation clips the order to the range from `LOWEST` to `HIGHEST`."""
    error: float | None
    """Estimated error of the value at the finest size, including a safety factor. None if a value is NaN."""
    flag: str = ""
    """Reason why the order is missing or not trusted. The text is empty if the order is trusted."""

    @classmethod
    def of(cls, sizes: Sequence[float], values: Sequence[float]) -> "Extrapolation":
        (h_3, h_2, h_1), (f_3, f_2, f_1) = sizes[-3:], values[-3:]
        fine, coarse = f_2 - f_1, f_3 - f_2
        if not np.isfinite([fine, coarse]).all():
            return cls(None, None, None, "not a number")
        widest = UNSURE * float(np.ptp([f_1, f_2, f_3]))
        if fine == 0.0:
            return cls(None, f_1, widest, "the two finest are equal")
        if fine * coarse < 0.0:
            return cls(None, None, widest, "it goes up and down")
        ratio, r_21, r_32 = coarse / fine, h_2 / h_1, h_3 / h_2
        if ratio <= log(r_32) / log(r_21):
            return cls(None, None, widest, "it does not come to rest")

        def excess(p: float) -> float:
            return float(r_21**p * (r_32**p - 1.0) / (r_21**p - 1.0) / ratio - 1.0)

        if excess(LEAST_ORDER) * excess(MOST_ORDER) > 0.0:
            return cls(None, None, widest, "it has no order that can be told")
        from scipy.optimize import brentq

        order = float(brentq(excess, LEAST_ORDER, MOST_ORDER, xtol=1e-12))
        used = min(max(order, LOWEST), HIGHEST)
        away, is_believed = fine / (r_21**used - 1.0), isclose(used, order, rel_tol=1e-6)
        flag = "" if is_believed else f"the order is taken as {used:g}"
        return cls(order, f_1 - away, (SAFE if is_believed else UNSURE) * abs(away), flag)
