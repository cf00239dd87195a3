"""Sums over particles for sensors, computed on the device during a run.

After a chunk of steps, the device computes the sums of `cortado.runs.particle_sums` for all states of the chunk, in
float64 and in a fixed order.
"""

from collections.abc import Callable, Mapping
from functools import cache, partial
from math import isqrt
from types import SimpleNamespace
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from cortado.device.launching import recorded
from cortado.device.modules import kernel_module
from cortado.device.precision import FLOAT64, Precision, TypesByName
from cortado.discretise.room import Domain
from cortado.discretise.shapes import in_space
from cortado.errors import InputError
from cortado.particles.state import Parameters, State, StateSeries
from cortado.runs.particle_sums import LoadSum, ParticleSum, RegionSum, Ride, WeightedSum, square
from cortado.runs.quantity_formulas import SIX, QuantityFormula
from cortado.runs.sensor import SensedScene
from cortado.scene.motions import AXES
from cortado.solvers.particles import ParticleSolver
from cortado.sph.moving_solids import rotations
from cortado.sph.parts import orders_of


@wp.struct
class _Around:
    place: wp.vec3d
    lower: wp.vec3d
    lengths: wp.vec3d
    seen: wp.mat33d
    turns: wp.mat33d
    steps: wp.mat33d
    reach: wp.float64
    widest: wp.float64
    share: wp.float64
    along: wp.vec3d
    offsets: wp.array(dtype=wp.vec3d)


@wp.struct
class _Region:
    start: wp.vec3d
    lengths: wp.vec3d
    lower: wp.vec3d
    upper: wp.vec3d
    about: wp.vec3d


@wp.struct
class _Ride:
    arm: wp.vec3d
    own: wp.mat33d
    turns: int


@cache
def _rides(precision: Precision, dimension: int) -> SimpleNamespace:
    angle, of = rotations(precision, dimension).angle, rotations(FLOAT64, dimension)
    module = kernel_module(f"sensors_on_solids_{precision.name}_{dimension}")
    wide = wp.float64 if dimension == 2 else wp.vec3d
    typed = TypesByName(precision.vector, {angle: "rotation turn", wp.vec3d: "places", wp.mat33d: "views"})

    @wp.func(module=module)
    def carry(
        k: int, a: _Ride, c: wp.vec3d, r: wp.mat33d, places: wp.array(dtype=wp.vec3d), views: wp.array(dtype=wp.mat33d)
    ):
        turn = r * a.own
        places[k] = c + turn * a.arm
        views[k] = wp.where(a.turns > 0, wp.transpose(turn), wp.identity(n=3, dtype=wp.float64))

    @wp.kernel(module=module, enable_backward=False)
    @typed.arrays
    def told(a: _Ride, position, rotation, turn, places, views):
        k = wp.tid()
        begun = of.rotation(wide(rotation[k]))
        carry(k, a, wp.vec3d(position[k]), of.rotation(wide(turn[k])) * begun, places, views)

    @wp.kernel(module=module, enable_backward=False)
    @typed.arrays
    def free(a: _Ride, position, rotation, x, y, z, places, views):
        k = wp.tid()
        q = wp.matrix_from_cols(wp.vec3d(x[k]), wp.vec3d(y[k]), wp.vec3d(z[k])) + wp.identity(n=3, dtype=wp.float64)
        carry(k, a, wp.vec3d(position[k]), q * of.rotation(wide(rotation[k])), places, views)

    return SimpleNamespace(told=told, free=free)


