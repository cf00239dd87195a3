"""The tables [problem], [optimise] and [fit] of a task, and the JSON schema of scene, task and data set files."""

import json
from collections.abc import Mapping
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
from cortado.gradients import AdjointEstimator, AdjointViscosity, EnsembleMean, Exact, GradientEstimator
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
DISTANCES: dict[str, ImageLoss] = {"squared_difference": SquaredDifference(), "pyramid": Pyramid()}
ESTIMATORS: dict[str, AdjointEstimator] = {"exact": Exact(), "adjoint_viscosity": AdjointViscosity()}


def _arrays(values: Any, info: ValidationInfo, words: tuple[str, ...] = ()) -> dict[str, Any]:
    """Convert values to arrays by parameter name; parameters in `CAN_BE_RANDOM` may instead be one of ``words``."""
    if not isinstance(values, Mapping) or not values:
        raise field_error((), Words("empty") if values == {} else values, wanted(VALUES))
    names, flat = _names(info), dict[str, Any]()
    for name, value in values.items():  # {"drag": {"k": 2.0}} is {"drag.k": 2.0}
        deeper = isinstance(value, Mapping) and any(known.startswith(f"{name}.") for known in names)
        flat |= {f"{name}.{key}": entry for key, entry in value.items()} if deeper else {name: value}
    for name, value in flat.items():
        if name not in names:
            raise field_error((name,), Words("unknown"), _offered(info))
        if not (name in CAN_BE_RANDOM and isinstance(value, str) and value in words):
            try:
                flat[name] = np.array(value if _is_numeric(value) else "no number", dtype=np.float64)
            except ValueError:
                finite = "made of finite numbers: one, a list of them, or a list of lists of one length"
                raise field_error((name,), value, finite) from None
    return flat


def _names(info: ValidationInfo) -> tuple[str, ...]:
    return (*NAMES, *(info.context or {}).get("names", ()))


def _offered(info: ValidationInfo) -> str:
    return f"one of {', '.join((info.context or {}).get('names', NAMES))}"


def _known(name: Any, check: ValidatorFunctionWrapHandler, info: ValidationInfo) -> Any:
    """Check a parameter's name against the names in the validation context, if there are any."""
    if info.context and name not in _names(info):
        raise field_error((), name, _offered(info))
    return name if info.context else check(name)


def _is_numeric(value: Any) -> bool:
    """Test for a finite number, or a non-empty (nested) list of finite numbers."""
    if isinstance(value, list):
        return bool(value) and all(map(_is_numeric, value))
    return as_number(value) is not None


def _schema(words: tuple[str, ...] = ()) -> dict[str, Any]:
    allowed = [{"enum": list(words)}] if words else []
    properties = {
        name: {"anyOf": [*_NUMBERS, *allowed] if name in CAN_BE_RANDOM else _NUMBERS, "unit": unit or "-"}
        for name, unit in UNITS.items()
    }
    dotted = {r"\.": {"anyOf": _NUMBERS, "unit": "-"}}  # user-defined parameters; tables are allowed too
    others = {"patternProperties": dotted, "additionalProperties": {"type": "object"}}
    return {"type": "object", "minProperties": 1, "properties": properties, **others}


VALUES = _schema()
Values = Annotated[dict[str, Any], BeforeValidator(_arrays), WithJsonSchema(VALUES)]
"""Parameters by name, each a number, a list of numbers, or a list of lists of numbers."""
Start = Annotated[
    dict[str, Any], BeforeValidator(partial(_arrays, words=(RANDOM,))), WithJsonSchema(_schema(words=(RANDOM,)))
]
"""`Values` in which first positions and mass fractions may be the word "random"."""
ParameterName = Annotated[str, OneOf(NAMES), WrapValidator(_known)]


class MeasuredTable(Table):
    """A measurement of an experiment."""

    name: Text
    """Name of the measurement in results, and prefix of its camera's parameters, as in "camera.rotation"."""
    file: Text
    """File with the measured data, relative to the folder of the task's file."""
    start: Seconds = 0.0
    """Time of the run at which the file's times are 0."""


class VideoTable(MeasuredTable):
    """Frames of a video, compared with pictures of the simulation by the camera of the table [render]."""

    kind: Literal["video"]
    """Frames, compared with pictures."""
    frame_rate: Annotated[float, quantity("1/s", gt=0.0)] | None = None
    """Frames per second; by default the video's frame rate. Needed for a folder of pictures."""
    every: Annotated[int, count(1, 1_000_000)] = 1
    """Use only every n-th frame."""
    crop: Annotated[tuple[Pixel, ...], components("left", "top", "right", "bottom")] | None = None
    """Rectangle of each frame that is compared, in pixels of the frame; by default the full frame."""
    mask: Text | None = None
    """Picture of the frames' size whose black pixels are ignored, relative to the folder of the task's file."""
    calibrate: tuple[Literal["start", "translation", "rotation", "field_of_view", "width", "extinction"], ...] = ()
    """Camera parameters, extinction of the fluid, or clock ("start", the key start) that are fitted too."""
    noise: Annotated[float, quantity(gt=0.0)] | None = None
    """Standard deviation of the linear light of a pixel; by default estimated from the residuals."""


