"""The tables [problem] and [optimise] of a task, with the field types that only they have."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Annotated, Any, Self

import numpy as np
from pydantic import model_validator

from cortado.errors import Words
from cortado.gradients import AdjointEstimator, AdjointViscosity, EnsembleMean, Exact, FrozenGeometry, GradientEstimator
from cortado.losses.image_losses import ImageLoss, Pyramid, SquaredDifference
from cortado.optimisation.optimisers import LBFGS, Adam, GradientDescent, Optimiser
from cortado.parameters.values import NAMES
from cortado.scene.fields import MISSING, Choice, Count, FieldType, Quantity, Text, as_number, as_sequence, field_error
from cortado.scene.tables import Table

OPTIMISERS: dict[str, Callable[[float], Optimiser]] = {
    "adam": Adam,
    "gradient_descent": GradientDescent,
    "lbfgs": lambda scale: LBFGS(scale=scale),
}
"""By the names in a file; each is made from the learning rate (for L-BFGS the size of its first step)."""
DISTANCES: dict[str, ImageLoss] = {"squared_difference": SquaredDifference(), "pyramid": Pyramid()}
ESTIMATORS: dict[str, AdjointEstimator] = {
    "exact": Exact(),
    "frozen_geometry": FrozenGeometry(),
    "adjoint_viscosity": AdjointViscosity(),
}
RANDOM = "random"
CAN_BE_RANDOM = ("initial_positions", "mass_fractions")


@dataclass(frozen=True)
class Values(FieldType):
    """Parameters by name, each a number, a list of numbers, or a list of lists of numbers."""

    random: bool = False
    """Whether `CAN_BE_RANDOM` may be the word "random"."""

    wanted = f"a table of at least one parameter out of {', '.join(NAMES)}"

    def check(self, value: Any) -> dict[str, Any]:
        if not isinstance(value, Mapping) or not value:
            raise field_error((), Words("empty") if value == {} else value, self.wanted)
        return {name: self._array(name, entry) for name, entry in value.items()}

    def _array(self, name: str, value: Any) -> Any:
        if name not in NAMES:
            raise field_error((name,), Words("unknown"), f"one of {', '.join(NAMES)}")
        if self.random and name in CAN_BE_RANDOM and value == RANDOM:
            return value
        wanted = "made of finite numbers: one, a list of them, or a list of lists of one length"
        if not _is_numeric(value):
            raise field_error((name,), value, wanted)
        try:
            return np.array(value, dtype=np.float64)
        except ValueError:
            raise field_error((name,), value, wanted) from None


@dataclass(frozen=True)
class Names(FieldType):
    """A list of parameters."""

    wanted = f"a list of parameters out of {', '.join(NAMES)}"

    def check(self, value: Any) -> tuple[str, ...]:
        if not isinstance(value, (list, tuple)) or not all(isinstance(name, str) and name in NAMES for name in value):
            raise field_error((), value, self.wanted)
        return tuple(value)


@dataclass(frozen=True)
class Schedule(FieldType):
    """A continuation schedule: factors that grow to 1."""

    wanted = "a list of numbers greater than 0, each greater than the one before, the last of them 1"

    def check(self, value: Any) -> tuple[float, ...]:
        numbers = [as_number(entry) for entry in as_sequence(value) or ()]
        factors = [number for number in numbers if number is not None and number > 0.0]
        growing = all(a < b for a, b in pairwise(factors))
        if not factors or len(factors) < len(numbers) or not growing or factors[-1] != 1.0:
            raise field_error((), value, self.wanted)
        return tuple(factors)


def _is_numeric(value: Any) -> bool:
    """Whether there is a finite number, or nothing else in a list that is not empty."""
    if isinstance(value, list):
        return bool(value) and all(map(_is_numeric, value))
    return as_number(value) is not None


class ProblemTable(Table):
    """[problem]: a number of steps, and a target: the end of a run with true parameters, or a picture."""

    steps: Annotated[int, Count(0, 10_000_000)]
    """Time steps; 0 for a loss of the first state."""
    loss: Annotated[str, Choice(("positions", "image"))] = "positions"
    """What is compared with the target: positions of particles, or images."""
    distance: Annotated[str, Choice(tuple(DISTANCES))] = "squared_difference"
    """How images are compared."""
    frames: Annotated[int, Count(1, 10_000)] = 1
    """Number of states that are compared, evenly spaced up to the last one."""
    target: Annotated[dict[str, Any] | None, Values()] = None
    """The true parameters: the target is what a run with them makes."""
    picture: Annotated[str | None, Text()] = None
    """"heart", "rosetta", or a file with a picture, beside the task's own."""

    @model_validator(mode="after")
    def _check_target(self) -> Self:
        if self.picture is None and self.target is None:
            raise field_error(("target",), MISSING, f"{Values.wanted}, as there is no picture")
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

    loss_reduction: Annotated[float, Quantity(least=1.0)] = 1.0
    """First loss / best loss."""
    parameter_error: Annotated[float, Quantity(above=0.0)] = 1e50
    """Largest relative distance (L2) of an estimated parameter from its true value."""
    psnr: Annotated[float, Quantity("dB", least=0.0)] = 0.0
    """Peak signal-to-noise ratio of the image of the estimate to the target."""


