"""The height of the fluid's surface at a place: the level up to which the fluid fills a column above a floor.

The column is divided into levels. The points x_c of a level have weights w_c that add up to 1. At a point with the
signed distance phi from a solid, the solid occupies the fraction

    s_c = min(max(1/2 - phi(x_c) / step, 0), 1)

where step is the distance between points. The occupied part of the column is therefore exact for a flat solid.
Fractions of several solids add up to at most 1. Level k has the free fraction 1 - sum_c w_c s_c, and the fluid fills
the levels from below.

Above a solid that floats on fluid, such as a boat, the height would jump as a function of the depth. A slope over a
depth of `FILM` replaces the jump, so that slightly compressed fluid does not appear on a deck.
"""

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cortado.calls import fixed
from cortado.discretise.room import Domain
from cortado.discretise.shapes import corners, grid, in_space
from cortado.discretise.solid import Solid
from cortado.particles.state import padded
from cortado.runs.particle_sums import (
    ACROSS,
    Around,
    Axes,
    Carrier,
    Summed,
    WeightedSum,
    axes_of,
    parts_of,
    reach_of,
    ride_of,
    square,
    together,
    weights_of,
)
from cortado.runs.sensor import Reading, SensedScene, direction, in_dimension, named, point, positive
from cortado.scene.motions import Pose, position_name, scale_name
from cortado.scene.shape_tables import Container, NoContainer
from cortado.scene.solids import SolidTable

MOST = 4_000_000
FILM = 1.0
"""Depth of the film of fluid above a solid with fluid below the solid [spacings]."""


@dataclass(frozen=True)
class Standing:
    """A solid near a wave gauge. A point r in the frame of the solid is at ``middle + scale turn r``."""

    own: Solid
    middle: NDArray[Any]
    turn: NDArray[Any]
    scale: float
    pose: Pose | None

    @classmethod
    def of(cls, table: SolidTable, d: int, at: Reading | None = None) -> "Standing":
        """Place a solid at its pose in the state ``at``. A solid at rest needs no state."""
        if at is None or not table.moves:
            return cls(table.own_solid(), table.middle(), table.turn(d), 1.0, None)
        pose = Pose.of(table.name, table.motion == "free", at)
        return cls(table.own_solid(), pose.position, pose.rotation[:d, :d], pose.scale, pose)

    def local(self, points: NDArray[Any], domain: Domain) -> NDArray[Any]:
        """Convert points (n, d) [m], along periodic axes their nearest images, to the frame of the solid."""
        return np.asarray(domain.shortest(points - self.middle) @ self.turn / self.scale)

    def reach(self, up: NDArray[Any], foot: NDArray[Any]) -> tuple[float, float]:
        """Return the greatest height of the solid above ``foot`` (d,) along ``up`` (d,) [m], and its radius [m]."""
        ends = self.scale * corners(*self.own.extent())
        high = float(((self.middle - foot) @ up) + (ends @ self.turn.T @ up).max())
        return high, float(np.linalg.norm(ends, axis=1).max()) if self.own.is_bounded else np.inf


@dataclass(frozen=True)
class Axis:
    foot: tuple[float, ...]
    """Intersection of the axis and the floor (d,) [m]."""
    up: tuple[float, ...]
    reach: float
    step: float
    film: float
    beside: tuple[tuple[float, ...], ...]
    """Unit vectors perpendicular to the axis (d - 1, d)."""

    def places(self) -> tuple[NDArray[Any], NDArray[Any]]:
        """Return the points (c, d) on the floor relative to ``foot`` [m], and their weights (c,)."""
        d, count = len(self.foot), int(np.ceil(self.reach / self.step))
        along = np.asarray(self.step * np.arange(-count, count + 1), dtype=np.float64)
        places = grid([along] * (d - 1))
        weights = weights_of(np.linalg.norm(places, axis=1) / self.reach)[0]
        return places[weights > 0.0] @ np.array(self.beside), weights[weights > 0.0] / weights.sum()

    def carried(self, carrier: Carrier, turns: bool) -> "Axis":
        foot = tuple(carrier.place(np.array(self.foot)).tolist())
        if not turns:
            return replace(self, foot=foot)
        up, *beside = (np.array([self.up, *self.beside]) @ carrier.flat.T).tolist()
        return replace(self, foot=foot, up=tuple(up), beside=tuple(map(tuple, beside)))


