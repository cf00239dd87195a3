"""The front of a dam break without friction, by potential flow: how fast a right solver should be.

A column of water, L wide and 2 L high, on a floor and against a wall, is released at once. With the mirror images of
wall and floor only the free surface is left; on it a boundary integral equation with linear elements gives the normal
velocity. Nodes move with the water, are spread anew after each step, and smoothed (Longuet-Higgins and Cokelet 1976).
Without friction the tip is a film without end, which no measurement sees: what is thinner than a depth is cut off.

Units: L = 1, T = t sqrt(2 g / L).
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.interpolate import CubicSpline

GRAVITY = 0.5
"""So that T = t."""
HEIGHT, ROUNDING = 2.0, 0.1
"""Of the column, and the radius of its upper corner."""
FINE, COURANT = 0.25, 0.15
"""Distance of nodes at the tip, over the depth that is cut; how far nodes may part in a step, over their distance."""


def integrals(points: np.ndarray, nodes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(points, nodes) of d ln r / dn and of ln r, times the hat function of each node, in closed form: a point may be
    as near to a segment as it likes."""
    along = np.diff(nodes, axis=0)
    length = np.hypot(*along.T)
    tangent = along / length[:, None]
    first = nodes[None, :-1] - points[:, None]
    u = np.einsum("pse,se->ps", first, tangent)
    v = np.einsum("pse,se->ps", first, outwards(tangent))
    ends = (u, u + length)
    r = [np.maximum(np.hypot(w, v), 1e-300) for w in ends]
    away = np.abs(v) > 1e-12 * length
    angle = np.where(away, np.arctan2(v, ends[0]) - np.arctan2(v, ends[1]), 0.0)
    lever = np.where(away, v * np.log(r[1] / r[0]), 0.0)
    plain = [w * np.log(s) - w + np.abs(v) * np.arctan2(w, np.abs(v)) for w, s in zip(ends, r, strict=True)]
    times = [0.5 * s**2 * np.log(s) - 0.25 * w**2 for w, s in zip(ends, r, strict=True)]
    found = []
    for zeroth, linear in ((angle, lever), (plain[1] - plain[0], times[1] - times[0])):
        second = (linear - u * zeroth) / length
        hats = np.zeros((len(points), len(nodes)))
        hats[:, :-1] += zeroth - second
        hats[:, 1:] += second
        found.append(hats)
    return found[0], found[1]


def outwards(tangents: np.ndarray) -> np.ndarray:
    """(n, 2) normals out of water that is to the right of the way along the surface."""
    return np.stack([-tangents[:, 1], tangents[:, 0]], axis=1)


def normal_velocity(nodes: np.ndarray, potential: np.ndarray) -> np.ndarray:
    """(nodes,) out of the water, for the potential at the nodes of the surface."""
    double, single = np.zeros((2, len(nodes), len(nodes)))
    for mirror in ((1, 1), (-1, 1), (1, -1), (-1, -1)):
        a, b = integrals(nodes * mirror, nodes)
        double, single = double + a, single + b
    return np.linalg.solve(single, double @ potential - double.sum(axis=1) * potential)


