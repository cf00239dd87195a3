"""Keeps particles on their side of a sheet, and moves back a particle that ends a step on the other side.

In the frame of a sheet a particle is at y_0 before the step and at y after the step. A face of the sheet has the normal
n and contains a point a. The particle is at the height h = n . (y - a) above the face, and at h_0 before the step. The
path from y_0 to y may cross the face, or end nearer to the face than e = s / 20 with the spacing s. The particle is
then put back on the side of y_0:

    y' = y + (e sign h_0 - h) n.

A particle is put back up to three times, each time by the face that the path meets first. If the path still crosses the
sheet, as in a sharp corner, the particle keeps its place relative to the sheet, y' = y_0.

For derivatives, let the middle c of the solid move by c', and let the solid turn by the small vector w' and grow by the
relative amount g' (`MovingWalls`). A point x of the solid then moves by t(x) = c' + w' x (x - c) + g' (x - c). A
particle that moves by x' moves by D = x' - t(x) relative to the solid. If the face has the normal N in the scene, the
correction changes D to D - N (N . D + e sign h_0 g'), and then adds t again.
"""

from functools import cache
from typing import Any

import warp as wp

from cortado.device.launching import bundle
from cortado.device.modules import Kernels, kernel_module
from cortado.device.precision import Precision, TypesByName
from cortado.discretise.tree_kernels import face_functions
from cortado.particles.neighbourhood import neighbourhood_type
from cortado.particles.sheets import Sheets, sheet_functions, sheets_type
from cortado.particles.state import Layout
from cortado.particles.wall_terms import share_kinds
from cortado.sph.parts import Adjoints, StepContext, Tangents

NEAREST = 0.05
"""Smallest distance of a particle from a sheet at the end of a step [spacings]."""
ROUNDS = 3
"""Greatest number of times that a particle is put back in a step."""
NONE = -1


