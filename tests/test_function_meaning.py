"""What is compiled of a user's function is what Python calls: its operators, decorators, file, and what it names."""

import functools
import importlib
import math
import pickle
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp

from bad_scenes import one_sentence
from cortado import InputError, Simulation, losses
from cortado.device.precision import FLOAT32, FLOAT64
from cortado.forces import Body, Rheology
from scenes import plane

settings = SimpleNamespace(k=3.0, on=True, inner=SimpleNamespace(k=2.0), axis=1)


def remainders(a, b):
    return (a % b) + 10.0 * (a // b) + (a + 0.5) % -3


def changed(a, b):
    total = a * 3
    total %= b
    total //= 0.25
    total **= 2
    return total - round(a / 0.5) + 100 * round(b) + int(a * 3.7) - int(-b)


def chained(a, b):
    if -1.0 < a < b < 4.0:
        return 1.0 if 0 < a <= 2 else 2.0
    low = a < 0
    if (low and not b > 2.0) or a == b:
        return 3.0
    return max(a, 1, b) - min(b, a, 0.5, 2) + pow(abs(a) + 1, b)


def counted(a, b):
    total = 0.0
    for k in range(5):
        total += k / 2 * a + k // 2 - (k - 1) % 3 + k**2
        for j in range(1, 4, 2):
            total = total + (j if k == j else j / 4) * b
    return total + k


def named(a, b):
    scale = settings.k if settings.on else 7.0
    return scale * a + settings.inner.k * b + math.floor(a) + math.trunc(b) + 1 / 3


def indexed(a, b):
    v, total = wp.vec3(a, b, a * b), 0.0
    for k in range(3):
        total += v[(k - 1) % 3] * k + v[-1] + v[settings.axis]
    return total


def evaluated(function, precision, values):
    """As it is compiled, at pairs (n, 2)."""
    real, own = precision.real, Rheology(function)._formula.function(precision, (), wp.get_module("meaning"))

    @wp.kernel(module=wp.get_module(f"meaning_{function.__name__}_{precision.name}"))
    def apply(a: wp.array(dtype=real), b: wp.array(dtype=real), found: wp.array(dtype=real)):
        i = wp.tid()
        found[i] = own(a[i], b[i])

    given = [wp.array(column, dtype=real, device="cpu") for column in values.T]
    found = wp.zeros(len(values), dtype=real, device="cpu")
    wp.launch(apply, len(values), inputs=[*given, found], device="cpu")
    return found.numpy()


@pytest.mark.parametrize("function", [remainders, changed, chained, counted, named, indexed])
def test_operators_mean_what_python_means(function):
    """Halves, negative numbers and numbers that are no binary fractions, to the last bits."""
    numbers = [-3.0, -2.5, -1.5, -1.0, -0.7, -0.5, 0.1, 0.3, 0.5, 1.0, 1.5, 2.0, 2.5, 3.1]
    pairs = np.array([(a, b) for a in numbers for b in numbers])
    if function is indexed:
        wanted = [sum((a, b, a * b)[(k - 1) % 3] * k + a * b + b for k in range(3)) for a, b in pairs]
    else:
        wanted = [function(float(a), float(b)) for a, b in pairs]
    np.testing.assert_allclose(evaluated(function, FLOAT64, pairs), wanted, rtol=1e-14, atol=1e-14)
    assert evaluated(function, FLOAT32, pairs).dtype == np.float32


def wrapped_remainder(x, v, k, c):
    return wp.vec3((x[0] - k) % c - x[1] // c, round(x[1] / c) * v[0], int(x[0] * k))


def test_derivatives_of_remainders_are_right():
    import cortado

    simulation = Simulation(plane(), precision="float64", forces=[Body(wrapped_remainder, k=0.013, c=0.117)])
    problem = cortado.Problem(simulation, 5, losses.FinalPositions(simulation.positions))
    assert cortado.certify(problem, ["wrapped_remainder.k", "wrapped_remainder.c"]).right


def either(a, b):
    return a or b


def digits(a, b):
    return round(a, 1)


def clamp(value):
    return value


def shadowed(a, b):
    return clamp(a)


def elsewhere(a, b):
    return wp.vec3(a, b, a)[int(b)]


def twice_named(a, b):
    k = 2.0 * a
    for k in range(3):  # noqa: B007
        b += 1.0
    return k * b


@wp.func
def whole_ratio(r: wp.float64):
    return r * wp.float64(1 / 2)


@wp.func
def c_remainder(r: wp.float64):
    return r % wp.float64(3.0)


def helped_ratio(a, b):
    return whole_ratio(a)


def helped_remainder(a, b):
    return c_remainder(a)


def doubled(function):
    @functools.wraps(function)
    def call(*arguments):
        return 2.0 * function(*arguments)

    return call


def plain(a, b):
    return a + b


@wp.func
@doubled
def doubled_helper(r: wp.float64):
    return r


def helped_doubled(a, b):
    return doubled_helper(a)


def at_the_line_of_another():
    text, scope = "\n" * (plain.__code__.co_firstlineno - 1) + "def plain(a, b):\n    return a - b\n", {}
    exec(compile(text, __file__, "exec"), scope)
    return scope["plain"]


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: either, "either has 'a or b', which is one of its operands in Python but True or False in Warp"),
        (lambda: digits, "digits must call round with one number only"),
        (lambda: shadowed, "shadowed cannot be compiled: the code calls clamp, but may only call functions of Warp"),
        (lambda: elsewhere, r"elsewhere has the index int\(b\), but indices must be whole numbers"),
        (lambda: twice_named, "twice_named assigns to k, which is also the counter of a loop"),
        (lambda: helped_ratio, "helped_ratio calls a function of Warp with '1 / 2', which has another value in Python"),
        (lambda: helped_remainder, "calls a function of Warp with 'r % wp.float64"),
        (lambda: doubled(plain), "plain has a decorator, which Warp would ignore"),
        (lambda: helped_doubled, "doubled_helper that .* calls has a decorator, which Warp would ignore"),
        (lambda: functools.partial(plain), "Rheology has functools.partial"),
        (at_the_line_of_another, "code of Rheology function plain in .* differs from the code that runs"),
    ],
)
def test_what_warp_would_take_for_something_else_is_refused(make, said):
    with one_sentence(said):
        Rheology(make())


