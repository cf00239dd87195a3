"""Tables and parameters of emitters, which push columns of particles out of an opening."""

import math
from dataclasses import dataclass
from typing import Annotated, Any, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import field_validator

from cortado.discretise.shapes import ROUND_OFF, Points, across, disc, lattice, whole_cells
from cortado.discretise.sheet import Sheet
from cortado.errors import Words, shown
from cortado.scene.courses import Knots
from cortado.scene.drain_tables import FlowTable
from cortado.scene.fluids import FluidBody
from cortado.scene.motions import course_table
from cortado.scene.parameters import Axis, Parameter, ending, of_part, spacing_of
from cortado.scene.tables import MISSING, Direction, FieldPath, Length, Text, Vector, field_error, quantity


@dataclass(frozen=True)
class EmitterSample:
    """The m particles of an emitter, sorted by layer. The first layer is at the opening."""

    offsets: Points
    """Vectors (m, d) [m] from the axis of the emitter to the particles, perpendicular to the axis."""
    upstream: Points
    """Initial distances of the particles from the opening, upstream (m,) [m]."""
    positions: Points
    velocities: Points
    speed: float
    """Initial speed of the flow [m/s]."""
    layer: int
    """Number of particles in each layer."""
    column: float
    """Length of the column of fluid that waits behind the opening [m]."""

    def in_line(self, name: str, first: int, others: Any, particles: int) -> Points:
        """Return each particle's initial distance from the opening, measured upstream (particles,) [m]. The distance is
        0 for particles of other emitters and bodies.

        ``first`` is the index of the emitter's first particle. ``others`` are fields of a state.
        """
        found = np.zeros(particles)
        found[first : first + len(self.upstream)] = self.upstream
        if (again := others.get(again_name(name))) is None:
            return found
        joined = (np.floor((np.ravel(again) - 1.0) / self.layer) + 0.5) * 2.0 * self.upstream[0]
        return np.where(np.ravel(again) > 0.0, joined, found)

    def waits(self, name: str, first: int, others: Any, particles: int) -> NDArray[np.bool_]:
        return self.in_line(name, first, others, particles) > float(np.ravel(others[emitted_name(name)])[0])


OF_OPENINGS = ("emitted", "again", "drained", ".count")
COLUMN = 6.0
"""Default length of the column of fluid behind the opening [spacings]."""
path_name = ending("path")
outlet_name = ending("outlet")
"""Name of a state field: position of an emitter's opening [m]."""
emitted_name = ending("emitted")
"""Name of a state field: length of the fluid column that has left an emitter [m]."""
again_name = ending("again")
"""Name of a state field: place of each particle in the queue to be emitted again, from 1; 0 outside the queue."""


def _path_of(name: str, of: str, outlet: Any, course: Knots | None = None) -> Parameter:
    meaning = f"where the opening of {of} is after each step"
    return of_part(name, "m", meaning, outlet, Axis.STEP, change=spacing_of, moment=1.0, course=course)


OutletPath: Any = course_table(_path_of("emitter_path", "an emitter", (0.0, 0.0)))