@lru_cache(maxsize=64)
def _axis_of(spacing: float, position: tuple[float, ...], floor: float, up: tuple[float, ...], reach: float) -> Axis:
    foot = np.array(position) + (floor - np.dot(position, up)) * np.array(up)
    beside = tuple(map(tuple, np.linalg.svd(np.array([up]))[2][1:].tolist()))
    return Axis(tuple(foot.tolist()), up, reach, min(0.5 * spacing, reach / 20.0), FILM * spacing, beside)


@dataclass(frozen=True)
class Column:
    """The points in the column of a wave gauge, with the fractions that solids occupy."""

    axis: Axis
    points: NDArray[Any]
    """Positions of points (levels, c, d) [m]."""
    weights: NDArray[Any]
    """Weights of points (c,). The weights of the points inside the container add up to 1."""
    outside: NDArray[Any]
    """Fraction of the cell around each point that is outside the container (c,)."""
    solids: list[tuple[Standing, NDArray[Any]]]
    """Solids in the column, with the distances of the points from the solid (levels, c) [m]."""

    @classmethod
    def of(cls, axis: Axis, solids: list[Standing], domain: Domain, container: Container) -> "Column | None":
        foot, up = np.array(axis.foot), np.array(axis.up)
        tops, sizes = np.array([one.reach(up, foot) for one in solids]).T
        ways = domain.shortest(foot - np.array([one.middle for one in solids], dtype=np.float64))
        aside = np.linalg.norm(ways - (ways @ up)[:, None] * up, axis=1)
        close = (aside < sizes + axis.reach + axis.step) & (tops > -axis.step)
        if not close.any():
            return None
        levels = int(np.ceil((tops[close].max() + axis.film) / axis.step)) + 1
        places, weights = axis.places()
        if levels * len(places) > MOST:
            wider = (levels * len(places) / MOST) ** (1.0 / len(foot))
            return cls.of(replace(axis, step=1.01 * wider * axis.step), solids, domain, container)
        inside = cut_by(axis, container)
        inside = np.ones(len(places)) if inside is None else inside
        heights = axis.step * (np.arange(levels) + 0.5)
        points = foot + places[None] + heights[:, None, None] * up
        found = []
        for one in (one for one, is_close in zip(solids, close, strict=True) if is_close):
            local = one.local(points.reshape(-1, len(foot)), domain)
            distances = one.scale * one.own.distance_up_to(local, axis.step / one.scale).reshape(points.shape[:2])
            if distances.min() < 0.5 * axis.step:
                found.append((one, distances))
        return cls(axis, points, weights / (weights @ inside), 1.0 - inside, found) if found else None

    @cached_property
    def _taken(self) -> NDArray[Any]:
        return self.outside + sum(np.clip(0.5 - far / self.axis.step, 0.0, 1.0) for _, far in self.solids)

    @cached_property
    def room(self) -> NDArray[Any]:
        """Free fraction of each level (levels,)."""
        return np.asarray((1.0 - np.minimum(self._taken, 1.0)) @ self.weights)

    @cached_property
    def _ends(self) -> tuple[NDArray[Any], NDArray[Any]]:
        """Heights [levels] and depths of fluid [m] at the corners of the piecewise linear function height(depth)."""
        filled = self.axis.step * np.concatenate([[0.0], np.cumsum(self.room)])
        kept, blocked = np.ones(len(filled), dtype=bool), np.append(self.room < 1e-3, False)  # full
        kept[: int(np.argmin(blocked))] = False  # what stands on the floor
        for ceiling in np.flatnonzero(blocked[1:] & ~blocked[:-1]) + 1:
            kept[ceiling + 1 :] &= filled[ceiling + 1 :] >= filled[ceiling] + self.axis.film
        ends = np.flatnonzero(kept)
        return ends, filled[ends]

    def level(self, depth: float) -> tuple[float, NDArray[Any], float]:
        """Return the height [m] of the surface, and its derivatives with respect to the volume of solids in each level
        (levels,) and to ``depth``. ``depth`` [m] is the depth that the fluid would have without solids."""
        (ends, filled), step, levels = self._ends, self.axis.step, np.arange(len(self.room))
        low = max(int(np.searchsorted(filled, depth, side="right")) - 1, 0)
        if low == len(ends) - 1:  # above all solids
            return ends[low] * step + (depth - filled[low]), np.ones(len(levels)), 1.0
        part = (depth - filled[low]) / (filled[low + 1] - filled[low])
        slope = step * (ends[low + 1] - ends[low]) / (filled[low + 1] - filled[low])
        below = np.where(levels < ends[low], 1.0, np.where(levels < ends[low + 1], part, 0.0))
        return step * (ends[low] + part * (ends[low + 1] - ends[low])), below, float(slope)

    def pushes(self, depth: float, bar: float, domain: Domain) -> "list[Push]":
        """Convert the derivative ``bar`` along the height to derivatives along the poses of solids."""
        _, below, slope = self.level(depth)
        shares, found = bar * slope * below, list[Push]()
        for one, far in self.solids:
            k, c = np.nonzero((np.abs(far) < 0.5 * self.axis.step) & (self._taken < 1.0))
            local, share = one.local(self.points[k, c], domain), shares[k] * self.weights[c]
            pushed = share[:, None] * one.own.outward(local)
            twisted = np.cross(padded(one.scale * local), padded(pushed))
            grown = float((pushed * local).sum() - (share * far[k, c]).sum() / one.scale)
            turn = square(one.turn) if one.pose is None else one.pose.rotation
            found.append(Push(one, one.turn @ pushed.sum(axis=0), turn @ twisted.sum(axis=0), grown))
        return found


