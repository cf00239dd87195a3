"""The command ``cortado sweep``, which runs a scene or a task with all combinations of values and writes a table."""

import csv
import io
import json
import re
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from hashlib import sha256
from itertools import product
from math import prod
from pathlib import Path
from typing import Any

from cortado.arrays import check_steps
from cortado.calls import counted
from cortado.cli.arguments import HERE, FrameOptions, Where, require_shared, steps_or_time
from cortado.cli.existing_runs import SWEEP
from cortado.cli.optimise import optimise_task, search_settings
from cortado.cli.run import RunRequest, run_scene
from cortado.errors import ComputationError, CortadoError, CortadoWarning, InputError, shown, unwarned, warn
from cortado.files.disk import locked, write_atomically
from cortado.files.terminal import Interrupted, keeping, track, untracked
from cortado.optimisation.task_files import load_task
from cortado.runs.run_folder import RunFolder
from cortado.scene.scene import load_scene, read_toml

MOST_COMBINATIONS = 100_000
_LONGEST_NAME = 120


@dataclass(frozen=True)
class Combination:
    values: tuple[tuple[str, str], ...]
    """Pairs of key and value, as the user wrote them."""

    @property
    def overrides(self) -> list[str]:
        return [f"{key}={value}" for key, value in self.values]

    @property
    def name(self) -> str:
        """Name of the combination's folder. A long or special name is shortened and ends with a checksum."""
        name = ",".join(self.overrides)
        is_plain = re.fullmatch(r"[A-Za-z0-9_=,.+-]+", name) and not name.startswith(("-", "."))  # needs no quotes
        if is_plain and len(name) <= _LONGEST_NAME:
            return name
        plain = re.sub(r"[^A-Za-z0-9_=,.+-]+", "_", name).lstrip("-.")[:_LONGEST_NAME]
        return f"{plain}-{sha256(name.encode()).hexdigest()[:8]}"


def combinations(options: Sequence[str], zipped: Sequence[str] = ()) -> list[Combination]:
    """Return all combinations of the values of all keys. The first values of all ``zipped`` keys occur together, as do
    the second values, and so on. Raises `InputError` for wrong options."""
    if not options and not zipped:
        raise InputError("--set is missing, but must name what changes, such as --set solver.time_step=0.001,0.002.")
    keys, together = _values(options, "--set"), _values(zipped, "--zip")
    if both := keys.keys() & together.keys():
        raise InputError(f"--zip gives {min(both)}, which --set gives too, but must give other keys.")
    if len(set(map(len, together.values()))) > 1:
        told = ", ".join(f"{len(values)} of {key}" for key, values in together.items())
        raise InputError(f"--zip gives {told}, but must give the same number of values for each key.")
    rows = [tuple(zip(together, row, strict=True)) for row in zip(*together.values(), strict=True)]
    number = prod(map(len, keys.values())) * max(len(rows), 1)
    if number > MOST_COMBINATIONS:
        raise InputError(f"--set makes {number:,} combinations, but there may be {MOST_COMBINATIONS:,} at most.")
    own = [tuple(zip(keys, values, strict=True)) for values in product(*keys.values())]
    return [Combination((*values, *row)) for values in own for row in rows or [()]]


def _values(options: Sequence[str], name: str) -> dict[str, list[str]]:
    keys: dict[str, list[str]] = {}
    for option in options:
        key, equals, text = option.partition("=")
        key, values = key.strip(), [value.strip() for value in _split(text)]
        if not equals or not key or not all(values):
            raise InputError(f"{name} is {shown(option)}, but must have the form key=value,value.")
        if key in keys:
            raise InputError(f"{name} gives {key} twice, but must give each key once, with all its values.")
        if len(set(values)) < len(values) and name == "--set":
            raise InputError(f"{name} is {shown(option)}, but must give each value of {key} once.")
        keys[key] = values
    return keys


