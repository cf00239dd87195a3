"""A number of a run by a function of one's own, which a command line names as ``FILE.py:FUNCTION``."""

import runpy
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cortado.errors import CortadoError, InputError, shown
from cortado.runs.trajectory import Trajectory


@dataclass(frozen=True)
class OwnQuantity:
    """A function of a trajectory that returns a number."""

    where: str
    """``FILE.py:FUNCTION``"""
    name: str
    function: Callable[[Trajectory], float]

    @classmethod
    def named(cls, where: str) -> "OwnQuantity":
        """Runs the file. Raises `InputError` for one that cannot be run, or has no such function."""
        file, _, name = where.rpartition(":")
        if not file.endswith(".py") or not name.isidentifier():
            raise InputError(f"--quantity is {shown(where)}, but must be FILE.py:FUNCTION.")
        try:
            function = runpy.run_path(str(Path(file))).get(name)
        except Exception as problem:
            raise InputError(f"--quantity {where} cannot be read: {_told(problem)}.") from problem
        if not callable(function):
            raise InputError(f"{file} has no function {name}, but must, as --quantity names it.")
        return cls(where, name, function)

    def __call__(self, trajectory: Trajectory) -> float:
        """The number; raises `InputError` where the function fails, or returns something else."""
        try:
            found = self.function(trajectory)
            value = np.asarray(found, dtype=np.float64)
        except CortadoError:
            raise
        except Exception as problem:
            raise InputError(f"--quantity {self.where} failed: {_told(problem)}.") from problem
        if value.ndim:
            raise InputError(f"--quantity {self.where} returned {shown(found)}, but must return a number.")
        return float(value)


def _told(problem: Exception) -> str:
    """Its kind and its words, on one line."""
    return " ".join(f"{type(problem).__name__}: {problem}".split()).rstrip(".")
