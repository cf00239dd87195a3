"""The tables [problem], [optimise] and [fit] of a task, and the JSON schema of scene, task and data set files."""

import json
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import partial
from itertools import pairwise
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import BeforeValidator, Field, ValidationInfo, WithJsonSchema, WrapValidator, model_validator

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
    """Convert values to arrays by parameter name. Parameters in `CAN_BE_RANDOM` may be one of the ``words``."""
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


def _known(name: Any, check: Callable[[Any], Any], info: ValidationInfo) -> Any:
    if info.context and name not in _names(info):
        raise field_error((), name, _offered(info))
    return name if info.context else check(name)


def _is_numeric(value: Any) -> bool:
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
"""Parameter values by name. A value is a number, a list of numbers, or a list of lists of numbers."""
Start = Annotated[
    dict[str, Any], BeforeValidator(partial(_arrays, words=(RANDOM,))), WithJsonSchema(_schema(words=(RANDOM,)))
]
"""Parameter values by name. Initial positions and mass fractions may be the word "random"."""
ParameterName = Annotated[str, OneOf(NAMES), WrapValidator(_known)]


class MeasuredTable(Table):
    """A measurement of an experiment."""

    name: Text
    """Name of the measurement in results, and prefix of the parameters of its camera, as in "camera.rotation"."""
    file: Text
    """File with the measured data, relative to the folder of the task's file."""
    start: Seconds = 0.0
    """Time of the simulation at the time 0 of the file."""


class VideoTable(MeasuredTable):
    """Frames of a video, which are compared with pictures of the simulation. The table [render] sets the camera."""

    kind: Literal["video"]
    """The measurements are frames of a video."""
    frame_rate: Annotated[float, quantity("1/s", gt=0.0)] | None = None
    """Frames per second. The default is the frame rate of the video. A folder of pictures needs a frame rate."""
    every: Annotated[int, count(1, 1_000_000)] = 1
    """Use only every n-th frame of the video."""
    crop: Annotated[tuple[Pixel, ...], components("left", "top", "right", "bottom")] | None = None
    """Part of each frame that is compared, as a rectangle in pixels. The default is the whole frame."""
    mask: Text | None = None
    """Mask picture with the size of the frames. Black pixels are ignored. The path is relative to the folder of the
    task's file."""
    calibrate: tuple[Literal["start", "translation", "rotation", "field_of_view", "width", "extinction"], ...] = ()
    """Additional quantities to fit: parameters of the camera, the extinction of the fluid, or "start" for the start
    time of the file."""
    noise: Annotated[float, quantity(gt=0.0)] | None = None
    """Standard deviation of the linear light of a pixel. The default is an estimate from the residuals."""


class SensorSeriesTable(MeasuredTable):
    """Readings of a sensor in a CSV file with a column "time" [s] and a column for each quantity of the sensor. Columns
    may be named as in `sensors.csv`, such as "gauge.height [m]". Columns of other sensors are ignored."""

    kind: Literal["sensor"]
    """The measurements are readings of a [[sensor]] over time."""
    sensor: Text
    """Name of the [[sensor]] in the scene."""
    calibrate: Clock = ()
    """Use ["start"] to fit also the start time of the file."""
    noise: Annotated[float, quantity(gt=0.0)] | None = None
    """Standard deviation of a reading, in its unit. The default is an estimate from the residuals."""


class TracksTable(MeasuredTable):
    """Paths of tracers in a CSV file with columns "time" [s], "tracer" (a number), "x", "y" and in 3-D "z" [m]. The
    file must contain the position of every tracer at the start of the run."""

    kind: Literal["tracks"]
    """The measurements are paths of tracers, which move with the fluid."""
    calibrate: Clock = ()
    """Use ["start"] to fit also the start time of the file."""
    noise: Annotated[float, quantity("m", gt=0.0)] | None = None
    """Standard deviation of a coordinate [m]. The default is an estimate from the residuals."""


AnyMeasured = Annotated[VideoTable | SensorSeriesTable | TracksTable, Field(discriminator="kind")]


def _growing(value: Any, check: Callable[[Any], Any]) -> tuple[float, ...]:
    with suppress(ValueError):
        factors = check(value)
        if factors[-1] == 1.0 and all(a < b for a, b in pairwise(factors)):
            return factors
    words = "a list of numbers greater than 0, each greater than the one before, the last of them 1"
    raise field_error((), value, words)


Schedule = Annotated[Several[Annotated[float, quantity(gt=0.0, le=1.0)]], WrapValidator(_growing)]