def _split(text: str) -> list[str]:
    parts, is_open = list[str](), False
    for piece in text.split(","):
        if is_open:
            parts[-1] += f",{piece}"
        else:
            parts.append(piece)
        bare = re.sub(r"\"[^\"]*\"|'[^']*'", "", parts[-1])  # without texts in quotes
        is_open = any(bare.count(begin) > bare.count(end) for begin, end in ("[]", "{}")) or bool({*"\"'"} & {*bare})
    return parts


def write_table(folder: Path, combinations: Sequence[Combination], results: Mapping[int, Mapping[str, Any]]) -> None:
    """``results`` has the contents of result.json by combination number."""
    rows = list[dict[str, Any]]()
    for number, result in sorted(results.items()):
        one, failures = combinations[number], result["failures"]
        found = _flat({name: value for name, value in result.items() if name != "failures"})
        found = {"status": "failed" if failures else "done", **found, "failures": " ".join(failures)}
        rows.append({"folder": one.name, **dict(one.values), **found})
    columns = list(dict.fromkeys(column for row in rows for column in row if column != "failures")) + ["failures"]
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write_atomically(folder / SWEEP, text.getvalue())


def _flat(result: Mapping[str, Any], before: str = "") -> dict[str, Any]:
    """Join the keys of nested dicts with full stops. Short lists become JSON text, and long lists are left out."""
    found: dict[str, Any] = {}
    for name, value in result.items():
        if isinstance(value, Mapping):
            found |= _flat(value, f"{before}{name}.")
        elif not isinstance(value, list):
            found[f"{before}{name}"] = value
        elif len(text := json.dumps(value)) and text.count(",") < 12:
            found[f"{before}{name}"] = text
    return found