class EmitterTable(FluidBody, FlowTable):
    """An emitter with a round or rectangular opening, in 2-D a line. Fluid leaves the whole opening with the same
    speed."""

    name: Text = "nozzle"
    """Name of the emitter. Names of the emitter's parameters begin with the emitter's name."""
    outlet: Vector[Length]
    """(d,) Position of the middle of the opening [m]."""
    direction: Direction = (0.0, -1.0, 0.0)
    """(d,) Direction of the flow; its length has no effect."""
    radius: Annotated[float, quantity("m", gt=0.0)] | None = None
    """Radius of a round opening, in 2-D half its width [m]. Fluid passes through the lattice cells inside the opening,
    so the speed is the flow rate divided by the area of these cells. `describe` prints the speed."""
    sides: tuple[Annotated[float, quantity("m", gt=0.0)], ...] | None = None
    """(d - 1,) Widths of a rectangular opening, in place of `radius` [m]. In 3-D the widths are along the two axes of
    space that are most nearly perpendicular to `direction`."""
    length: Annotated[float, quantity("m", gt=0.0)] | None = None
    """Length of the column of fluid that waits behind the opening [m]; six spacings if left out."""
    volume: Annotated[float, quantity("m3 (m2 in 2-D)", gt=0.0)] | None = None
    """Total volume that the emitter emits [m3], in 2-D area [m2]. If left out, commands such as ``cortado run`` provide
    enough fluid for the run, but `Simulation` provides only the column behind the opening (see `Scene.lasting`)."""
    fed_by: tuple[Text, ...] = ()
    """Names of drains. The emitter emits the particles that the listed drains remove. Besides the particles from
    drains, the emitter has only the waiting column and `volume`. A drain can feed only one emitter."""
    path: OutletPath | None = None
    """Position of the middle of the opening over time; if left out, the opening stays at `outlet`."""
    jitter: Annotated[float, quantity(ge=0.0, le=0.3)] = 0.0
    """Largest random offset of a particle from its lattice position, along each axis of the opening, in spacings. All
    runs have equal offsets. The default in "projection" is 0.05, because a stream on an exact lattice is too wide."""

    @field_validator("direction")
    @classmethod
    def _normalise(cls, direction: tuple[float, ...]) -> tuple[float, ...]:
        size = math.hypot(*direction)
        return direction if abs(size - 1.0) < 1e-12 else tuple(value / size for value in direction)

    def in_dimension(self, dimension: int, path: FieldPath = ()) -> Self:
        if self.sides is None and self.radius is None:
            raise field_error((*path, "radius"), MISSING, "given, or sides in its place")
        if self.sides is not None and self.radius is not None:
            raise field_error((*path, "radius"), self.radius, "left out, as there are sides")
        if self.sides is not None and len(self.sides) != dimension - 1:
            wanted = f"a list of {dimension - 1}, as the scene has {dimension} dimensions"
            raise field_error((*path, "sides"), self.sides, wanted)
        placed = super().in_dimension(dimension, path)
        if self.path is None:
            return placed
        return placed.model_copy(update={"path": self.path.in_dimension(dimension, (*path, "path"))})

    def layers(self, spacing: float) -> float:
        length = COLUMN * spacing if self.length is None else self.length
        within = float(max(math.ceil(length / spacing - 0.5 - ROUND_OFF), 0))
        return within if self.volume is None or self.fed_by else min(within, self.supply(spacing))

    def supply(self, spacing: float) -> float:
        given = 0.0 if self.volume is None else self.volume / (self.area(spacing) * spacing)
        if self.volume is None or self.fed_by:
            given += self.layers(spacing)
        return float(max(math.ceil(given - ROUND_OFF), 1))

    def dry_after(self, spacing: float) -> float:
        """Return the time [s] at which the emitter runs out of fluid; infinite if it never does."""
        return math.inf if self.fed_by else self.time_for(self.supply(spacing) * spacing * self.area(spacing))

    def lasting(self, time: float, spacing: float) -> Self:
        """Return the table with enough fluid until ``time`` [s]. A ``volume`` in the table stays unchanged."""
        if self.volume is not None or self.dry_after(spacing) >= time:
            return self
        column = self.layers(spacing) * spacing * self.area(spacing)
        return self.model_copy(update={"volume": self.passed(time) + column})

    def speed(self, spacing: float) -> float:
        """Return the greatest speed of the flow [m/s]."""
        return self.greatest / self.area(spacing)

    def area(self, spacing: float) -> float:
        """Return the total area [m2], in 2-D the width [m], of the lattice cells inside the opening."""
        return float(len(self._cross_section(spacing)) * spacing ** (len(self.outlet) - 1))

    def asked_area(self) -> float:
        """Area [m2], in 2-D width [m], of the opening that the scene file prescribes."""
        if self.radius is None:
            return math.prod(self.sides or ())
        return 2.0 * self.radius if len(self.outlet) == 2 else float(np.pi * self.radius**2)

    @property
    def width(self) -> float:
        return max(self.sides or (2.0 * (self.radius or 0.0),))

    def opening(self, spacing: float) -> Points:
        """Return the positions (n, d) [m] of one layer of particles, in the opening."""
        return np.array(self.outlet) + self._cross_section(spacing)

    def sample(self, spacing: float) -> EmitterSample:
        cross_section = self._cross_section(spacing)
        layers, speed = int(self.supply(spacing)), self.begun / self.area(spacing)
        upstream = np.repeat((np.arange(layers) + 0.5) * spacing, len(cross_section))
        moves = np.random.default_rng(0).uniform(-self.jitter, self.jitter, (len(upstream), len(self.outlet) - 1))
        offsets = np.tile(cross_section, (layers, 1)) + spacing * moves @ across(self.direction)
        positions = np.array(self.outlet) + offsets - np.outer(upstream, self.direction)
        velocities = np.tile(speed * np.array(self.direction), (len(upstream), 1))
        column, layer = self.layers(spacing) * spacing, len(cross_section)
        return EmitterSample(offsets, upstream, positions, velocities, speed, layer, column)

    def count(self, spacing: float) -> float:
        return float(np.prod(self._cells(spacing))) * self.supply(spacing)

    def extent(self, spacing: float) -> tuple[Points, Points]:
        opening, direction = self.opening(spacing), np.array(self.direction)
        first, last = 0.5 * spacing * direction, (self.layers(spacing) - 0.5) * spacing * direction
        beside = self.jitter * spacing * np.abs(across(direction)).sum(axis=0)
        lower, upper = opening.min(axis=0) - beside, opening.max(axis=0) + beside
        return lower - np.maximum(first, last), upper - np.minimum(first, last)

    def particles(self, spacing: float) -> Points:
        sample = self.sample(spacing)
        return sample.positions[sample.upstream < sample.column]

    def _cells(self, spacing: float) -> Points:
        sides = self.sides or (2.0 * (self.radius or 0.0),) * (len(self.outlet) - 1)
        return np.maximum(whole_cells(np.array(sides), spacing), 1.0)

    def _cross_section(self, spacing: float) -> Points:
        size = len(self.outlet) - 1
        points = lattice(self._cells(spacing), spacing) if self.radius is None else disc(self.radius, spacing, size)
        return points @ across(self.direction)


