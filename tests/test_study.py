"""The study's own tools: tables, experiment files, comparisons, and every source of gradients against another."""

import os

import numpy as np
import pytest

from cortado import InputError, Problem, SceneError, Simulation, gradients, losses
from cortado.reference import Terms
from experiments.comparison import compare, growth
from experiments.scenes import varied
from experiments.sources import (
    ByEstimator,
    FiniteDifference,
    Reference,
    ReferenceAdjoint,
    ReferenceTangent,
    Warp,
    WarpTangent,
)
from experiments.tables import Table
from scenes import plane, splash

STEPS = 12


def observations():
    parts = [{"way": "tape", "step": [1, 2, 3], "norm": [0.1, 1e-300, np.inf]}, {"way": "a, b", "step": [4], "norm": 2}]
    return Table.joined(parts)


def test_a_table_survives_its_file(tmp_path):
    table = observations()
    table.write_csv(tmp_path / "data.csv")
    again = Table.read_csv(tmp_path / "data.csv")
    assert list(again.columns) == ["way", "step", "norm"] and len(again) == 4
    for name, kind in (("way", "U"), ("step", "i"), ("norm", "f")):
        np.testing.assert_array_equal(again[name], table[name])
        assert again[name].dtype.kind == kind
    np.testing.assert_array_equal(table.where(way="tape", step=2)["norm"], [1e-300])
    assert len(table.where(way="nothing")) == 0 and table.values("way") == ["tape", "a, b"]
    assert [(key, len(rows)) for key, rows in table.groups("way")] == [(("tape",), 3), (("a, b",), 1)]


def test_what_is_no_table_is_refused(tmp_path):
    (tmp_path / "ragged.csv").write_text("a,b\n1,2\n3\n")
    os.mkfifo(tmp_path / "pipe.csv")
    for call, words in [
        (lambda: Table({"a": [1, 2], "b": [1, 2, 3]}), "one length"),
        (lambda: Table.joined([{"a": 1}, {"b": 1}]), "to be joined"),
        (lambda: Table.read_csv(tmp_path / "absent.csv"), "cannot be read"),
        (lambda: Table.read_csv(tmp_path / "ragged.csv"), "longer or shorter"),
        (lambda: Table.read_csv(tmp_path / "pipe.csv"), r"pipe.csv cannot be read: it is a pipe, but must be a reg"),
    ]:
        with pytest.raises(InputError, match=words):
            call()


def test_a_varied_scene_differs_only_there():
    scene = varied(splash(), forces={"viscosity": "none"}, phase={"viscosity": 2.0})
    assert (scene.forces.viscosity, scene.forces.gravity) == ("none", (0.0, -9.81, 0.0))
    assert [phase.viscosity for phase in scene.phase] == [2.0] and scene.solver == splash().solver
    with pytest.raises(SceneError, match=r"solver\.step"):
        varied(splash(), solver={"step": 1.0})


def test_comparison_of_gradients():
    found, truth = {"a": [3.0, 0.0], "b": 4.0}, {"b": np.array(4.0), "a": np.array([0.0, 3.0])}
    comparison = compare(found, truth)
    assert comparison.relative_l2 == pytest.approx(np.sqrt(18) / 5)
    assert comparison.cosine == pytest.approx(16 / 25) and comparison.norm_ratio == pytest.approx(1.0)


def test_growth_is_found_with_its_error():
    steps = np.arange(400)
    noise = np.random.default_rng(0).normal(0.0, 0.5, 400)
    exact, noisy = growth(steps, 1e-3 * np.exp(0.05 * steps)), growth(steps, np.exp(0.05 * steps + noise))
    assert exact.rate == pytest.approx(0.05, rel=1e-12) and exact.error < 1e-12
    assert 0.0 < abs(noisy.rate - 0.05) < 3.0 * noisy.error < 0.01
    assert np.isnan(growth([1, 2], [1.0, 2.0]).rate)
    assert growth([*range(20), 20], [*np.exp(np.arange(20.0)), 0.0]).rate == pytest.approx(1.0)


