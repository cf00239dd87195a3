"""Forces that are one function: what they do, their derivatives, and what is said of functions that are none."""

import math
import re
import runpy
from pathlib import Path

import numpy as np
import pytest
import warp as wp

from cortado import InputError, Simulation
from cortado.forces import Body, OverTime, Pair
from scenes import aimed, plane, splash, two_layers

ROOT = Path(__file__).parent.parent
STEPS = 5
STRENGTH = 0.3


def gust(x, v, t, k, centre, wind=(1.0, 0.5, -0.5)):
    """Everything that a function may have: numbers from outside, whole numbers, branches, loops, types of Warp."""
    away = x - centre
    force = k / 2 * (wind - v) - away * math.exp(-wp.length(away)) + wp.vec3(0.0, STRENGTH, 1)
    if x[0] > 0.1:
        force += v * wp.sin(300 * t) * math.pi + x[1] ** 2 * wind
    for axis in range(2):
        force -= 1 / 10 * v * v[axis]
    return force


def spring(x_ij, v_ij, t, k, damping):
    return -k * (wp.length(x_ij) - 0.04) * x_ij - damping * wp.dot(x_ij, v_ij) * x_ij


def leaning(x_ij: wp.vec3, v_ij: wp.vec3, t: float, k: float, damping: float) -> wp.vec3:
    """No odd function: momentum is not kept."""
    return k * wp.vec3(x_ij[1] ** 2, wp.cos(200.0 * t), x_ij[0] * v_ij[1]) - damping * v_ij


FORCES = {
    "a body force": lambda d: Body(
        gust, k=OverTime([0.002, 0.006], [20.0, 30.0]), centre=[0.1] * d, wind=[3.0, 0.5, -1][:d]
    ),
    "a pair force": lambda d: Pair(spring, k=3000.0, damping=OverTime([0.0, 0.01], [2e4, 3e4])),
    "a pair force that is not odd": lambda d: Pair(leaning, k=1.0, damping=0.5),
}


def problem(force, make=splash, **options):
    return aimed(Simulation(make(), **{"precision": "float64", **options}, forces=[force]), STEPS)


def free(**changes):
    return plane(forces={"gravity": [0.0, 0.0], "viscosity": "none", "pressure": False}, **changes)


def test_a_body_force_is_an_acceleration_at_the_place_the_speed_and_the_time_of_a_particle():
    def pull(x, v, t, k, c):
        return -k * x - c * v + wp.vec3(t, 0.0, 5.0)

    simulation = Simulation(free(), precision="float64", forces=[Body(pull, k=3.0, c=0.5)])
    x, v, dt = simulation.positions, simulation.velocities, 0.0021
    for step in range(STEPS):
        v = v + dt * (-3.0 * x - 0.5 * v + [step * dt, 0.0])
        x = x + dt * v
    np.testing.assert_allclose(simulation.run(STEPS).positions[-1], x, rtol=1e-13)


def test_a_pair_force_is_the_weighted_sum_over_neighbours():
    def pull(x_ij, v_ij, k):
        return k * wp.vec3(x_ij[0] + 0.01, -2.0 * x_ij[1], 7.0)

    simulation = Simulation(free(), precision="float64", forces=[Pair(pull, k=40.0)])
    x, spacing = simulation.positions, 0.05
    q = np.linalg.norm(x[:, None] - x[None], axis=-1) / (2.0 * spacing)
    weights = np.where(q < 0.5, 1.0 - 6.0 * q**2 + 6.0 * q**3, 2.0 * np.clip(1.0 - q, 0.0, None) ** 3)
    np.fill_diagonal(weights, 0.0)
    away = x[:, None] - x[None]
    force = 40.0 * np.stack([away[..., 0] + 0.01, -2.0 * away[..., 1]], axis=-1)
    acceleration = (weights[..., None] * force).sum(axis=1) / (1000.0 * spacing**2)
    np.testing.assert_allclose(simulation.run(1).velocities[-1], 0.0021 * acceleration, rtol=1e-12, atol=1e-15)


def test_an_odd_pair_force_keeps_momentum():
    alone = {"container": {"shape": "none"}}
    for force, kept in ((FORCES["a pair force"](3), True), (FORCES["a pair force that is not odd"](3), False)):
        made = two_layers(forces={"gravity": [0.0] * 3, "viscosity": "none", "pressure": False}, **alone)
        simulation = Simulation(made, precision="float64", forces=[force])
        heavy = np.array([1000.0, 1800.0])[simulation.mass_fractions.argmax(axis=1)]
        moved = heavy[:, None] * simulation.run(1).velocities[-1]
        assert np.abs(moved).max() > 1e-3
        assert (np.abs(moved.sum(axis=0)).max() < 1e-12 * np.abs(moved).sum()) == kept


