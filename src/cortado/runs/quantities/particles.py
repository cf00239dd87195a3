"""Sorted particles of a step off the device, and the sums over their neighbours on it."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
import warp as wp
from numpy.typing import NDArray

from cortado.device.launching import Named
from cortado.particles.arrays import Fields
from cortado.solvers.particles import ParticleSolver
from cortado.sph.parts import Adjoints, StepContext
from cortado.sph.vorticity import circulation_kernels


def vectors(array: wp.array) -> NDArray:
    """(n, 3) in float64."""
    return np.asarray(array.numpy(), dtype=np.float64)


@dataclass(frozen=True)
class Pressures:
    """Of the sorted particles of a step, in float64, off the device: copies."""

    push: NDArray
    """(n,) with which they push walls [Pa]."""
    stress: NDArray | None
    """(n,) what a gauge would read [Pa]; None where nobody asks for it."""


@dataclass(frozen=True)
class Particles:
    """Numbers of sorted particles in float64, off the device: of a step, their tangents, or adjoints."""

    fields: Mapping[str, NDArray]
    """By the names of `Fields`: ``x`` and ``v`` (n, 3), ``n`` and ``m`` (n,)."""
    pressures: Pressures | None
    """None where none were computed."""
    on_device: "OnDevice | None" = None
    """Of adjoints those that kernels add to."""

    @classmethod
    def of(cls, fields: Fields, pressures: Pressures | None) -> Self:
        """Those of fields on the device."""
        return cls({name: fields[name].numpy().astype(np.float64) for name in "xvnm"}, pressures)

    @classmethod
    def zeros(cls, particles: int, on_device: "OnDevice | None" = None) -> Self:
        """All 0."""
        shapes = {"x": (3,), "v": (3,), "n": (), "m": ()}
        fields = {name: np.zeros((particles, *shape)) for name, shape in shapes.items()}
        return cls(fields, Pressures(np.zeros(particles), np.zeros(particles)), on_device)

    def __getitem__(self, name: str) -> NDArray:
        return self.fields[name]

    @property
    def push(self) -> NDArray:
        """(n,) what they push walls with [Pa]."""
        assert self.pressures is not None
        return self.pressures.push

    @property
    def stress(self) -> NDArray:
        """(n,) what a gauge would read [Pa]."""
        assert self.pressures is not None and self.pressures.stress is not None
        return self.pressures.stress

    @property
    def within(self) -> "OnDevice":
        """What kernels add to."""
        assert self.on_device is not None
        return self.on_device


@dataclass(frozen=True)
class OnDevice:
    """Adjoints of what a step computes, for kernels."""

    bar: Adjoints
    """Of sorted particles at the start of the step, and of parameters and solids."""
    v_star: wp.array
    """(n,) as that of `cortado.solvers.solver.WithinBar`."""


class Sums:
    """The sums over neighbours of a step, on the device."""

    def __init__(self, solver: ParticleSolver, context: StepContext):
        self._solver, self.context = solver, context
        self.circulation = circulation_kernels(solver.discretisation)

    def __call__(self, kernel: Any, *named: Named, **given: NDArray) -> NDArray:
        """(n, 3) what a kernel writes to its last argument, given the step's fields and further vectors."""
        arrays = {name: self.on_device(value) for name, value in given.items()}
        found = self._solver.vectors()
        self.context.launch(kernel, *named, **arrays, **{kernel.adj.args[-1].label: found})
        return vectors(found)

    def add(self, kernel: Any, bar: Particles, **given: NDArray) -> None:
        """Have a kernel add to ``x_bar`` and ``v_bar``."""
        arrays = {name: self.on_device(value) for name, value in given.items()}
        own = {"x": self._solver.vectors(), "v": self._solver.vectors()}
        self.context.launch(kernel, **arrays, **{f"{name}_bar": array for name, array in own.items()})
        for name, array in own.items():
            bar[name][:] += array.numpy()

    def on_device(self, values: NDArray) -> wp.array:
        """Vectors (n, 3)."""
        return wp.array(values, dtype=self._solver.discretisation.precision.vector, device=self._solver.device)