@cache
def _kernels(precision: Precision) -> SimpleNamespace:
    real, vector = precision.real, precision.vector
    module, numbers = kernel_module(f"particle_sums_{precision.name}"), wp.array(dtype=real)

    @wp.func(module=module)
    def of_state(first: wp.array(dtype=vector), later: wp.array(dtype=vector), i: int, before: int) -> vector:
        if i < before:
            return first[i]
        return later[i - before]

    @wp.func(module=module)
    def doubled(x: vector) -> wp.vec3d:
        return wp.vec3d(wp.float64(x[0]), wp.float64(x[1]), wp.float64(x[2]))

    @wp.func(module=module)
    def placed(x: vector, start: wp.vec3d, lengths: wp.vec3d) -> wp.vec3d:
        """Return the periodic image of a particle in the periodic box with the lower corner ``start``."""
        y = doubled(x)
        for k in range(3):
            if lengths[k] > wp.float64(0.0):
                rest = y[k] - start[k]
                rest = rest - wp.floor(rest / lengths[k]) * lengths[k]
                y[k] = start[k] + wp.where(rest >= lengths[k], wp.float64(0.0), rest)
        return y

    @wp.func(module=module)
    def from_a_solid(
        row: int, y: wp.vec3d, places: wp.array(dtype=wp.vec3d), views: wp.array(dtype=wp.mat33d)
    ) -> wp.vec3d:
        return views[row] * (y - places[row])

    @wp.func(module=module)
    def weight(
        a: _Around, x: vector, row: int, places: wp.array(dtype=wp.vec3d), views: wp.array(dtype=wp.mat33d)
    ) -> wp.float64:
        """Return the weight of a particle, averaged over its parts and summed over periodic images."""
        y = placed(x, a.lower, a.lengths)
        way = y - a.place
        if places.shape[0] > 0:
            way = from_a_solid(row, y, places, views)
        way = a.seen * way
        turns = a.turns * way
        way = way - a.steps * wp.vec3d(wp.rint(turns[0]), wp.rint(turns[1]), wp.rint(turns[2]))
        total = wp.float64(0.0)
        if wp.dot(way, way) < a.widest * a.widest:
            for k in range(a.offsets.shape[0]):
                q = wp.length(way + a.offsets[k]) / a.reach
                if q < wp.float64(1.0):
                    square = (wp.float64(1.0) - q) * (wp.float64(1.0) - q)
                    total += square * square * (wp.float64(1.0) + wp.float64(4.0) * q)
        return a.share * total

    typed = TypesByName(vector, {SIX: "partial total", wp.vec3d: "places", wp.mat33d: "views"})

    @wp.kernel(module=module, enable_backward=False)
    @typed.arrays
    def weighted(
        particles: int, before: int, stride: int, a: _Around, x_first, x, v_first, v, q: numbers, places, views, partial
    ):
        state, total = wp.tid() // stride, SIX()
        row = state * particles
        for i in range(row + wp.tid() % stride, row + particles, stride):
            w = weight(a, of_state(x_first, x, i, before), state, places, views)
            if w > wp.float64(0.0):
                value = wp.float64(0.0)
                if q.shape[0] > 0:
                    value = wp.float64(q[i])
                else:
                    value = wp.dot(doubled(of_state(v_first, v, i, before)), a.along)
                total[0] = total[0] + w
                total[1] = total[1] + w * value
        partial[wp.tid()] = total

    @wp.kernel(module=module, enable_backward=False)
    @typed.arrays
    def within(particles: int, before: int, stride: int, a: _Region, x_first, x, q, places, views, partial):
        state, total = wp.tid() // stride, SIX()
        row = state * particles
        for i in range(row + wp.tid() % stride, row + particles, stride):
            y = placed(of_state(x_first, x, i, before), a.start, a.lengths)
            if places.shape[0] > 0:
                y = a.about + from_a_solid(state, y, places, views)
            inside = bool(True)
            for k in range(3):
                inside = inside and y[k] >= a.lower[k] and y[k] < a.upper[k]
            if inside:
                f = doubled(q[i])
                if places.shape[0] > 0:
                    f = views[state] * f
                torque = wp.cross(y - a.about, f)
                for k in range(3):
                    total[k] = total[k] + f[k]
                    total[k + 3] = total[k + 3] + torque[k]
        partial[wp.tid()] = total

    @wp.kernel(module=module, enable_backward=False)
    @typed.arrays
    def join(stride: int, partial, total):
        found = SIX()
        for t in range(stride):
            found += partial[wp.tid() * stride + t]
        total[wp.tid()] = found

    return SimpleNamespace(weighted=weighted, within=within, join=join)


