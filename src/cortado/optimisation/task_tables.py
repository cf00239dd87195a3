"""The tables of a task, [problem] with what was measured, [optimise] and [fit], and the JSON schema of all files."""

import json
from collections.abc import Collection, Mapping
from contextlib import suppress
from functools import partial
from itertools import pairwise
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import (
    BeforeValidator,
    Field,
    ValidationError,
    ValidationInfo,
    ValidatorFunctionWrapHandler,
    WithJsonSchema,
    WrapValidator,
    model_validator,
)

from cortado.arrays import as_number
from cortado.errors import Words
from cortado.executors import Executor, InProcess
from cortado.gradients import (
    AdjointEstimator,
    AdjointViscosity,
    EnsembleMean,
    Exact,
    GradientEstimator,
)
from cortado.image_losses import ImageLoss, Pyramid, SquaredDifference
from cortado.optimisation.datasets import DatasetTables
from cortado.optimisation.optimise import MOST_ITERATIONS
from cortado.optimisation.optimisers import BY_NAME, Optimiser
from cortado.scene.parameter_values import NAMES, UNITS
from cortado.scene.scene import Scene
from cortado.scene.tables import MISSING, OneOf, Several, Table, Text, components, count, field_error, quantity, wanted

RANDOM = "random"
CAN_BE_RANDOM = ("initial_positions", "mass_fractions")
Pixel = Annotated[int, count(0, 100_000)]
Seconds = Annotated[float, quantity("s")]
Clock = tuple[Literal["start"], ...]
_NUMBERS: list[Any] = [{"type": "number"}, {"type": "array"}]
WITH_A_SCALE = ("lbfgs", "line_search")
"""Optimisers whose learning rate is the size of the first step, or the longest one."""
DISTANCES: dict[str, ImageLoss] = {"squared_difference": SquaredDifference(), "pyramid": Pyramid()}
ESTIMATORS: dict[str, AdjointEstimator] = {
    "exact": Exact(),
    "adjoint_viscosity": AdjointViscosity(),
}


def _arrays(values: Any, info: ValidationInfo, words: tuple[str, ...] = ()) -> dict[str, Any]:
    """Return values by name as arrays, or as one of the words where a parameter can be random; raise `field_error`."""
    if not isinstance(values, Mapping) or not values:
        raise field_error((), Words("empty") if values == {} else values, wanted(VALUES))
    found = {}
    names = _names(info)
    for name, value in _flat(values, names).items():
        if name not in names:
            raise field_error((name,), Words("unknown"), _offered(info))
        is_word = name in CAN_BE_RANDOM and isinstance(value, str) and value in words
        found[name] = value if is_word else _array(name, value)
    return found


def _flat(values: Mapping[str, Any], names: Collection[str]) -> dict[str, Any]:
    """Return values by name, where ``drag.k = 2.0`` came as a table in a table."""
    found = {}
    for name, value in values.items():
        deeper = isinstance(value, Mapping) and any(known.startswith(f"{name}.") for known in names)
        found.update({f"{name}.{key}": entry for key, entry in value.items()} if deeper else {name: value})
    return found


def _names(info: ValidationInfo) -> Collection[str]:
    """Return the names of all parameters, with those of parts of packages if the reader of the tables knows these."""
    return (*NAMES, *(info.context or {}).get("names", ()))


def _offered(info: ValidationInfo) -> str:
    """Name in words the right parameters: the scene's, if the reader of the tables knows these."""
    return f"one of {', '.join((info.context or {}).get('names', NAMES))}"


def _known(name: Any, check: ValidatorFunctionWrapHandler, info: ValidationInfo) -> Any:
    """Check the name of a parameter; raise a `field_error` if the reader of the tables knows other names only."""
    if info.context and name not in _names(info):
        raise field_error((), name, _offered(info))
    return name if info.context else check(name)


