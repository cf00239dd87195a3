"""Every derivative of a sum over neighbours that is written by hand equals the one that Warp makes of the term."""

import ast

import numpy as np
import pytest

from cortado.device.neighbourhood import Discretisation
from cortado.device.precision import FLOAT64
from cortado.lattice.smoothing import CUBIC_SPLINE
from summing import ROOT, Both, by_hand, noting_factories
from test_kernels import array, cloud

ALL = [Both(one) for one in by_hand(Discretisation(CUBIC_SPLINE, FLOAT64, periodic=True, taped=True))]


@pytest.mark.parametrize("both", ALL, ids=[both.name for both in ALL])
@pytest.mark.parametrize("name", ["3-D", "periodic"])
def test_a_derivative_by_hand_is_the_made_one(both, name):
    around = cloud(name)
    s = without_walls(around.neighbourhood)
    values = both.values(array(around.x), seed=5)
    pairs = zip(both.by_hand(s, values), both.made(s, values), strict=False)
    for found, wanted in list(pairs)[: both.compared]:
        assert np.abs(wanted.numpy()).max() > 1e-3
        np.testing.assert_allclose(found.numpy(), wanted.numpy(), rtol=1e-11, atol=1e-12 * np.abs(wanted.numpy()).max())


def without_walls(neighbourhood):
    """Made derivatives are over the fluid alone."""
    s = neighbourhood._cls()
    for name in neighbourhood._cls.vars:
        setattr(s, name, getattr(neighbourhood, name))
    s.count = s.fluid_count
    return s


def test_every_derivative_by_hand_is_noted():
    """A term whose name says that it is a derivative has a note, or is one of a frozen geometry."""
    noted = sum(count for _, count in noting_factories())
    calls = sum(
        path.read_text().count("@tangent_of(") + path.read_text().count("@adjoint_of(") for path in ROOT.rglob("*.py")
    )
    assert noted == calls
    for path in sorted(ROOT.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.FunctionDef) and {"tangent", "adjoint"} & {*node.name.split("_")}:
                decorators = [ast.unparse(one) for one in node.decorator_list]
                if any(one.startswith(("pair_sum(", "fluid_sum(", "summed(")) for one in decorators):
                    frozen = path.name == "frozen_pressure.py"
                    assert frozen or any(one.startswith(("tangent_of(", "adjoint_of(")) for one in decorators), (
                        node.name
                    )