def test_time_and_an_annotation_may_be_left_out_and_a_default_is_a_parameter():
    def brake(x, v, k=4.0):
        return -k * v

    judged = problem(Body(brake, name="slow"))
    assert judged.simulation.parameters()["slow.k"] == 4.0
    assert "time" not in judged.simulation.known

    def lift(x, v):
        return wp.vec3(0.0, 1.0, 0.0)

    assert problem(Body(lift)).value_and_gradient({"time_step": 0.002})[1]["time_step"] != 0.0


def test_parameters_over_time_of_a_batch():
    force = Body(gust, k=OverTime([0.0], [20.0]), centre=[0.1] * 3)
    rows = np.array([np.linspace(1.0, 2.0, STEPS), np.linspace(4.0, 3.0, STEPS)])
    together, alone = problem(force, batch=2), problem(force)
    loss, gradient = together.value_and_gradient({"gust.k": rows, "time_step": [0.002, 0.001]})
    for b in range(2):
        single, found = alone.value_and_gradient({"gust.k": rows[b], "time_step": [0.002, 0.001][b]})
        assert loss[b] == single
        np.testing.assert_array_equal(gradient["gust.k"][b], found["gust.k"])


def test_a_step_of_a_captured_search_has_the_numbers_of_its_own():
    """The same arrays over and over: a parameter that changes from one evaluation to the next is read anew."""
    judged = problem(FORCES["a body force"](3))
    first = [judged.value({"gust.k": k}) for k in (1.0, 2.0, 3.0, 1.0)]
    assert first[0] == first[3] and len(set(first)) == 3


def test_another_function_is_another_force_also_by_values_from_outside():
    """Where the text is the same: numbers of it and of a function of Warp that it calls, vectors, and courses."""

    def made(strength, scale, centre):
        @wp.func
        def scaled(r: wp.float64):
            return r * wp.float64(scale)

        def steady(x, v, k):
            return scaled(k) * strength * (centre - x)

        return problem(Body(steady, k=1.0))

    ends, values = {}, ((1.0, 1.0, 0.0), (2.0, 1.0, 0.0), (1.0, 20.0, 0.0), (1.0, 1.0, 9.0))
    for strength, scale, x in values:
        judged = made(strength, scale, wp.vec3d(x, 0.0, 0.0))
        ends[judged.fingerprint] = judged.run({}).velocities[-1].tobytes()
    assert len(ends) == len(set(ends.values())) == 4
    assert made(1.0, 1.0, wp.vec3d(0.0, 0.0, 0.0)).fingerprint == next(iter(ends))
    courses = [OverTime([0.0, 1.0], [1.0, last]) for last in (2.0, 3.0)]
    assert len({problem(Body(gust, k=course, centre=[0.1] * 3)).fingerprint for course in courses}) == 2


def test_what_it_is_made_with_stays():
    force = Body(gust, k=1.0, centre=[0.1] * 3)
    with pytest.raises(InputError, match="name cannot be set"):
        force.name = "other"
    centre = np.full(3, 0.1)
    kept = Body(gust, k=1.0, centre=centre)
    centre[:] = 9.0
    assert problem(kept).simulation.parameters()["gust.centre"].tolist() == [0.1] * 3


def drag(x, v, t, k):
    return -k * v


def three(x, v, t, k, c):
    return v


def time_second(x_ij, t, v_ij, k):
    return -k * t * v_ij


CALLED = """
import numpy as np
import warp as wp

AWAY = [1.0, 0.0, 0.0]

@wp.func
def looping(r: wp.float64):
    while r > 1.0:
        r = r * r
    return r

@wp.func
def flattened(a: wp.vec3):
    a.y = 0.0
    return a

@wp.func
def helping_itself(r: wp.float64):
    return helping_itself(r)

"""
NO_FORCES = {
    "calls itself": ("def f(x, v): return f(x, v)", "Body function f calls itself, but Warp has no recursion"),
    "calls what calls itself": ("def f(x, v): return helping_itself(x[0]) * v", "helping_itself that Body function f"),
    "waits": ("async def f(x, v): return x", "Body function f is a coroutine or a generator, but must be a plain"),
    "no axis": ("def f(x, v): return x[3] * v", r"f has x\[3\], but the index of a component must be 0, 1 or 2"),
    "order": ("def f(v, x, k): return -k * v", "f has the arguments v, x, k, but must have x, v first, and"),
    "one": ("def f(x): return x", "Body function f has x without a value, but must have"),
    "many": ("def f(x, v, *rest): return v", r"Body function f has the argument \*rest, but must have"),
    "time": ("def f(x, v, t=0.0, k=1.0): return -k * t * v", "f is given a value of t, but the run sets t"),
    "some return": ("def f(x, v, k):\n if x[0] < 0.1: return k * v", "Body function f may end without return"),
    "unknown": ("def f(x, v, k): return k * undefined(v)", "f has the name .*, which is not defined"),
    "list": ("def f(x, v, k): return k * AWAY", "AWAY, which is a list outside the function, but must be a number"),
    "named part": ("def f(x, v, k):\n a = k * x\n a.y = 0.0\n return a", "changes a.y separately, which Warp cannot"),
    "called part": ("def f(x, v, k): return k * flattened(x)", "function f changes a.y separately, which Warp cannot"),
    "long loop": (
        "def f(x, v, k):\n for _ in range(257): v = v * 0.5\n return k * v",
        r"f has 'for _ in range\(257\)', which Warp cannot differ",
    ),
    "break": (
        "def f(x, v, k):\n for axis in range(3):\n  if v[axis] > 0.0: break\n return k * v",
        "f has 'break', which Warp cannot differ",
    ),
    "called while": ("def f(x, v, k): return k * looping(x[0]) * v", "f has 'while r > 1.0', which Warp cannot differ"),
    "no vector": ("def f(x, v, k): return k", "Body function f cannot be compiled: .* return a vector"),
    "NumPy": ("def f(x, v, k): return -k * np.tanh(v)", "Body function f cannot be compiled: "),
    "compares": ("def f(x, v):\n if v < x: return v\n return x", r"f cannot be compiled: invalid operands .* numbers"),
    "nested": ("def f(x, v): return wp.vec3(x, v[0], 1.0)", "f cannot be compiled: no matching constructor for ini"),
}


