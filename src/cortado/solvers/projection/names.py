"""The types of the projection's quantities by their names, which its sums over neighbours and its kernels share."""

from collections.abc import Mapping
from functools import cache
from typing import Any

import warp as wp

from cortado.device.precision import Precision, TypesByName
from cortado.particles.neighbourhood import neighbourhood_type
from cortado.sph.moment_functions import matrix_type, symmetric


@cache
def weights_type(precision: Precision) -> Any:
    """Return the Warp type of a particle's four weights (sigma, f, u, r)."""
    return wp.types.vector(length=4, dtype=precision.real)


def types_by_name(precision: Precision, more: Mapping[Any, str] | None = None) -> TypesByName:
    """Return the types of names in sums and kernels: vectors, matrices, symmetric ones as six numbers, and numbers for
    all others. ``more`` are names of some kernels, and count before these."""
    common = {
        neighbourhood_type(precision): "s",
        precision.vector: "x v u g f h gamma beside mirror normal whole crowd apart arm kick thrust delta foot turn "
        "total lifted row lift direct diagonal others",
        matrix_type(precision): "A L M N Q",
        symmetric(precision).kind: "S T",
        weights_type(precision): "weights",
        precision.pair: "error sums sizes",
    }
    return TypesByName(precision.real, common, more or {})
