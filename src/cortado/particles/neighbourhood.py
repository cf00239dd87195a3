"""The neighbourhood of a particle, as one argument of kernels that sum over neighbours, wall particles and images.

Warp functions here load array entries without Warp's support of negative indices, which costs a comparison and an
addition per load.
"""

from dataclasses import dataclass, replace
from functools import cache
from types import SimpleNamespace
from typing import Any

import warp as wp

from cortado.device.modules import by_name, kernel_module, kind_of
from cortado.device.precision import Precision, arithmetic, lane_functions, set_lanes
from cortado.discretise.smoothing import SmoothingKernel
from cortado.discretise.smoothing_functions import smoothing_functions
from cortado.particles.mirrors import mirror_functions


@cache
def loads(precision: Precision, taped: bool) -> SimpleNamespace:
    """Make the Warp functions that load one element, at indices that are not negative, of a list [neighbour, particle]
    or of a contiguous array. A tape can differentiate ``taped`` functions."""
    return _of_warp(precision) if taped else _direct(precision)


def _of_warp(precision: Precision) -> SimpleNamespace:
    real, vector, six = precision.real, precision.vector, precision.six

    @wp.func
    def load_neighbour(lists: wp.array2d(dtype=wp.int32), k: int, i: int) -> int:
        return lists[k, i]

    @wp.func
    def load_vector(a: wp.array(dtype=vector), j: int) -> vector:
        return a[j]

    @wp.func
    def load_number(a: wp.array(dtype=real), j: int) -> real:
        return a[j]

    @wp.func
    def load_six(a: wp.array(dtype=six), j: int) -> six:
        return a[j]

    return by_name(load_neighbour, load_vector, load_number, load_six)


def _direct(precision: Precision) -> SimpleNamespace:
    real, vector, six = precision.real, precision.vector, precision.six
    two = {4: "float2", 8: "double2"}[precision.bytes]
    by_two = f"const {two}* p = (const {two}*)(a.data + j); {two} u = p[0], v = p[1], w = p[2]; "
    by_two += "return {{u.x, u.y, v.x, v.y, w.x, w.y}};"
    place = "(long long)i * lists.strides[1] + (long long)k * lists.strides[0]"

    @wp.func_native(f"return *(const int*)((const char*)lists.data + {place});")
    def load_neighbour(lists: wp.array2d(dtype=wp.int32), k: int, i: int) -> int: ...

    @wp.func_native("return a.data[j];")
    def load_vector(a: wp.array(dtype=vector), j: int) -> vector: ...

    @wp.func_native("return a.data[j];")
    def load_number(a: wp.array(dtype=real), j: int) -> real: ...

    @wp.func_native(f"#if defined(__CUDA_ARCH__)\n{by_two}\n#else\nreturn a.data[j];\n#endif\n")
    def load_six(a: wp.array(dtype=six), j: int) -> six: ...

    return by_name(load_neighbour, load_vector, load_number, load_six)


UNROLL = 4
"""Number of fluid neighbours that a loop processes together, so that their loads overlap. Lists are padded to a
multiple of `UNROLL` with the particle itself, which only adds W(0) to the density."""


@dataclass(frozen=True)
class Discretisation:
    smoothing: SmoothingKernel
    precision: Precision
    lanes: int = 1
    """Number of GPU threads for each particle, see `cortado.device.precision`."""
    periodic: bool = False
    moving: bool = False
    taped: bool = False
    """True for forward kernels with Warp's adjoint, for a tape; they need a single lane."""

    @property
    def types(self) -> tuple[Any, Any, Any]:
        return self.precision.real, self.precision.vector, neighbourhood_type(self.precision)

    @property
    def lane(self) -> Any:
        return lane_functions(self.precision, self.lanes).lane

    @property
    def still(self) -> "Discretisation":
        """A copy with walls at rest, for terms that are linear in the fluid's velocities alone."""
        return replace(self, moving=False)

    def module(self, forward: bool, topic: str) -> Any:
        """Return the Warp module of forward or adjoint kernels; ``topic`` is that of a file or solver."""
        return self._module(kind_of(forward, self.taped), topic, forward and self.taped)

    def tangent_module(self, topic: str) -> Any:
        return self._module("tangent", topic, False)

    def modules(self, topic: str) -> tuple[Any, Any, Any]:
        return self.module(True, topic), self.tangent_module(topic), self.module(False, topic)

    def _module(self, kind: str, topic: str, enable_backward: bool) -> Any:
        images = "_periodic" * self.periodic + "_moving" * self.moving
        lanes = "" if self.lanes == 1 else f"_{self.lanes}_lanes"
        beside = f"{images}{lanes}_beside_taped" if self.taped and not enable_backward else f"{images}{lanes}"
        module = kernel_module(f"{topic}_{kind}_{self.smoothing.name}_{self.precision.name}{beside}", enable_backward)
        set_lanes(module, self.lanes)
        return module