@pytest.mark.parametrize("name", NO_FORCES)
def test_what_is_no_force_is_a_sentence(name, tmp_path, capfd):
    """And nothing more: the compiler would print pages."""
    text, said = NO_FORCES[name]
    (tmp_path / "force.py").write_text(CALLED + text)
    force = runpy.run_path(str(tmp_path / "force.py"))["f"]
    with pytest.raises(InputError, match=said):
        problem(Body(force, **{"k": 1.0} if ", k)" in text else {}))
    captured = capfd.readouterr()
    assert "error" not in captured.out + captured.err


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: Body(3.0), "Body has 3.0, but must have a function defined by def"),
        (lambda: Body(lambda x, v, k: -k * v, k=1.0), "Body function <lambda> is a lambda, but must be"),
        (lambda: Body(drag), "Body function drag is given no value of k, but must have a value of each parameter"),
        (lambda: Body(three, c=[1.0, 0.0, 0.0]), "Body function three is given no value of k, but must have"),
        (lambda: Pair(time_second, k=1.0), "time_second has the arguments .*, but must have x_ij, v_ij first"),
        (lambda: Body(drag, k=1.0, x=2.0), "drag is given a value of x, but the run sets x"),
        (lambda: Pair(drag, k=1.0, c=2.0), r"is given a value of c, but has only .*\(x, v, t, k\)"),
        (lambda: Body(drag, k="fast"), "parameter drag.k is 'fast', but must be"),
        (lambda: Body(drag, k=[[1.0]]), r"Body function drag uses the array k without indices"),
        (lambda: Body(drag, "a b", k=1.0), "Body has the name 'a b', but must have a valid name"),
        (lambda: problem(Body(drag, k=math.nan)), "parameter drag.k has a value that is not finite"),
        (lambda: problem(Body(drag, k=[1.0, 2.0])), r"parameter drag.k has shape \(2,\), but must be \(3,\)"),
        (lambda: OverTime([0.0, 0.0], [1.0, 2.0]), "OverTime times are .*, but each time must be greater than the"),
        (lambda: OverTime([0.0], [1.0, 2.0]), r"OverTime values have shape \(2,\), but must be \(1,\) or \(1, d\)"),
        (lambda: OverTime([], []), "OverTime times are .*, but must be a list of finite times"),
    ],
)
def test_values_that_make_no_force_are_a_sentence(make, said):
    with pytest.raises(InputError, match=said):
        make()


def test_the_forces_of_the_page_run_as_printed(tmp_path, monkeypatch):
    """From a file, as Warp wants the text of functions."""
    page = (ROOT / "docs/own_parts.md").read_text()
    blocks = re.findall(r"^```py\n(.*?)^```$", page, re.DOTALL | re.MULTILINE)
    program = tmp_path / "page.py"
    program.write_text("\n".join(blocks))
    monkeypatch.chdir(ROOT)
    assert len(blocks) == 6
    runpy.run_path(str(program))


CALM = wp.vec3(0.25, -0.5, 0.0)


def with_vector(x, v, k):
    return k * (CALM - v)


def with_numbers(x, v, k):
    return k * (wp.vec3(0.25, -0.5, 0.0) - v)


@pytest.mark.parametrize("precision", ["float32", "float64"])
def test_a_vector_from_outside_is_one_of_the_precision(precision):
    given = ({"precision": precision, "forces": [Body(force, k=2.0)]} for force in (with_vector, with_numbers))
    ends = [Simulation(plane(), **own).run(3).positions[-1] for own in given]
    assert ends[0].tobytes() == ends[1].tobytes()
