"""``cortado dataset``: many runs of a scene with varied values, in files of LagrangeBench's layout."""

import json
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cortado.cli.commands.options import HERE, Where, require_shared
from cortado.errors import (
    ComputationError,
    CortadoWarning,
    DivergedError,
    InputError,
    SceneError,
    shown,
    unwarned,
    warn,
)
from cortado.files.disk import LOCK, UNFINISHED, locked, sentences, write_atomically
from cortado.files.interruption import keeping
from cortado.files.terminal import track, untracked
from cortado.optimisation.datasets import (
    METADATA,
    DatasetTable,
    DatasetTables,
    Parts,
    Sample,
    assemble,
    metadata,
    one_run,
    remove_parts,
    write_metadata,
)
from cortado.pictures.side_by_side import differences
from cortado.runs.run_folder import read_json
from cortado.scene.scene import Scene, load_scene
from cortado.scene.tables import MISSING
from cortado.scene.tables import sentences as in_sentences
from cortado.scene.toml import overrides_of, read_toml
from cortado.simulation import Simulation
from cortado.version import __version__
from cortado.words import counted

ASKED = "dataset.json"
"""The file with the choices of a data set, by which the same command goes on with it, and another one does not."""
MOST_RUNS = 100_000


@dataclass(frozen=True)
class Member:
    """The computation of the runs of a data set, which a worker process is sent."""

    file: Path
    overrides: tuple[str, ...]
    table: DatasetTable
    out: Path
    device: str
    precision: str

    def scene(self, number: int) -> Scene:
        """Return the scene of the run of a number."""
        return load_scene(self.file, [*self.overrides, *Sample(self.table, number).overrides]).lasting(
            steps=self.table.steps
        )

    def __call__(self, number: int) -> tuple[bool, list[str]]:
        """Compute a run and write it; return True if there is one, and its warnings."""
        require_shared(self.out, "the scene and the folder of a data set")
        parts = Parts(self.out)
        with warnings.catch_warnings(record=True) as caught, untracked():
            warnings.simplefilter("always", CortadoWarning)
            try:
                simulation = Simulation(self.scene(number), self.device, self.precision)
                found = one_run(simulation, Sample(self.table, number))
            except (DivergedError, SceneError, InputError) as error:
                parts.save_failure(number, str(error))
                return False, []
        parts.save(number, found)
        return True, [str(one.message) for one in caught if issubclass(one.category, CortadoWarning)]


def make_dataset(
    file: Path, runs: int, out: Path, overrides: list[str], device: str, precision: str, where: Where
) -> str:
    """Compute the missing runs of a data set and put all together; return a sentence that says where they are. Raise
    `ComputationError` where the disk is full, and where a purpose is left without a run."""
    table = _table(file, overrides)
    of_scene = [one for one in overrides if one not in overrides_of(overrides, ("dataset",))]
    member = Member(file.absolute(), tuple(of_scene), table, out.absolute(), device, precision)
    split = table.split(_checked_runs(runs, table))
    asked = _asked(member, runs)
    if out.suffix in (".h5", ".hdf5"):
        raise InputError(f"--out is {out}, but must be a folder, for the files train.h5, valid.h5 and test.h5.")
    parts, absolute = Parts(member.out), member.out
    with locked(out):
        for left_behind in absolute.glob(UNFINISHED):  # by a process that was killed
            left_behind.unlink(missing_ok=True)
        if _is_complete(absolute, asked):
            remove_parts(absolute)
            return f"The data set in {absolute} is complete already: {_sizes(read_json(absolute / METADATA))}."
        left = [number for number in range(runs) if parts.note(number) is None]

        def kept() -> str:
            there = sum(parts.note(number) is not None for number in range(runs))
            return (
                f"{there} of {counted(runs, 'run')} are finished, in {absolute}; the same command goes on with the rest"
            )

        told: dict[int, list[str]] = {}

        def note(k: int, result: tuple[bool, list[str]]) -> None:
            there, told[left[k]] = result
            failed.extend([left[k]] * (not there))
            advance(failed=len(failed))

        failed: list[int] = []
        with (
            (where if left else HERE).executor(device, len(left)) as executor,
            _saying(kept),
            track(len(left), "data set") as advance,
        ):
            executor.map(member, left, note)
        there, notes, failures = _finished(parts, split)
        with _saying(kept):
            sizes = _put_together(member, there, notes)
    _warn(told, failures, runs)
    return f"The data set is in {absolute}: {sizes}."


@contextmanager
def _saying(kept: Callable[[], str]) -> Iterator[None]:
    """Add what is ``kept`` to the message of a disk that refuses, or of an interruption."""
    try:
        with keeping(kept):
            yield
    except ComputationError as error:
        raise ComputationError(f"{str(error).rstrip('.')}. {kept()}.") from error


def _finished(parts: Parts, split: Mapping[str, range]) -> tuple[dict[str, list[int]], dict[int, Any], dict[int, str]]:
    """Return the numbers of the finished runs for each purpose, the note on each, and why others failed; raise
    `ComputationError` where a purpose has none."""
    notes = {number: parts.note(number) or {} for own in split.values() for number in own}
    failures = {number: note["failure"] for number, note in notes.items() if "failure" in note}
    there = {purpose: [number for number in own if number not in failures] for purpose, own in split.items()}
    for purpose, numbers in there.items():
        if split[purpose] and not numbers:
            first = next(failures[number] for number in split[purpose])
            raise ComputationError(f"No run of those for {purpose} could be computed. The first: {first}")
    return there, {number: note for number, note in notes.items() if number not in failures}, failures


