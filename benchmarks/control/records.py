"""Runs of contenders as lines of a file, by which a benchmark that was stopped goes on."""

import json
import os
import time
import warnings
from dataclasses import asdict, astuple, dataclass
from pathlib import Path

import numpy as np

from cortado import CortadoError, CortadoWarning, InputError, __version__
from cortado.files.disk import sentences

from .catalogue import task
from .contenders import contender
from .objective import Objective


@dataclass(frozen=True)
class Run:
    """What is run: one contender on one task."""

    task: str
    size: str
    contender: str
    seed: int
    budget: float
    """Simulated steps."""
    device: str
    precision: str


@dataclass(frozen=True)
class Record:
    """What came of it."""

    run: Run
    steps: list[float]
    """(evaluations,) simulated until each evaluation had ended"""
    losses: list[float | None]
    """(evaluations,), None of a run that diverged"""
    best: list[float]
    """(numbers,) the controls with the least loss"""
    score: dict[str, float]
    """Of these."""
    forward_steps: int
    backward_steps: int
    seconds: float
    cortado: str

    @property
    def so_far(self) -> np.ndarray:
        """(evaluations,) the least loss until then."""
        return np.minimum.accumulate([np.inf if loss is None else loss for loss in self.losses])

    @property
    def diverged(self) -> int:
        """How many runs did."""
        return self.losses.count(None)


def carried_out(run: Run) -> Record:
    """Search, and judge what was found."""
    began, chosen = time.perf_counter(), task(run.task, run.size)
    problem = chosen.problem(run.device, run.precision)
    objective = Objective(chosen, problem, run.seed, run.budget)
    contender(run.contender).search(objective, run.seed)
    if not objective.curve:
        raise InputError(f"The budget of {run.budget:g} steps ends before the first evaluation; give a larger one.")
    return Record(
        run=run,
        steps=[steps for steps, _ in objective.curve],
        losses=[loss if np.isfinite(loss) else None for _, loss in objective.curve],
        best=objective.best.tolist(),
        score=objective.score(),
        forward_steps=objective.steps.forward,
        backward_steps=objective.steps.backward,
        seconds=round(time.perf_counter() - began, 1),
        cortado=__version__,
    )


def outcome(run: Run) -> Record | str:
    """A record, or a sentence that says why there is none."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CortadoWarning)  # of time steps that are long where a tank is shaken most
        try:
            return carried_out(run)
        except CortadoError as error:
            return str(error)


class Records:
    """A file with a line of JSON for each run."""

    def __init__(self, path: Path):
        self.path = path

    def read(self) -> list[Record]:
        """Those in the file, of each run the last one; none if there is no file. What a command that was killed left of
        a last line is left aside. Raises `InputError` for a line of another kind."""
        if not self.path.exists():
            return []
        found = {}
        for number, line in enumerate(self.path.read_bytes().split(b"\n")[:-1], 1):
            try:
                fields = json.loads(line)
                record = Record(**{**fields, "run": Run(**fields["run"])})
            except (ValueError, TypeError, KeyError):
                raise InputError(f"Line {number} of {self.path} is no run of this benchmark; remove it.") from None
            found[astuple(record.run)] = record
        return list(found.values())

    def add(self, record: Record) -> None:
        """The file with one line more, in the place of one that was cut off."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        with sentences(self.path), open(self.path, "ab+") as file:
            file.seek(0)
            file.truncate(file.read().rfind(b"\n") + 1)
            file.write(json.dumps(asdict(record)).encode() + b"\n")
            file.flush()
            os.fsync(file.fileno())

    def missing(self, runs: list[Run]) -> list[Run]:
        """Those that are not in the file."""
        done = {astuple(record.run) for record in self.read()}
        return [run for run in runs if astuple(run) not in done]