@pytest.fixture(scope="module")
def problem():
    """Particles in 2-D with a wall and a push, so that every component has a derivative."""
    return Problem(Simulation(plane(), precision="float64"), STEPS, losses.CentreOfMass([0.3, 0.1]))


PARAMETERS = {"gravity": np.array([0.7, -9.81]), "viscosity": np.array(0.05)}


@pytest.fixture(scope="module")
def truth(problem):
    return ByEstimator(gradients.Exact())(problem, PARAMETERS)


SOURCES = {
    "tape": (ByEstimator(gradients.Tape()), 1e-10),
    "Warp tangent": (WarpTangent(), 1e-10),
    "reference adjoint": (ReferenceAdjoint(), 1e-10),
    "reference adjoint in float80": (ReferenceAdjoint("float80"), 1e-10),
    "reference adjoint in float32": (ReferenceAdjoint("float32"), 1e-3),
    "analytic tangent": (ReferenceTangent(), 1e-10),
    "dual numbers in float128": (ReferenceTangent("float128", "dual"), 1e-10),
    "complex step": (ReferenceTangent(method="complex_step"), 1e-10),
    "differences of states": (ReferenceTangent(method="finite_difference", difference=1e-5), 1e-6),
    "differences": (FiniteDifference(1e-5, Warp()), 1e-6),
    "differences of the reference engine": (FiniteDifference(1e-5, Reference("float80")), 1e-6),
}


@pytest.mark.parametrize("name", SOURCES)
def test_every_source_finds_the_gradient(name, problem, truth):
    source, tolerance = SOURCES[name]
    found = source(problem, PARAMETERS)
    assert found.loss == pytest.approx(truth.loss, rel=1e-6)
    assert {key: value.shape for key, value in found.gradient.items()} == {"gravity": (2,), "viscosity": ()}
    assert compare(found.gradient, truth.gradient).relative_l2 < tolerance
    assert found.history.positions.shape == found.history.velocities.shape == (STEPS + 1,)


def test_histories_of_tangents_and_of_adjoints(problem, truth):
    sources = ReferenceTangent(), FiniteDifference(1e-5, Warp()), WarpTangent(), ReferenceAdjoint()
    tangent, differences, warp, adjoint = (source(problem, PARAMETERS).history for source in sources)
    np.testing.assert_allclose(tangent.positions, warp.positions, rtol=1e-9)
    np.testing.assert_allclose(differences.velocities, tangent.velocities, rtol=1e-5)
    for name in ("positions", "velocities"):
        np.testing.assert_allclose(getattr(adjoint, name), getattr(truth.history, name), rtol=1e-9)
    assert tangent.positions[0] == 0.0 < tangent.positions[-1] and adjoint.velocities[-1] == 0.0


def test_terms_left_out_are_left_out(problem, truth):
    for source in (ReferenceAdjoint(terms=Terms(hessian=False)), ReferenceTangent(terms=Terms(hessian=False))):
        assert 1e-4 < compare(source(problem, PARAMETERS).gradient, truth.gradient).relative_l2 < 1.0


def test_a_smoothed_gradient_has_no_history(problem, truth):
    found = ByEstimator(gradients.RandomizedSmoothing(spread=1e-3, samples=2, position_noise=0.0))(problem, PARAMETERS)
    assert found.history is None and compare(found.gradient, truth.gradient).relative_l2 < 1e-3


def test_losses_of_positions_keep_their_digits_and_frames_are_refused(problem):
    target = problem.simulation.positions
    final = Problem(problem.simulation, STEPS, losses.FinalPositions(target))
    expected = ByEstimator(gradients.Exact())(final, PARAMETERS)
    assert compare(ReferenceAdjoint("float128")(final, PARAMETERS).gradient, expected.gradient).relative_l2 < 1e-10
    frames = Problem(problem.simulation, STEPS, losses.Frames({STEPS: losses.FinalPositions(target)}))
    assert FiniteDifference(1e-5, Warp())(frames, PARAMETERS).loss == pytest.approx(expected.loss, rel=1e-6)
    with pytest.raises(InputError, match="loss has frames"):
        ReferenceAdjoint()(frames, PARAMETERS)