class GradientTable(Table):
    """[optimise.gradient]: which gradient the search follows, see docs/gradients.md."""

    name: Annotated[str, Choice(tuple(ESTIMATORS))] = "exact"
    """Name of the estimator."""
    strength: Annotated[float | None, Quantity(above=0.0, most=1.0)] = None
    """Strength of `AdjointViscosity`; None: chosen at the start of a search."""
    samples: Annotated[int, Count(1, 10_000)] = 1
    """Runs of the ensemble over which the gradient is averaged."""
    spread: Annotated[dict[str, Any] | None, Values()] = None
    """Width of the ensemble in each parameter, by name, in the units of what is searched."""
    position_noise: Annotated[float, Quantity("spacings", least=0.0)] = EnsembleMean.position_noise
    """Standard deviation of the perturbations of first positions in the ensemble."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.strength is not None and self.name != "adjoint_viscosity":
            raise field_error(("strength",), self.strength, "left out, as nothing is smoothed")
        if self.strength is not None and self.strength * self._order > 1.0:
            raise field_error(("strength",), self.strength, f"at most {1.0 / self._order:g}, as means are extrapolated")
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

    @property
    def _order(self) -> int:
        return 2 if self.samples > 1 else 1

    def estimator(self) -> GradientEstimator:
        """As an object."""
        one = ESTIMATORS[self.name]
        if isinstance(one, AdjointViscosity):
            one = AdjointViscosity("auto" if self.strength is None else self.strength, order=self._order)
        if self.spread is None:
            return one
        spread = {name: float(number) for name, number in self.spread.items()}
        return EnsembleMean(spread, self.samples, self.position_noise, estimator=one)


class OptimiseTable(Table):
    """[optimise]: the start of the search, its algorithm, and its length."""

    start: Annotated[dict[str, Any], Values(random=True)]
    """Parameters with which the search starts; these are optimised."""
    knots: Annotated[int | None, Count(2, 10_000_000)] = None
    """Number of free rows between which parameters over time are interpolated; None: one row for each step."""
    logarithmic: Annotated[tuple[str, ...], Names()] = ()
    """Parameters that are searched by their logarithm."""
    bounds: Annotated[dict[str, Any] | None, Values()] = None
    """By name: two entries, the lower and the upper bound."""
    extinction_schedule: Annotated[tuple[float, ...], Schedule()] = (1.0,)
    """A continuation schedule: one search for each factor, which starts where the last one ended and sees the fluid
    with the scene's extinction times that factor. A picture of thinner fluid shows what is behind its surface."""
    optimiser: Annotated[str, Choice(tuple(OPTIMISERS))] = "adam"
    """Name of the algorithm."""
    learning_rate: Annotated[float, Quantity(above=0.0)]
    """In units of the parameters; for L-BFGS the size of its first step."""
    tolerance: Annotated[float | None, Quantity(above=0.0, most=0.5)] = None
    """L-BFGS ends where the gradient is this part of the first one; None: where round-off stops it."""
    iterations: Annotated[int, Count(1, 10_000_000)]
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