@cache
def neighbourhood_type(precision: Precision) -> Any:
    """Make the Warp struct of a neighbourhood; arrays are sorted by cell, lists are [neighbour, particle]."""
    real, vector, matrix = precision.real, precision.vector, precision.matrix

    class Neighbourhood:
        first: wp.int32
        part: wp.int32
        particles: wp.int32
        """Number of particles of one scene; particle i belongs to scene i // particles of a batch."""
        neighbours: wp.array2d(dtype=wp.int32)
        """Fluid neighbours, padded with the particle itself, then wall neighbours, then images within reach."""
        fluid_count: wp.array(dtype=wp.int32)
        """Length of the padded list of fluid neighbours, a multiple of `UNROLL`."""
        filling: wp.array(dtype=wp.int32)
        count: wp.array(dtype=wp.int32)
        all_count: wp.array(dtype=wp.int32)
        wall_positions: wp.array(dtype=vector)
        """[m]"""
        wall_weights: wp.array(dtype=real)
        """w_b [-]: weight of a wall particle in the density; that of a fluid particle is 1."""
        wall_grips: wp.array(dtype=real)
        """w_b of walls without slip, 0 of others [-]."""
        wall_velocities: wp.array(dtype=vector)
        """Velocity of the surface point above a wall particle [m/s]; used if the `Discretisation` is moving."""
        wall_feet: wp.array(dtype=vector)
        """Vector from a wall particle to the nearest point of the surface [m]."""
        wall_solids: wp.array(dtype=wp.int32)
        """Number of the solid: from 0 on if it moves, from -2 downwards if it rests; -1 for the container."""
        wall_positions_dot: wp.array(dtype=vector)
        """Tangents of wall particles, only if walls move."""
        wall_velocities_dot: wp.array(dtype=vector)
        wall_turns_dot: wp.array(dtype=vector)
        """Tangents of the rotation of a wall particle's solid, rotation vectors."""
        wall_growths_dot: wp.array(dtype=real)
        """Relative tangents of weights and grips [-]."""
        support: real
        """Support radius h [m]."""
        per_support: real
        """1 / h [1 / m]."""
        reach: real
        """Search radius [m], a little above the support radius."""
        normalisation: real
        """sigma of the kernel [1 / m^d]."""
        self_weight: real
        """W(0) [1 / m^d]."""
        response_scale: real
        """(sum_j |G_j|^2)^(-1/2) of a filled neighbourhood [m^(d + 1)], for the relaxation beside walls."""
        laplacian_correction: real
        """Correction factor of second derivatives [-], see `cortado.discretise.smoothing`."""
        volume: real
        """Volume V of a particle [m^d] with which the rest lattice has the rest density."""
        period: vector
        """[m], 0 along an axis that is not periodic."""
        frequency: vector
        """1 / period [1 / m], or 0."""
        mirror_lower: vector
        """Coordinates of mirroring walls at the lower ends of the axes [m], -inf without one."""
        mirror_upper: vector
        faces: wp.int32
        """Number of mirroring flat faces of moving solids; the following fields are used only if walls move."""
        face_solids: wp.array(dtype=wp.int32)
        face_places: wp.array(dtype=vector)
        """Middles of the faces in the frames of their solids [m]."""
        face_frames: wp.array(dtype=matrix)
        """Rows: the normal towards the fluid and two unit vectors along a face, in the solid's frame."""
        face_sizes: wp.array(dtype=vector)
        """0, and half the lengths of a face along its unit vectors [m]."""
        wall_faces: wp.array(dtype=wp.int32)
        """Number of the face in front of a wall particle, or -1."""
        after: wp.array2d(dtype=vector)
        """(members, solids), like the following fields: poses of solids, see `pose_arrays`."""
        turns: wp.array2d(dtype=matrix)
        before: wp.array2d(dtype=vector)
        turns_before: wp.array2d(dtype=matrix)
        scales: wp.array2d(dtype=real)
        after_dot: wp.array2d(dtype=vector)
        turned_dot: wp.array2d(dtype=vector)
        before_dot: wp.array2d(dtype=vector)
        turned_before_dot: wp.array2d(dtype=vector)
        scales_dot: wp.array2d(dtype=real)

    Neighbourhood.__qualname__ = f"Surroundings_{precision.name}"
    Neighbourhood.__name__ = Neighbourhood.__qualname__
    return wp.struct(Neighbourhood)


