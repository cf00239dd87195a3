"""The table [dataset] of a file: how the runs of a data set are varied, and what is kept of each."""

from collections.abc import Mapping
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import BeforeValidator, Field, WithJsonSchema, model_validator

from cortado.scene.fields import Flag, Text, count, field_error, quantity
from cortado.scene.tables import Table

PAIR = "a lower and an upper end of the same shape, each a number or a list of numbers"


def _ranges(given: Any) -> Any:
    """By the name of a value its lower and its upper end, as lists of floats."""
    if not isinstance(given, Mapping):
        raise field_error((), given, "a table of ranges by the keys of values")
    found = {}
    for key, pair in given.items():
        if isinstance(pair, Mapping):
            raise field_error((key,), pair, f'{PAIR}; a key with dots stands in quotes, as in vary."{key}.…"')
        try:
            lower, upper = np.asarray(pair, dtype=np.float64)
        except (ValueError, TypeError):
            raise field_error((key,), pair, PAIR) from None
        if not np.isfinite([lower, upper]).all() or np.any(lower > upper):
            raise field_error((key,), pair, f"{PAIR}, finite, the lower one nowhere above the upper one")
        found[key] = (lower.tolist(), upper.tolist())
    return found


Ranges = Annotated[
    dict[str, Any],
    BeforeValidator(_ranges),
    WithJsonSchema({"type": "object", "additionalProperties": {"type": "array", "minItems": 2, "maxItems": 2}}),
]


class DatasetTable(Table):
    """[dataset]: how long the runs of a data set are, how they are varied, and what is kept of each."""

    steps: Annotated[int, count(1, 10_000_000)]
    """Time steps of each run."""
    write_every: Annotated[int, count(1, 10_000_000)] = 1
    """Time steps from one frame to the next; steps is a multiple of it."""
    vary: Ranges = Field(default_factory=dict)
    """By the key of a value of the scene, in quotes, the ends of its range, as vary."phase.0.viscosity" = [0.1, 1.0]:
    each run has a value from it, each component for itself."""
    logarithmic: tuple[Text, ...] = ()
    """Keys of vary that are drawn evenly by their logarithm."""
    position_noise: Annotated[float, quantity("spacings", ge=0.0, le=0.5)] = 0.0
    """Standard deviation of what is added to every coordinate of the first positions [spacings]"""
    velocity_noise: Annotated[float, quantity("m/s", ge=0.0)] = 0.0
    """Standard deviation of what is added to every component of the first velocities [m/s]"""
    valid: Annotated[float, quantity(ge=0.0, le=0.9)] = 0.1
    """The part of the runs that is for validation."""
    test: Annotated[float, quantity(ge=0.0, le=0.9)] = 0.1
    """The part of the runs that is for tests."""
    walls: Flag = True
    """Whether the particles of walls come behind those of fluid."""
    tangents: Annotated[int, count(0, 1_000)] = 0
    """Random directions of the first state along which each run is differentiated."""
    tangent_frames: Literal["last", "all"] = "last"
    """Of which frames the derivatives are kept."""
    seed: Annotated[int, count(0, 2**31)] = 0
    """Of all random numbers."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.steps % self.write_every:
            raise field_error(("write_every",), self.write_every, f"a divisor of steps, which is {self.steps}")
        if self.valid + self.test >= 1.0:
            raise field_error(("test",), self.test, f"less than {1.0 - self.valid:g}, so that runs to train are left")
        if not self.vary and not self.position_noise and not self.velocity_noise:
            raise field_error(("vary",), "nothing", "given, or position_noise or velocity_noise, so that runs differ")
        if not self.tangents and self.tangent_frames != "last":
            raise field_error(("tangent_frames",), self.tangent_frames, "left out, as there are no tangents")
        for key in self.logarithmic:
            if key not in self.vary:
                raise field_error(("logarithmic",), key, "one of the keys of vary")
            if np.min(self.vary[key][0]) <= 0.0:
                raise field_error(("vary", key), self.vary[key][0], "above 0, as its logarithm is drawn")
        return self

    def split(self, runs: int) -> dict[str, range]:
        """The numbers of the runs for each purpose: the first ones train."""
        valid, test = (max(round(part * runs), 1) if part else 0 for part in (self.valid, self.test))
        train = runs - valid - test
        return {"train": range(train), "valid": range(train, train + valid), "test": range(train + valid, runs)}


class DatasetTables(Table):
    """The table that a data set has besides those of its scene."""

    dataset: DatasetTable