class ProblemTable(Table):
    """[problem]: the number of time steps and the target. The target is a picture, or the result of a run with true
    parameters."""

    steps: Annotated[int, count(0, 10_000_000)]
    """Number of time steps. With 0 steps, the loss uses the initial state."""
    loss: Literal["positions", "image"] = "positions"
    """Data that are compared with the target: positions of particles, or images."""
    distance: Annotated[str, OneOf(DISTANCES)] = "squared_difference"
    """Distance between images: the squared difference, or an image pyramid. A pyramid suits shapes that do not overlap
    at the start."""
    frames: Annotated[int, count(1, 10_000)] = 1
    """Number of compared states. The states are evenly spaced in time up to the last state."""
    target: Values | None = None
    """True parameters by name. The target is the result of a run with the true parameters. Give either target or
    picture."""
    picture: Text | None = None
    """Target picture: "heart", "rosetta", or a file relative to the folder of the task's file."""
    measured: tuple[AnyMeasured, ...] = ()
    """Measurements of an experiment, which replace the target or picture in `cortado fit`."""
    also: tuple[Text, ...] = ()
    """Files of other experiments with the same fluid, for `cortado fit`. Each file is a scene with measured data in a
    table [problem]. Paths are relative to the folder of the task's file."""

    @model_validator(mode="after")
    def _check_measured(self) -> Self:
        if not self.measured:
            if self.also:
                raise field_error(("also",), list(self.also), "left out, as problem.measured is missing")
            return self._check_target()
        for name in sorted({"loss", "distance", "frames", "target", "picture"} & self.model_fields_set):
            raise field_error((name,), Words("given"), "left out, as problem.measured is given")
        names = [one.name for one in self.measured]
        for k, name in enumerate(names):
            if name in names[:k] or "." in name:
                raise field_error(("measured", k, "name"), name, "a unique name without a dot")
        return self

    def _check_target(self) -> Self:
        has_picture, most = self.picture is not None, max(self.steps, 1)
        if not has_picture and self.target is None:
            raise field_error(("target",), MISSING, f"{wanted(VALUES)}, as problem.picture is missing")
        has_idle_distance = self.loss != "image" and "distance" in self.model_fields_set
        for is_wrong, name, words in (
            (has_picture and self.target is not None, "picture", "left out, as there is a target"),
            (has_picture and self.loss != "image", "loss", '"image", as there is a picture'),
            (has_picture and self.frames > 1, "frames", "1, as there is a picture, which is one"),
            (has_idle_distance, "distance", 'left out, as problem.loss is not "image"'),
            (self.frames > most, "frames", f"at most {most}, as there are {self.steps} steps"),
        ):
            if is_wrong:
                raise field_error((name,), getattr(self, name), words)
        return self

    @property
    def compared(self) -> list[int]:
        return [round(self.steps * (k + 1) / self.frames) for k in range(self.frames)]


class CheckTable(Table):
    """[optimise.check]: criteria that the estimate must meet."""

    loss_reduction: Annotated[float, quantity(ge=1.0)] = 1.0
    """Least allowed ratio of the first loss to the lowest loss."""
    parameter_error: Annotated[float, quantity(gt=0.0)] = 1e50
    """Greatest allowed relative error (L2) of an estimated parameter."""
    psnr: Annotated[float, quantity("dB", ge=0.0)] = 0.0
    """Least allowed peak signal-to-noise ratio between the image of the estimate and the target image."""


