"""Numbers as users give them: what is taken, and what is refused in a sentence."""

from fractions import Fraction

import numpy as np
import pytest
import warp as wp

from cortado.arrays import as_numbers, as_one_number
from cortado.errors import InputError


class Tensor:
    """An array of another library."""

    def __init__(self, values, problem=None):
        self.values, self.problem = values, problem

    def __array__(self, dtype=None, copy=None):
        if self.problem is not None:
            raise self.problem
        return np.array(self.values, dtype=dtype)


@pytest.mark.parametrize(
    "value, wanted",
    [
        (3, 3.0),
        ([1, 2.5], [1.0, 2.5]),
        (np.array([1, 2], np.uint8), [1.0, 2.0]),
        (np.array([1.5], np.float16), [1.5]),
        ([10**30, Fraction(1, 2)], [1e30, 0.5]),
        (range(3), [0.0, 1.0, 2.0]),
        (np.ma.array([1.0, 2.0]), [1.0, 2.0]),
        (Tensor([1.0, 2.0]), [1.0, 2.0]),
    ],
)
def test_numbers_are_taken(value, wanted):
    found = as_numbers("gravity", value)
    assert type(found) is np.ndarray and found.dtype == np.float64
    np.testing.assert_array_equal(found, wanted)


def test_warp_arrays_are_taken():
    vectors = wp.array(np.ones((2, 3)), dtype=wp.vec3f, device="cpu")
    np.testing.assert_array_equal(as_numbers("positions", vectors), np.ones((2, 3)))


def test_an_array_in_float64_is_not_copied():
    values = np.zeros(3)
    assert as_numbers("gravity", values) is values


def endless() -> list:
    found: list = []
    found.append(found)
    return found


@pytest.mark.parametrize(
    "value, found",
    [
        (1j, "1j"),
        (np.array([1 + 0j, 2]), "made of complex numbers"),
        ("1.5", "'1.5'"),
        (["1", "2"], "made of text"),
        (np.array([b"1"]), "made of text"),
        (True, "True"),
        (np.array([True, False]), "made of True and False"),
        (np.array(["2020-01-01"], "M8[D]"), "made of dates"),
        (np.ma.array([1.0, 2.0, 3.0], mask=[1, 0, 1]), "partly masked"),
        ([np.ma.array([1.0, 2.0], mask=[0, 1]), [1.0, 2.0]], "partly masked"),
        (np.ma.masked, "partly masked"),
        (np.array([None, 1.0]), "None"),
        (np.array([True, 1.0], object), "True"),
        ([[1.0], [1.0, 2.0]], "[[1.0], [1.0, 2.0]]"),
        (10**400, "1000"),
        (None, "None"),
        ({"x": 1.0}, "a table"),
        (Tensor([1.0], RuntimeError("it requires grad")), "Tensor"),
        (endless(), "[[...]]"),
    ],
)
@pytest.mark.filterwarnings("error")
def test_what_is_not_made_of_real_numbers_is_a_sentence(value, found):
    with pytest.raises(InputError) as caught:
        as_numbers("gravity", value)
    sentence = str(caught.value)
    assert sentence.startswith("gravity is ") and found in sentence and "must be a number or an array" in sentence
    assert "\n" not in sentence and len(sentence) < 200


def test_one_number_is_no_array():
    assert as_one_number("the loss", np.array(2)) == 2.0
    with pytest.raises(InputError, match=r"the loss has shape \(1,\), but must be one number"):
        as_one_number("the loss", [2.0])
