"""Cortado's errors and warnings, each with a message of one sentence."""

import sys
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

LONGEST = 90


class CortadoError(Exception):
    """The base class of Cortado's errors."""


class CortadoWarning(UserWarning):
    """A warning about a probable mistake that does not prevent the computation."""


class MassWarning(CortadoWarning):
    """A warning about a difference between the mass of the particles and the mass in the scene."""


_INSIDE = ("cortado", "pydantic", "contextlib", "functools")


def warn(sentence: str, category: type[Warning] = CortadoWarning) -> None:
    """Issue a warning at the line of the user's code."""
    level, frame = 1, sys._getframe()
    while frame.f_back is not None and frame.f_globals.get("__name__", "").partition(".")[0] in _INSIDE:
        level, frame = level + 1, frame.f_back
    warnings.warn(sentence, category, stacklevel=level)


@contextmanager
def unwarned(category: type[Warning] = CortadoWarning) -> Iterator[None]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", category)
        yield


class InputError(CortadoError):
    """An error in the user's input, with the exit code 2."""


class OutOfRangeError(InputError):
    """An error for parameters that make a run impossible. After this error, `evaluate` continues with other points."""


class Words(str):
    """Text that appears without quotes in an error message. A plain ``str`` appears with quotes."""


class MissingDerivativeError(InputError):
    """An error for a derivative that a solver cannot compute."""


class SceneError(CortadoError):
    """An error in a scene, with the exit code 2. The message names the key, the wrong value and the allowed values."""

    def __init__(self, file: str | None, field: str, found: Any = None, wanted: str = "", sentence: str | None = None):
        """``sentence`` replaces the part of the message "is <found>, but must be <wanted>"."""
        super().__init__(file, field, found, wanted, sentence)
        self.file = file
        """Path of the scene file as the user gave it, or None for a scene built in Python."""
        self.field = field
        """Key of the scene, such as ``fluid[0].upper``, or an empty text for an error of the whole scene."""
        self.found = found
        """Wrong value of the key, or a `Words` text that describes the mistake."""
        self.wanted = wanted
        self.sentence = sentence or f"is {shown(found)}, but must be {wanted}."

    def in_file(self, file: str) -> "SceneError":
        _, *rest = self.args
        return SceneError(file, *rest)

    def __str__(self) -> str:
        place = self.field or "the scene"
        return f"{self.file}: {place} {self.sentence}" if self.file else f"{place} {self.sentence}"


class ComputationError(CortadoError):
    """An error for a failed computation from valid input, with the exit code 1."""


class DivergedError(ComputationError):
    """An error for a particle that left its container, flew too far away or has no finite position."""

    def __init__(
        self, step: int, particle: int, advice: str, where: str = "was lost", others: int = 0, preface: str = ""
    ):
        super().__init__(step, particle, advice, where, others, preface)
        self.step = step
        """Number of the step that lost the particle, counted from 1."""
        self.particle = particle
        """Number of the first lost particle, in the order of the initial particles."""
        self.advice = advice
        self.where = where
        """Text on how and where the particle was lost."""
        self.others = others
        """Number of other particles that the same step lost."""
        self.preface = preface
        """First sentence of the message, about all runs of an ensemble. For a single run, this text is empty."""

    def with_advice(self, advice: str) -> "DivergedError":
        return DivergedError(self.step, self.particle, advice, self.where, self.others, self.preface)

    def among_others(self, preface: str) -> "DivergedError":
        return DivergedError(self.step, self.particle, self.advice, self.where, self.others, preface)

    def __str__(self) -> str:
        more = f" (and {self.others} more)" if self.others else ""
        said = f"The simulation diverged in step {self.step}: particle {self.particle}{more} {self.where}"
        return " ".join(filter(None, [self.preface, f"{said}; {self.advice}."]))


def shown(value: Any) -> str:
    """Return a value as text on one short line."""
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
    """An error for a missing reference engine."""

    def __str__(self) -> str:
        said = "The reference engine is not installed: in a clone of the repository pip install ./reference"
        return f"{said}, which needs a C++17 compiler (g++, for all precisions)."


class ExtraMissingError(InputError, ImportError):
    """An error for a missing library of an optional dependency group, with the exit code 2."""

    def __init__(self, name: str, package: str):
        super().__init__(name, package)

    def __str__(self) -> str:
        name, package = self.args
        return f"The {name} library is not installed: pip install {package}."


class LibraryMissingError(CortadoError, ImportError):
    """An error for a missing optional library."""

    def __init__(self, name: str, package: str, module: str | None = None):
        """``package`` contains the library ``name``, which Cortado's ``module`` needs."""
        super().__init__(name, package, module)
        self.package = package

    def __str__(self) -> str:
        name, package, module = self.args
        return f"{name} is not installed, which cortado.{module or package} needs: pip install {package}"
