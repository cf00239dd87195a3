"""An acceleration that is the same everywhere, one for each step (report eq. 8)."""

from functools import cache
from types import SimpleNamespace

import warp as wp

from cortado.physics.integration import integration_module
from cortado.precision import Precision


@cache
def gravity_kernels(precision: Precision) -> SimpleNamespace:
    """Kernels ``forward``, ``tangent`` and ``adjoint`` of an acceleration that is the same everywhere."""
    vector = precision.vector

    @wp.kernel(module=integration_module(precision, True))
    def gravity(
        table: wp.array(dtype=vector),
        step: wp.array(dtype=wp.int32),
        acceleration_in: wp.array(dtype=vector),
        # out
        acceleration: wp.array(dtype=vector),
    ):
        i = wp.tid()
        acceleration[i] = acceleration_in[i] + table[step[0]]

    @wp.kernel(module=integration_module(precision, False), enable_backward=False)
    def gravity_adjoint(
        total: wp.array(dtype=vector),
        step: wp.array(dtype=wp.int32),
        # in and out
        table_bar: wp.array(dtype=vector),
    ):
        table_bar[step[0]] = table_bar[step[0]] + total[0]

    return SimpleNamespace(forward=gravity, tangent=gravity, adjoint=gravity_adjoint)
