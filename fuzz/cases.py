"""One case: what its random numbers are, where its files lie, and the commands that it runs."""

import zlib
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from fuzz import judge
from fuzz.processes import LIMITS, Kill, Limits, Outcome, by_console, by_fork, call, console

CONSOLE_SHARE = 0.05
"""How many cases go through the real command instead of a fork, which is quicker."""


@dataclass
class Case:
    """A case of a family, drawn from a seed: the same seed, family and number make the same case."""

    family: str
    number: int
    seed: int
    folder: Path
    """Empty at first; commands run in it."""
    complaints: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    """What was done, in words."""
    outcomes: list[Outcome] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.random = np.random.default_rng([self.seed, zlib.crc32(self.family.encode()), self.number])
        self.in_console = bool(self.random.random() < CONSOLE_SHARE)

    @property
    def name(self) -> str:
        """Such as "scenes:17"."""
        return f"{self.family}:{self.number}"

    def cortado(
        self,
        *arguments: str,
        kill: Kill | None = None,
        limits: Limits = LIMITS,
        codes: Collection[int] = judge.CODES,
    ) -> Outcome:
        """Run the command line, and complain of what every command has to keep to."""
        words = [word.encode("utf-8", "surrogatepass").decode("utf-8", "replace") for word in arguments]
        if self.in_console:
            outcome = by_console([*console(), *words], self.folder, limits=limits, kill=kill)
        else:
            outcome = by_fork(words, self.folder, limits, kill)
        return self.judged(outcome, limits, codes)

    def read(self, function: Callable[[Path], object], path: Path, codes: Collection[int] = judge.CODES) -> Outcome:
        """Let a function of Cortado's read a file; an error of Cortado's own is a sentence, as on the command line."""

        def program() -> None:
            from cortado.errors import CortadoError

            try:
                function(path)
            except CortadoError as error:
                raise SystemExit(f"{error}") from None

        return self.judged(call(program, (function.__name__, path.name), self.folder), codes=codes)

    def judged(
        self,
        outcome: Outcome,
        limits: Limits = LIMITS,
        codes: Collection[int] = judge.CODES,
        heard: bool = True,
    ) -> Outcome:
        """Note an outcome, with the complaints that there are about it."""
        self.outcomes.append(outcome)
        self.complaints += judge.complaints(outcome, limits, codes, heard)
        return outcome


@dataclass(frozen=True)
class Family:
    """Cases of one kind."""

    cases: int
    run: Callable[[Case], None]
    """Runs a case, which gets its notes, outcomes and complaints."""
    prepare: Callable[[Path], Sequence[Outcome]] | None = None
    """Makes once, in a folder of its own, what the cases are held against."""
