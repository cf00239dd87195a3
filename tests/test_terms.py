"""What a term of a pair cannot be is said where it is made a sum or a derivative of."""

import re

import pytest
import warp as wp

from cortado.device.precision import FLOAT64
from cortado.discretise.smoothing import CUBIC_SPLINE
from cortado.particles.made_derivatives import made_adjoint, made_tangent
from cortado.particles.neighbourhood import Discretisation
from cortado.particles.pair_sums import fluid_sum, pair_sum, wall_sum

D = Discretisation(CUBIC_SPLINE, FLOAT64)
real, vector = FLOAT64.real, FLOAT64.vector


def untyped(x_ij: vector, c_j) -> real:
    return c_j


def texts(x_ij: vector, c_j: "real") -> real:
    return c_j


def hidden(x_ij: vector, _c_j: real) -> real:
    return _c_j


def matrix(x_ij: vector) -> wp.mat33d:
    return wp.outer(x_ij, x_ij)


def half(x_ij: vector) -> wp.float32:
    return wp.float32(1.0)


def apart(c_i: real, c_j: real) -> real:
    return c_i * c_j


def tangential(x_ij: vector, c_j: real, c_dot_j: real) -> real:
    return c_j * c_dot_j


def fluid(x_ij: vector, c_j: real) -> real:
    return c_j


def other_walls(x_ij: vector, strength: real) -> real:
    return strength


def vector_walls(x_ij: vector) -> vector:
    return x_ij


@pytest.mark.parametrize(
    ("make", "term", "message"),
    [
        (fluid_sum(D), untyped, "term untyped has no type at 'c_j', but must have a type at each."),
        (fluid_sum(D), texts, "term texts has a text at 'c_j', but must have a type at each."),
        (fluid_sum(D), hidden, "term hidden has '_c_j', but names must not begin with an underscore."),
        (fluid_sum(D), matrix, "but a sum must be of numbers or vectors of the precision."),
        (fluid_sum(D), half, "but a sum must be of numbers or vectors of the precision."),
        (wall_sum(D), apart, "term apart has no x_ij, but must have it where it is summed over walls."),
        (pair_sum(D, other_walls), fluid, "term other_walls of walls has strength, but must have"),
        (pair_sum(D, vector_walls), fluid, "term vector_walls of walls returns"),
        (lambda f: made_adjoint(D, lambda d: f), apart, "term apart has no x_ij, but must have it for derivatives"),
        (lambda f: made_tangent(D, lambda d: f), tangential, "has a name and the same with _dot, but tangents have"),
    ],
)
def test_what_a_term_cannot_be_is_said(make, term, message):
    with pytest.raises(TypeError, match=re.escape(message)):
        make(term)