@pytest.fixture
def module(tmp_path, monkeypatch):
    """Writes a module and imports it."""
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "edited_forces", raising=False)

    def write(text):
        (tmp_path / "edited_forces.py").write_text(text)
        importlib.invalidate_caches()
        return importlib.import_module("edited_forces")

    return write


PUSH = "import warp as wp\n\n\ndef push(x, v):\n    return wp.vec3(3.0, 0.0, 0.0)\n"


@pytest.mark.parametrize(
    "edited",
    [PUSH.replace("3.0", "15.0"), "# moved\n" * 9 + PUSH, PUSH.replace("push", "pull"), PUSH.partition("def")[0]],
)
def test_a_file_that_has_changed_since_it_was_imported_is_refused(module, edited):
    made = module(PUSH)
    Body(made.push)
    Path(made.__file__).write_text(edited)
    with pytest.raises(InputError, match=r"Body function push .*(differs from the code that runs|is not found)"):
        Body(made.push)


STRENGTH, AIM = 6.0, wp.vec3d(1.0, 0.0, 0.0)


@wp.func
def inner_strength(r: wp.float64):
    return r * wp.float64(STRENGTH) * wp.float64(settings.k)


@wp.func
def outer_strength(r: wp.float64):
    return inner_strength(r) + wp.float64(settings.inner.k)


def helped(x, v, k):
    return outer_strength(k) * AIM


def test_what_a_force_names_is_frozen_with_all_that_it_calls(monkeypatch):
    """A number of the module, an attribute and a vector, behind two functions of Warp, changed before anything is
    compiled; a force that is made then is another one."""
    force = Body(helped, k=1.0)
    monkeypatch.setitem(globals(), "STRENGTH", 150.0)
    monkeypatch.setattr(settings, "k", 30.0)
    monkeypatch.setattr(settings.inner, "k", 20.0)
    AIM[0] = 5.0
    try:
        other = Body(helped, k=1.0)
        free = {"forces": {"gravity": [0.0, 0.0], "viscosity": "none", "pressure": False}}
        dt, ends = 0.0021, []
        for one in (force, other):
            end = Simulation(plane(**free), precision="float64", forces=[one]).run(1)
            ends.append((end.velocities[-1] - end.velocities[0])[:, 0] / dt)
    finally:
        AIM[0] = 1.0
    np.testing.assert_allclose(ends[0], 6.0 * 3.0 + 2.0, rtol=1e-12)
    np.testing.assert_allclose(ends[1], 5.0 * (150.0 * 30.0 + 20.0), rtol=1e-12)
    assert force.fingerprint != other.fingerprint
    with pytest.raises(InputError, match="a value or function that the Body function helped uses has changed since"):
        pickle.loads(pickle.dumps(other))
