"""Sheets, which are walls without thickness. Particles on opposite sides of a sheet do not interact.

The neighbour search first ignores sheets. Once in each time step, the hidden neighbours of particle i are removed:

- particle j, if the segment from i to j crosses a sheet;
- the image of j, if the segment from i to the image of j, or from the image of i to j, crosses a sheet;
- a wall particle of a sheet, if the segment from i to the wall particle crosses another sheet or does not cross this
  sheet;
- a wall particle of a solid or the container, if the segment from i to the wall particle crosses a sheet.

The wall particles of a sheet fill the hidden part of the support, also at tips and holes. Positions of particles and
sheets are the positions before the time step. A particle does not change the side of a sheet in a time step
(`cortado.solvers.projection.sides`). Lists of fluid neighbours are symmetric, because the tested segment of a pair
always starts at the particle with the lower number. Visibility has no derivative.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import warp as wp

from cortado.device.modules import kernel_module
from cortado.device.precision import Precision, TypesByName, struct_of
from cortado.discretise.sheet import Sheet
from cortado.discretise.tree_kernels import face_functions, faces_on, faces_type
from cortado.particles.mirrors import CONTAINER, reflections
from cortado.particles.neighbourhood import UNROLL, Discretisation, neighbourhood_type, pair_functions
from cortado.particles.neighbours import NeighbourSearch
from cortado.particles.state import Layout


@dataclass(frozen=True)
class PlacedSheet:
    number: int
    """Number of the sheet (`cortado.scene.motions.wall_numbers`), which is negative for a sheet at rest."""
    sheet: Sheet
    """Geometry of the sheet. The coordinates of a moving sheet are relative to its middle and without rotation."""


@cache
def sheets_type(precision: Precision) -> Any:
    return struct_of("Sheets", precision, faces=faces_type(precision), numbers=wp.array(dtype=wp.int32))


@cache
def sheet_functions(precision: Precision) -> tuple[Any, Any]:
    """``seen_from`` converts a position to the frame of a sheet."""
    real, vector, sheets_of = precision.real, precision.vector, sheets_type(precision)
    neighbourhood, poses = neighbourhood_type(precision), wp.array2d(dtype=vector)
    turnings = wp.array2d(dtype=precision.matrix)

    @wp.func
    def scale_of(k: int, member: int, s: neighbourhood, sheets: sheets_of) -> real:
        scale = real(1.0)
        if sheets.numbers[k] >= 0:
            scale = s.scales[member, sheets.numbers[k]]
        return scale

    @wp.func
    def seen_from(
        x: vector, middles: poses, turns: turnings, k: int, member: int, s: neighbourhood, sheets: sheets_of
    ) -> vector:
        number, y = sheets.numbers[k], x
        if number >= 0:
            y = wp.transpose(turns[member, number]) * (x - middles[member, number]) / s.scales[member, number]
        return y - sheets.faces.middles[k]

    return scale_of, seen_from


@cache
def hiding_kernel(discretisation: Discretisation) -> Any:
    precision, (real, vector, neighbourhood) = discretisation.precision, discretisation.types
    sheets_of, (scale_of, seen_from) = sheets_type(precision), sheet_functions(precision)
    query, _, goes_through = face_functions(precision)
    pair = pair_functions(discretisation)
    reflection, turned = pair.reflection, pair.turned
    REFLECTIONS, MOVES = wp.constant(reflections(discretisation.moving)), wp.constant(discretisation.moving)
    module = kernel_module(f"sheets_{precision.name}{'_moving' * discretisation.moving}")
    typed = TypesByName(wp.int32, {neighbourhood: "s", sheets_of: "sheets", vector: "x"})

    @wp.func
    def crossed(p: vector, q: vector, own: int, member: int, s: neighbourhood, sheets: sheets_of) -> int:
        """Return 1 if a segment crosses the sheet ``own``, 2 if another sheet, and 3 if both."""
        found = int(0)
        for k in range(sheets.numbers.shape[0]):
            start = seen_from(p, s.before, s.turns_before, k, member, s, sheets)
            end = seen_from(q, s.before, s.turns_before, k, member, s, sheets)
            if goes_through(start, end, k, sheets.faces):
                found = found | wp.where(sheets.numbers[k] == own, 1, 2)
        return found

    @wp.func
    def is_near(x: vector, member: int, reach: real, s: neighbourhood, sheets: sheets_of) -> bool:
        for k in range(sheets.numbers.shape[0]):
            y = seen_from(x, s.before, s.turns_before, k, member, s, sheets)
            face = int(0)
            candidates = query(y, y, reach / scale_of(k, member, s, sheets), k, sheets.faces)
            while wp.bvh_query_next(candidates, face):
                return True
        return False

    @wp.func
    def place_before(b: int, member: int, s: neighbourhood) -> vector:
        x = s.wall_positions[b]
        if MOVES:
            number = s.wall_solids[b]
            if number >= 0:
                own = wp.transpose(s.turns[member, number]) * (x - s.after[member, number])
                x = s.before[member, number] + s.turns_before[member, number] * own
        return x

    @typed.kernel(module)
    def hide(s, sheets, x, fluid_count, filling, count, all_count):
        i = s.first + wp.tid()
        member, x_i, listed = i // s.particles, x[i], int(all_count[i])
        if listed == 0 or not is_near(x_i, member, real(2.0) * s.reach, s, sheets):
            return
        fluid_end, wall_end, kept = int(fluid_count[i]), int(count[i]), int(0)
        for place in range(fluid_end - filling[i]):
            j = s.neighbours[place, i]
            if crossed(x[wp.min(i, j)], x[wp.max(i, j)], wp.static(CONTAINER), member, s, sheets) == 0:
                s.neighbours[kept, i] = j
                kept += 1
        to_fill = -kept & (wp.static(UNROLL) - 1)
        for _more in range(to_fill):
            s.neighbours[kept, i] = i
            kept += 1
        fluid_count[i] = kept
        filling[i] = to_fill
        for place in range(fluid_end, wall_end):
            b = s.neighbours[place, i]
            hidden = crossed(x_i, place_before(b, member, s), s.wall_solids[b], member, s, sheets)
            wanted = int(0)
            for k in range(sheets.numbers.shape[0]):
                if sheets.numbers[k] == s.wall_solids[b]:
                    wanted = 1
            if hidden == wanted:
                s.neighbours[kept, i] = b
                kept += 1
        count[i] = kept
        for place in range(wall_end, listed):
            image = s.neighbours[place, i]
            j = image // REFLECTIONS
            R, offset = reflection(image % REFLECTIONS, member, s)
            first, second = x[wp.min(i, j)], x[wp.max(i, j)]
            hidden = crossed(first, turned(R, second) + offset, wp.static(CONTAINER), member, s, sheets)
            hidden = hidden | crossed(turned(R, first) + offset, second, wp.static(CONTAINER), member, s, sheets)
            if hidden == 0:
                s.neighbours[kept, i] = image
                kept += 1
        all_count[i] = kept

    return hide


class Sheets:
    def __init__(self, placed: Sequence[PlacedSheet], spacing: float, layout: Layout):
        self.numbers, device = [one.number for one in placed], layout.device
        self.struct = sheets_type(layout.precision)()
        faces = [(one.sheet.pieces, one.sheet.normals) for one in placed]
        self.struct.faces, self._trees = faces_on(faces, spacing, layout.precision, device)
        self.struct.numbers = wp.array(self.numbers, dtype=wp.int32, device=device)

    def hide(
        self, launch: Callable[..., None], discretisation: Discretisation, search: NeighbourSearch, **known: Any
    ) -> None:
        """Remove hidden neighbours from a search, given the neighbourhood ``s`` and sorted positions ``x``."""
        launch(hiding_kernel(replace(discretisation, lanes=1)), search.lists, sheets=self.struct, **known)
