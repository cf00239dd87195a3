"""Kernels that are made: of a term of a pair, of a function of one particle; and derivatives written by hand."""

import ast
import re
from functools import cache

import numpy as np
import pytest
import warp as wp

from benchmarks.by_hand import ROOT, by_hand, noting_factories, pairs, without_walls
from cortado.device.grid import Grid
from cortado.device.launching import launch
from cortado.device.modules import kernel_module
from cortado.device.precision import FLOAT32, FLOAT64
from cortado.discretise.smoothing import CUBIC_SPLINE
from cortado.particles.made_derivatives import made_adjoint
from cortado.particles.moving_walls import WallArrays
from cortado.particles.neighbourhood import Discretisation, neighbourhood_type
from cortado.particles.neighbours import NeighbourSearch
from cortado.particles.pair_sums import fluid_sum, pair_sum, wall_sum
from cortado.particles.particle_kernels import particle_kernel, pointwise_kernels
from cortado.particles.state import Layout

D = Discretisation(CUBIC_SPLINE, FLOAT64)
real, vector = FLOAT64.real, FLOAT64.vector


def untyped(x_ij: vector, c_j) -> real:
    return c_j


def matrix(x_ij: vector) -> wp.mat33d:
    return wp.outer(x_ij, x_ij)


def apart(c_i: real, c_j: real) -> real:
    return c_i * c_j


def other_walls(x_ij: vector, strength: real) -> real:
    return strength


@pytest.mark.parametrize(
    ("make", "term", "message"),
    [
        (fluid_sum(D), untyped, "term untyped has no type for 'c_j', but must have a type for each."),
        (fluid_sum(D), matrix, "but must return numbers or vectors of the precision."),
        (wall_sum(D), apart, "term apart has no x_ij, but needs x_ij for a sum over walls."),
        (pair_sum(D, walls=other_walls), matrix, "term other_walls of walls has strength, but must have"),
        (lambda f: made_adjoint(D, lambda d: f), apart, "term apart has no x_ij, but needs x_ij for derivatives"),
    ],
)
def test_what_a_term_cannot_be_is_said(make, term, message):
    with pytest.raises(TypeError, match=re.escape(message)):
        make(term)


def test_arguments_of_a_kernel_are_what_their_names_say():
    """Few arrays one by one and many in bundles, in two scenes."""
    module, numbers, n = kernel_module("test_arguments"), wp.array(dtype=real), 6
    rng = np.random.default_rng(3)

    @particle_kernel(module, "+a b:before c", numbers=["factor"])
    def few(i: int, member: int, factor: real, time_step: real, c_i: real, table: numbers) -> tuple[real, real, real]:
        return time_step * c_i, factor * table[i], real(member) + c_i

    @particle_kernel(module, "+a b:before c d e f g h", numbers=["factor"])
    def many(
        i: int, member: int, factor: real, time_step: real, c_i: real, d_i: real, table: numbers
    ) -> tuple[real, real, real, real, real, real, real, real]:
        return time_step * c_i, factor * table[i], real(member) + c_i, d_i, d_i, d_i, d_i, d_i

    for kernel, arrays in (few, "abc"), (many, "abcdefgh"):
        start = {name: rng.normal(size=n) for name in (*arrays, "before", "table")}
        on_device = {name: wp.array(value, dtype=real, device="cpu") for name, value in start.items()}
        time_step = wp.array([0.5, 2.0], dtype=real, device="cpu")
        launch(kernel, n, wp.get_device("cpu"), on_device, particles=3, factor=0.3, time_step=time_step)
        wanted = {
            "a": start["a"] + np.repeat([0.5, 2.0], 3) * start["c"],
            "b": start["before"] + 0.3 * start["table"],
            "c": np.repeat([0.0, 1.0], 3) + start["c"],
        }
        for name, value in wanted.items():
            np.testing.assert_allclose(on_device[name].numpy(), value, rtol=1e-14)
        assert any(a.label == "to" for a in kernel.adj.args) == (kernel is many)


MEMBERS, PARTICLES = 2, 5


def made(precision, replaced=None):
    real, vector, matrix = precision.real, precision.vector, wp.types.matrix((3, 3), precision.real)

    def make(module):
        def turn(spacing: real, time_step: real, x_i: vector, A_i: matrix, m_i: real) -> tuple[vector, real]:
            moved = A_i * (time_step * x_i) / m_i
            return moved / spacing, wp.dot(moved, x_i) * spacing

        return turn

    modules = [kernel_module(f"pointwise_{kind}_{precision.name}") for kind in "abc"]
    return pointwise_kernels(precision, modules, make, ["moved", "work"], replaced, numbers=["spacing"])


