"""Runs the cases of several families, a few at a time, each in a fork of this process."""

import json
import os
import shutil
import sys
import time
import traceback
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path

from fuzz.cases import Case, Family
from fuzz.ledger import Entry, Ledger

POLL = 0.02
"""[s] between two looks at the cases that run."""


class Campaign:
    """Cases by name, a ledger, and a folder in which cases that failed leave their files."""

    def __init__(self, families: Mapping[str, Family], seed: int, folder: Path):
        self._families, self._seed = families, seed
        self._folder = folder.absolute() / f"seed-{seed}"
        self.ledger = Ledger(self._folder / "ledger.jsonl")
        self._prepared: set[str] = set()
        self._running: dict[int, tuple[str, float]] = {}

    def open_cases(self, only: Sequence[str] = ()) -> list[str]:
        """Names of cases in the order in which they come: all families side by side, those that failed before last."""
        families = {name: family for name, family in self._families.items() if not only or name in only}
        places = [
            ((number + 0.5) / family.cases, f"{name}:{number}")
            for name, family in families.items()
            for number in range(family.cases)
        ]
        names = [name for _, name in sorted(places)]
        new = [name for name in names if name not in self.ledger.entries]
        return new + [name for name in names if name not in new and self.ledger.entries[name].complaints]

    def run(self, names: Sequence[str], jobs: int = 1, seconds: float | None = None) -> None:
        """Run these cases; none is begun after so many seconds."""
        started = time.monotonic()
        waiting = list(reversed(names))
        try:
            while self._running or waiting:
                late = seconds is not None and time.monotonic() - started > seconds
                if late:
                    waiting.clear()
                while waiting and len(self._running) < jobs:
                    self._begin(waiting.pop())
                self._collect()
                time.sleep(POLL)
        finally:
            while self._running:
                self._collect()
                time.sleep(POLL)

    def _begin(self, name: str) -> None:
        family = name.partition(":")[0]
        if family not in self._prepared:
            self._prepare(family)
        sys.stdout.flush()
        child = os.fork()
        if child == 0:
            self._be_case(name)
        self._running[child] = (name, time.monotonic())

    def _prepare(self, family: str) -> None:
        self._prepared.add(family)
        prepare, folder = self._families[family].prepare, self._folder / "prepared" / family
        if prepare is not None:
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir(parents=True)
            prepare(folder)

    def _be_case(self, name: str) -> None:
        """What a fork does: run one case and write down what came of it; it never returns."""
        try:
            family, _, number = name.partition(":")
            folder = self.case_folder(name)
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir(parents=True)
            case = Case(family, int(number), self._seed, folder)
            started = time.monotonic()
            try:
                self._families[family].run(case)
            except Exception:
                case.complaints.append(f"the fuzzer itself failed: {traceback.format_exc()}")
            memory = max((outcome.memory for outcome in case.outcomes), default=0)
            codes = [outcome.code for outcome in case.outcomes]
            seconds = round(time.monotonic() - started, 3)
            computed = round(sum(outcome.computed for outcome in case.outcomes), 3)
            entry = Entry(name, list(dict.fromkeys(case.complaints)), case.notes, codes, seconds, computed, memory)
            self._result(name).write_text(json.dumps(asdict(entry)), encoding="utf-8")
        finally:
            os._exit(0)

    def _collect(self) -> None:
        """Note the cases that have ended."""
        for child in list(self._running):
            ended, _ = os.waitpid(child, os.WNOHANG)
            if ended:
                name, started = self._running.pop(child)
                self._note(name, time.monotonic() - started)

    def _note(self, name: str, seconds: float) -> None:
        result = self._result(name)
        try:
            entry = Entry(**json.loads(result.read_text(encoding="utf-8")))
        except (OSError, ValueError):
            entry = Entry(name, ["the fuzzer itself died"], [], [], seconds, 0.0, 0)
        result.unlink(missing_ok=True)
        self.ledger.add(entry)
        if not entry.complaints:
            shutil.rmtree(self.case_folder(name), ignore_errors=True)
            return
        print(f"{name} ({'; '.join(entry.notes)})")
        for complaint in entry.complaints:
            print(f"    {complaint}")
        print(f"    again: python -m fuzz --seed {self._seed} --again {name}", flush=True)

    def case_folder(self, name: str) -> Path:
        """Where the files of a case lie; they are kept if it failed."""
        return self._folder / name.replace(":", "-")

    def _result(self, name: str) -> Path:
        return self._folder / f"{name.replace(':', '-')}.json"
