"""The measuring parts of the study's own experiments, on cases whose answers are known."""

from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cortado.scene.scene import scene_from_dict
from experiments import spatial_scales
from experiments.estimates import Estimate, growth_rate, norms
from experiments.experiment_files import load_experiment
from experiments.lyapunov_spectrum import growth_by_segment
from experiments.results import Results
from experiments.wrong_adjoints import CLAMP, LINEAR, RIGHT, WALLS, WRONG_ADJOINTS
from scenes import box

EXPERIMENTS = Path(__file__).parents[1] / "experiments"


def test_an_estimate_is_a_mean_with_its_standard_error():
    samples = np.random.default_rng(0).normal(3.0, 0.5, size=400)
    found = Estimate.of(samples)
    assert abs(found.value - 3.0) < 4 * found.error
    assert found.error == pytest.approx(0.5 / 20, rel=0.1)
    assert np.isnan(Estimate.of([1.0]).error)
    ratio = Estimate(6.0, 0.3).over(Estimate(2.0, 0.24))
    assert (ratio.value, ratio.error) == pytest.approx((3.0, 3.0 * np.hypot(0.05, 0.12)))


def test_an_estimate_shows_the_digits_that_it_knows():
    texts = {(0.04731, 0.00123): "0.0473 ± 0.0012", (334.2, 29.1): "334 ± 29", (2.5e-9, 1e-10): "(2.50 ± 0.10)e-9"}
    assert [str(Estimate(*given)) for given in [*texts, (1.5, np.nan)]] == [*texts.values(), "1.5"]


def test_growth_is_the_rate_of_an_exponential_and_what_cannot_be_squared_has_an_infinite_norm():
    steps = np.arange(50)
    assert growth_rate(steps, 3.0 * np.exp(0.05 * steps)) == pytest.approx(0.05)
    assert np.isnan(growth_rate(steps[:2], steps[:2] + 1.0))
    assert norms(np.array([[[3.0, 4.0]], [[1e200, 0.0]], [[np.nan, 0.0]]])).tolist() == [5.0, np.inf, np.inf]


def test_exponents_of_the_henon_map():
    """Known: 0.41922 and ln 0.3 - 0.41922 (Sprott 2003)."""

    def push(state, vectors):
        for _ in range(5):
            x, y = state
            vectors = vectors @ np.array([[-2.8 * x, 1.0], [0.3, 0.0]]).T
            state = 1.0 - 1.4 * x * x + y, 0.3 * x
        return state, vectors

    rates = growth_by_segment(push, (0.1, 0.1), np.eye(2), 8000)[20:].mean(axis=0) / 5
    assert rates[0] == pytest.approx(0.4192, abs=0.004)
    assert rates.sum() == pytest.approx(np.log(0.3), abs=1e-9)


LOWER, UPPER = (0.0, 0.0, 0.0), (0.4, 0.6, 0.25)


def particles(count=150):
    return np.random.default_rng(5).uniform(LOWER, UPPER, size=(count, 3))


def test_a_picture_changes_as_its_particles_move():
    x, u = particles(20), np.random.default_rng(6).normal(size=(20, 3))

    def picture(positions):
        ends = zip(x[:, :2].min(axis=0) - 0.15, x[:, :2].max(axis=0) + 0.15, strict=True)
        axes = [np.arange(a, b, 0.05) for a, b in ends]
        pixels = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 1, 2)
        return np.exp(-0.5 * ((pixels - positions[:, :2]) ** 2).sum(axis=2) / 0.05**2).sum(axis=1)

    difference = (picture(x + 1e-6 * u) - picture(x - 1e-6 * u)) / 2e-6
    assert spatial_scales.picture_change(x, u, 0.05) == pytest.approx(difference, rel=1e-6, abs=1e-7)
    assert not spatial_scales.picture_change(x, u * [0.0, 0.0, 1.0], 0.05).any()


FREE = {"minimum_iterations": 3, "maximum_iterations": 3, "density_tolerance": 0.01}
SCENE = {
    "name": "drop",
    "dimension": 2,
    "discretisation": {"spacing": 0.05, "support": 2.0, "kernel": "cubic_spline"},
    "phase": [{"name": "water", "rest_density": 1000.0, "viscosity": 0.05}],
    "fluid": [box([0.0, 0.05], [0.2, 0.25], phase="water")],
    "container": box([0.0, 0.0], [0.35, 0.5]),
    "forces": {"gravity": [0.0, -9.81], "viscosity": "pairwise", "pressure": True},
    "solver": {"kind": "pcisph", "time_step": 0.002, **FREE},
}


ADAPTED = {
    "wrong_adjoints": ["start=40"],
    **{name: ["direction=[0.0, 1.0]"] for name in ("wrong_derivation", "step_size", "round_off")},
    "lyapunov": ["fall=0.05"],
    "locality": ["direction=[1.0, 0.0]", "long_modes=4"],
}
"""What the reduced experiments need for the scene above."""


def no_progress(total):
    return nullcontext(lambda n=1, **fields: None)


@pytest.mark.parametrize("name", ADAPTED)
def test_an_experiment_measures_draws_and_judges(name, tmp_path, unrendered):
    experiment = load_experiment(EXPERIMENTS / f"{name}.toml", reduced=True, overrides=ADAPTED[name])
    settings = experiment.settings.model_copy(update={"scene": scene_from_dict(SCENE)})
    results = Results(tmp_path)
    sentences = results.measure(replace(experiment, settings=settings))
    assert results.picture.is_file()
    assert sentences and "nan" not in " ".join(sentences)


def test_one_kernel_loops_are_wrong_only_where_the_sum_is_used_non_linearly():
    settings = load_experiment(EXPERIMENTS / "wrong_adjoints.toml", True, ADAPTED["wrong_adjoints"]).settings
    table = WRONG_ADJOINTS.measure(settings.model_copy(update={"scene": scene_from_dict(SCENE)}), no_progress)
    for way in (RIGHT, LINEAR):
        assert table.where(way=way)["error"].max() < 1e-10
    for way in (CLAMP, WALLS):
        assert table.where(way=way, parameter="initial_positions")["error"].max() > 1e-2
