"""Every derivative of a sum over neighbours that is written by hand equals the one that Warp makes of the term."""

import ast

import numpy as np
import pytest

from benchmarks.by_hand import ROOT, noting_factories, pairs, without_walls
from cortado.device.neighbourhood import Discretisation
from cortado.device.precision import FLOAT64
from cortado.lattice.smoothing import CUBIC_SPLINE
from test_kernels import array, cloud

ALL = pairs(Discretisation(CUBIC_SPLINE, FLOAT64, periodic=True))


@pytest.mark.parametrize("pair", ALL, ids=[pair.name for pair in ALL])
@pytest.mark.parametrize("name", ["3-D", "periodic"])
def test_a_derivative_by_hand_is_the_made_one(pair, name):
    around = cloud(name)
    s, x = without_walls(around.neighbourhood), array(around.x)
    values, results = pair.values(x, seed=5), []
    for called in (pair.by_hand, pair.made):
        outputs = called.outputs(x)
        called(s, values, outputs)
        results.append([output.numpy() for output in outputs[: pair.compared]])
    for found, wanted in zip(*results, strict=True):
        assert np.abs(wanted).max() > 1e-3
        np.testing.assert_allclose(found, wanted, rtol=1e-11, atol=1e-12 * np.abs(wanted).max())


def test_every_derivative_by_hand_is_noted():
    """A term whose name says that it is a derivative has a note, or is one of a frozen geometry."""
    texts = {path: path.read_text() for path in ROOT.rglob("*.py")}
    notes = sum(text.count("@tangent_of(") + text.count("@adjoint_of(") for text in texts.values())
    assert sum(count for _, count in noting_factories()) == notes > 0
    for path, text in texts.items():
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.FunctionDef) and {"tangent", "adjoint"} & {*node.name.split("_")}:
                decorators = [ast.unparse(one) for one in node.decorator_list]
                if any(one.startswith(("pair_sum(", "fluid_sum(", "summed(")) for one in decorators):
                    noted = any(one.startswith(("tangent_of(", "adjoint_of(")) for one in decorators)
                    assert noted or path.name == "frozen_pressure.py", node.name
