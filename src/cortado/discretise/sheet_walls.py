"""The wall particles of sheets, and what each counts for in the density, in float64."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from cortado.discretise.room import Room
from cortado.discretise.shapes import Points
from cortado.discretise.sheet import Sheet, Thickened
from cortado.discretise.solid_walls import DENSITY, WallPoints, frames, surface_points
from cortado.discretise.walls import Places, RestLattice, WallLayers, uneven_changes, wall_weights


def sheet_points(sheet: Sheet, layers: WallLayers, lattice: RestLattice) -> WallPoints:
    """Make the wall particles on both sides of a sheet and around its ends, in layers at the depths of those of flat
    walls."""
    apart = DENSITY * lattice.spacing
    parts = [surface_points(Thickened(sheet, depth), apart, 0.0) for depth in layers.depths]
    positions = np.concatenate([one.points for one in parts])
    shares = [weight * one.shares for weight, one in zip(layers.weights, parts, strict=True)]
    flat = DENSITY ** (lattice.dimension - 1) * np.concatenate(shares)
    return WallPoints(positions, flat, sheet.nearest(positions) - positions)


def sheet_weights(
    sheet: Sheet, points: Sequence[Points], flat: Sequence[Points], room: Room, lattice: RestLattice, least: float
) -> Points:
    """Compute the weights (b,) of the wall particles of a sheet, as those of other solids are found: by places beside
    it that are no nearer than ``least`` [m] to any surface. The lists have positions (b, d) [m] and weights (b,): first
    those of the sheet in a flat wall, then those of others that are in the room."""
    spacing, own = lattice.spacing, len(points[0])
    heights = spacing * (np.arange(int(np.ceil(lattice.support / spacing - 0.5))) + 0.5)
    found = np.concatenate([surface_points(Thickened(sheet, height), spacing, 0.0).points for height in heights])
    away = found - sheet.nearest(found)
    about = Places(found, frames(away / np.linalg.norm(away, axis=1, keepdims=True)))
    around = replace(room, solids=(*room.solids, sheet))
    places = about.some(around.contains(found, -least))
    walls, weights = np.concatenate(points), np.concatenate(flat)
    seen = places, lattice, around, np.zeros(lattice.dimension), uneven_changes, len(walls) - own
    return wall_weights(walls, weights, *seen, partial(sheet.crossed, spacing=spacing))[:own]