@dataclass(frozen=True, eq=False)
class Push:
    solid: Standing
    shift: NDArray[Any]
    """Derivative with respect to the position of the solid (d,)."""
    twist: NDArray[Any]
    """Derivative with respect to a small rotation about the middle of the solid (3,)."""
    grown: float
    """Derivative with respect to the scale of the solid."""

    @property
    def bars(self) -> dict[str, NDArray[Any]]:
        pose = self.solid.pose
        if pose is None:
            return {}
        found = {position_name(pose.name): self.shift[None]} | pose.turning_bars(self.twist)
        return found if pose.is_free else found | {scale_name(pose.name): np.array([self.grown])}


def column_of(axis: Axis, at: Reading, container: Container) -> Column | None:
    tables, domain = at.solids, at.lattice.domain
    if any(table.moves for table in tables):
        return Column.of(axis, [Standing.of(table, at.dimension, at) for table in tables], domain, container)
    return _at_rest(axis, tables, domain, container)


@lru_cache(maxsize=64)
def cut_by(axis: Axis, container: Container) -> NDArray[Any] | None:
    """Return the fraction (c,) of the cell around each point that is inside the container. Return None if all cells are
    inside, or if the sides of the container are not parallel to the column."""
    up, foot = np.array(axis.up), np.array(axis.foot)
    region, periods = container.region(len(up)), container.periods(len(up))[1]
    along = np.abs(up) > 1.0 - 1e-12
    if not along.any() or (region.across @ along and region.across.any()):
        return None
    sides = region.opened(np.where(along, 1.0, periods))
    if sides.distance(foot[None])[0] <= -axis.reach - axis.step:
        return None
    places, weights = axis.places()
    inside = sides.cell_shares(foot + places, axis.step)
    return inside if weights @ inside > 0.01 else None  # not too narrow a part


@lru_cache(maxsize=64)
def _at_rest(axis: Axis, tables: tuple[SolidTable, ...], domain: Domain, container: Container) -> Column | None:
    if not tables:
        return None
    return Column.of(axis, [Standing.of(table, len(axis.foot)) for table in tables], domain, container)