@cache
def pair_functions(discretisation: Discretisation) -> SimpleNamespace:
    """Make the Warp functions of a separation x in a neighbourhood.

    ``separation`` is x_i - x_j of the nearest image. With the kernel's gradient G = a x, ``slope`` is a,
    ``slope_change`` u^T grad a, ``slope_gradient`` grad a, and ``hessian_product`` H u = a u + (u^T grad a) x.
    ``per_size`` is 1 / (|x|^2 + 0.01 h^2). ``factor`` is F = laplacian_correction per_size x^T G, for second
    derivatives after Brookshaw (1985). ``neighbour`` is the k-th in the list of i, ``several`` the numbers of `UNROLL`
    neighbours from the k-th on. ``vectors``, ``numbers`` and ``sixes`` load the entries of several neighbours together.
    The functions of `loads` and `mirror_functions` are included.
    """
    real, vector = discretisation.precision.real, discretisation.precision.vector
    neighbourhood = neighbourhood_type(discretisation.precision)
    smooth = smoothing_functions(discretisation.smoothing, discretisation.precision, discretisation.taped)
    smooth_weight, smooth_slope, smooth_slope_change = smooth.weight, smooth.slope, smooth.slope_change
    smooth_slope_gradient = smooth.slope_gradient
    reciprocal = arithmetic(discretisation.precision, discretisation.taped).reciprocal
    load = loads(discretisation.precision, discretisation.taped)
    load_neighbour, load_vector = load.load_neighbour, load.load_vector
    load_number, load_six = load.load_number, load.load_six
    six, six_rows = discretisation.precision.six, wp.types.matrix(shape=(UNROLL, 6), dtype=real)
    rows = wp.types.matrix(shape=(UNROLL, 3), dtype=real)
    row = wp.types.vector(length=UNROLL, dtype=real)

    @wp.func
    def difference(x_i: vector, x_j: vector, s: neighbourhood) -> vector:
        return x_i - x_j

    @wp.func
    def nearest_image(x_i: vector, x_j: vector, s: neighbourhood) -> vector:
        x_ij = x_i - x_j
        turns = vector(
            wp.round(x_ij[0] * s.frequency[0]), wp.round(x_ij[1] * s.frequency[1]), wp.round(x_ij[2] * s.frequency[2])
        )
        return x_ij - wp.cw_mul(turns, s.period)

    @wp.func
    def weight(x: vector, s: neighbourhood) -> real:
        return smooth_weight(x, s.per_support, s.normalisation)

    @wp.func
    def slope(x: vector, s: neighbourhood) -> real:
        return smooth_slope(x, s.per_support, s.normalisation)

    @wp.func
    def slope_change(x: vector, u: vector, s: neighbourhood) -> real:
        return smooth_slope_change(x, u, s.per_support, s.normalisation)

    @wp.func
    def slope_gradient(x: vector, s: neighbourhood) -> vector:
        return smooth_slope_gradient(x, s.per_support, s.normalisation)

    @wp.func
    def gradient(x: vector, s: neighbourhood) -> vector:
        return slope(x, s) * x

    @wp.func
    def hessian_product(x: vector, u: vector, s: neighbourhood) -> vector:
        return slope(x, s) * u + slope_change(x, u, s) * x

    @wp.func
    def per_size(x: vector, s: neighbourhood) -> real:
        return reciprocal(wp.dot(x, x) + real(0.01) * s.support * s.support)

    @wp.func
    def factor(x: vector, s: neighbourhood) -> real:
        return s.laplacian_correction * slope(x, s) * wp.dot(x, x) * per_size(x, s)

    @wp.func
    def factor_gradient(x: vector, s: neighbourhood) -> vector:
        per_d = per_size(x, s)
        a = slope(x, s)
        change = real(2.0) * a + slope_change(x, x, s) - real(2.0) * a * wp.dot(x, x) * per_d
        return (s.laplacian_correction * per_d * change) * x

    @wp.func
    def neighbour(k: int, i: int, s: neighbourhood) -> int:
        return load_neighbour(s.neighbours, k, i)

    @wp.func
    def several(k: int, i: int, s: neighbourhood) -> wp.vec4i:
        return wp.vec4i(neighbour(k, i, s), neighbour(k + 1, i, s), neighbour(k + 2, i, s), neighbour(k + 3, i, s))

    @wp.func
    def vectors(a: wp.array(dtype=vector), j: wp.vec4i) -> rows:
        return wp.matrix_from_rows(
            load_vector(a, j[0]), load_vector(a, j[1]), load_vector(a, j[2]), load_vector(a, j[3])
        )

    @wp.func
    def numbers(a: wp.array(dtype=real), j: wp.vec4i) -> row:
        return row(load_number(a, j[0]), load_number(a, j[1]), load_number(a, j[2]), load_number(a, j[3]))

    @wp.func
    def sixes(a: wp.array(dtype=six), j: wp.vec4i) -> six_rows:
        return wp.matrix_from_rows(load_six(a, j[0]), load_six(a, j[1]), load_six(a, j[2]), load_six(a, j[3]))

    of_kernel = by_name(weight, slope, slope_change, slope_gradient, gradient, hessian_product)
    own = by_name(per_size, factor, factor_gradient, neighbour, several, vectors, numbers, sixes)
    return SimpleNamespace(
        separation=nearest_image if discretisation.periodic else difference,
        **vars(of_kernel),
        **vars(own),
        **vars(load),
        **mirror_functions(discretisation.precision, discretisation.moving, neighbourhood),
    )