def _array(name: str, value: Any) -> Any:
    with suppress(ValueError):
        if _is_numeric(value):
            return np.array(value, dtype=np.float64)
    finite = "made of finite numbers: one, a list of them, or a list of lists of one length"
    raise field_error((name,), value, finite)


def _is_numeric(value: Any) -> bool:
    """Test for a finite number, or a list, not empty, of nothing else."""
    if isinstance(value, list):
        return bool(value) and all(map(_is_numeric, value))
    return as_number(value) is not None


def _schema(words: tuple[str, ...] = ()) -> dict[str, Any]:
    """Return the JSON schema of values by name; parameters that can be random may be one of the words too."""
    allowed = [{"enum": list(words)}] if words else []
    properties = {
        name: {"anyOf": [*_NUMBERS, *allowed] if name in CAN_BE_RANDOM else _NUMBERS, "unit": unit or "-"}
        for name, unit in UNITS.items()
    }
    dotted = {r"\.": {"anyOf": _NUMBERS, "unit": "-"}}  # of parts of packages, also written as tables
    others = {"patternProperties": dotted, "additionalProperties": {"type": "object"}}
    return {"type": "object", "minProperties": 1, "properties": properties, **others}


VALUES = _schema()
"""The JSON schema of `Values`."""
Values = Annotated[dict[str, Any], BeforeValidator(_arrays), WithJsonSchema(VALUES)]
"""Parameters by name, each a number, a list of numbers, or a list of lists of numbers."""
Start = Annotated[
    dict[str, Any], BeforeValidator(partial(_arrays, words=(RANDOM,))), WithJsonSchema(_schema(words=(RANDOM,)))
]
"""Values, of which some may be the word "random"."""
ParameterName = Annotated[str, OneOf(NAMES), WrapValidator(_known)]
"""Of a parameter of Cortado, or of a part of a package where whoever reads the tables knows it."""


class MeasuredTable(Table):
    """Something that was measured."""

    name: Text
    """Its name in results; its camera's parameters begin with it, as "camera.rotation"."""
    file: Text
    """File with the numbers, beside the task's own file."""
    start: Seconds = 0.0
    """Time on the clock of the run where that of the file shows 0."""


class VideoTable(MeasuredTable):
    """Frames of a video, beside pictures of the simulation, whose camera [render] describes."""

    kind: Literal["video"]
    """Frames, compared with pictures."""
    frame_rate: Annotated[float, quantity("1/s", gt=0.0)] | None = None
    """Frames in a second; needed for a folder of pictures, what the video itself says if left out."""
    every: Annotated[int, count(1, 1_000_000)] = 1
    """Take only every so many frames."""
    crop: Annotated[tuple[Pixel, ...], components("left", "top", "right", "bottom")] | None = None
    """The part of each frame that counts, in its pixels; all of it if left out."""
    mask: Text | None = None
    """A picture of the frames' size, beside the task's own file, black where pixels do not count."""
    calibrate: tuple[Literal["start", "translation", "rotation", "field_of_view", "width", "extinction"], ...] = ()
    """What of the camera, the fluid's extinction, and the clock is searched beside the parameters; "start" is the key
    start."""
    noise: Annotated[float, quantity(gt=0.0)] | None = None
    """Standard deviation of the linear light of a pixel; the residuals tell if left out."""


class SensorSeriesTable(MeasuredTable):
    """What a sensor measured: a CSV file with a column "time" [s], and columns by the names of the sensor's numbers.
    They may be named as in `sensors.csv`, such as "gauge.height [m]"; columns of other sensors are left out."""

    kind: Literal["sensor"]
    """A series, compared with a [[sensor]] of the scene; heights of a surface are those of a "wave_gauge"."""
    sensor: Text
    """The name of the [[sensor]]."""
    calibrate: Clock = ()
    """["start"] to search the key start beside the parameters."""
    noise: Annotated[float, quantity(gt=0.0)] | None = None
    """Standard deviation of a number, in its unit; the residuals tell if left out."""


