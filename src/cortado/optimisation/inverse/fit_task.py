"""What ``cortado fit`` reads: a scene with the tables [problem], of measured data, and [fit]."""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cortado.errors import InputError, SceneError, Words
from cortado.optimisation.fitting.experiment import Experiment
from cortado.optimisation.inverse.fit_tables import FitTable, FitTables
from cortado.optimisation.inverse.measured_data import observation
from cortado.optimisation.inverse.tables import ProblemTable
from cortado.scene.fields import MISSING
from cortado.scene.parameters import Role, offered
from cortado.scene.scene import Scene, scene_from_dict
from cortado.scene.tables import Table, sentences
from cortado.scene.toml import read_toml
from cortado.simulation import Simulation
from cortado.solvers.makers import known_in


class ExperimentTables(Table):
    """The table of a file with one more experiment."""

    problem: ProblemTable


@dataclass(frozen=True)
class MeasuredScene:
    """A scene, and what was measured."""

    file: str
    scene: Scene
    problem: ProblemTable

    def experiment(self, device: str, precision: str) -> Experiment:
        """On a device; raises `InputError` and `SceneError` for data that cannot be read, or does not fit."""
        simulation, folder = Simulation(self.scene, device, precision), Path(self.file).parent
        last = self.problem.steps * float(self.scene.solver.time_step)
        found = {}
        for k, table in enumerate(self.problem.measured):
            try:
                found[table.name] = observation(table, simulation, folder, last)
            except InputError as error:
                raise InputError(f"{self.file}: problem.measured[{k}] ({table.name}): {error}") from None
        return Experiment(simulation, found, self.problem.steps)


@dataclass(frozen=True)
class FitTask:
    """Measured experiments, and which parameters are fitted to them."""

    experiments: tuple[MeasuredScene, ...]
    fit: FitTable

    @property
    def scene(self) -> Scene:
        """The scene of the first experiment."""
        return self.experiments[0].scene


def load_fit(path: str | os.PathLike[str], overrides: Sequence[str] = ()) -> FitTask:
    """Read one from a TOML file; raises `SceneError` in one sentence."""
    file = os.fspath(path)
    data = read_toml(path, overrides, ("optimise", "dataset"))
    if "fit" not in data:
        raise SceneError(file, "fit", MISSING, "a table; a task with [optimise] is solved by cortado optimise")
    if "optimise" in data:
        raise SceneError(file, "optimise", Words("given"), "left out of a fit, whose search [fit] describes")
    first, tables = _read(data, file, FitTables)
    others = [_also(Path(file).parent / name) for name in first.problem.also]
    return FitTask((first, *others), tables.fit)


def _also(path: Path) -> MeasuredScene:
    """One more experiment, whose file may have a table [fit] of its own, which is not looked at."""
    found, _ = _read(read_toml(path), os.fspath(path), ExperimentTables)
    if found.problem.also:
        raise SceneError(
            found.file, "problem.also", list(found.problem.also), "left out, as another file names this one"
        )
    return found


def _read(data: dict[str, Any], file: str, model: type[Table]) -> tuple[MeasuredScene, Any]:
    scene = scene_from_dict(data, file)
    try:
        names = (*offered(scene), *(p.name for p in known_in(scene).own if p.role is not Role.CLOCK))
        with sentences(model):
            given = {key: data[key] for key in model.model_fields if key in data}
            tables: Any = model.model_validate(given, context={"names": names})
        if not tables.problem.measured:
            raise SceneError(None, "problem.measured", MISSING, "a list of tables, each written [[problem.measured]]")
    except SceneError as error:
        raise error.in_file(file) from None
    except InputError as error:
        raise SceneError(file, "", sentence=f"cannot be a task: {error}") from None
    return MeasuredScene(file, scene.lasting(steps=tables.problem.steps), tables.problem), tables
