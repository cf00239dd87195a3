"""The extension module of the C++ engine."""

import importlib
import os
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any

WAITING = "OMP_WAIT_POLICY"


@cache
def extension() -> Any:
    """The module."""
    with _patient_threads():
        return importlib.import_module("cortado_reference._engine")


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


def precisions() -> list[str]:
    """Names of the precisions that were built: "float32", "float64", "float80" and, with g++, "float128"."""
    return sorted(extension().precisions(), key=lambda name: int(name.removeprefix("float")))