@dataclass(frozen=True)
class Member:
    file: Path
    duration: float | None
    """Duration of a scene's run [s], or None for a task."""
    asked: RunRequest
    frames: FrameOptions

    def __call__(self, combination: Combination) -> dict[str, Any]:
        require_shared(self.asked.out, "the task and the folder of a sweep")
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            found = self.finished(combination) or self._computed(combination)
        for warning in caught:
            if issubclass(warning.category, CortadoWarning):
                warn(f"{combination.name}: {warning.message}", warning.category)
        return found

    def finished(self, combination: Combination) -> dict[str, Any] | None:
        """Return the result of a combination of values, or None if the run of this combination has not ended."""
        overrides = combination.overrides
        if self.duration is None:
            task = load_task(self.file, overrides)
            scene, kind, settings = task.scene, "optimise", search_settings(task, self.asked.precision)
        else:
            scene, kind, steps = load_scene(self.file, overrides), "run", self.steps(combination)
            frames = self.frames.choice(max(steps // 100, 1))
            settings = {"steps": steps, "precision": self.asked.precision, **frames.settings}
        if (folder := self._folder(combination)) is None:
            return None
        folder.require(scene.to_json(), kind, settings)
        return folder.read_result()

    def _folder(self, combination: Combination) -> RunFolder | None:
        path = self.asked.out / combination.name
        return RunFolder.open(path) if (path / "environment.json").exists() else None

    def steps(self, combination: Combination) -> int:
        """Return the number of steps nearest to the duration, at least 1."""
        assert self.duration is not None
        return check_steps(max(round(self.duration / _time_step(self.file, combination)), 1))

    def _computed(self, combination: Combination) -> dict[str, Any]:
        out, overrides, begun = self.asked.out / combination.name, combination.overrides, self._folder(combination)
        words = [str(self.file), *(word for one in overrides for word in ("--set", one)), "--out", str(out)]
        words += ["--device", self.asked.device, "--precision", self.asked.precision]
        asked = replace(self.asked, out=out, overrides=overrides, resume=begun is not None)
        said = "It left no result."
        try:
            with untracked():
                if self.duration is None:
                    optimise_task(self.file, replace(asked, command=["cortado", "optimise", *words]))
                else:
                    steps = self.steps(combination)
                    frames = self.frames.choice(max(steps // 100, 1))
                    ((name, value),) = frames.settings.items()
                    words += ["--steps", str(steps), f"--{name.replace('_', '-')}", str(value)]
                    own: Any = {"steps": steps, "frames": frames, "command": ["cortado", "run", *words]}
                    run_scene(self.file, replace(asked, **own))
        except Interrupted as stop:  # what is kept of one combination says less than the sweep does
            raise Interrupted(stop.args[0]) from None
        except CortadoError as error:
            said = str(error)
        folder = self._folder(combination)
        return (folder and folder.read_result()) or {"failures": [said]}


def run_sweep(
    file: Path, options: list[str], zipped: list[str], asked: RunRequest, frames: FrameOptions, where: Where
) -> str:
    chosen, duration, out = combinations(options, zipped), asked.time, asked.out.absolute()
    if "optimise" in read_toml(file):  # a task
        own: dict[str, Any] = {"steps": asked.steps, "time": asked.time, "no-pictures": None if asked.report else True}
        for name, value in {**own, "record-every": frames.record_every, "fps": frames.fps}.items():
            if value is not None:
                why = ", as the task says problem.steps" if name in ("steps", "time") else " of a sweep of a task"
                raise InputError(f"--{name} is given, but must be left out{why}.")
    elif (number := steps_or_time(asked.steps, asked.time)) is not None:
        duration = check_steps(number) * min(_time_step(file, one) for one in chosen)
    member = Member(file.absolute(), duration, replace(asked, out=out, steps=None, time=None), frames)
    with unwarned():  # warnings are printed when a combination runs; mistakes are found before computing
        read = {number: member.finished(one) for number, one in enumerate(chosen)}
    done = {number: result for number, result in read.items() if result is not None}
    left = [number for number in range(len(chosen)) if number not in done]
    there = len(done)

    def kept() -> str:
        return f"{len(done)} of {len(chosen)} are finished, in {out}; the same command goes on with the rest"

    def note(number: int, result: dict[str, Any]) -> None:
        done[left[number]] = result
        write_table(out, chosen, done)
        advance(failed=sum(bool(one["failures"]) for one in done.values()))

    with (
        (where if left else HERE).executor(asked.device, len(left)) as executor,
        locked(out),
        keeping(kept),
        track(len(left), "sweep") as advance,
    ):
        write_table(out, chosen, done)
        executor.map(member, [chosen[number] for number in left], note)
    failures = [number for number in sorted(done) if done[number]["failures"]]
    _warn_of_times(member, [chosen[number] for number in done if number not in failures])
    all_of_them = f"Of {counted(len(chosen), 'combination')}{f', {there} of them there already,' if there else ''}"
    table = f"table is {out / SWEEP}, beside a folder for each."
    if failures:
        first = f"the first of them {chosen[failures[0]].name}: {' '.join(done[failures[0]]['failures'])}"
        raise ComputationError(f"{all_of_them} {len(failures)} failed, {first} The {table}")
    return f"{all_of_them} none failed; the {table}"


def _time_step(file: Path, combination: Combination) -> float:
    with unwarned():
        return load_scene(file, combination.overrides).solver.fixed_time_step("a sweep")


def _warn_of_times(member: Member, done: list[Combination]) -> None:
    """Warn if runs end at different times, because the duration is no multiple of their time steps."""
    duration = member.duration
    if duration is None or not done:
        return
    ends = {one.name: member.steps(one) * _time_step(member.file, one) for one in done}
    last, off = max(ends.items(), key=lambda pair: abs(pair[1] - duration))
    if abs(off - duration) > 1e-9 * duration:
        found = f"not all combinations end at {duration:g} s, which is no whole number of their time steps"
        warn(f"{found}: {last} ends at {off:g} s. Choose a --time that is a multiple of every time step.")