class StepQuantities:
    def __init__(self, formulas: Mapping[str, QuantityFormula], solver: ParticleSolver, length: int):
        self._formulas, self._solver, self._length, self.kept = formulas, solver, length, dict[str, wp.array]()

    def launch(self, step: int, parameters: Parameters) -> None:
        solver, context = self._solver, self._solver.context(parameters)
        pressures = solver.pressures()
        if pressures is None:
            raise InputError("The solver of this scene computes no pressure, so that no pressure can be read.")
        for name, formula in self._formulas.items():
            found = formula.value(context, pressures)
            if name not in self.kept:
                self.kept[name] = wp.zeros(self._length * len(found), dtype=found.dtype, device=found.device)
            own = self.of_step(name, step)
            if found.dtype is SIX:
                wp.copy(own, found)
            else:
                context.launch(orders_of(found).unsort, a=found, a_scene=own)

    def of_step(self, name: str, step: int) -> wp.array:
        """Return a load, or a quantity in the order of the scene."""
        size = len(self.kept[name]) // self._length
        return self.kept[name][step * size : (step + 1) * size]


class CarriedRows:
    def __init__(self, ride: Ride, point: NDArray[Any], scene: SensedScene, solver: ParticleSolver, rows: int):
        """``point`` (d,) [m] is the initial place of the sensor."""
        table, layout = ride.table(scene), solver.layout
        self._device, self._members, self._ride = solver.device, layout.members, _Ride()
        self._ride.arm = wp.vec3d(*in_space(point - table.middle()))
        self._ride.own = wp.mat33d(*square(table.turn(scene.dimension)).T.ravel())
        self._ride.turns = int(ride.turns)
        kernels, is_free = _rides(layout.precision, scene.dimension), table.motion == "free"
        self._kernel = kernels.free if is_free else kernels.told
        last = dict(zip("xyz", AXES, strict=True)) if is_free else {"turn": "turn"}
        fields = {
            label: f"{table.name}.{end}"
            for label, end in {"position": "position", "rotation": "rotation", **last}.items()
        }
        like = layout.state(tuple(field for field in solver.state_fields if field.name in fields.values()))
        self._fields = {name: wp.empty(rows, dtype=like[name].dtype, device=solver.device) for name in fields.values()}
        self._arguments = {label: self._fields[name] for label, name in fields.items()}
        self.places = wp.empty(rows, dtype=wp.vec3d, device=solver.device)
        self.views = wp.empty(rows, dtype=wp.mat33d, device=solver.device)

    def recorded(self, rows: int, first: State, later: StateSeries) -> list[Callable[[], None]]:
        members, behind = self._members, rows - self._members
        copies = [partial(wp.copy, own, first[name], count=members) for name, own in self._fields.items()]
        if behind:
            series = ((own, later.whole(name)) for name, own in self._fields.items())
            copies += [partial(wp.copy, own, whole, dest_offset=members, count=behind) for own, whole in series]
        found = {"places": self.places, "views": self.views}
        return [*copies, recorded(self._kernel, rows, self._device, a=self._ride, **self._arguments, **found)]


