"""The extension module of the C++ engine, where there is one."""

import importlib
import os
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any

from cortado.errors import CortadoError

WAITING = "OMP_WAIT_POLICY"


class EngineMissingError(CortadoError):
    """Cortado was installed without the C++ engine."""

    def __str__(self) -> str:
        return (
            "The reference engine was not built when Cortado was installed: install a C++17 compiler (g++, for all "
            "precisions), then install Cortado again."
        )


@cache
def extension() -> Any:
    """The module; raises `EngineMissingError` where it was not built."""
    with _patient_threads():
        try:
            return importlib.import_module("cortado.reference._engine")
        except ImportError as error:
            raise EngineMissingError from error


@contextmanager
def _patient_threads() -> Iterator[None]:
    """OpenMP reads its settings when it is loaded. Threads that spin while they wait are slower by far than one thread
    where something else runs too."""
    given = os.environ.get(WAITING)
    os.environ.setdefault(WAITING, "passive")
    try:
        yield
    finally:
        if given is None:
            del os.environ[WAITING]


def available() -> bool:
    """Whether it was built."""
    try:
        extension()
    except EngineMissingError:
        return False
    return True


def precisions() -> list[str]:
    """Names of the precisions that were built: "float32", "float64", "float80" and, with g++, "float128"."""
    return sorted(extension().precisions(), key=lambda name: int(name.removeprefix("float")))
