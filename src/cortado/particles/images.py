"""Lists of the images that particles see in flat walls (`cortado.particles.mirrors`)."""

from functools import cache
from typing import Any

import warp as wp

from cortado.device.lanes import lane_functions
from cortado.particles.candidates import append_function
from cortado.particles.loads import loads
from cortado.particles.mirrors import REFLECTIONS
from cortado.particles.neighbourhood import Discretisation, neighbourhood_type, pair_functions


@cache
def image_kernel(discretisation: Discretisation) -> Any:
    """The kernel that appends images to lists of neighbours, of which and of the particle itself they are."""
    vector, neighbourhood = discretisation.precision.vector, neighbourhood_type(discretisation.precision)
    pair, load = pair_functions(discretisation), loads(discretisation.precision, discretisation.taped)
    separation, reflects, reflection = pair.separation, pair.reflects, pair.reflection
    near_mirrors, before_mirrors = pair.near_mirrors, pair.before_mirrors
    load_vector, neighbour = load.vector, pair.neighbour
    LANES = discretisation.lanes
    lane, append = lane_functions(discretisation.precision, LANES).lane, append_function(discretisation)

    @wp.kernel(module=discretisation.module(True, "neighbours"), enable_backward=False)
    def fill_images(
        s: neighbourhood,
        bad_step: wp.array(dtype=wp.int32),
        x: wp.array(dtype=vector),
        # in and out
        all_count: wp.array(dtype=wp.int32),
        needed: wp.array(dtype=wp.int32),
    ):
        """``needed`` as in `cortado.particles.neighbours.fill_kernel`."""
        i = s.first + wp.tid() // LANES
        x_i, limit, found = x[i], s.reach * s.reach, int(s.count[i])
        near_walls = near_mirrors(x_i, s) & before_mirrors(x_i, s)
        if near_walls == 0 or bad_step[i // s.particles] >= 0:
            return
        others = s.fluid_count[i] - s.filling[i]
        for bits in range(1, near_walls + 1):
            if reflects(bits, near_walls):
                flip, offset = reflection(bits, s)
                for first in range(0, others + 1, LANES):
                    place, j = first + lane(), int(i)
                    if place < others:
                        j = neighbour(place, i, s)
                    x_j = load_vector(x, j)
                    x_ij = separation(x_i, wp.cw_mul(flip, x_j) + offset, s)
                    is_near = place <= others and wp.dot(x_ij, x_ij) < limit and reflects(bits, before_mirrors(x_j, s))
                    found = append(i, wp.static(REFLECTIONS) * j + bits, is_near, found, s)
        if lane() > 0:
            return
        all_count[i] = wp.min(found, s.neighbours.shape[0])
        if found > needed[s.part]:
            wp.atomic_max(needed, s.part, found)

    return fill_images
