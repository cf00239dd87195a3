"""Parameters and first states around given ones, over which a loss or its gradient is averaged."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from cortado.arrays import as_numbers
from cortado.errors import InputError, shown
from cortado.gradients.estimator import Differentiable
from cortado.parameters.values import Arrays, Values
from cortado.scene.fields import as_number

Made = TypeVar("Made")


@dataclass(frozen=True)
class Cloud:
    """How wide it is, and how many samples of it are taken; they are the same at every call.

    Parameters, N numbers, lie in a ball of radius sqrt(N), in units of their spreads; every coordinate of the first
    positions is perturbed by a normal number. With each point goes the one opposite.
    """

    spread: float | Mapping[str, float] = 0.5
    """Of the parameters, in their units, or by name; sqrt((N + 2) / N) times the standard deviation of a number."""
    samples: int = 8
    position_noise: float = 0.01
    """Standard deviation of the perturbations of first positions [spacings]; 0 for none."""
    seed: int = 0

    def __post_init__(self) -> None:
        if not _is_whole(self.samples) or self.samples < 2:
            raise InputError(f"samples is {shown(self.samples)}, but must be at least 2, to know how they scatter.")
        position_noise = as_number(self.position_noise)
        if position_noise is None or position_noise < 0.0:
            raise InputError(
                f"position_noise is {shown(self.position_noise)}, but must be a number of at least 0, in spacings."
            )
        if not _is_whole(self.seed) or self.seed < 0:
            raise InputError(f"seed is {shown(self.seed)}, but must be a whole number of at least 0.")

    def around(self, problem: Differentiable, parameters: Values) -> "Sampler":
        """Of these parameters of a problem."""
        values = {name: as_numbers(f"parameter {name}", value) for name, value in parameters.items()}
        spreads = np.concatenate([np.full(value.size, self._spread(name)) for name, value in values.items()])
        start = problem.simulation.positions
        position_noise = self.position_noise * problem.simulation.scene.discretisation.spacing
        return Sampler(values, spreads, start, position_noise, np.random.default_rng(self.seed))

    def _spread(self, name: str) -> float:
        if isinstance(self.spread, Mapping) and name not in self.spread:
            raise InputError(f"spread has nothing for {name}, but must have a number for every parameter.")
        spread = self.spread[name] if isinstance(self.spread, Mapping) else self.spread
        number = as_number(spread)
        if number is None or number <= 0.0:
            raise InputError(f"spread of {name} is {shown(spread)}, but must be a number greater than 0.")
        return number


@dataclass(frozen=True)
class Sampler:
    """An ensemble around the parameters of a problem, and the random numbers that samples are drawn by."""

    values: Arrays
    spreads: np.ndarray
    """(numbers,) of all numbers of the values, one after another."""
    start: np.ndarray
    """(n, d) first positions of the simulation [m]"""
    position_noise: float
    """[m]"""
    random: np.random.Generator

    def rotation(self) -> np.ndarray:
        """(numbers, numbers) rows of a random orthonormal basis, uniform over all of them."""
        q, r = np.linalg.qr(self.random.standard_normal((len(self.spreads), len(self.spreads))))
        return (q * np.sign(np.diag(r))).T

    def offset(self) -> np.ndarray:
        """(numbers,) uniform in the ball, in spreads."""
        direction, numbers = self.random.standard_normal(len(self.spreads)), len(self.spreads)
        radius = np.sqrt(numbers) * self.random.random() ** (1.0 / numbers)
        return radius / np.linalg.norm(direction) * direction

    def displacement(self) -> np.ndarray:
        """(n, d) a random one of the first positions [m]"""
        return self.position_noise * self.random.standard_normal(self.start.shape)

    def at(self, u: np.ndarray, displacement: np.ndarray, made: Callable[[Arrays], Made]) -> Made:
        """What is made of the parameters moved by ``u`` (numbers,), in spreads, and first positions displaced."""
        values = _moved(self.values, self.spreads * u)
        if self.position_noise:
            values["initial_positions"] = values.get("initial_positions", self.start) + displacement
        try:
            return made(values)
        except InputError as error:
            advice = "Take a smaller spread, or a logarithm (cortado.optimisation.transforms)."
            raise InputError(f"A sample of the ensemble does not fit: {error} {advice}") from error

    def named(self, numbers: np.ndarray) -> Arrays:
        """Numbers one after another, as arrays by the parameters' names."""
        return _moved({name: np.zeros_like(value) for name, value in self.values.items()}, numbers)


def _moved(values: Arrays, change: np.ndarray) -> Arrays:
    """Values plus a change of all their numbers, one after another."""
    ends = np.cumsum([value.size for value in values.values()])
    parts = np.split(change, ends[:-1])
    return {name: value + part.reshape(value.shape) for (name, value), part in zip(values.items(), parts, strict=True)}


def _is_whole(value: object) -> bool:
    return isinstance(value, (int, np.integer)) and not isinstance(value, bool)