class SensorSeriesTable(MeasuredTable):
    """Readings of a sensor: a CSV file with a column "time" [s], and columns named like the sensor's numbers. Columns
    may be named as in `sensors.csv`, such as "gauge.height [m]"; columns of other sensors are ignored."""

    kind: Literal["sensor"]
    """A series, compared with a [[sensor]] of the scene; a "wave_gauge" predicts heights of a surface."""
    sensor: Text
    """Name of the [[sensor]]."""
    calibrate: Clock = ()
    """["start"] fits the key start too."""
    noise: Annotated[float, quantity(gt=0.0)] | None = None
    """Standard deviation of a number, in its unit; by default estimated from the residuals."""


class TracksTable(MeasuredTable):
    """Paths of tracers: a CSV file with columns "time" [s], "tracer" (a number), "x", "y" and in 3-D "z" [m]. Every
    tracer needs a line for the start of the run."""

    kind: Literal["tracks"]
    """Tracers, which swim with the fluid around them."""
    calibrate: Clock = ()
    """["start"] fits the key start too."""
    noise: Annotated[float, quantity("m", gt=0.0)] | None = None
    """Standard deviation of a coordinate [m]; by default estimated from the residuals."""


AnyMeasured = Annotated[VideoTable | SensorSeriesTable | TracksTable, Field(discriminator="kind")]


def _growing(value: Any, check: ValidatorFunctionWrapHandler) -> tuple[float, ...]:
    """Return the factors of a continuation schedule; raise a `field_error` unless they increase to 1."""
    with suppress(ValidationError):
        factors = check(value)
        if factors[-1] == 1.0 and all(a < b for a, b in pairwise(factors)):
            return factors
    words = "a list of numbers greater than 0, each greater than the one before, the last of them 1"
    raise field_error((), value, words)


Schedule = Annotated[Several[Annotated[float, quantity(gt=0.0, le=1.0)]], WrapValidator(_growing)]


class ProblemTable(Table):
    """[problem]: a number of steps, and a target: the end of a run with true parameters, or a picture."""

    steps: Annotated[int, count(0, 10_000_000)]
    """Time steps; 0 for a loss of the first state."""
    loss: Literal["positions", "image"] = "positions"
    """Compare positions of particles, or images, with the target."""
    distance: Annotated[str, OneOf(DISTANCES)] = "squared_difference"
    """Distance between images: their squared difference, or a pyramid, for shapes that do not overlap yet."""
    frames: Annotated[int, count(1, 10_000)] = 1
    """Number of states that are compared, evenly spaced up to the last one."""
    target: Values | None = None
    """True parameters by name: the target is the result of a run with them. Either target or picture is needed."""
    picture: Text | None = None
    """"heart", "rosetta", or a picture file, relative to the folder of the task's file."""
    measured: tuple[AnyMeasured, ...] = ()
    """Measurements of an experiment, in place of a target or a picture; for `cortado fit`."""
    also: tuple[Text, ...] = ()
    """Files of other experiments with the same fluid, relative to the folder of the task's file, for `cortado fit`:
    scenes with a table [problem] of measured data."""

    @model_validator(mode="after")
    def _check_measured(self) -> Self:
        if not self.measured:
            if self.also:
                raise field_error(("also",), list(self.also), "left out, as nothing is measured")
            return self._check_target()
        others = {"loss", "distance", "frames", "target", "picture"} & self.model_fields_set
        for name in sorted(others):
            raise field_error((name,), Words("given"), "left out, as there is measured data")
        names = [one.name for one in self.measured]
        for k, name in enumerate(names):
            if name in names[:k] or "." in name:
                raise field_error(("measured", k, "name"), name, "a name of its own, without a dot")
        return self

    def _check_target(self) -> Self:
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
        """Return the step numbers of the states that are compared."""
        return [round(self.steps * (k + 1) / self.frames) for k in range(self.frames)]


class CheckTable(Table):
    """[optimise.check]: criteria that the estimate has to meet."""

    loss_reduction: Annotated[float, quantity(ge=1.0)] = 1.0
    """First loss / best loss."""
    parameter_error: Annotated[float, quantity(gt=0.0)] = 1e50
    """Greatest allowed relative distance (L2) of an estimated parameter from its true value."""
    psnr: Annotated[float, quantity("dB", ge=0.0)] = 0.0
    """Least peak signal-to-noise ratio between the image of the estimate and the target image."""