class TracksTable(MeasuredTable):
    """Paths of tracers: a CSV file with columns "time" [s], "tracer" (a number), "x", "y" and in 3-D "z" [m]. Each
    tracer needs a line for the start of the run."""

    kind: Literal["tracks"]
    """Tracers, which swim with the fluid around them."""
    calibrate: Clock = ()
    """["start"] to search the key start beside the parameters."""
    noise: Annotated[float, quantity("m", gt=0.0)] | None = None
    """Standard deviation of a coordinate [m]; the residuals tell if left out."""


AnyMeasured = Annotated[VideoTable | SensorSeriesTable | TracksTable, Field(discriminator="kind")]


def _growing(value: Any, check: ValidatorFunctionWrapHandler) -> tuple[float, ...]:
    """Check that factors grow to 1, and return them; raise a `field_error` if not."""
    with suppress(ValidationError):
        factors = check(value)
        if factors[-1] == 1.0 and all(a < b for a, b in pairwise(factors)):
            return factors
    words = "a list of numbers greater than 0, each greater than the one before, the last of them 1"
    raise field_error((), value, words)


Schedule = Annotated[Several[Annotated[float, quantity(gt=0.0, le=1.0)]], WrapValidator(_growing)]
"""A continuation schedule: factors that grow to 1."""


class ProblemTable(Table):
    """[problem]: a number of steps, and a target: the end of a run with true parameters, or a picture."""

    steps: Annotated[int, count(0, 10_000_000)]
    """Time steps; 0 for a loss of the first state."""
    loss: Literal["positions", "image"] = "positions"
    """What is compared with the target: positions of particles, or images."""
    distance: Annotated[str, OneOf(DISTANCES)] = "squared_difference"
    """How images are compared: by their difference, or by a pyramid, for shapes that do not overlap yet."""
    frames: Annotated[int, count(1, 10_000)] = 1
    """Number of states that are compared, evenly spaced up to the last one."""
    target: Values | None = None
    """The true parameters by name: the target is what a run with them makes. Either this or a picture is needed."""
    picture: Text | None = None
    """"heart", "rosetta", or a file with a picture, beside the task's own."""
    measured: tuple[AnyMeasured, ...] = ()
    """What was measured of an experiment, in the place of a target or a picture; for `cortado fit`."""
    also: tuple[Text, ...] = ()
    """Files of other experiments with the same fluid, beside the task's own: scenes with a table [problem] of measured
    data; for `cortado fit`."""

    @model_validator(mode="after")
    def _check_measured(self) -> Self:
        if not self.measured:
            if self.also:
                raise field_error(("also",), list(self.also), "left out, as nothing is measured")
            return self
        others = {"loss", "distance", "frames", "target", "picture"} & self.model_fields_set
        for name in sorted(others):
            raise field_error((name,), Words("given"), "left out, as there is measured data")
        names = [one.name for one in self.measured]
        for k, name in enumerate(names):
            if name in names[:k] or "." in name:
                raise field_error(("measured", k, "name"), name, "a name of its own, without a dot")
        return self

    @model_validator(mode="after")
    def _check_target(self) -> Self:
        if self.measured:
            return self
        has_picture, most = self.picture is not None, max(self.steps, 1)
        if not has_picture and self.target is None:
            raise field_error(("target",), MISSING, f"{wanted(VALUES)}, as there is no picture")
        has_idle_distance = self.loss != "image" and "distance" in self.model_fields_set
        for is_wrong, name, words in (
            (has_picture and self.target is not None, "picture", "left out, as there is a target"),
            (has_picture and self.loss != "image", "loss", '"image", as there is a picture'),
            (has_picture and self.frames > 1, "frames", "1, as there is a picture, which is one"),
            (has_idle_distance, "distance", "left out, as positions are compared"),
            (self.frames > most, "frames", f"at most {most}, as there are {self.steps} steps"),
        ):
            if is_wrong:
                raise field_error((name,), getattr(self, name), words)
        return self

    @property
    def compared(self) -> list[int]:
        """Return the numbers of steps before the states that are compared."""
        return [round(self.steps * (k + 1) / self.frames) for k in range(self.frames)]