@cache
def side_kernels(precision: Precision) -> Kernels:
    real, vector, matrix = precision.real, precision.vector, precision.matrix
    neighbourhood, sheets_of = neighbourhood_type(precision), sheets_type(precision)
    (scale_of, seen_from), (query, meets, goes_through) = sheet_functions(precision), face_functions(precision)
    bars = bundle(**share_kinds(precision), x=vector)
    modules = [kernel_module(f"sheet_sides{kind}_{precision.name}") for kind in ("", "_tangent", "_adjoint")]
    typed = TypesByName(vector, {neighbourhood: "s", sheets_of: "sheets", bars: "bar"})
    one, poses = wp.constant(real(1.0)), wp.array2d(dtype=vector)

    @wp.func
    def way_of(x: vector, x_now: vector, k: int, member: int, s: neighbourhood, sheets: sheets_of):
        start = seen_from(x, s.before, s.turns_before, k, member, s, sheets)
        return start, seen_from(x_now, s.after, s.turns, k, member, s, sheets)

    @wp.func
    def turn_of(k: int, member: int, s: neighbourhood, sheets: sheets_of) -> matrix:
        R = wp.identity(n=3, dtype=real)
        if sheets.numbers[k] >= 0:
            R = s.turns[member, sheets.numbers[k]]
        return R

    @wp.func
    def side_of(start: vector, face: int, sheets: sheets_of) -> real:
        h = wp.dot(sheets.faces.normals[face], start - sheets.faces.places[face, 0])
        return wp.where(h < real(0.0), -one, one)

    @wp.func
    def time_of(start: vector, y: vector, face: int, least: real, sheets: sheets_of) -> real:
        """Return the fraction of the path before the face. Return 1 if the path of a particle ends too close to a face
        without crossing the face, and 2 if the path does not meet the face."""
        n, a = sheets.faces.normals[face], sheets.faces.places[face, 0]
        side = side_of(start, face, sheets)
        h_0, h = side * wp.dot(n, start - a), side * wp.dot(n, y - a)
        found = real(2.0)
        if h < real(0.0):
            if meets(start, y, face, sheets.faces):
                found = h_0 / (h_0 - h)
        elif h < least:
            found = one
            for end in range(3):
                way = y - sheets.faces.places[face, end]
                if wp.dot(sheets.faces.inwards[face, end], way) < -sheets.faces.margin:
                    found = real(2.0)
        return found

    @wp.func
    def kept(start: vector, end: vector, k: int, least: real, sheets: sheets_of):
        """Return the new position, the touched faces, and 1 if the particle keeps its old position relative to the
        sheet, else 0."""
        y, used = end, wp.vec3i(NONE, NONE, NONE)
        rounds = int(ROUNDS)
        for round in range(rounds):
            first = int(NONE)
            earliest = real(2.0)
            face = int(0)
            candidates = query(start, y, least + sheets.faces.around, k, sheets.faces)
            while wp.bvh_query_next(candidates, face):
                f = sheets.faces.starts[k] + face
                if f != used[0] and f != used[1]:
                    t = time_of(start, y, f, least, sheets)
                    if t < earliest or (t == earliest and t < real(2.0) and f < first):
                        first = f
                        earliest = t
            if first != NONE:
                n, a = sheets.faces.normals[first], sheets.faces.places[first, 0]
                y += (side_of(start, first, sheets) * least - wp.dot(n, y - a)) * n
                used[round] = first
        stays = wp.where(goes_through(start, y, k, sheets.faces), 1, 0)
        if stays == 1:
            y = start
        return y, used, stays

    @typed.kernel(modules[0])
    def keep(s, sheets, k: int, least: real, x, x_now, x_kept):
        i = s.first + wp.tid()
        member = i // s.particles
        start, end = way_of(x[i], x_now[i], k, member, s, sheets)
        y, used, stays = kept(start, end, k, least / scale_of(k, member, s, sheets), sheets)
        number = sheets.numbers[k]
        x_end = vector(x_now[i])
        if used[0] != NONE or stays == 1:
            x_end = y + sheets.faces.middles[k]
            if number >= 0:
                x_end = s.after[member, number] + s.scales[member, number] * (s.turns[member, number] * x_end)
        x_kept[i] = x_end

    @wp.func
    def twist(x: vector, middles: poses, moved: poses, turned: poses, k: int, member: int, s: neighbourhood) -> vector:
        """Return the motion of the point ``x`` of a solid, given the changes of the solid's pose."""
        arm = x - middles[member, k]
        grown = s.scales_dot[member, k] / s.scales[member, k]
        return moved[member, k] + wp.cross(turned[member, k], arm) + grown * arm

    @typed.kernel(modules[1])
    def keep_tangent(s, sheets, k: int, least: real, x, x_dot, x_now, x_kept, x_now_dot):
        i = s.first + wp.tid()
        member, number = i // s.particles, sheets.numbers[k]
        start, end = way_of(x[i], x_now[i], k, member, s, sheets)
        _y, used, stays = kept(start, end, k, least / scale_of(k, member, s, sheets), sheets)
        if used[0] == NONE and stays == 0:
            return
        R, grown = turn_of(k, member, s, sheets), real(0.0)
        change = vector(x_now_dot[i])
        if number >= 0:
            grown = s.scales_dot[member, number] / s.scales[member, number]
            change -= twist(x_now[i], s.after, s.after_dot, s.turned_dot, number, member, s)
        rounds = int(ROUNDS)
        for round in range(rounds):
            if used[round] != NONE:
                N = R * sheets.faces.normals[used[round]]
                change -= (wp.dot(N, change) + side_of(start, used[round], sheets) * least * grown) * N
        if stays == 1:
            change = vector(x_dot[i])
            if number >= 0:
                change -= twist(x[i], s.before, s.before_dot, s.turned_before_dot, number, member, s)
                change = R * (wp.transpose(s.turns_before[member, number]) * change)
        if number >= 0:
            change += twist(x_kept[i], s.after, s.after_dot, s.turned_dot, number, member, s)
        x_now_dot[i] = change

    @typed.kernel(modules[2])
    def keep_adjoint(s, sheets, k: int, least: real, x, x_now, x_kept, x_now_bar, bar):
        i = s.first + wp.tid()
        member, number = i // s.particles, sheets.numbers[k]
        start, end = way_of(x[i], x_now[i], k, member, s, sheets)
        _y, used, stays = kept(start, end, k, least / scale_of(k, member, s, sheets), sheets)
        if used[0] == NONE and stays == 0:
            return
        R, grown = turn_of(k, member, s, sheets), real(0.0)
        whole, left = vector(x_now_bar[i]), vector(x_now_bar[i])
        rounds = int(ROUNDS)
        for back in range(rounds):
            face = used[rounds - 1 - back]
            if face != NONE and stays == 0:
                N = R * sheets.faces.normals[face]
                along = wp.dot(N, left)
                grown -= side_of(start, face, sheets) * least * along
                left -= along * N
        if stays == 1:
            left = vector()
            began = vector(whole)
            if number >= 0:
                began = s.turns_before[member, number] * (wp.transpose(R) * whole)
                arm = x[i] - s.before[member, number]
                bar.force_before[i] = bar.force_before[i] - began
                bar.torque_before[i] = bar.torque_before[i] - wp.cross(arm, began)
                grown -= wp.dot(arm, began)
            bar.x[i] = bar.x[i] + began
        x_now_bar[i] = left
        if number >= 0:
            arm, arm_kept = x_now[i] - s.after[member, number], x_kept[i] - s.after[member, number]
            bar.force[i] = bar.force[i] + whole - left
            bar.torque[i] = bar.torque[i] + wp.cross(arm_kept, whole) - wp.cross(arm, left)
            grown += wp.dot(arm_kept, whole) - wp.dot(arm, left)
            bar.growth[i] = bar.growth[i] + grown / s.scales[member, number]

    return Kernels(keep, keep_tangent, keep_adjoint)


