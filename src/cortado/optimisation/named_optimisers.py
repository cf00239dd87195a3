"""Optimisers by their names, as `cortado.optimise` takes them."""

from collections.abc import Mapping
from dataclasses import MISSING, fields
from typing import Any

from cortado.errors import InputError, shown
from cortado.optimisation.optimisers import LBFGS, Adam, GradientDescent, LineSearch, Optimiser
from cortado.words import quoted

BY_NAME: dict[str, Any] = {"adam": Adam, "gradient_descent": GradientDescent, "lbfgs": LBFGS, "line_search": LineSearch}
"""The optimisers by the names that `cortado.optimise` takes."""


def as_optimiser(optimiser: Any, settings: Mapping[str, Any]) -> Optimiser:
    """An optimiser from its name and its settings, or the object itself; raises `InputError` for anything else."""
    if isinstance(optimiser, str):
        return _named(optimiser, settings)
    if isinstance(optimiser, type) or not isinstance(optimiser, Optimiser):
        raise InputError(
            f"The optimiser must be an object such as cortado.optimisers.Adam(learning_rate=0.1), or one of "
            f"{quoted(BY_NAME)}, not {shown(optimiser)}."
        )
    if settings:
        raise InputError(
            f"optimise was given {quoted(settings)}, but takes settings only of an optimiser that is given by its "
            "name: an object has its own."
        )
    return optimiser


def _named(name: str, settings: Mapping[str, Any]) -> Optimiser:
    """The optimiser of a name, with settings that must be its own and complete."""
    if name not in BY_NAME:
        raise InputError(f"The optimiser is {shown(name)}, but must be one of {quoted(BY_NAME)}, or an object.")
    known = {field.name: field.default is MISSING for field in fields(BY_NAME[name])}
    unknown = sorted(set(settings) - set(known))
    if unknown:
        raise InputError(f"{quoted(unknown)} is no setting of '{name}', whose settings are {quoted(known)}.")
    missing = [setting for setting, needed in known.items() if needed and setting not in settings]
    if missing:
        raise InputError(f"'{name}' needs {quoted(missing)}; its settings are {quoted(known)}.")
    return BY_NAME[name](**settings)
