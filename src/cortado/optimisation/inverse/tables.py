"""The tables [problem] and [optimise] of a task."""

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import replace
from itertools import pairwise
from typing import Annotated, Any, Literal, Self

from pydantic import (
    ValidationError,
    ValidatorFunctionWrapHandler,
    WrapValidator,
    model_validator,
)

from cortado.errors import Words
from cortado.executors import Executor, InProcess
from cortado.gradients import (
    AdjointEstimator,
    AdjointViscosity,
    EnsembleMean,
    Exact,
    GradientEstimator,
    ImplicitPressure,
)
from cortado.losses.image_losses import ImageLoss, Pyramid, SquaredDifference
from cortado.optimisation.inverse.measured_tables import AnyMeasured
from cortado.optimisation.inverse.named_values import VALUES, ParameterName, Start, Values
from cortado.optimisation.optimisers import LBFGS, Adam, GradientDescent, LineSearch, Optimiser
from cortado.optimisation.start import MOST_ITERATIONS
from cortado.scene.fields import MISSING, OneOf, Several, Text, count, field_error, quantity
from cortado.scene.tables import Table, wanted

OPTIMISERS: dict[str, Callable[[float], Optimiser]] = {
    "adam": Adam,
    "gradient_descent": GradientDescent,
    "lbfgs": lambda scale: LBFGS(scale=scale),
    "line_search": LineSearch,
}
"""By the names in a file; each is made from the learning rate (for L-BFGS the size of its first step, for the line
search the longest one)."""
DISTANCES: dict[str, ImageLoss] = {"squared_difference": SquaredDifference(), "pyramid": Pyramid()}
ESTIMATORS: dict[str, AdjointEstimator] = {
    "exact": Exact(),
    "adjoint_viscosity": AdjointViscosity(),
    "implicit_pressure": ImplicitPressure(),
}


def _growing(value: Any, check: ValidatorFunctionWrapHandler) -> tuple[float, ...]:
    """Factors that grow to 1; raises a `field_error`."""
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
        if self.picture is None and self.target is None:
            raise field_error(("target",), MISSING, f"{wanted(VALUES)}, as there is no picture")
        if self.picture is not None and self.target is not None:
            raise field_error(("picture",), self.picture, "left out, as there is a target")
        if self.picture is not None and self.loss != "image":
            raise field_error(("loss",), self.loss, '"image", as there is a picture')
        if self.picture is not None and self.frames > 1:
            raise field_error(("frames",), self.frames, "1, as there is a picture, which is one")
        if self.loss != "image" and "distance" in self.model_fields_set:
            raise field_error(("distance",), self.distance, "left out, as positions are compared")
        if self.frames > max(self.steps, 1):
            raise field_error(
                ("frames",), self.frames, f"at most {max(self.steps, 1)}, as there are {self.steps} steps"
            )
        return self

    @property
    def compared(self) -> list[int]:
        """The numbers of the states that are compared."""
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
    """Name of the estimator; "adjoint_viscosity" is for long splashes, "implicit_pressure" for the solver
    "projection" with many iterations."""
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
        """As an object; ``executor`` computes the samples of an ensemble."""
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
    optimiser: Annotated[str, OneOf(OPTIMISERS)] = "adam"
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
        """The optimiser as an object."""
        made = OPTIMISERS[self.optimiser](self.learning_rate)
        if isinstance(made, LBFGS) and self.tolerance is not None:
            return replace(made, tolerance=self.tolerance)
        return made


class TaskTables(Table):
    """The two tables of a task."""

    problem: ProblemTable
    optimise: OptimiseTable