class Sides:
    def __init__(self, sheets: Sheets, spacing: float, layout: Layout):
        self._kernels, self._sheets, count = side_kernels(layout.precision), sheets, len(sheets.numbers)
        self._known: dict[str, Any] = {"sheets": sheets.struct, "least": NEAREST * spacing}
        self._passes = [*range(count)] * (1 if count == 1 else 2)
        vector = layout.precision.vector
        self._kept = [layout.arrays(x=vector)["x"] for _ in self._passes]
        self._none = layout.arrays("_bar", **share_kinds(layout.precision))

    def keep(self, step: StepContext, x_now: wp.array) -> wp.array:
        """Return an array (n,) of sorted particles' corrected positions. ``x_now`` are the uncorrected positions."""
        for k, x_kept in zip(self._passes, self._kept, strict=True):
            step.launch(self._kernels.forward, self._known, k=k, x_now=x_now, x_kept=x_kept)
            x_now = x_kept
        return x_now

    def tangent(self, step: StepContext, dot: Tangents, x_now: wp.array, x_now_dot: wp.array) -> None:
        self.keep(step, x_now)
        for k, x_kept in zip(self._passes, self._kept, strict=True):
            own = {"x_now": x_now, "x_kept": x_kept, "x_now_dot": x_now_dot}
            step.launch(self._kernels.tangent, *dot.named, self._known, own, k=k)
            x_now = x_kept

    def adjoint(self, step: StepContext, bar: Adjoints, x_now: wp.array, x_now_bar: wp.array) -> None:
        """Apply the adjoint of `keep`. Update ``x_now_bar``, and add to the adjoints of solids and of old positions."""
        self.keep(step, x_now)
        given = [x_now, *self._kept]
        for k, before, x_kept in reversed([*zip(self._passes, given, self._kept, strict=False)]):
            number = self._sheets.numbers[k]
            shares = bar.solids.of(number) if number >= 0 else self._none
            own = {"x_now": before, "x_kept": x_kept, "x_now_bar": x_now_bar}
            step.launch(self._kernels.adjoint, *bar.named, self._known, shares, own, k=k)