@dataclass(frozen=True)
class Surface:
    """Nodes (n, 2) from the wall to the floor, and the potential (n,) there."""

    nodes: np.ndarray
    potential: np.ndarray

    @cached_property
    def arc(self) -> np.ndarray:
        """(n,) length from the wall."""
        return np.concatenate([[0.0], np.hypot(*np.diff(self.nodes, axis=0).T).cumsum()])

    def curves(self) -> tuple[CubicSpline, CubicSpline]:
        """Of the nodes and of the potential, by arc length; at the wall with the symmetry of the mirror image."""
        level, odd, free = (1, 0.0), (2, 0.0), "not-a-knot"
        x = CubicSpline(self.arc, self.nodes[:, 0], bc_type=(odd, free))
        y = CubicSpline(self.arc, self.nodes[:, 1], bc_type=(level, free))
        place = CubicSpline.construct_fast(np.stack([x.c, y.c], axis=2), x.x)
        return place, CubicSpline(self.arc, self.potential, bc_type=(level, free))

    def rates(self) -> "Surface":
        """Velocities of the nodes, and how their potential changes (Bernoulli)."""
        place, potential = self.curves()
        tangents = place(self.arc, 1)
        tangents /= np.hypot(*tangents.T)[:, None]
        out = normal_velocity(self.nodes, self.potential)
        velocities = potential(self.arc, 1)[:, None] * tangents + out[:, None] * outwards(tangents)
        velocities[0, 0] = velocities[-1, 1] = 0.0
        return Surface(velocities, 0.5 * (velocities**2).sum(axis=1) - GRAVITY * self.nodes[:, 1])

    def moved(self, time: float, rates: "Surface") -> "Surface":
        """After a time at these rates."""
        return Surface(self.nodes + time * rates.nodes, self.potential + time * rates.potential)

    def cut(self, depth: float) -> "Surface":
        """Without the film that is thinner than this, ended by a quarter of a circle."""
        first = np.flatnonzero(self.nodes[:, 1] > depth)[-1] + 1
        if self.nodes[-1, 0] - self.nodes[first, 0] < 1.5 * depth:
            return self
        (before, after), values = self.nodes[first - 1 : first + 1], self.potential[first - 1 : first + 1]
        share = (before[1] - depth) / (before[1] - after[1])
        start, value = before + share * (after - before), values[0] + share * (values[1] - values[0])
        slope = (np.interp(start[0] + depth, self.nodes[first - 1 :, 0], self.potential[first - 1 :]) - value) / depth
        turn = np.linspace(0.0, np.pi / 2.0, 9)
        end = start + depth * np.stack([np.sin(turn), np.cos(turn) - 1.0], axis=1)
        potential = value + slope * (end[:, 0] - start[0])
        return Surface(np.concatenate([self.nodes[:first], end]), np.concatenate([self.potential[:first], potential]))

    def spread(self, fine: float, coarse: float) -> "Surface":
        """With nodes a fifth of the height apart, within these limits, and no more than a tenth wider in a step."""
        place, potential = self.curves()
        s = np.linspace(0.0, self.arc[-1], 4000)
        wanted = np.clip(0.2 * np.abs(place(s)[:, 1]), fine, coarse)
        forwards = np.minimum.accumulate(wanted - 0.1 * s) + 0.1 * s
        backwards = np.minimum.accumulate((wanted + 0.1 * s)[::-1])[::-1] - 0.1 * s
        density = 1.0 / np.minimum(forwards, backwards)
        count = np.concatenate([[0.0], np.cumsum(0.5 * (density[1:] + density[:-1]) * np.diff(s))])
        at = np.interp(np.linspace(0.0, count[-1], int(np.ceil(count[-1])) + 1), count, s)
        return Surface(place(at), potential(at))

    def smoothed(self) -> "Surface":
        """Without what changes sign from node to node."""
        found = Surface(self.nodes.copy(), self.potential.copy())
        for new, old in (found.nodes, self.nodes), (found.potential, self.potential):
            new[2:-2] = (10.0 * old[2:-2] + 4.0 * (old[1:-3] + old[3:-1]) - old[:-4] - old[4:]) / 16.0
        found.nodes[0, 0] = found.nodes[-1, 1] = 0.0
        return found

    def area_and_energy(self) -> tuple[float, float]:
        """Of the water, its density being 1."""
        x, y = self.nodes.T
        kinetic = np.trapezoid(0.5 * self.potential * normal_velocity(self.nodes, self.potential), self.arc)
        return -float(np.trapezoid(x, y)), float(kinetic - GRAVITY * np.trapezoid(x * y, y))


def column() -> Surface:
    """At rest, its upper corner rounded, as splines want it."""
    turn = np.linspace(np.pi / 2.0, 0.0, 40)
    corner = np.array([1.0, HEIGHT]) - ROUNDING + ROUNDING * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    top = np.stack([np.linspace(0.0, 1.0 - ROUNDING, 60)[:-1], np.full(59, HEIGHT)], axis=1)
    face = np.stack([np.ones(200), np.linspace(HEIGHT - ROUNDING, 0.0, 201)[1:]], axis=1)
    nodes = np.concatenate([top, corner, face])
    return Surface(nodes, np.zeros(len(nodes)))


def dam_break(until: float, depth: float = 0.04, coarse: float = 0.04) -> np.ndarray:
    """(steps + 1, 4): T, front, and area and energy over their first values."""
    fine = FINE * depth
    water, time, rows = column().spread(fine, coarse), 0.0, []
    while True:
        rows.append((time, water.nodes[-1, 0], *water.area_and_energy()))
        if time >= until:
            break
        first = water.rates()
        gaps, parting = (np.hypot(*np.diff(each.nodes, axis=0).T) for each in (water, first))
        step = min(0.02, until - time, COURANT * float((gaps / np.maximum(parting, 1e-6)).min()))
        second = water.moved(0.5 * step, first).rates()
        third = water.moved(0.5 * step, second).rates()
        fourth = water.moved(step, third).rates()
        for weight, rates in zip((1, 2, 2, 1), (first, second, third, fourth), strict=True):
            water = water.moved(step * weight / 6.0, rates)
        water = water.cut(depth).spread(fine, coarse).smoothed()
        time += step
    found = np.array(rows)
    found[:, 2:] /= found[0, 2:]
    return found
