"""``cortado compare``: two runs, how far apart they ended and why that may be."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from cortado.errors import InputError, shown
from cortado.files.input_files import content, reason
from cortado.files.output_files import parsed_json
from cortado.pictures.side_by_side import differences
from cortado.runs.run_folder import RunFolder
from cortado.runs.trajectory import Trajectory

_LARGEST = 2**31
"""Bytes of a file that is read."""
_IGNORED = ("command", "started", "resumed", "settings", "kind", "format")
"""Keys of environment.json that differ between any two runs, or are compared apart."""
SAME_TIME = 1e-9
"""Relative: times that differ by less are the same, as so many steps of another length add up to."""
_UNITS = {"positions": "m", "velocities": "m/s", "mass_fractions": "-"}
"""Of the fields of a frame."""


def compare_runs(first: Path, second: Path, as_json: bool) -> str:
    """What is the same and what differs, as text or as JSON. Two runs that differ are no failure."""
    found = _compared(RunFolder.open(first), RunFolder.open(second))
    return json.dumps(found, indent=2) if as_json else _as_text(found)


def _compared(one: RunFolder, other: RunFolder) -> dict[str, Any]:
    here, there = (_json(folder.environment) for folder in (one, other))
    environments = [{key: value for key, value in noted.items() if key not in _IGNORED} for noted in (here, there)]
    settings = [{"kind": noted.get("kind"), **_table(noted.get("settings"))} for noted in (here, there)]
    scenes = [_json(folder.scene) for folder in (one, other)]
    found: dict[str, Any] = {
        "runs": [str(one.path), str(other.path)],
        "scene": differences(scenes[0], scenes[1]),
        "settings": differences(settings[0], settings[1]),
        "environment": differences(environments[0], environments[1]),
        "result": differences(one.read_result() or {}, other.read_result() or {}),
        "metrics": _other_steps(settings, scenes) or _metrics(one, other),
        "last_state": _last_states(one, other),
    }
    return {"equal": _is_equal(found), **found}


def _is_equal(found: Mapping[str, Any]) -> bool:
    """Whether nothing differs but where the runs were made."""
    state = found["last_state"]
    same_state = state is None or (
        "unlike" not in state and _at_one_time(*state["times_s"]) and not any(map(_size, state["fields"].values()))
    )
    same = not any(found[part] for part in ("scene", "settings", "result")) and not found["metrics"]
    return same and same_state


def _size(field: Mapping[str, Any]) -> float:
    return field["greatest"]


def _json(path: Path) -> dict[str, Any]:
    """Of a file that may not be there; raises `InputError`."""
    if not path.exists():
        return {}
    try:
        return _table(parsed_json(content(path, _LARGEST)))
    except (OSError, ValueError) as problem:
        raise InputError(f"{path} cannot be read: {reason(problem)}.") from problem


def _table(value: Any) -> dict[str, Any]:
    return dict(value) if isinstance(value, Mapping) else {}


def _other_steps(settings: list[dict[str, Any]], scenes: list[dict[str, Any]]) -> dict[str, Any]:
    """What to say of the metrics of two runs, of which line k is at another time in each; empty where it is at the
    same."""
    steps = [_table(scene.get("solver")).get("time_step") for scene in scenes]
    same = steps[0] == steps[1] and (steps[0] != "auto" or scenes[0] == scenes[1])
    if same or any(table["kind"] != "run" for table in settings):
        return {}
    words = ["a length that is chosen" if step == "auto" else f"{step} s" for step in steps]
    return {"unlike": f"time steps of {words[0]} and {words[1]} cannot be compared one by one"}


def _metrics(one: RunFolder, other: RunFolder) -> dict[str, Any]:
    """The first line that differs, and of every number the greatest difference over the lines that both have."""
    rows, others = one.read_metrics(), other.read_metrics()
    found: dict[str, Any] = {} if len(rows) == len(others) else {"lines": [len(rows), len(others)]}
    differ = [k for k, (row, twin) in enumerate(zip(rows, others, strict=False)) if row != twin]
    if differ:
        found["first_different_line"] = differ[0] + 1
        names = [name for name, value in rows[0].items() if isinstance(value, (int, float)) and name in others[0]]
        pairs = [(rows[k], others[k]) for k in differ]
        found["greatest_difference"] = {
            name: max(abs(row[name] - twin[name]) for row, twin in pairs if name in row and name in twin)
            for name in names
            if any(row.get(name) != twin.get(name) for row, twin in pairs)
        }
    return found


def _last_states(one: RunFolder, other: RunFolder) -> dict[str, Any] | None:
    """How far apart positions and velocities are, of the last frames that are at the same time; None where a run has no
    trajectory. ``times_s``: of the last frames."""
    if not (one.trajectory.exists() and other.trajectory.exists()):
        return None
    runs = [Trajectory.load(folder.trajectory) for folder in (one, other)]
    if not all(map(len, runs)):
        return None
    frames = [run[-1] for run in runs]
    found: dict[str, Any] = {"times_s": [frame.time for frame in frames]}
    if not _at_one_time(*found["times_s"]):
        pair = _last_at_one_time(*(run.times for run in runs))
        if pair is None:
            return {
                **found,
                "unlike": "these are different times, and no frames are at the same time",
                "fields": {},
            }
        frames = [run[k] for run, k in zip(runs, pair, strict=True)]
    found["compared_at_s"] = frames[0].time
    shapes = [frame.positions.shape for frame in frames]
    if shapes[0] != shapes[1]:
        words = [f"{particles} particles in {dimension}-D" for particles, dimension in shapes]
        return {**found, "unlike": f"{words[0]} and {words[1]} cannot be compared one by one", "fields": {}}
    fields = {}
    for name, unit in _UNITS.items():
        values = [getattr(frame, name) for frame in frames]
        if all(value is not None for value in values) and values[0].shape == values[1].shape:
            fields[name] = {"unit": unit, **_distance(*(value.astype(np.float64) for value in values))}
    return {**found, "fields": fields}


def _at_one_time(one: Any, other: Any) -> Any:
    """Whether times [s] are the same but for round-off; of arrays element by element."""
    return np.isclose(one, other, rtol=SAME_TIME, atol=0.0)


def _last_at_one_time(one: np.ndarray, other: np.ndarray) -> tuple[int, int] | None:
    """The last frame of each run, given their times (frames,) [s], that is at the time of one of the other run; the
    first frame, from which both began, does not count."""
    if len(one) < 2 or len(other) < 2:
        return None
    after = np.clip(np.searchsorted(other, one), 1, len(other) - 1)
    near = np.where(np.abs(other[after - 1] - one) < np.abs(other[after] - one), after - 1, after)
    same = [k for k in range(1, len(one)) if near[k] and _at_one_time(one[k], other[near[k]])]
    return (same[-1], int(near[same[-1]])) if same else None


def _distance(one: np.ndarray, other: np.ndarray) -> dict[str, Any]:
    """Of vectors (n, d) of the same particles."""
    apart = np.linalg.norm(one - other, axis=1)
    return {
        "root_mean_square": float(np.sqrt(np.mean(apart**2))),
        "greatest": float(apart.max()),
        "particle": int(apart.argmax()),
    }


# ---- words -------------------------------------------------------------------------------------------------------


def _as_text(found: Mapping[str, Any]) -> str:
    lines = [f"first: {found['runs'][0]}", f"second: {found['runs'][1]}"]
    lines += [_part("scene", found["scene"]), _part("settings", found["settings"])]
    lines += [_state(found["last_state"]), _metric_line(found["metrics"])]
    lines += [_part("result", found["result"]), _part("environment", found["environment"])]
    lines.append("The two runs are equal." if found["equal"] else "The two runs differ.")
    return "\n".join(lines)


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
    if not metrics:
        return "metrics: the same"
    if "unlike" in metrics:
        return f"metrics: {metrics['unlike']}"
    words = [f"{metrics['lines'][0]} | {metrics['lines'][1]} lines"] if "lines" in metrics else []
    if "first_different_line" in metrics:
        greatest = ", ".join(f"{name} by {value:.3g}" for name, value in metrics["greatest_difference"].items())
        at_most = f", at most {greatest}" if greatest else ""
        words.append(f"the first that differs is line {metrics['first_different_line']}{at_most}")
    return f"metrics: {'; '.join(words)}"