class CheckTable(Table):
    """[optimise.check]: what the estimate has to reach."""

    loss_reduction: Annotated[float, quantity(ge=1.0)] = 1.0
    """First loss / best loss."""
    parameter_error: Annotated[float, quantity(gt=0.0)] = 1e50
    """Largest relative distance (L2) of an estimated parameter from its true value."""
    psnr: Annotated[float, quantity("dB", ge=0.0)] = 0.0
    """Peak signal-to-noise ratio of the image of the estimate to the target."""


class GradientTable(Table):
    """[optimise.gradient]: which gradient the search follows, see docs/gradients.md."""

    name: Annotated[str, OneOf(ESTIMATORS)] = "exact"
    """Name of the estimator; "adjoint_viscosity" is for long splashes."""
    coefficient: Annotated[float, quantity(ge=0.0)] | None = None
    """C of `AdjointViscosity`, whose strength is C times what the fluid strains in a step; if left out, 2."""
    samples: Annotated[int, count(1, 10_000)] = 1
    """Runs of the ensemble over which the gradient is averaged: 1, or an even number of at least 4."""
    spread: Values | None = None
    """By name, for every parameter that is searched, the width of the ensemble in its units (knots, logarithms); needed
    with several samples. Samples may be outside of the bounds: make parameters that must stay positive logarithmic."""
    position_noise: Annotated[float, quantity("spacings", ge=0.0)] = EnsembleMean.position_noise
    """Standard deviation of the perturbations of first positions in the ensemble."""

    @model_validator(mode="before")
    @classmethod
    def _has_no_strength(cls, given: Any) -> Any:
        if isinstance(given, Mapping) and "strength" in given:
            words = "left out, as the strength follows the flow now; coefficient is a factor on it"
            raise field_error(("strength",), given["strength"], words)
        return given

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.coefficient is not None and self.name != "adjoint_viscosity":
            raise field_error(("coefficient",), self.coefficient, "left out, as nothing is smoothed")
        if self.samples != 1 and (self.samples % 2 or self.samples < 4):
            raise field_error(("samples",), self.samples, "1, or an even number of at least 4")
        if self.samples > 1 and self.spread is None:
            raise field_error(("spread",), MISSING, "a table of numbers greater than 0, as there are several samples")
        for name in ("spread", "position_noise"):
            if self.samples == 1 and name in self.model_fields_set:
                raise field_error((name,), Words("given"), "left out, as there is one sample")
        for name, number in (self.spread or {}).items():
            if number.ndim or not number > 0.0:
                raise field_error(("spread", name), number.tolist(), "a number greater than 0")
        return self

    def estimator(self, executor: Executor | None = None) -> GradientEstimator:
        """Make the gradient estimator of the table; ``executor`` computes the samples of an ensemble."""
        one = ESTIMATORS[self.name]
        if isinstance(one, AdjointViscosity):
            coefficient = one.coefficient if self.coefficient is None else self.coefficient
            one = AdjointViscosity(coefficient, order=2 if self.samples > 1 else 1)
        if self.spread is None:
            return one
        spread = {name: float(number) for name, number in self.spread.items()}
        executor = InProcess() if executor is None else executor
        return EnsembleMean(spread, self.samples, self.position_noise, estimator=one, executor=executor)


