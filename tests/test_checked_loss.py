"""Losses that users write: what their mistakes are called, and that good ones come through unchanged."""

from functools import cache, partial
from types import MethodType, SimpleNamespace

import numpy as np
import pytest
import warp as wp

from bad_scenes import one_sentence
from cortado.device.precision import FLOAT64
from cortado.losses import FinalPositions, Frames, Recorded, Snapshot, SnapshotAdjoint, fingerprint
from cortado.losses.run_losses import as_loss
from cortado.particles.state import POSITIONS, VELOCITIES, Layout, State
from cortado.sph.mixture import MASS_FRACTIONS

N, PHASES = 5, 2


def state(particles: int = N, phases: int = PHASES, precision=FLOAT64) -> State:
    return Layout(particles, phases, precision, "cpu").state((POSITIONS, VELOCITIES, MASS_FRACTIONS))


END = Snapshot(state(), 2, np.zeros((PHASES, 3)))


class Given:
    def __init__(self, value=1.0, adjoint=None):
        self._value, self._adjoint = value, adjoint

    def value(self, end):
        return self._value

    def adjoint(self, end):
        return self._adjoint


def adjoint_of(given):
    return as_loss(Given(adjoint=given)).value_and_adjoint(END)[1]


def test_adjoints_of_every_form_come_through():
    arrays = (np.ones((N, 2)), np.zeros((N, 2)), np.ones((N, PHASES)))
    for given in (arrays, arrays[:2], [array.tolist() for array in arrays]):
        found = adjoint_of(given)
        assert len(found) == len(given)
        for one, wanted in zip(found, arrays, strict=False):
            assert one.dtype == np.float64
            np.testing.assert_array_equal(one, wanted)
    bar = state()
    assert adjoint_of(bar) is bar
    found = as_loss(Given(adjoint=SnapshotAdjoint(bar, np.ones((PHASES, 3)))))
    assert found.value_and_adjoint(END)[1].state is bar


def test_what_a_loss_is_given_cannot_be_changed():
    for name in ("positions", "velocities", "mass_fractions"):
        with pytest.raises(ValueError, match="read-only"):
            getattr(END, name)[:] = 1.0


def a_pair(positions, velocities=None):
    return positions, np.zeros((N, 2)) if velocities is None else velocities


ONES = np.ones((N, 2))
LOST = np.diag([1.0, np.nan, 1.0, 1.0, 1.0])[:, :2]
WARPED = r"is a Warp array of vec3d of shape \(6,\) on cpu, but must be .* \(5,\)"
OF_END = r"takes the arguments '\(end\)', but .* is an object with value\(end\) and adjoint\(end\)\.$"
BAD_ADJOINTS = {
    "an adjoint that is not finite": (
        a_pair(LOST),
        r"positions is not finite in row 1, but must be finite everywhere\.$",
    ),
    "no adjoint": (None, "is a NoneType"),
    "one array in a tuple": ((ONES,), "is a tuple of 1"),
    "a wrong shape": (a_pair(np.ones((N, 3))), r"of positions has shape \(5, 3\), but must be \(5, 2\)"),
    "complex numbers": (a_pair(ONES, ONES.astype(complex)), "of velocities is made of complex numbers"),
    "a mask": (a_pair(np.ma.masked_equal(0.0 * ONES, 0.0)), "of positions is partly masked"),
    "another number of particles": (state(N + 1), f"of positions {WARPED}"),
    "NumPy arrays in a state": (
        State(END.state.fields, {**state().named(), "velocities": np.zeros((N, 3))}),
        "of velocities is a ndarray",
    ),
    "colours": (SnapshotAdjoint(state(), np.ones(3)), "of colours has shape"),
    "no state": (SnapshotAdjoint(None, np.ones((2, 3))), "a NoneType as its"),
}
MISTAKES = {
    "no value": (lambda: as_loss(Given(None)).value(END), "the loss's value is None"),
    "an array as value": (lambda: as_loss(Given(np.ones(3))).value(END), r"shape \(3,\), but must be one number"),
    "a complex value": (lambda: as_loss(Given(1j)).value(END), "the loss's value is 1j"),
    **{name: (partial(adjoint_of, given), words) for name, (given, words) in BAD_ADJOINTS.items()},
    "a class": (lambda: as_loss(FinalPositions), "loss is the class FinalPositions"),
    "too few arguments": (lambda: as_loss(lambda x, v: None), r"takes the arguments '\(x, v\)', but must take 3"),
    "a function of the end": (lambda: as_loss(lambda end: 0.0), OF_END),
    "a function that is recorded": (lambda: Recorded(lambda x, v: None), r"arguments '\(x, v\)', but must take 3: pos"),
    "frames that are a list": (lambda: Frames([Given()]), "losses is .* but must be a table"),
}


@pytest.mark.parametrize("mistake, words", MISTAKES.values(), ids=MISTAKES)
def test_a_mistake_is_a_sentence(mistake, words):
    with one_sentence(words) as caught:
        mistake()
    assert len(str(caught.value)) < 300


GAIN = 2.0


@wp.func
def gained(x: wp.float64):
    return wp.float64(GAIN) * x


@wp.kernel
def add_heights(x: wp.array(dtype=wp.vec3d), loss: wp.array(dtype=wp.float64)):
    wp.atomic_add(loss, 0, gained(x[wp.tid()][1]))


def heights(positions, velocities, loss):
    wp.launch(add_heights, dim=len(positions), inputs=[positions, loss])


def test_a_loss_in_warp_is_told_from_one_of_other_code_or_numbers(monkeypatch):
    """Also through a kernel and the function that it calls; a search of the one does not go on with the other."""

    def of(power):
        def function(positions, velocities, loss):
            heights(positions, velocities, loss)
            return power

        return function

    found = {fingerprint(Recorded(one)) for one in (heights, of(1), of(2), lambda x, v, loss: heights(v, x, loss))}
    assert len(found) == 4 and fingerprint(heights) != fingerprint(of(1))
    assert fingerprint(Recorded(of(1))) == fingerprint(Recorded(of(1)))
    before = fingerprint(Recorded(heights))
    monkeypatch.setitem(globals(), "GAIN", 3.0)
    assert fingerprint(Recorded(heights)) != before


class Settings:
    def __init__(self, gain):
        self.gain = gain

    def twice(self):
        return 2.0 * self.gain


@pytest.mark.parametrize(
    "made",
    [
        lambda k: partial(lambda x, v, loss, k: None, k=k),
        lambda k: SimpleNamespace(k=k),
        lambda k: Settings(k).twice,
        lambda k: {"inner": {"k": k}},
        lambda k: cache(lambda: k),
        lambda k: MethodType(lambda self: k, 1.0),
    ],
)
def test_numbers_behind_what_a_loss_in_warp_names_tell_it_too(made):
    def of(k):
        outside = made(k)

        def function(positions, velocities, loss):
            return outside

        return function

    assert fingerprint(Recorded(of(1.0))) == fingerprint(Recorded(of(1.0))) != fingerprint(Recorded(of(2.0)))
    if callable(made(1.0)):
        assert fingerprint(made(1.0)) == fingerprint(made(1.0)) != fingerprint(made(2.0))
