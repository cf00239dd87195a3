"""The section of a ship or a barge in the flume: a polygon at its draught, and what follows from its part under water.

Hulls have the keel at y = 0 and stand at their place with x = 0. All numbers are of the whole breadth, but for those of
`tables`, which are for each metre of it, as a scene in the plane has them.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

DEPTH, DENSITY, GRAVITY, HINGE = 1.0, 1000.0, 9.81, 0.1  # of the water [m], [kg/m3], [m/s2]; of the flap [m]
GAUGE, LINE = 0.33, 20.0  # height of the load cell over the keel, lines so long that they stay level [m]
SLACK = 1e-3  # of springs that only damp [N/m]


@dataclass(frozen=True)
class Rig:
    """The weights of a section that floats, and what holds it."""

    gravity_centre: float  # height over the keel [m]
    gyration: float  # radius [m]
    stiffness: float  # of the springs across [N/m]
    damping: float  # across and up [N s/m]


def polygon(corners):
    """Area, centroid (2,), and the corners (n, 2) counter-clockwise, of a polygon."""
    x, y = corners.T
    parts = x * np.roll(y, -1) - np.roll(x, -1) * y
    twice = parts.sum()
    centre = [(parts * (one + np.roll(one, -1))).sum() / (3.0 * twice) if twice else 0.0 for one in (x, y)]
    return 0.5 * abs(twice), np.array(centre), corners if twice > 0.0 else corners[::-1]


def crosses(corners):
    """Whether two sides of a polygon cross."""
    ends = np.roll(corners, -1, axis=0)
    sides = ends - corners
    first, last = (
        sides[:, :1] * (to[:, 1] - corners[:, 1:]) - sides[:, 1:] * (to[:, 0] - corners[:, :1])
        for to in (corners, ends)
    )
    apart = first * last < 0.0
    return bool((apart & apart.T).any())


@dataclass(frozen=True)
class Section:
    """A hull (n, 2) [m] at its draught and place [m], as long as the flume is broad; it is held without a rig."""

    hull: np.ndarray
    draught: float
    place: float  # from the flap
    breadth: float = 1.0
    rig: Rig | None = None
    guides: float = 0.0  # what moves across with it [kg]

    def __post_init__(self):
        hull = np.asarray(self.hull, dtype=float)
        if len(hull) < 3 or not np.isfinite(hull).all() or not polygon(hull)[0] or crosses(hull):
            raise ValueError(
                "The hull is no polygon: it wants three corners or more, once around, and no sides that cross."
            )
        if not hull[:, 1].min() < self.draught + hull[:, 1].min() < hull[:, 1].max():
            high = np.ptp(hull[:, 1])
            raise ValueError(f"The hull would not float at a draught of {self.draught:g} m, as it is {high:g} m high.")
        if self.draught >= DEPTH or not self.breadth > 0.0:
            raise ValueError(f"The water is {DEPTH:g} m deep: a draught is less, and a breadth more than 0.")
        object.__setattr__(self, "hull", polygon(hull - [0.0, hull[:, 1].min()])[2])
        if np.count_nonzero(np.diff(self.hull[:, 1] >= self.draught, append=self.hull[0, 1] >= self.draught)) != 2:
            raise ValueError(
                f"At a draught of {self.draught:g} m the surface cuts the hull more than twice: one hull is wanted."
            )

    @cached_property
    def wet(self):
        """The part (n, 2) of the hull under water, from the surface at its left to that at its right [m]."""
        ends = np.roll(self.hull, -1, axis=0)
        cut = []
        for a, b in zip(self.hull, ends, strict=True):
            if a[1] < self.draught:
                cut.append(a)
            if (a[1] < self.draught) != (b[1] < self.draught):
                cut.append(a + (b - a) * (self.draught - a[1]) / (b[1] - a[1]))
        first = next(n for n in range(len(cut)) if cut[n][1] == cut[n - 1][1] == self.draught)
        return np.roll(cut, -first, axis=0)

    @property
    def left(self):
        """Where the surface meets the hull, from its place [m]."""
        return self.wet[0, 0]

    @property
    def right(self):
        return self.wet[-1, 0]

    @property
    def beam(self):
        """The beam at the waterline [m]."""
        return self.right - self.left

    @property
    def area(self):
        """The area under water [m2]."""
        return polygon(self.wet)[0]

    @property
    def buoyancy_centre(self):
        """The centroid (2,) of what is under water [m]; the centre of gravity is over or under it."""
        return polygon(self.wet)[1]

    @property
    def mass(self):
        """That of the water that it displaces [kg]."""
        return DENSITY * self.area * self.breadth

    def stiffness(self, gravity_centre):
        """What a heave and a roll about the centre of gravity change of the water's force and moment, over its weight
        for a volume: (2, 2) [m2, m3; m3, m4]."""
        middle, up = self.buoyancy_centre
        ends = np.array([self.left, self.right]) - middle
        first, second = (np.diff(ends**n)[0] / n for n in (2, 3))
        return self.breadth * np.array([[self.beam, first], [first, second + self.area * (up - gravity_centre)]])

    @property
    def keel(self):
        """The point of the hull at x = y = 0, in the flume [m]."""
        return np.array([self.place, DEPTH - self.draught])

    @property
    def corners(self):
        """The corners (n, 2) in the flume [m]."""
        return self.hull + self.keel

    @property
    def middle(self):
        """The centroid (2,) of the whole hull in the flume [m]."""
        return polygon(self.hull)[1] + self.keel

    def tables(self):
        """The solid of a scene, and its springs, for each metre of breadth."""
        own = {"name": "section", "shape": "polygon", "corners": self.corners.tolist()}
        if self.rig is None:
            return {**own, "motion": "path", "velocity": [0.0, 0.0]}, []
        x, y = centre = self.keel + [self.buoyancy_centre[0], self.rig.gravity_centre]
        own |= {"motion": "free", "mass": self.mass / self.breadth, "gyration_radius": self.rig.gyration}
        own |= {"centre_of_mass": (centre - self.middle).tolist()}
        holds = {"solid": "section", "point": centre.tolist(), "damping": self.rig.damping / self.breadth}
        across = {
            **holds,
            "name": "across",
            "anchor": [x + LINE, y],
            "stiffness": max(self.rig.stiffness / self.breadth, SLACK),
        }
        return own, [across, {**holds, "name": "up", "anchor": [x, y + LINE], "stiffness": SLACK}]


def round_bilges(beam=0.4, high=0.256, bilge=0.0512):
    """A hull with upright sides and round bilges."""
    arc = np.linspace(0.0, 0.5 * np.pi, 9)[:, None]
    right = [0.5 * beam - bilge, bilge] + bilge * np.concatenate([np.sin(arc), -np.cos(arc)], axis=1)
    half = np.concatenate([right, [[0.5 * beam, high]]])
    return np.concatenate([half, half[::-1] * [-1.0, 1.0]])


MEASURED = Section(round_bilges(), 0.2, 7.0, 0.586, Rig(0.108, 0.144, 60.0, 8.7), 0.303)  # as those who measured tell
HELD = replace(MEASURED, rig=None)
