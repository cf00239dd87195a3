"""Every derivative of a sum over neighbours that is written by hand equals the one that Warp makes of the term."""

import ast

import numpy as np
import pytest
import warp as wp

from benchmarks.by_hand import ROOT, noting_factories, pairs, without_walls
from cortado.device.precision import FLOAT32, FLOAT64
from cortado.discretise.smoothing import CUBIC_SPLINE
from cortado.particles.neighbourhood import Discretisation, neighbourhood_type
from test_kernels import array, cloud

ALL = {precision: pairs(Discretisation(CUBIC_SPLINE, precision, periodic=True)) for precision in (FLOAT64, FLOAT32)}
CASES = [(precision, pair) for precision, found in ALL.items() for pair in found]
for _, pair in CASES:
    for called in (pair.by_hand, pair.made):  # for a few particles, LLVM's work takes longer than it saves
        called.module.options["optimization_level"] = 0


@pytest.mark.parametrize(("precision", "pair"), CASES, ids=[f"{pair.name} {p.name}" for p, pair in CASES])
@pytest.mark.parametrize("name", ["3-D", "periodic"])
def test_a_derivative_by_hand_is_the_made_one(precision, pair, name):
    around, tolerance = cloud(name), 1e-11 if precision is FLOAT64 else 2e-4
    s, x = in_precision(without_walls(around.neighbourhood), precision), array(around.x, precision.vector)
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