class GradientTable(Table):
    """[optimise.gradient]: the gradient estimator of the search; see docs/gradients.md."""

    name: Annotated[str, OneOf(ESTIMATORS)] = "exact"
    """Name of the estimator. "adjoint_viscosity" suits long splashes."""
    coefficient: Annotated[float, quantity(ge=0.0)] | None = None
    """Coefficient of `AdjointViscosity`, by default 2. The strength of the viscosity is the coefficient times the
    strain in a step."""
    samples: Annotated[int, count(1, 10_000)] = 1
    """Number of runs over which the gradient is averaged: 1, or an even number of at least 4."""
    spread: Values | None = None
    """Width of the ensemble by parameter name, in the units of the searched values, knots or logarithms. Several
    samples need this key. Samples may be out of bounds. Search positive parameters by their logarithm."""
    position_noise: Annotated[float, quantity("spacings", ge=0.0)] = EnsembleMean.position_noise
    """Standard deviation of the random displacements of initial positions in the ensemble."""

    @model_validator(mode="before")
    @classmethod
    def _has_no_strength(cls, given: Any) -> Any:
        if isinstance(given, Mapping) and "strength" in given:
            words = "left out: the strength now follows the flow, and coefficient is a factor of the strength"
            raise field_error(("strength",), given["strength"], words)
        return given

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.coefficient is not None and self.name != "adjoint_viscosity":
            raise field_error(("coefficient",), self.coefficient, 'given for "adjoint_viscosity" only')
        if self.samples != 1 and (self.samples % 2 or self.samples < 4):
            raise field_error(("samples",), self.samples, "1, or an even number of at least 4")
        if self.samples > 1 and self.spread is None:
            raise field_error(("spread",), MISSING, "a table of numbers greater than 0, as samples is above 1")
        for name in ("spread", "position_noise"):
            if self.samples == 1 and name in self.model_fields_set:
                raise field_error((name,), Words("given"), "left out, as samples is 1")
        for name, number in (self.spread or {}).items():
            if number.ndim or not number > 0.0:
                raise field_error(("spread", name), number.tolist(), "a number greater than 0")
        return self

    def estimator(self, executor: Executor | None = None) -> GradientEstimator:
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
    """[optimise]: the start, the algorithm and the length of the search."""

    start: Start
    """Start values by parameter name. Initial positions and mass fractions may be the word "random"."""
    knots: Annotated[int, count(2, 10_000_000)] | None = None
    """Number of knots in time for the linear interpolation of parameters over time. By default every time step has a
    separate value."""
    logarithmic: tuple[ParameterName, ...] = ()
    """Parameters that are searched by their logarithm."""
    bounds: Values | None = None
    """Lower and upper bound by parameter name. Viscosity, mobility and fractions never become negative, with or without
    bounds."""
    extinction_schedule: Schedule = (1.0,)
    """Factors of successive searches. Each search multiplies the scene's extinction by one factor, and starts from the
    result of the previous search. With less extinction, pictures show more of the fluid behind its surface."""
    optimiser: Annotated[str, OneOf(BY_NAME)] = "adam"
    """Name of the algorithm. The line search of "lbfgs" needs exact gradients."""
    learning_rate: Annotated[float, quantity("units of the parameters", gt=0.0)]
    """Approximate step size of Adam, first step size of L-BFGS, or greatest step size of the line search, in units of
    the parameters. For gradient descent, the learning rate is the factor of the gradient."""
    tolerance: Annotated[float, quantity(gt=0.0, le=0.5)] | None = None
    """L-BFGS ends when the gradient is smaller than this fraction of the first gradient. By default L-BFGS ends when
    round-off errors prevent further progress."""
    iterations: Annotated[int, count(1, MOST_ITERATIONS)]
    """Greatest number of updates of each search."""
    gradient: GradientTable = GradientTable()
    """Gradient estimator of the search."""
    check: CheckTable = CheckTable()
    """Criteria that the estimate must meet."""

    @model_validator(mode="after")
    def _check_tolerance(self) -> Self:
        if self.tolerance is not None and self.optimiser != "lbfgs":
            raise field_error(("tolerance",), self.tolerance, 'given for "lbfgs" only')
        return self

    def algorithm(self) -> Optimiser:
        setting = "scale" if self.optimiser in ("lbfgs", "line_search") else "learning_rate"
        given = {setting: self.learning_rate, "tolerance": self.tolerance}
        made: Optimiser = BY_NAME[self.optimiser](**{key: one for key, one in given.items() if one is not None})
        return made


class TaskTables(Table):
    problem: ProblemTable
    optimise: OptimiseTable


class FitTable(Table):
    """[fit]: the fitted parameters and the length of the fit."""

    start: Values
    """First values of the fitted parameters by name. Positive parameters are searched by their logarithm."""
    bounds: Values | None = None
    """Lower and upper bound by parameter name. A value with equal bounds is not fitted."""
    iterations: Annotated[int, count(1, 10_000)] = 50
    """Greatest number of trial points of each of the two fits. The first fit gives all residuals equal weights. The
    second fit uses weights from the residuals of the first fit."""
    starts: Annotated[int, count(1, 100)] | None = None
    """Number of starts of the fit. By default the fit has one start. If the result is doubtful, three further starts
    follow. Further starts lie within the bounds. Without bounds, positive parameters vary by a factor of up to 100."""
    profiles: Annotated[int, count(0, 100)] = 7
    """Number of points in the profile of the sum of squares for each fitted value. The number 0 gives no profiles. At
    each point of a profile, all other values are fitted again."""


class FitTables(Table):
    problem: ProblemTable
    fit: FitTable


def file_schema() -> dict[str, Any]:
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
