"""Cortado's errors and warnings; each message is one sentence for the user."""

import sys
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

LONGEST = 90


class CortadoError(Exception):
    """The base class of Cortado's errors."""


class CortadoWarning(UserWarning):
    """A warning of something that works but is probably a mistake."""


class MassWarning(CortadoWarning):
    """A warning that the fluid's mass differs from the mass that the scene describes."""


_INSIDE = ("cortado", "pydantic", "contextlib", "functools")


def warn(sentence: str, category: type[Warning] = CortadoWarning) -> None:
    """Issue a warning that points to the line of the user's code."""
    level, frame = 1, sys._getframe()
    while frame.f_back is not None and frame.f_globals.get("__name__", "").partition(".")[0] in _INSIDE:
        level, frame = level + 1, frame.f_back
    warnings.warn(sentence, category, stacklevel=level)


@contextmanager
def unwarned(category: type[Warning] = CortadoWarning) -> Iterator[None]:
    """Suppress Cortado's warnings of a category in the block."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", category)
        yield


class InputError(CortadoError):
    """An error in the user's input. Exit code 2."""


class OutOfRangeError(InputError):
    """An error for a parameter value with which no run is possible: out of range, beyond the precision, or a place
    without room for fluid. Among many points, only the bad point fails."""


class Words(str):
    """Words in an error's sentence that are printed without quotes; a plain ``str`` is quoted."""


class MissingDerivativeError(InputError):
    """An error for a derivative that a solver does not have."""


class SceneError(CortadoError):
    """An error in a scene, with the key, the value found and the value wanted. Exit code 2."""

    def __init__(self, file: str | None, field: str, found: Any = None, wanted: str = "", sentence: str | None = None):
        """Store the parts of the message; ``sentence`` replaces the default "is <found>, but must be <wanted>."."""
        super().__init__(file, field, found, wanted, sentence)
        self.file = file
        """Path of the scene file as the user gave it; None for a scene built in Python."""
        self.field = field
        """Key of the scene, such as ``fluid[0].upper``; empty for the whole scene."""
        self.found = found
        """Wrong value, or `Words` that describe it."""
        self.wanted = wanted
        self.sentence = sentence or f"is {shown(found)}, but must be {wanted}."

    def in_file(self, file: str) -> "SceneError":
        """Return this error with the name of the file."""
        _, *rest = self.args
        return SceneError(file, *rest)

    def __str__(self) -> str:
        place = self.field or "the scene"
        return f"{self.file}: {place} {self.sentence}" if self.file else f"{place} {self.sentence}"


class ComputationError(CortadoError):
    """An error for a computation that failed although the input was valid. Exit code 1."""


class DivergedError(ComputationError):
    """An error for a lost particle, which left its container, or whose position is not finite or too far away."""

    def __init__(
        self, step: int, particle: int, advice: str, where: str = "was lost", others: int = 0, preface: str = ""
    ):
        super().__init__(step, particle, advice, where, others, preface)
        self.step = step
        """Step in which the particle was lost, counted from 1."""
        self.particle = particle
        """Number of the first lost particle, in the scene's order."""
        self.advice = advice
        self.where = where
        """How the particle was lost, and where it was at the end of the step, in words."""
        self.others = others
        """Number of further particles lost in the same step."""
        self.preface = preface
        """Sentence about all runs, if this run is one of several."""

    def with_advice(self, advice: str) -> "DivergedError":
        return DivergedError(self.step, self.particle, advice, self.where, self.others, self.preface)

    def among_others(self, preface: str) -> "DivergedError":
        """Return a copy of this error whose message begins with ``preface``."""
        return DivergedError(self.step, self.particle, self.advice, self.where, self.others, preface)

    def __str__(self) -> str:
        more = f" (and {self.others} more)" if self.others else ""
        said = f"The simulation diverged in step {self.step}: particle {self.particle}{more} {self.where}"
        return " ".join(filter(None, [self.preface, f"{said}; {self.advice}."]))


def shown(value: Any) -> str:
    """Return a value on one short line."""
    if isinstance(value, Words):
        return str(value)
    if isinstance(value, Mapping):
        return "a table"
    try:
        text = repr(list(value) if isinstance(value, tuple) else value)
    except ValueError:
        return "too long to print"
    except Exception:  # an object of a user's, whose own words cannot be made
        text = f"<a {type(value).__name__}>"
    text = " ".join(text.split())
    return text if len(text) <= LONGEST else f"{text[:LONGEST]}..."


class EngineMissingError(CortadoError, ImportError):
    """An error for the missing reference engine."""

    def __str__(self) -> str:
        return (
            "The reference engine is not installed: in a clone of the repository pip install ./reference, which needs "
            "a C++17 compiler (g++, for all precisions)."
        )


class ExtraMissingError(InputError, ImportError):
    """An error for a missing library that comes with an extra of Cortado. Exit code 2."""

    def __init__(self, name: str, package: str):
        super().__init__(name, package)

    def __str__(self) -> str:
        name, package = self.args
        return f"{name} is needed for that, but is not installed: pip install {package}."


class LibraryMissingError(CortadoError, ImportError):
    """An error for a missing library that Cortado can do without."""

    def __init__(self, name: str, package: str, module: str | None = None):
        """Store the library's ``name`` and ``package``, and the ``module`` of Cortado that needs it."""
        super().__init__(name, package, module)
        self.package = package

    def __str__(self) -> str:
        name, package, module = self.args
        return f"{name} is not installed, which cortado.{module or package} needs: pip install {package}"
