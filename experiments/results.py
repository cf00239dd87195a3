"""The folder of an experiment: its numbers, its picture and its verdict."""

from __future__ import annotations

import json
import time
from functools import partial
from pathlib import Path
from typing import Any

from cortado.errors import InputError
from cortado.files.disk import content, parsed_json, write_atomically
from cortado.files.terminal import track
from experiments.canvas import save
from experiments.experiment import Experiment
from experiments.tables import MOST_BYTES, Table


class Results:
    """``data.csv``, ``figure.png``, ``verdict.txt`` and, for machines and with the settings, ``verdict.json``."""

    def __init__(self, folder: Path):
        self.folder = folder.absolute()
        self.data, self.picture = self.folder / "data.csv", self.folder / "figure.png"
        self.sentences, self.record = self.folder / "verdict.txt", self.folder / "verdict.json"

    def measure(self, experiment: Experiment) -> list[str]:
        """Measure, draw and judge; returns the verdict."""
        self._make_folder()
        started = time.perf_counter()
        progress = partial(track, description=experiment.name)
        table = experiment.type.measure(experiment.settings, progress)
        table.write_csv(self.data)
        return self._show(experiment, table, time.perf_counter() - started)

    def redraw(self, experiment: Experiment) -> list[str]:
        """Draw and judge numbers that were measured before; returns the verdict."""
        return self._show(experiment, Table.read_csv(self.data), self._recorded().get("seconds"))

    def has(self, experiment: Experiment) -> bool:
        """Whether the experiment was measured here with the same settings."""
        recorded = self._recorded()
        same = {key: recorded.get(key) for key in ("kind", "settings")} == _identity(experiment)
        return same and "verdict" in recorded

    def verdict(self) -> list[str]:
        """The verdict that was written before."""
        return self._recorded()["verdict"]

    def _show(self, experiment: Experiment, table: Table, seconds: float | None) -> list[str]:
        own, settings = experiment.type, experiment.settings
        save(lambda: own.draw(table, settings), self.picture)
        verdict = own.verdict(table, settings)
        record = {**_identity(experiment), "reduced": experiment.reduced, "seconds": seconds, "verdict": verdict}
        write_atomically(self.sentences, "".join(f"{sentence}\n" for sentence in [settings.title, *verdict]))
        write_atomically(self.record, json.dumps(record, indent=2) + "\n")
        return verdict

    def _make_folder(self) -> None:
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            self.record.unlink(missing_ok=True)
        except OSError as problem:
            raise InputError(f"The folder {self.folder} cannot be written: {problem}.") from problem

    def _recorded(self) -> dict[str, Any]:
        try:
            recorded = parsed_json(content(self.record, MOST_BYTES))
        except (OSError, ValueError):
            return {}
        return recorded if isinstance(recorded, dict) else {}


def _identity(experiment: Experiment) -> dict[str, Any]:
    return {"kind": experiment.type.name, "settings": experiment.settings.identity()}
