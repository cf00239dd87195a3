"""The command ``cortado dataset``, which computes many runs of a scene and writes the files of LagrangeBench."""

import json
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any

from cortado import errors
from cortado.calls import counted
from cortado.cli.arguments import HERE, Where, require_shared
from cortado.files.disk import LOCK, UNFINISHED, locked, sentences, write_atomically
from cortado.files.terminal import keeping, track, untracked
from cortado.optimisation import datasets
from cortado.runs.run_folder import differences, read_json
from cortado.scene.scene import Scene, files_named, load_scene, overrides_of, read_toml
from cortado.scene.tables import MISSING
from cortado.scene.tables import sentences as in_sentences
from cortado.simulation import Simulation
from cortado.version import __version__

MOST_RUNS = 100_000


@dataclass(frozen=True)
class Member:
    file: Path
    overrides: tuple[str, ...]
    table: datasets.DatasetTable
    out: Path
    device: str
    precision: str

    def scene(self, number: int) -> Scene:
        overrides = [*self.overrides, *datasets.Sample(self.table, number).overrides]
        return load_scene(self.file, overrides).lasting(steps=self.table.steps)

    def __call__(self, number: int) -> tuple[bool, list[str]]:
        """Compute and write a run. Return whether the run succeeded, and the run's warnings."""
        require_shared(self.out, "the scene and the folder of a data set")
        folder = datasets.DatasetFolder(self.out)
        with warnings.catch_warnings(record=True) as caught, untracked():
            warnings.simplefilter("always", errors.CortadoWarning)
            try:
                simulation = Simulation(self.scene(number), self.device, self.precision)
                found = datasets.one_run(simulation, datasets.Sample(self.table, number))
            except (errors.DivergedError, errors.SceneError, errors.InputError) as error:
                folder.save_failure(number, str(error))
                return False, []
        folder.save(number, found)
        return True, [str(one.message) for one in caught if issubclass(one.category, errors.CortadoWarning)]


def make_dataset(file: Path, runs: int, out: Path, words: list[str], device: str, precision: str, where: Where) -> str:
    table = _table(file, words)
    of_scene = [one for one in words if one not in overrides_of(words, ("dataset",))]
    member = Member(file.absolute(), tuple(of_scene), table, out.absolute(), device, precision)
    least = 1 + (table.valid > 0.0) + (table.test > 0.0)
    if not least <= runs <= MOST_RUNS or not (split := table.split(runs))["train"]:
        parts = ["train", *(["validate"] if table.valid else []), *(["test"] if table.test else [])]
        purposes = " and ".join(f"one to {part}" for part in parts)
        found = f"--runs is {runs:,}, but must be from {least} to {MOST_RUNS:,}: {purposes} at least"
        advice = "; dataset.valid = 0 and dataset.test = 0 leave the others out" if least > 1 else ""
        raise errors.InputError(f"{found}{advice}.")
    asked = _asked(member)
    if out.suffix in (".h5", ".hdf5"):
        raise errors.InputError(f"--out is {out}, but must be a folder, for the files train.h5, valid.h5 and test.h5.")
    with locked(out):
        _claim(file, member.out, asked)
        folder = datasets.DatasetFolder(member.out)
        before, known = folder.size, folder.metadata.get("failed", {})
        if runs < before:
            raise errors.InputError(f"--runs is {runs}, but must be at least {before}: {out} contains as many already.")
        left = [number for number in range(runs) if number not in folder.runs and number not in folder.failures]

        def kept() -> str:
            now = datasets.DatasetFolder(member.out)
            there = f"{sum(k in now.runs or k in now.failures for k in range(runs))} of {counted(runs, 'run')}"
            return f"{there} are finished, in {member.out}; the same command goes on with the rest"

        told: dict[int, list[str]] = {}
        failed = 0

        def note(k: int, result: tuple[bool, list[str]]) -> None:
            nonlocal failed
            there, told[left[k]] = result
            failed += not there
            advance(failed=failed)

        with (
            (where if left else HERE).executor(device, len(left)) as executor,
            _saying(kept),
            track(len(left), "data set") as advance,
        ):
            executor.map(member, left, note)
        with _saying(kept):
            content = _put_together(member, split, runs)
    for path, why in folder.damaged.items():
        errors.warn(
            f"{path} was damaged ({why}) and has been made anew; {counted(len(left), 'run')} had to be computed."
        )
    new = {int(number): why for number, why in content["failed"].items() if number not in known}
    _warn({number: sentences[0] for number, sentences in told.items() if sentences}, new, runs)
    if not left and not folder.damaged:
        return f"The data set in {member.out} is complete already: {_sizes(content)}."
    grown = f"; its first {before} runs are as they were" if 0 < before < runs and not folder.damaged else ""
    return f"The data set is in {member.out}: {_sizes(content)}{grown}."


