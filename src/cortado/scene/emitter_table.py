"""An emitter: a column of particles that waits upstream of an opening, and comes out of it with one speed."""

import math
from dataclasses import dataclass
from typing import Annotated, Self

import numpy as np
from pydantic import field_validator

from cortado.discretise.shapes import ROUND_OFF, Points, across, disc, disc_cells
from cortado.scene.fluids import FluidBody
from cortado.scene.tables import GREATEST, Length, Vector, field_error, quantity


@dataclass(frozen=True)
class EmitterSample:
    """The particles of an emitter, m of them: layer after layer from the outlet upstream."""

    offsets: Points
    """(m, d) from the axis, perpendicular to it [m]"""
    upstream: Points
    """(m,) distance from the opening, against the direction [m]"""
    positions: Points
    """(m, d) [m]"""
    velocities: Points
    """(m, d) [m/s]"""
    speed: float
    """[m/s]"""
    layer: int
    """Particles in a layer; m is a multiple of it."""
    column: float
    """Length of the column that waits in line [m]; what is further upstream is in reserve."""


COLUMN = 6.0
"""Length of the column where none is given, in spacings: fluid at the opening has others behind it, and they too."""


class EmitterTable(FluidBody):
    """An opening, a disc or in 2-D a line, out of which a column of fluid comes with one speed."""

    outlet: Vector[Length]
    """(d,) Middle of the opening [m]."""
    direction: Vector[Annotated[float, quantity()]] = (0.0, -1.0, 0.0)
    """(d,) Direction of the flow; its length does not matter."""
    radius: Annotated[float, quantity("m", gt=0.0)]
    """Radius of the opening [m]. The cells of the lattice that it holds are what fluid comes through: its speed is the
    flow rate over their area, which `describe` says."""
    length: Annotated[float, quantity("m", gt=0.0)] | None = None
    """Length of the column that waits upstream of the opening [m]; six spacings if left out."""
    flow_rate: Annotated[float, quantity("m3/s (m2/s in 2-D)", gt=0.0)]
    """Volume, in 2-D area, that comes out in a second [m3/s (m2/s in 2-D)]."""
    duration: Annotated[float, quantity("s", gt=0.0)] | None = None
    """For how long fluid comes out [s]. If left out, commands such as `cortado run` have enough for the run, and
    `Simulation` has what is in the column (`Scene.lasting`)."""
    jitter: Annotated[float, quantity(ge=0.0, le=0.3)] = 0.0
    """How far a particle is from its place in the lattice of its layer at most, along each axis of the opening and
    in spacings, the same in every run. With the solver "projection" 0.05 if left out, as a stream on a lattice is
    too wide."""

    @field_validator("direction")
    @classmethod
    def _normalise(cls, direction: tuple[float, ...]) -> tuple[float, ...]:
        """Normalise a direction; one that is normalised but for round-off stays, as JSON must bring it back."""
        size = math.hypot(*direction)
        if size < 1.0 / GREATEST:
            raise field_error((), direction, "a vector that is not zero")
        return direction if abs(size - 1.0) < 1e-12 else tuple(value / size for value in direction)

    def layers(self, spacing: float) -> float:
        """Return the number of layers of the column, with their middle within its length, or all if they are fewer: a
        whole number that may be larger than any array."""
        length = COLUMN * spacing if self.length is None else self.length
        within = float(max(math.ceil(length / spacing - 0.5 - ROUND_OFF), 0))
        return within if self.duration is None else min(within, self.supply(spacing))

    def supply(self, spacing: float) -> float:
        """Return the number of layers, with those in reserve."""
        if self.duration is None:
            return self.layers(spacing)
        return float(max(math.ceil(self.duration * self.speed(spacing) / spacing - ROUND_OFF), 1))

    def dry_after(self, spacing: float) -> float:
        """Return the time when all fluid is out [s]."""
        return self.supply(spacing) * spacing / self.speed(spacing)

    def lasting(self, time: float, spacing: float) -> Self:
        """Return this table with a duration, if it has none and the column is out before a time [s]: the column is
        whole then."""
        if self.duration is not None or self.dry_after(spacing) >= time:
            return self
        return self.model_copy(update={"duration": time + self.dry_after(spacing)})

    def speed(self, spacing: float) -> float:
        """Return the speed of the flow [m/s], with which the volume of its particles is that of the flow rate."""
        return self.flow_rate / self.area(spacing)

    def area(self, spacing: float) -> float:
        """Return the area of the cells that a layer of particles has across the flow [m2], in 2-D their width [m]."""
        return float(len(self._cross_section(spacing)) * spacing ** (len(self.outlet) - 1))

    def asked_area(self) -> float:
        """Return the area of the opening [m2], in 2-D its width [m]."""
        return 2.0 * self.radius if len(self.outlet) == 2 else float(np.pi * self.radius**2)

    def opening(self, spacing: float) -> Points:
        """Return a layer of particles, moved into the opening, (n, d) [m]."""
        return np.array(self.outlet) + self._cross_section(spacing)

    def sample(self, spacing: float) -> EmitterSample:
        """Return the particles on a lattice of the spacing [m], those in reserve in line behind the column."""
        cross_section = self._cross_section(spacing)
        layers, speed = int(self.supply(spacing)), self.speed(spacing)
        upstream = np.repeat((np.arange(layers) + 0.5) * spacing, len(cross_section))
        moves = np.random.default_rng(0).uniform(-self.jitter, self.jitter, (len(upstream), len(self.outlet) - 1))
        offsets = np.tile(cross_section, (layers, 1)) + spacing * moves @ across(self.direction)
        return EmitterSample(
            offsets=offsets,
            upstream=upstream,
            positions=np.array(self.outlet) + offsets - np.outer(upstream, self.direction),
            velocities=np.tile(speed * np.array(self.direction), (len(upstream), 1)),
            speed=speed,
            layer=len(cross_section),
            column=self.layers(spacing) * spacing,
        )

    def count(self, spacing: float) -> float:
        cells = disc_cells(self.radius, spacing, len(self.outlet) - 1)
        return float(np.prod(cells)) * self.supply(spacing)

    def extent(self, spacing: float) -> tuple[Points, Points]:
        opening, direction = self.opening(spacing), np.array(self.direction)
        first, last = 0.5 * spacing * direction, (self.layers(spacing) - 0.5) * spacing * direction
        beside = self.jitter * spacing * np.abs(across(direction)).sum(axis=0)
        lower, upper = opening.min(axis=0) - beside, opening.max(axis=0) + beside
        return lower - np.maximum(first, last), upper - np.minimum(first, last)

    def particles(self, spacing: float) -> Points:
        """Return the particles of the column, (n, d) [m]."""
        sample = self.sample(spacing)
        return sample.positions[sample.upstream < sample.column]

    def _cross_section(self, spacing: float) -> Points:
        """Return offsets (n, d) of the particles of a layer from the axis [m]."""
        return disc(self.radius, spacing, len(self.outlet) - 1) @ across(self.direction)
