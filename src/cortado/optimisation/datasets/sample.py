"""What is random of one run of a data set: drawn from the seed and the number of the run alone."""

import json
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from cortado.optimisation.datasets.table import DatasetTable


@dataclass(frozen=True)
class Sample:
    """The run of a number."""

    table: DatasetTable
    number: int

    @cached_property
    def values(self) -> dict[str, Any]:
        """Of what is varied, by the keys of the scene, in the order of the table."""
        random = self._random(0)
        found = {}
        for key, (lower, upper) in self.table.vary.items():
            ends, part = np.array([lower, upper]), random.random(np.shape(lower))
            if key in self.table.logarithmic:
                drawn = np.exp((1.0 - part) * np.log(ends[0]) + part * np.log(ends[1]))
            else:
                drawn = (1.0 - part) * ends[0] + part * ends[1]
            found[key] = drawn.tolist()
        return found

    @property
    def overrides(self) -> list[str]:
        """The same, as a scene takes them."""
        return [f"{key}={json.dumps(value)}" for key, value in self.values.items()]

    def start(self, positions: np.ndarray, velocities: np.ndarray, spacing: float) -> dict[str, np.ndarray]:
        """First positions [m] and velocities [m/s] (n, d) with noise; those without any are left out."""
        random, found = self._random(1), {}
        for name, array, size in (
            ("initial_positions", positions, self.table.position_noise * spacing),
            ("initial_velocities", velocities, self.table.velocity_noise),
        ):
            noise = random.standard_normal(array.shape)
            if size:
                found[name] = array + size * noise
        return found

    def direction(self, which: int, shape: tuple[int, ...], sizes: tuple[float, float]) -> dict[str, np.ndarray]:
        """A random direction of the first state: normal numbers times a change of positions [m], and of velocities
        [m/s]."""
        random = self._random(2, which)
        names = ("initial_positions", "initial_velocities")
        return {name: size * random.standard_normal(shape) for name, size in zip(names, sizes, strict=True)}

    def _random(self, *purpose: int) -> np.random.Generator:
        return np.random.default_rng([self.table.seed, self.number, *purpose])