class ChunkSums:
    def __init__(self, summed: ParticleSum, scene: SensedScene, solver: ParticleSolver, length: int):
        layout, self._summed, domain = solver.layout, summed, scene.lattice.domain
        self._scenes, self._particles, self._device = layout.members, layout.particles, solver.device
        self._stride, self._kernels = isqrt(layout.particles - 1) + 1, _kernels(layout.precision)
        self._none, rows = wp.empty(0, dtype=layout.precision.real, device=solver.device), length * layout.members
        self._partial = wp.empty(rows * self._stride, dtype=SIX, device=solver.device)
        self._total = wp.zeros(rows, dtype=SIX, device=solver.device)
        self._launches: dict[tuple[int, int], list[Callable[[], None]]] = {}
        self._setting: Any = None
        point: NDArray[Any] | None = None
        if isinstance(summed, WeightedSum):
            self._setting, point = _around(summed, domain, solver.device), summed.around.place
        elif isinstance(summed, RegionSum):
            self._setting, point = _region(summed, domain), summed.about
        ride = getattr(summed, "ride", None)
        self._carried = None if ride is None or point is None else CarriedRows(ride, point, scene, solver, rows)

    def launch(self, count: int, first: State, later: StateSeries, kept: Mapping[str, wp.array]) -> wp.array:
        """Return an array with a sum for each state and scene."""
        if isinstance(self._summed, LoadSum):
            return self._total if self._summed.quantity is None else kept[self._summed.quantity]
        key = count, first.positions.ptr
        if key not in self._launches:
            self._launches[key] = self._recorded(self._summed, count, first, later, kept)
        for each in self._launches[key]:
            each()
        return self._total

    def _recorded(
        self, summed: ParticleSum, count: int, first: State, later: StateSeries, kept: Mapping[str, wp.array]
    ) -> list[Callable[[], None]]:
        rows = count * self._scenes
        sizes = {"particles": self._particles, "before": self._scenes * self._particles, "stride": self._stride}
        fields = {"x_first": first.positions, "x": later.whole("positions"), "a": self._setting}
        kernel = self._kernels.within
        if isinstance(summed, WeightedSum):
            kernel = self._kernels.weighted
            fields |= {"v_first": first.velocities, "v": later.whole("velocities")}
        fields["q"] = self._none if summed.quantity is None else kept[summed.quantity]
        join = {"stride": self._stride, "partial": self._partial, "total": self._total}
        carried = self._carried
        none = (wp.empty(0, dtype=dtype, device=self._device) for dtype in (wp.vec3d, wp.mat33d))
        fields["places"], fields["views"] = none if carried is None else (carried.places, carried.views)
        return [
            *([] if carried is None else carried.recorded(rows, first, later)),
            recorded(kernel, rows * self._stride, self._device, **sizes, **fields, partial=self._partial),
            recorded(self._kernels.join, rows, self._device, **join),
        ]


def _around(summed: WeightedSum, domain: Domain, device: Any) -> Any:
    around, found = summed.around, _Around()
    d, shifts = len(around.place), around.shifts()
    widest = around.reach + float(np.linalg.norm(shifts, axis=1).max())
    steps, inverse, images = domain.images(widest, around.across)
    offsets = (images[:, None] + shifts).reshape(-1, shifts.shape[1])
    found.place, found.seen = wp.vec3d(*in_space(around.place)), wp.mat33d(*_square(around.across(np.eye(d)).T))
    found.lower, found.lengths, _ = domain.vectors(wp.vec3d)
    found.turns, found.steps = wp.mat33d(*_square(inverse.T)), wp.mat33d(*_square(steps.T))
    found.reach, found.share = around.reach, 1.0 / len(shifts)
    found.widest = float(np.linalg.norm(offsets, axis=1).max()) + around.reach
    found.along = wp.vec3d(*in_space(np.zeros(d) if summed.along is None else summed.along))
    found.offsets = wp.array(in_space(offsets), dtype=wp.vec3d, device=device)
    return found


def _region(summed: RegionSum, domain: Domain) -> Any:
    found, (start, lower, upper) = _Region(), domain.ends(summed.lower, summed.upper)
    found.start, found.about = wp.vec3d(*in_space(start)), wp.vec3d(*in_space(summed.about))
    beyond = [np.inf] * (3 - len(lower))
    found.lower, found.upper = wp.vec3d(*lower, *(-end for end in beyond)), wp.vec3d(*upper, *beyond)
    found.lengths = domain.vectors(wp.vec3d)[1]
    return found


def _square(matrix: NDArray[Any]) -> NDArray[Any]:
    return np.pad(matrix, [(0, 3 - size) for size in matrix.shape]).ravel()