def emitter_parameters(scene: Any) -> list[Parameter]:
    found = []
    for emitter in scene.emitter:
        course = None if emitter.path is None else emitter.path.knots
        outlet = _path_of(path_name(emitter.name), f"the emitter {emitter.name}", emitter.outlet, course)
        found += [outlet, emitter.flow_parameter(scene.dimension)]
    return found


def check_fed(scene: Any) -> None:
    names, fed = [drain.name for drain in scene.drain], list[str]()
    for index, emitter in enumerate(scene.emitter):
        path = "emitter", index, "fed_by"
        if emitter.fed_by and len(scene.phase) > 1:
            raise field_error(path, Words("given"), "left out where there are several phases")
        for name in emitter.fed_by:
            if name not in names or name in fed:
                raise field_error(path, name, f"drains that feed no other emitter, of {shown(names)}")
            fed.append(name)


def check_columns(scene: Any) -> None:
    spacing = scene.discretisation.spacing
    for index, emitter in enumerate(scene.emitter):
        opening, ahead = emitter.opening(spacing), spacing * np.array(emitter.direction)
        for table in scene.solid:
            about = table.own_solid() if table.is_sheet else None
            if isinstance(about, Sheet):
                sheet = about.placed(table.middle(), table.turn(scene.dimension))
                if sheet.crossed(opening - emitter.layers(spacing) * ahead, opening + ahead, spacing).any():
                    wanted = "clear of sheets from the end of its column to a spacing beyond its opening"
                    raise field_error(("emitter", index), Words(f"crossed by the sheet {table.name!r}"), wanted)


def samples(scene: Any, count: int) -> list[tuple[str, int, EmitterSample]]:
    """Return the name, the index of the first particle and the particles of each emitter."""
    made = [emitter.sample(scene.discretisation.spacing) for emitter in scene.emitter]
    ends = count - np.cumsum([0, *(len(sample.upstream) for sample in made[::-1])])[::-1]
    return list(zip([emitter.name for emitter in scene.emitter], ends[:-1].tolist(), made, strict=True))


def waits(scene: Any, others: Any, particles: int) -> NDArray[np.bool_]:
    """Return a mask of the particles that have not left their emitter yet (particles,)."""
    found = np.zeros(particles, dtype=bool)
    for name, first, sample in samples(scene, particles):
        if emitted_name(name) in others:
            found |= sample.waits(name, first, others, particles)
    return found