class GradientTable(Table):
    """[optimise.gradient]: which gradient the search follows, see docs/gradients.md."""

    name: Annotated[str, OneOf(ESTIMATORS)] = "exact"
    """Name of the estimator; "adjoint_viscosity" is for long splashes."""
    coefficient: Annotated[float, quantity(ge=0.0)] | None = None
    """C of `AdjointViscosity`, whose strength is C times the strain of the fluid in a step; by default 2."""
    samples: Annotated[int, count(1, 10_000)] = 1
    """Runs of the ensemble over which the gradient is averaged: 1, or an even number of at least 4."""
    spread: Values | None = None
    """Width of the ensemble for every searched parameter by name, in the units of its knots or logarithms; needed with
    several samples. Samples may be out of bounds: make parameters logarithmic that must stay positive."""
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
    """First values of the searched parameters by name; first positions and mass fractions may be the word "random"."""
    knots: Annotated[int, count(2, 10_000_000)] | None = None
    """Number of knots in time between which parameters over time are interpolated; by default one row per step."""
    logarithmic: tuple[ParameterName, ...] = ()
    """Parameters that are searched by their logarithm."""
    bounds: Values | None = None
    """Lower and upper bound by parameter name; viscosity, mobility and fractions never become negative anyway."""
    extinction_schedule: Schedule = (1.0,)
    """A continuation schedule of searches. Each search multiplies the scene's extinction by one factor, and starts at
    the end of the previous search. Pictures of thinner fluid show what is behind its surface."""
    optimiser: Annotated[str, OneOf(BY_NAME)] = "adam"
    """Name of the algorithm; the line search of "lbfgs" needs exact gradients."""
    learning_rate: Annotated[float, quantity("units of the parameters", gt=0.0)]
    """Approximate step size of Adam, first step size of L-BFGS, or greatest step size of the line search, in units of
    the parameters. Gradient descent multiplies the gradient by it."""
    tolerance: Annotated[float, quantity(gt=0.0, le=0.5)] | None = None
    """L-BFGS ends if the gradient is smaller than this part of the first gradient; by default, if round-off stops
    it."""
    iterations: Annotated[int, count(1, MOST_ITERATIONS)]
    """Greatest number of updates of each search."""
    gradient: GradientTable = GradientTable()
    """Gradient that the search follows."""
    check: CheckTable = CheckTable()
    """Criteria that the estimate has to meet."""

    @model_validator(mode="after")
    def _check_tolerance(self) -> Self:
        if self.tolerance is not None and self.optimiser != "lbfgs":
            raise field_error(("tolerance",), self.tolerance, 'left out, as only "lbfgs" has one')
        return self

    def algorithm(self) -> Optimiser:
        """Make the optimiser of the table."""
        setting = "scale" if self.optimiser in ("lbfgs", "line_search") else "learning_rate"
        given = {setting: self.learning_rate, "tolerance": self.tolerance}
        made: Optimiser = BY_NAME[self.optimiser](**{key: one for key, one in given.items() if one is not None})
        return made


class TaskTables(Table):
    """The tables [problem] and [optimise] of a task."""

    problem: ProblemTable
    optimise: OptimiseTable


class FitTable(Table):
    """[fit]: the parameters that are fitted to measured data, and the length of the fit."""

    start: Values
    """First values of the fitted parameters by name; positive parameters are searched by their logarithm."""
    bounds: Values | None = None
    """Lower and upper bound by parameter name; a number with equal bounds is not fitted."""
    iterations: Annotated[int, count(1, 10_000)] = 50
    """Greatest number of trial points of each of the two fits: the first weights all residuals equally, the second by
    the noise that the first finds."""
    starts: Annotated[int, count(1, 100)] | None = None
    """Number of starts of the fit; by default 1, and three more if the first fit ends in doubt. Further starts lie
    within the bounds, or within two decades of a positive number."""
    profiles: Annotated[int, count(0, 100)] = 7
    """Number of points of each fitted number's profile, with a fit of all other numbers at each point; 0 for none."""


class FitTables(Table):
    """The tables [problem] and [fit] of a task whose target was measured."""

    problem: ProblemTable
    fit: FitTable


def file_schema() -> dict[str, Any]:
    """Return the JSON schema of scenes, tasks and data sets: names, types, units and ranges of all keys."""
    schemas = [model.model_json_schema() for model in (Scene, TaskTables, FitTables, DatasetTables)]
    tables = {name: table for schema in schemas for name, table in schema["$defs"].items()}
    for table in tables.values():
        if "shape" in table.get("properties", {}):  # it has a default in Python, but has to be named in a file
            table["required"] = list(dict.fromkeys(["shape", *table.get("required", [])]))
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        **{key: value for key, value in schemas[0].items() if key != "$defs"},
        "title": "A scene of Cortado, a task, or a data set",
        "properties": {key: value for schema in schemas for key, value in schema["properties"].items()},
        "$defs": tables,
    }


def file_schema_text() -> str:
    return json.dumps(file_schema(), indent=1, ensure_ascii=False) + "\n"