def wanted(spacing, time_step, x, A, m):
    moved = np.einsum("nij,nj->ni", A, np.repeat(time_step, PARTICLES)[:, None] * x) / m[:, None]
    return moved / spacing, (moved * x).sum(1) * spacing


@pytest.mark.parametrize("precision", [FLOAT32, FLOAT64])
def test_values_and_derivatives(precision):
    rng, n = np.random.default_rng(7), MEMBERS * PARTICLES
    given = [rng.uniform(0.5, 1.5, size) for size in (MEMBERS, (n, 3), (n, 3, 3), n)]
    ways = [rng.normal(size=value.shape) for value in given]
    bars = [rng.normal(size=(n, 3)), rng.normal(size=n)]
    kinds = [precision.real, precision.vector, wp.types.matrix((3, 3), precision.real), precision.real]
    names, kernels = ["time_step", "x", "A", "m"], made(precision)

    def on_device(values, kinds, suffix=""):
        arrays = (wp.array(value, dtype=kind) for value, kind in zip(values, kinds, strict=True))
        return {f"{name}{suffix}": array for name, array in zip(names, arrays, strict=False)}

    def launched(kernel, **arrays):
        values = {"particles": PARTICLES, "spacing": 0.3, **on_device(given, kinds), **arrays}
        inputs = []
        for argument in kernel.adj.args:
            if argument.label in ("dot", "bar"):
                struct = argument.type()
                for name in names:
                    setattr(struct, name, arrays[f"{name}_{argument.label}"])
                inputs.append(struct)
            else:
                inputs.append(values[argument.label])
        wp.launch(kernel, dim=n, inputs=inputs)

    def results():
        return wp.zeros(n, dtype=precision.vector), wp.zeros(n, dtype=precision.real)

    tolerance, found, change = (1e-5 if precision is FLOAT32 else 1e-8), results(), results()
    launched(kernels.forward, moved=found[0], work=found[1])
    launched(kernels.tangent, **on_device(ways, kinds, "_dot"), moved_dot=change[0], work_dot=change[1])
    back = on_device([np.zeros((n, *value.shape[1:])) for value in given], kinds, "_bar")
    launched(
        kernels.adjoint,
        **back,
        moved_bar=wp.array(bars[0], dtype=precision.vector),
        work_bar=wp.array(bars[1], dtype=precision.real),
    )
    step = 1e-6
    ahead, behind = (wanted(0.3, *(v + sign * step * w for v, w in zip(given, ways, strict=True))) for sign in (1, -1))
    for value, by_tangent, right, a, b in zip(found, change, wanted(0.3, *given), ahead, behind, strict=True):
        np.testing.assert_allclose(value.numpy(), right, rtol=tolerance)
        np.testing.assert_allclose(by_tangent.numpy(), (a - b) / (2 * step), rtol=100 * tolerance, atol=tolerance)
    forward = sum((bar * tangent.numpy()).sum() for bar, tangent in zip(bars, change, strict=True))
    ways[0] = np.repeat(ways[0], PARTICLES)  # shares of a scene's parameter stand at its particles
    backward = sum((back[f"{name}_bar"].numpy() * way).sum() for name, way in zip(names, ways, strict=True))
    assert backward == pytest.approx(forward, rel=tolerance)


N, WALLS, SIDE, REACH = 60, 40, 2.3, 1.03