@fixed
class WaveGauge(Summed):
    """A sensor of the height h of the fluid's surface at a place.

    The height is the level up to which the fluid in a column around the place would fill the column from its floor.
    Without solids the height is

    h = floor + sum_i V w_i,   w_i = w(r_i / radius) with the integral 1.

    Here r_i is the horizontal distance of particle i, V = spacing^d its volume, and w a smooth function. In the column
    of the gauge, solids occupy a part of the volume. The height is also correct above a solid on the floor, within the
    fluid or piercing its surface. Fluid in the air, or on a solid with air below the solid, counts as if the fluid lay
    on the fluid below. The column ends at sides of the container that are parallel to ``up``.

    Example::

        run = simulation.run(100, sensors={"gauge": cortado.sensors.WaveGauge([0.4, 0.0])})
        print(run.sensors["gauge"]["height"])  # (101,) m
    """

    def __init__(
        self,
        position: Any,
        floor: float = 0.0,
        radius: float | None = None,
        up: Any = None,
        on: str | None = None,
        axes: Axes = "world",
    ):
        """Place a gauge at ``position`` (d,) [m]. The component of ``position`` along ``up`` has no effect. ``floor``
        is the coordinate of the column's bottom along ``up`` [m]. ``up`` (d,) is by default the y axis. ``radius`` [m]
        is the radius of the column. The default radius is two support radii of the smoothing kernel or five spacings,
        whichever is larger.

        ``on`` names a solid that carries the bottom of the column. With ``axes`` "body" the column rotates with the
        solid, and the height is measured along the axes of the solid. With ``axes`` "world", the height is measured
        along ``up``. Sides of the container do not bound a column on a solid.
        """
        self.position, self.floor = point("position", position), float(floor)
        self.radius = None if radius is None else positive("radius", radius)
        self.up = direction("up", np.eye(len(self.position))[1] if up is None else up)
        self.on = None if on is None else named("on", on, "solid that moves")
        self.axes = axes_of(axes, on is not None)

    def columns(self, dimension: int) -> dict[str, str]:
        return {"height": "m"}

    def summed(self, at: SensedScene) -> WeightedSum:
        axis, across, ride = self._axis(at), at.dimension - 1, ride_of(self.on, self.axes == "body", at)
        finer = axis.reach / 4.0  # as solids cut particles
        if ride is not None:
            parts = parts_of(finer, at, self._across, across)
            return WeightedSum(Around(np.array(axis.foot), axis.reach, self._across, parts), ride=ride)
        whole = cut_by(axis, at.container) is None and not any(table.moves for table in at.solids)
        whole = whole and _at_rest(axis, at.solids, at.lattice.domain, at.container) is None
        parts = parts_of(axis.reach if whole else finer, at, self._across, across)
        return WeightedSum(Around(self.position, axis.reach, self._across, parts))

    def reading(self, at: Reading, found: NDArray[Any]) -> NDArray[Any]:
        axis = self._axis(at)
        depth, ride = self._scale(axis, at) * float(found[0]), ride_of(self.on, self.axes == "body", at)
        if ride is None:
            column, floor = column_of(axis, at, at.container), self.floor
        else:
            axis = axis.carried(ride.carrier(at), ride.turns)
            column = column_of(axis, at, NoContainer())
            floor = self.floor if ride.turns else float(np.dot(axis.foot, axis.up))
        return np.array([floor + (depth if column is None else column.level(depth)[0])])

    def adjoint(self, at: Reading, bar: NDArray[Any]) -> dict[str, NDArray[Any]]:
        axis, summed = self._axis(at), self.summed(at)
        around, scale, ride = summed.seen(at), self._scale(axis, at), summed.ride
        if ride is None:
            column = column_of(axis, at, at.container)
        else:
            carrier, begun = ride.carrier(at), np.array(axis.foot)
            axis = axis.carried(carrier, ride.turns)
            column = column_of(axis, at, NoContainer())
        depth, slope, pushes = float(scale * around.weights.sum()), 1.0, list[Push]()
        if column is not None:
            slope, pushes = column.level(depth)[2], column.pushes(depth, bar[0], at.lattice.domain)
        pulled, bars = around.pulled(bar[0] * slope * scale), [push.bars for push in pushes]
        against = -sum((push.shift for push in pushes), np.zeros(at.dimension))
        if ride is not None and ride.turns:
            pulled = pulled @ carrier.flat.T
            back = [-push.twist - np.cross(carrier.arms(push.solid.middle), in_space(push.shift)) for push in pushes]
            bars += [carrier.carried(pulled, at["positions"]), carrier.bars(against, sum(back, np.zeros(3)))]
        elif ride is not None:
            bars.append(carrier.lifted(against - pulled.sum(axis=0) + bar[0] * self.up, begun))
        return together(*bars, {"positions": pulled})

    def _axis(self, at: SensedScene) -> Axis:
        in_dimension("position", self.position, at.dimension)
        spacing, reach = at.lattice.cell ** (1.0 / at.dimension), reach_of(self.radius, at)
        return _axis_of(spacing, tuple(self.position.tolist()), self.floor, tuple(self.up.tolist()), reach)

    def _scale(self, axis: Axis, at: SensedScene) -> float:
        """Return the volume of a particle divided by the cross-section of the column [m]."""
        across, inside = at.dimension - 1, cut_by(axis, at.container) if self.on is None else None
        open_part = 1.0 if inside is None else float(axis.places()[1] @ inside)
        return float(at.lattice.cell * ACROSS[across] / axis.reach**across / open_part)

    def _across(self, way: NDArray[Any]) -> NDArray[Any]:
        return np.asarray(way - (way @ self.up)[:, None] * self.up)
