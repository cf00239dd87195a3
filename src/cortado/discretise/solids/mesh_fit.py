"""What a mesh is beside particles of a spacing, and beside a container: its unit of length, and how thick it is."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from cortado.discretise.shapes import Points
from cortado.discretise.solids.mesh import Mesh
from cortado.errors import InputError

LEAST_THICKNESS = 0.5
"""In spacings. In the plane, water 16 spacings deep on one side or on both goes through walls 0.2 spacings thick within
0.2 s; those 0.3 thick hold it for 1 s, with either solver."""
SHARE = 0.01
"""Of the surface: where no more is too thin, nothing is said."""
ALONG = 0.9
"""Cosine between the normals of both sides of a sheet, one of them turned round, at least; of a wedge it is less."""
TOO_LARGE = 100.0
"""Times the length of the container, or 100 spacings without one: a mesh that is longer has another unit of length."""
PROBES, STEPS, HALVINGS = 20_000, 16, 12
"""Points of a surface at which its thickness is measured, in so many steps, the last of which is halved so often."""
BEYOND = 1e-3
"""Of the steps' length: how far behind a solid one looks back at it."""


def check_fit(
    mesh: Mesh,
    origin: Points,
    what: str,
    scale: float,
    spacing: float,
    support: float,
    container: tuple[Points, Points] | None,
) -> tuple[str, ...]:
    """Notes about a mesh beside particles a spacing [m] apart that see each other up to a support [m]; raises
    `InputError`, a sentence that calls the mesh ``what``, where it cannot be meant or cannot keep fluid out.

    ``origin``: (3,) that of the mesh in the file, times the scale [m].
    ``container``: lower and upper corner, each (3,) [m], of the box around it.
    """
    check_unit(mesh, what, scale, spacing, container)
    return tuple(_thickness_notes(mesh, origin, what, spacing, support))


def check_unit(mesh: Mesh, what: str, scale: float, spacing: float, container: tuple[Points, Points] | None) -> None:
    """The first part of `check_fit`: raises `InputError` where a mesh is far too large or too small."""
    length = float(np.ptp(mesh.extent(), axis=0).max())
    room = None if container is None else float(np.ptp(container, axis=0).max())
    beside = 100.0 * spacing if room is None else room
    if length > TOO_LARGE * beside:
        times = f"{length / spacing:,.0f} spacings" if room is None else f"{length / room:,.0f} times the container"
        raise InputError(
            f"{what} is {length:g} m long, {times}; it looks like millimetres: give it scale = {0.001 * scale:g}, and "
            f"it will be {0.001 * length:g} m long."
        )
    if length < spacing:
        raise InputError(
            f"{what} is only {length:g} m long, less than a spacing, {spacing:g} m; it may have another unit of "
            f"length, so give it a larger scale than {scale:g}, or make the spacing smaller."
        )


@dataclass(frozen=True)
class Thickness:
    """How thick a solid is beneath points of its surface that stand for equal parts of it."""

    points: Points
    """(n, 3) [m]"""
    lengths: Points
    """(n,) from each straight down to where the solid ends [m]; infinite where that is further than was looked"""
    is_sheet: np.ndarray
    """(n,) whether the surface there is nearly parallel"""

    def share(self, which: np.ndarray) -> float:
        """The part of the surface that some points are."""
        return float(np.count_nonzero(which) / max(len(which), 1))

    def place(self, which: np.ndarray) -> str:
        """The thinnest of some points, in words."""
        thinnest = self.points[which][np.argmin(self.lengths[which])]
        return f"({', '.join(f'{value:g}' for value in thinnest)}) m"

    @property
    def thinnest(self) -> float:
        """Of sheets, what all but `SHARE` of the surface is thicker than [m]; infinite if none is."""
        return float(np.quantile(np.where(self.is_sheet, self.lengths, np.inf), SHARE, method="higher"))


def thickness_of(mesh: Mesh, reach: float) -> Thickness:
    """The thickness of a mesh where it is less than a reach [m]."""
    points, outward = mesh.own_feet(float(np.sqrt(mesh.areas().sum() / PROBES)))
    depths = reach * (np.arange(STEPS) + 1.0) / STEPS
    inside = np.array([mesh.holds(points - depth * outward) for depth in depths])
    through = ~inside.all(axis=0)
    high = depths[np.argmin(inside, axis=0)[through]]
    low, probes, down = high - reach / STEPS, points[through], -outward[through]
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        holds = mesh.holds(probes + middle[:, None] * down)
        low, high = np.where(holds, middle, low), np.where(holds, high, middle)
    lengths, is_sheet = np.full(len(points), np.inf), np.zeros(len(points), dtype=bool)
    lengths[through] = high
    beyond = probes + (high + BEYOND * reach)[:, None] * down
    is_sheet[through] = (mesh.outward(beyond) * down).sum(axis=1) > ALONG
    return Thickness(points, lengths, is_sheet)


def _thickness_notes(mesh: Mesh, origin: Points, what: str, spacing: float, support: float) -> Iterator[str]:
    found, least = thickness_of(mesh, support), LEAST_THICKNESS * spacing
    found = replace(found, points=origin + found.points)
    sheet, sharp = (found.lengths < least) & found.is_sheet, (found.lengths < least) & ~found.is_sheet
    if found.share(sheet) > SHARE:
        raise InputError(
            f"{what} is thinner than half a spacing, {least:g} m, at {found.share(sheet):.0%} of its surface, for "
            f"example at {found.place(sheet)}, so that fluid would pass: make it thicker, or the spacing smaller."
        )
    if found.share(sharp) > SHARE:
        yield (
            f"{what} has edges so sharp that it is thinner than half a spacing, {least:g} m, at "
            f"{found.share(sharp):.0%} of its surface, for example at {found.place(sharp)}: fluid may pass there."
        )
    thin = (found.lengths < support) & found.is_sheet
    if found.share(thin) > SHARE:
        yield (
            f"{what} is thinner than the support, {support:g} m, at {found.share(thin):.0%} of its surface, down to "
            f"{found.lengths[thin].min():.3g} m at {found.place(thin)}: fluid on one side feels that on the other."
        )