@cache
def cloud(is_periodic):
    """Random fluid and wall particles in a small box, which may be periodic along x, with their lists."""
    random, period = np.random.default_rng(7), np.array([SIDE, 0.0, 0.0]) * is_periodic
    x, walls = random.uniform(0.0, SIDE, (N, 3)), random.uniform(0.0, SIDE, (WALLS, 3))
    walls[:, 1] = random.uniform(-0.4, 0.0, WALLS)
    grid = Grid.around(np.full(3, -0.4), np.full(3, SIDE), period, REACH, 512)
    weights = random.uniform(0.5, 1.5, WALLS)
    feet = walls * [0.0, -1.0, 0.0]
    known = WallArrays(walls, weights, weights, feet, 0.0 * feet, *[np.full(WALLS, -1)] * 2)
    of_both = Discretisation(CUBIC_SPLINE, FLOAT64, periodic=True)
    search = NeighbourSearch(of_both, grid, known, Layout(N, 1, FLOAT64, wp.get_device("cpu")), 100)
    s = neighbourhood_type(FLOAT64)()
    s.particles = N
    s.neighbours, s.fluid_count = search.neighbours, search.fluid_count
    s.filling, s.count = search.filling, search.count
    for name, values in search.walls.items():
        setattr(s, name, values)
    s.support, s.per_support, s.reach = 1.0, 1.0, REACH
    s.normalisation = CUBIC_SPLINE.normalisation(3, 1.0)
    s.self_weight = float(CUBIC_SPLINE.weight(np.zeros(1), 3, 1.0)[0])
    s.volume, s.response_scale, s.laplacian_correction = 0.11, 30.0**-0.5, 1.3
    s.period, s.frequency = wp.vec3d(*period), wp.vec3d(is_periodic / SIDE, 0.0, 0.0)
    search.sort(wp.array(x, dtype=vector, device="cpu"))
    x = x[search.order.numpy()[:N]]
    search.fill(s, wp.array(x, dtype=vector, device="cpu"), wp.array([-1], dtype=wp.int32, device="cpu"))
    count, fluid_count = search.count.numpy(), search.fluid_count.numpy()
    assert search.needed < 100 and fluid_count.mean() > 8 and (count - fluid_count).mean() > 1
    return x, s, search


@cache
def pairs_in(precision):
    """Derivatives by hand with the made ones, by their names."""
    found = {pair.name: pair for pair in pairs(Discretisation(CUBIC_SPLINE, precision, periodic=True))}
    for pair in found.values():
        for called in (pair.by_hand, pair.made):  # for a few particles, LLVM's work takes longer than it saves
            called.module.options["optimization_level"] = 0
    assert found.keys() == NAMES.keys()
    return found


NAMES = by_hand(Discretisation(CUBIC_SPLINE, FLOAT64, periodic=True))
CASES = [(one, name) for one in (FLOAT64, FLOAT32) for name in NAMES]
CALLED = [f"{name.split('.')[-1]} {one.name}" for one, name in CASES]
"""Without the modules that they are in, as tests/seconds.csv knows them."""


@pytest.mark.parametrize(("precision", "name"), CASES, ids=CALLED)
@pytest.mark.parametrize("is_periodic", [False, True], ids=["3-D", "periodic"])
def test_a_derivative_by_hand_is_the_made_one(precision, name, is_periodic):
    pair, (x, s, _) = pairs_in(precision)[name], cloud(is_periodic)
    tolerance = 1e-11 if precision is FLOAT64 else 2e-4
    s, x = in_precision(without_walls(s), precision), wp.array(x, dtype=precision.vector, device="cpu")
    values, results = pair.values(x, seed=5), []
    for called in (pair.by_hand, pair.made):
        outputs = called.outputs(x)
        called(s, values, outputs)
        results.append([output.numpy() for output in outputs[: pair.compared]])
    for found, wanted in zip(*results, strict=True):
        assert np.abs(wanted).max() > 1e-3
        np.testing.assert_allclose(found, wanted, rtol=tolerance, atol=0.1 * tolerance * np.abs(wanted).max())


def in_precision(neighbourhood, precision):
    """A neighbourhood in float64 in another precision."""
    s = neighbourhood_type(precision)()
    for name, kind in s._cls.vars.items():
        value = getattr(neighbourhood, name)
        if isinstance(value, wp.array) and value.dtype is not wp.int32:
            value = wp.array(value.numpy(), dtype=kind.type.dtype, device=value.device)
        elif kind.type is precision.vector:
            value = precision.vector(*map(float, value))
        setattr(s, name, value)
    return s


def test_every_derivative_by_hand_is_noted():
    """A term whose name says that it is a derivative has a note."""
    texts = {path: path.read_text() for path in ROOT.rglob("*.py")}
    notes = sum(text.count("@tangent_of(") + text.count("@adjoint_of(") for text in texts.values())
    assert sum(count for _, count in noting_factories()) == notes > 0
    for text in texts.values():
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.FunctionDef) and {"tangent", "adjoint"} & {*node.name.split("_")}:
                decorators = [ast.unparse(one) for one in node.decorator_list]
                if any(one.startswith(("pair_sum(", "fluid_sum(", "summed(")) for one in decorators):
                    noted = any(one.startswith(("tangent_of(", "adjoint_of(")) for one in decorators)
                    assert noted, node.name
