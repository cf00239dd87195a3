"""The neighbourhood of a particle, as one argument of kernels that sum over neighbours, wall particles and images."""

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
    """Indices must not be negative. A Warp tape can record the ``taped`` functions of arrays."""
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
"""Number of fluid neighbours that a loop processes together."""


@dataclass(frozen=True)
class Discretisation:
    smoothing: SmoothingKernel
    precision: Precision
    lanes: int = 1
    """Number of GPU threads for each particle. See `cortado.device.precision`."""
    periodic: bool = False
    moving: bool = False
    taped: bool = False
    """True if a Warp tape differentiates the forward kernels, which then need a single thread per particle."""

    @property
    def types(self) -> tuple[Any, Any, Any]:
        return self.precision.real, self.precision.vector, neighbourhood_type(self.precision)

    @property
    def lane(self) -> Any:
        return lane_functions(self.precision, self.lanes).lane

    @property
    def still(self) -> "Discretisation":
        return replace(self, moving=False)

    def module(self, forward: bool, topic: str) -> Any:
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
    """A neighbourhood has its arrays sorted by cell."""
    real, vector, matrix = precision.real, precision.vector, precision.matrix

    class Neighbourhood:
        first: wp.int32
        part: wp.int32
        particles: wp.int32
        neighbours: wp.array2d(dtype=wp.int32)
        """Lists [neighbour, particle] of fluid neighbours, then wall neighbours, then images. Lists of fluid neighbours
        are padded with the particle itself."""
        fluid_count: wp.array(dtype=wp.int32)
        """Length (n,) of the padded list of fluid neighbours of each particle."""
        filling: wp.array(dtype=wp.int32)
        count: wp.array(dtype=wp.int32)
        all_count: wp.array(dtype=wp.int32)
        wall_positions: wp.array(dtype=vector)
        """Positions of wall particles [m]. `cortado.particles.moving_walls.WallArrays` describes the other arrays of
        wall particles."""
        wall_weights: wp.array(dtype=real)
        wall_grips: wp.array(dtype=real)
        wall_velocities: wp.array(dtype=vector)
        wall_feet: wp.array(dtype=vector)
        wall_solids: wp.array(dtype=wp.int32)
        wall_positions_dot: wp.array(dtype=vector)
        wall_velocities_dot: wp.array(dtype=vector)
        wall_turns_dot: wp.array(dtype=vector)
        """Tangents of the rotations of the solids to which wall particles belong, as rotation vectors."""
        wall_growths_dot: wp.array(dtype=real)
        """Tangents of the weights of wall particles, divided by the weights [-]."""
        support: real
        per_support: real
        reach: real
        """Search radius [m], slightly larger than the support radius."""
        normalisation: real
        """Normalisation factor of the smoothing kernel [1 / m^d]."""
        self_weight: real
        """Smoothing kernel at distance 0 [1 / m^d]."""
        response_scale: real
        """Inverse square root of `cortado.discretise.smoothing.wall_response` [m^(d + 1)]."""
        laplacian_correction: real
        """Correction factor of second derivatives [-]. See `cortado.discretise.smoothing`."""
        volume: real
        period: vector
        """Lengths of the periodic box [m], 0 along axes that are not periodic."""
        frequency: vector
        """Inverse lengths of the periodic box [1 / m], 0 along axes that are not periodic."""
        mirror_lower: vector
        """Coordinates of mirroring walls at the lower ends of the axes [m], or -inf."""
        mirror_upper: vector
        faces: wp.int32
        """Number of flat faces of moving solids that mirror the fluid."""
        face_solids: wp.array(dtype=wp.int32)
        face_places: wp.array(dtype=vector)
        """Middles of the faces in the frames of their solids [m]."""
        face_frames: wp.array(dtype=matrix)
        """Matrix for each face, in the frame of its solid. The rows of the matrix are the normal towards the fluid and
        two unit vectors along the face."""
        face_sizes: wp.array(dtype=vector)
        """Vector (0, a, b) for each face: a and b are half of the face's two side lengths [m]."""
        wall_faces: wp.array(dtype=wp.int32)
        after: wp.array2d(dtype=vector)
        """Positions of the middles of solids after the time step (members, solids) [m]."""
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
    """Make the Warp functions of the separation of two particles, such as the gradient of the smoothing kernel W. For
    the separation x the gradient is a x, where a is the derivative of W divided by the distance.

    - ``separation`` is x_i - x_j, to the nearest periodic image.
    - ``slope`` is a, ``slope_gradient`` is grad a, and ``slope_change`` is u^T grad a for a vector u.
    - ``hessian_product`` is the Hessian of W times u, which is a u + (u^T grad a) x.
    - ``per_size`` is 1 / (|x|^2 + 0.01 h^2), with the support radius h.
    - ``factor`` is the factor of second derivatives after Brookshaw (1985).
    - ``neighbour`` loads one neighbour of particle i, and ``several`` loads `UNROLL` neighbours.
    - ``vectors``, ``numbers`` and ``sixes`` load the values of several neighbours together.

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
    of_mirrors = mirror_functions(discretisation.precision, discretisation.moving, neighbourhood)
    separation = nearest_image if discretisation.periodic else difference
    return SimpleNamespace(separation=separation, **vars(of_kernel), **vars(own), **vars(load), **of_mirrors)