@contextmanager
def _saying(kept: Callable[[], str]) -> Iterator[None]:
    """Add the sentence ``kept()`` to the error message of an interruption or a full disk."""
    try:
        with keeping(kept):
            yield
    except errors.ComputationError as error:
        raise errors.ComputationError(f"{str(error).rstrip('.')}. {kept()}.") from error


def _put_together(member: Member, split: Mapping[str, Sequence[int]], runs: int) -> dict[str, Any]:
    folder = datasets.DatasetFolder(member.out)
    there = {purpose: [number for number in own if number in folder.runs] for purpose, own in split.items()}
    for purpose, numbers in split.items():
        if numbers and not there[purpose]:
            first = folder.failures[numbers[0]]
            raise errors.ComputationError(f"None of the runs for {purpose} could be computed. The first: {first}")
    folder.assemble(there)
    with errors.unwarned():
        content = datasets.metadata(member.scene(there["train"][0]), member.table, there, folder, runs)
    folder.write_metadata(content)
    return content


def _table(file: Path, overrides: list[str]) -> datasets.DatasetTable:
    data = read_toml(file, overrides, ("problem", "optimise", "fit"))
    if "dataset" not in data:
        raise errors.SceneError(
            str(file), "dataset", MISSING, "a table of the varied values, like the example in docs/datasets.md"
        )
    try:
        with in_sentences(datasets.DatasetTables):
            return datasets.DatasetTables(dataset=data["dataset"]).dataset
    except errors.SceneError as error:
        raise error.in_file(str(file)) from None


def _asked(member: Member) -> dict[str, Any]:
    """The scene is read once with the least and once with the greatest varied values, to find mistakes early."""
    table = member.table
    with errors.unwarned():
        ends = [[f"{key}={json.dumps(pair[end])}" for key, pair in table.vary.items()] for end in (0, 1)]
        for end in ends:
            one = load_scene(member.file, [*member.overrides, *end])
            one.solver.fixed_time_step("a data set")
            datasets.bounds_of(one.lasting(steps=table.steps))
        for k, key in enumerate(table.vary):
            others = [*ends[0][:k], *ends[0][k + 1 :]]
            with suppress(errors.SceneError):  # of an end that is invalid with the lower ends of the others
                made = {load_scene(member.file, [*member.overrides, *others, end[k]]).computed_json() for end in ends}
                if ends[0][k] != ends[1][k] and len(made) == 1:
                    raise errors.InputError(f"vary has {key}, which has no effect on what is computed.")
    for key in table.vary:
        if key in ("solver.time_step", "dimension", "discretisation.spacing") or key.startswith("container."):
            raise errors.InputError(f"vary has {key}, which must be the same in all runs of a data set.")
    with errors.unwarned():  # the runs print its warnings
        scene = load_scene(member.file, member.overrides)
    if len(scene.phase) > (most := datasets.KINDS - datasets.MORE_FLUID + 1):
        raise errors.InputError(
            f"The scene has {len(scene.phase)} phases, but a data set has types for at most {most}."
        )
    asked = {"scene": json.loads(scene.to_json()), "dataset": table.model_dump(mode="json")}
    for named, key in files_named(asked["scene"]):  # such as meshes
        named[f"{key} content"] = sha256(Path(named[key]).read_bytes()).hexdigest()
    return {**asked, "--precision": member.precision, "cortado": __version__}


def _claim(file: Path, out: Path, asked: Mapping[str, Any]) -> None:
    """Write the settings of the data set into its folder, and remove unfinished files."""
    note = out / "dataset.json"
    for left_behind in [*out.glob(UNFINISHED), *(out / datasets.PARTS).glob(UNFINISHED)]:
        left_behind.unlink(missing_ok=True)
    if note.exists():
        if other := differences(read_json(note), json.loads(json.dumps(asked)), "missing"):
            own = {key.removeprefix("scene."): pair for key, pair in other.items()}
            unlike = "; ".join(
                f"{key} is {errors.shown(now)}, but must be {errors.shown(old)}" for key, (old, now) in own.items()
            )
            raise errors.InputError(f"{file}: {unlike}, as in the data set in {out}; choose another --out.")
        return
    with sentences(out):
        others = [one.name for one in out.iterdir() if one.name != LOCK]
    if others:
        raise errors.InputError(f"{out} holds {others[0]}, but no data set; choose another --out.")
    write_atomically(note, json.dumps(asked, indent=2) + "\n")


def _sizes(content: Mapping[str, Any]) -> str:
    runs = ", ".join(f"{content[f'num_trajs_{purpose}']} to {purpose}" for purpose in ("train", "valid", "test"))
    return f"{counted(content['sequence_length_train'], 'frame')} each, {runs}".replace("to valid", "to validate")


def _warn(warned: Mapping[int, str], failures: Mapping[int, str], runs: int) -> None:
    for found, what in ((warned, "came with a warning"), (failures, "failed and are left out")):
        if found:
            first = min(found)
            errors.warn(f"{len(found)} of {counted(runs, 'run')} {what}. The first is run {first}: {found[first]}")