def _put_together(member: Member, there: Mapping[str, list[int]], notes: Mapping[int, Any]) -> str:
    """Write the files of the data set, from runs by purpose and their notes; return their sizes in words."""
    out = member.out
    assemble(out, there)
    with unwarned():
        most = max(note["statistics"]["particles"] for note in notes.values())
        content = metadata(member.scene(min(notes)), member.table, there, notes, most)
    write_metadata(out, content)
    remove_parts(out)
    return _sizes(content)


def _table(file: Path, overrides: list[str]) -> DatasetTable:
    """Read the table [dataset] of a file; raise `SceneError`."""
    data = read_toml(file, overrides, ("problem", "optimise", "fit"))
    if "dataset" not in data:
        raise SceneError(str(file), "dataset", MISSING, "a table that says what varies, as docs/datasets.md has one")
    try:
        with in_sentences(DatasetTables):
            return DatasetTables(dataset=data["dataset"]).dataset
    except SceneError as error:
        raise error.in_file(str(file)) from None


def _checked_runs(runs: int, table: DatasetTable) -> int:
    least = 1 + (table.valid > 0.0) + (table.test > 0.0)
    if not least <= runs <= MOST_RUNS or not table.split(runs)["train"]:
        parts = ["train", *(["validate"] if table.valid else []), *(["test"] if table.test else [])]
        purposes = " and ".join(f"one to {part}" for part in parts)
        found = f"--runs is {runs:,}, but must be from {least} to {MOST_RUNS:,}: {purposes} at least"
        advice = "; dataset.valid = 0 and dataset.test = 0 leave the others out" if least > 1 else ""
        raise InputError(f"{found}{advice}.")
    return runs


def _asked(member: Member, runs: int) -> dict[str, Any]:
    """Return the choices of a data set. The first scene and those with the ends of all ranges are read, so that a
    mistake is found before anything is computed. Raise `SceneError`."""
    table = member.table
    with unwarned():
        ends = [[f"{key}={json.dumps(pair[end])}" for key, pair in table.vary.items()] for end in (0, 1)]
        for end in ends:
            load_scene(member.file, [*member.overrides, *end]).solver.fixed_time_step("a data set")
        for k, key in enumerate(table.vary):
            others = [*ends[0][:k], *ends[0][k + 1 :]]
            if ends[0][k] != ends[1][k] and _are_one(member, [*others, ends[0][k]], [*others, ends[1][k]]):
                raise InputError(f"vary has {key}, which changes nothing that is computed.")
    for key in table.vary:
        if key in ("solver.time_step", "dimension", "discretisation.spacing") or key.startswith("container."):
            raise InputError(f"vary has {key}, which must be the same in all runs of a data set.")
    scene_json = json.loads(_scene(member).to_json())
    numbers = {"runs": runs, "precision": member.precision, "cortado": __version__}
    return {"scene": scene_json, "dataset": table.model_dump(mode="json"), **numbers}


def _are_one(member: Member, *overrides: list[str]) -> bool:
    """Test whether the scenes of a run with some overrides and with others compute the same; False where one is
    refused."""
    try:
        scenes = [load_scene(member.file, [*member.overrides, *some]).computed_json() for some in overrides]
    except SceneError:
        return False
    return scenes[0] == scenes[1]


def _scene(member: Member) -> Scene:
    """Read the scene of the file, whose warnings come with the runs."""
    with unwarned():
        return load_scene(member.file, member.overrides)


def _is_complete(out: Path, asked: Mapping[str, Any]) -> bool:
    """Test whether the data set is complete; note the choices in a new folder; raise `InputError` for another
    folder."""
    note = out / ASKED
    if note.exists():
        if other := differences(read_json(note), json.loads(json.dumps(asked))):
            unlike = "; ".join(f"{key} is {shown(there)}, not {shown(now)}" for key, (there, now) in other.items())
            grows = (
                ", as a data set does not grow: how many runs there are says which are for tests"
                if "runs" in other
                else ""
            )
            raise InputError(f"{out} holds another data set ({unlike}); choose another --out{grows}.")
        return (out / METADATA).exists()
    with sentences(out):
        others = [one.name for one in out.iterdir() if one.name != LOCK]
    if others:
        raise InputError(f"{out} holds {others[0]}, but no data set; choose another --out.")
    write_atomically(note, json.dumps(asked, indent=2) + "\n")
    return False


def _sizes(content: Mapping[str, Any]) -> str:
    """Write the number of runs for each purpose, and their length."""
    runs = ", ".join(f"{content[f'num_trajs_{purpose}']} to {purpose}" for purpose in ("train", "valid", "test"))
    return f"{counted(content['sequence_length_train'], 'frame')} each, {runs}".replace("to valid", "to validate")


def _warn(told: Mapping[int, list[str]], failures: Mapping[int, str], runs: int) -> None:
    """Tell once the warnings of runs, and which runs are left out."""
    warned = {number: sentences for number, sentences in told.items() if sentences}
    if warned:
        first = min(warned)
        said = (
            f"{len(warned)} of {counted(runs, 'run')} came with a warning. The first is run {first}: {warned[first][0]}"
        )
        warn(said)
    if failures:
        first = min(failures)
        said = f"{len(failures)} of {counted(runs, 'run')} failed and are left out. The first is run {first}: "
        warn(f"{said}{failures[first]}")