class OptimiseTable(Table):
    """[optimise]: the start of the search, its algorithm, and its length."""

    start: Start
    """By name the parameters that are searched, as the search starts; first positions and mass fractions may be the
    word "random"."""
    knots: Annotated[int, count(2, 10_000_000)] | None = None
    """Number of free rows between which parameters over time are interpolated; if left out, one row for each step."""
    logarithmic: tuple[ParameterName, ...] = ()
    """Parameters that are searched by their logarithm."""
    bounds: Values | None = None
    """By the name of a parameter the lower and the upper bound; viscosity, mobility and fractions never go below 0
    anyway."""
    extinction_schedule: Schedule = (1.0,)
    """A continuation schedule: one search for each factor, which starts where the last one ended and sees the fluid
    with the scene's extinction times that factor. A picture of thinner fluid shows what is behind its surface."""
    optimiser: Annotated[str, OneOf(BY_NAME)] = "adam"
    """Name of the algorithm; the line search of "lbfgs" needs exact gradients."""
    learning_rate: Annotated[float, quantity("units of the parameters", gt=0.0)]
    """For Adam about the size of its steps, in units of the parameters; for L-BFGS the size of its first step, for the
    line search its longest step. For gradient descent the factor of the gradient."""
    tolerance: Annotated[float, quantity(gt=0.0, le=0.5)] | None = None
    """L-BFGS ends where the gradient is this part of the first one; if left out, where round-off stops it."""
    iterations: Annotated[int, count(1, MOST_ITERATIONS)]
    """Updates at most, of each search."""
    gradient: GradientTable = GradientTable()
    """The gradient that the search follows."""
    check: CheckTable = CheckTable()
    """What the estimate has to reach."""

    @model_validator(mode="after")
    def _check_tolerance(self) -> Self:
        if self.tolerance is not None and self.optimiser != "lbfgs":
            raise field_error(("tolerance",), self.tolerance, 'left out, as only "lbfgs" has one')
        return self

    def algorithm(self) -> Optimiser:
        """Make the optimiser of the table."""
        setting = "scale" if self.optimiser in WITH_A_SCALE else "learning_rate"
        given = {setting: self.learning_rate, "tolerance": self.tolerance}
        made: Optimiser = BY_NAME[self.optimiser](**{key: one for key, one in given.items() if one is not None})
        return made


class TaskTables(Table):
    """The tables [problem] and [optimise] of a task."""

    problem: ProblemTable
    optimise: OptimiseTable


class FitTable(Table):
    """[fit]: the parameters that are fitted to measured data, and how long."""

    start: Values
    """By name the parameters that are fitted, as the fit starts; positive ones are searched by their logarithm."""
    bounds: Values | None = None
    """By the name of a parameter the lower and the upper bound; a number whose bounds are the same is not fitted."""
    iterations: Annotated[int, count(1, 10_000)] = 50
    """Trial points at most, of each of the two fits."""
    starts: Annotated[int, count(1, 100)] | None = None
    """From how many starts the fit searches; if left out, from the one that is given, and from three others where that
    ends in doubt. Others lie within the bounds, or within two decades of a positive number."""
    profiles: Annotated[int, count(0, 100)] = 7
    """Points of the profile of each number, each with a fit of all others; 0 for no profiles."""


class FitTables(Table):
    """The tables [problem] and [fit] of a task whose target was measured."""

    problem: ProblemTable
    fit: FitTable


def file_schema() -> dict[str, Any]:
    """Return the JSON schema of a scene or a task. It knows names, types, units and ranges; Cortado itself checks what
    must fit together."""
    models = (Scene, TaskTables, FitTables, DatasetTables)
    scene, task, fit, data_set = (model.model_json_schema() for model in models)
    tables = {**scene["$defs"], **task["$defs"], **fit["$defs"], **data_set["$defs"]}
    for table in tables.values():
        if "shape" in table.get("properties", {}):  # it has a default in Python, but has to be named in a file
            table["required"] = list(dict.fromkeys(["shape", *table.get("required", [])]))
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        **{key: value for key, value in scene.items() if key != "$defs"},
        "title": "A scene of Cortado, a task, or a data set",
        "properties": {**scene["properties"], **task["properties"], **fit["properties"], **data_set["properties"]},
        "$defs": tables,
    }


def file_schema_text() -> str:
    """Return the JSON schema as the text that is shipped."""
    return json.dumps(file_schema(), indent=1, ensure_ascii=False) + "\n"
