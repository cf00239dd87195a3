"""The measuring parts of the study's own experiments, on cases whose answers are known."""

import json
import os
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cortado.discretise.smoothing import CUBIC_SPLINE
from cortado.reference import Simulation
from cortado.scene.scene import scene_from_dict
from experiments import spatial_scales
from experiments.ensembles import perturbed, side_by_side
from experiments.estimates import Estimate, Line, growth_rate, norms
from experiments.experiment_files import load_experiment
from experiments.lyapunov_spectrum import growth_by_segment
from experiments.results import Results
from experiments.wrong_adjoints import CLAMP, LINEAR, RIGHT, WALLS, WRONG_ADJOINTS
from scenes import box

EXPERIMENTS = Path(__file__).parents[1] / "experiments"


# ---- numbers with their uncertainty ------------------------------------------------------------------------------
def test_an_estimate_is_a_mean_with_its_standard_error():
    """Errors of a ratio add up as independent ones."""
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


def test_a_line_is_found_within_its_error():
    x = np.linspace(0.0, 10.0, 200)
    line = Line.through(x, 2.0 - 0.7 * x + np.random.default_rng(1).normal(0.0, 0.1, size=200))
    assert abs(line.slope.value + 0.7) < 4 * line.slope.error < 0.05
    assert abs(line.offset.value - 2.0) < 4 * line.offset.error < 0.2


def test_growth_is_the_rate_of_an_exponential_and_what_cannot_be_squared_has_an_infinite_norm():
    steps = np.arange(50)
    assert growth_rate(steps, 3.0 * np.exp(0.05 * steps)) == pytest.approx(0.05)
    assert np.isnan(growth_rate(steps[:2], steps[:2] + 1.0))
    assert norms(np.array([[[3.0, 4.0]], [[1e200, 0.0]], [[np.nan, 0.0]]])).tolist() == [5.0, np.inf, np.inf]


# ---- Lyapunov exponents ------------------------------------------------------------------------------------------
def test_exponents_of_the_cat_map():
    matrix = np.array([[2.0, 1.0], [1.0, 1.0]])
    logarithms = growth_by_segment(lambda state, v: (state, v @ matrix.T), None, np.eye(2), 60)
    golden = np.log((3.0 + np.sqrt(5.0)) / 2.0)
    assert logarithms[10:].mean(axis=0) == pytest.approx([golden, -golden], abs=1e-12)


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


def test_growth_in_segments_of_the_engine_is_that_of_one_run():
    """Restarted from its own states, a tangent is the same; and so is the area between two."""
    scene = scene_from_dict(SCENE)
    simulation = Simulation(scene, threads=1)
    shape = simulation.positions.shape

    def pushed(state, vectors, steps):
        found = []
        for x_dot, v_dot in vectors.reshape(-1, 2, *shape):
            along = {"initial_positions": x_dot, "initial_velocities": v_dot}
            after = simulation.tangent(state, along, steps, record_every=steps)
            found.append(np.stack([after.position_tangents.high[1], after.velocity_tangents.high[1]]).ravel())
        return {"initial_positions": after.positions[1], "initial_velocities": after.velocities[1]}, np.array(found)

    start = {"initial_positions": perturbed(simulation, 0, 0.05), "initial_velocities": simulation.velocities}
    vectors = np.random.default_rng(3).normal(size=(2, 2 * np.prod(shape)))
    found = growth_by_segment(lambda state, frame: pushed(state, frame, 5), start, vectors, 8).sum(axis=0)
    frame = np.linalg.qr(vectors.T)[0].T
    _, (first, second) = pushed(start, frame, 40)
    assert found[0] == pytest.approx(np.log(np.linalg.norm(first)), rel=1e-9)
    area = np.linalg.norm(first) * np.linalg.norm(second - first * (first @ second) / (first @ first))
    assert found.sum() == pytest.approx(np.log(area), rel=1e-9)


# ---- spatial scales ----------------------------------------------------------------------------------------------
LOWER, UPPER = (0.0, 0.0, 0.0), (0.4, 0.6, 0.25)


def particles(count=150):
    return np.random.default_rng(5).uniform(LOWER, UPPER, size=(count, 3))


def noise(count=150, seed=6):
    return np.random.default_rng(seed).normal(size=(count, 3))


def test_moving_all_alike_is_common_and_in_the_first_mode():
    """One particle takes part alone."""
    x, u, alone = particles(), np.tile([1.0, -2.0, 0.5], (150, 1)), np.zeros((150, 3))
    assert spatial_scales.common_share(u) == pytest.approx(1.0)
    assert spatial_scales.shares_of_modes(spatial_scales.box_modes(x, LOWER, UPPER), u)[0] == pytest.approx(1.0)
    assert spatial_scales.participation(u) == pytest.approx(150)
    alone[17] = 1.0
    assert spatial_scales.participation(alone) == pytest.approx(1.0)


def test_a_sloshing_mode_is_found_where_it_belongs():
    """The longest wave of this box is along y, the second is its first harmonic along x."""
    x = particles()
    modes = spatial_scales.box_modes(x, LOWER, UPPER)
    for direction, index in ((1, 1), (0, 2)):
        u = np.zeros_like(x)
        u[:, 0] = np.cos(np.pi * x[:, direction] / UPPER[direction])
        u -= u.mean(axis=0)
        shares = spatial_scales.shares_of_modes(modes, u)
        assert shares[index] > 0.999 > 0.9 > shares[index - 1]


def test_noise_has_what_chance_gives_it():
    x = particles()
    modes = spatial_scales.box_modes(x, LOWER, UPPER)
    shares = np.mean([spatial_scales.shares_of_modes(modes, noise(seed=seed)) for seed in range(200)], axis=0)
    assert shares == pytest.approx(np.arange(1, 151) / 150, abs=0.01)
    common = np.mean([spatial_scales.common_share(noise(seed=seed)) for seed in range(400)])
    assert common == pytest.approx(1 / 150, rel=0.15)


def test_averages_keep_long_waves_and_take_noise_away():
    x = particles(600)
    long = np.cos(np.pi * x / np.array(UPPER))
    assert spatial_scales.smoothed_share(x, long, CUBIC_SPLINE, 0.1) > 0.8
    assert spatial_scales.smoothed_share(x, noise(600), CUBIC_SPLINE, 0.1) < 0.35


def test_a_picture_changes_as_its_particles_move():
    """Against a difference of two pictures; shifting the depth changes nothing."""
    x, u = particles(20), noise(20)

    def picture(positions):
        ends = zip(x[:, :2].min(axis=0) - 0.15, x[:, :2].max(axis=0) + 0.15, strict=True)
        axes = [np.arange(a, b, 0.05) for a, b in ends]
        pixels = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 1, 2)
        return np.exp(-0.5 * ((pixels - positions[:, :2]) ** 2).sum(axis=2) / 0.05**2).sum(axis=1)

    difference = (picture(x + 1e-6 * u) - picture(x - 1e-6 * u)) / 2e-6
    assert spatial_scales.picture_change(x, u, 0.05) == pytest.approx(difference, rel=1e-6, abs=1e-7)
    assert not spatial_scales.picture_change(x, u * [0.0, 0.0, 1.0], 0.05).any()


# ---- runs, and whole experiments ---------------------------------------------------------------------------------
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


def test_first_states_differ_by_seed_and_no_further_than_asked():
    simulation = Simulation(scene_from_dict(SCENE), threads=1)
    one, other = (perturbed(simulation, seed, 0.02) for seed in (0, 1))
    assert 0.0 < np.abs(one - simulation.positions).max() <= 0.02 * 0.05
    assert not np.array_equal(one, other) and np.array_equal(one, perturbed(simulation, 0, 0.02))


def test_tasks_side_by_side_keep_their_order():
    done = []
    assert side_by_side([lambda k=k: k * k for k in range(20)], lambda: done.append(1)) == [k * k for k in range(20)]
    assert len(done) == 20


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
def test_an_experiment_measures_draws_and_judges(name, tmp_path):
    experiment = load_experiment(EXPERIMENTS / f"{name}.toml", reduced=True, overrides=ADAPTED[name])
    settings = experiment.settings.model_copy(update={"scene": scene_from_dict(SCENE)})
    results = Results(tmp_path)
    sentences = results.measure(replace(experiment, settings=settings))
    assert results.picture.stat().st_size > 20_000
    assert sentences and "nan" not in " ".join(sentences)


@pytest.mark.parametrize("damage", ["pipe", "list", "torn", "no verdict"])
def test_a_damaged_record_is_no_result(tmp_path, damage):
    experiment = load_experiment(EXPERIMENTS / "wrong_adjoints.toml", reduced=True)
    results = Results(tmp_path)
    record = {"kind": experiment.type.name, "settings": experiment.settings.identity()}
    results.record.write_text(json.dumps({**record, "verdict": ["It is so."]}))
    assert results.has(experiment) and results.verdict() == ["It is so."]
    results.record.unlink()
    if damage == "pipe":
        os.mkfifo(results.record)
    else:
        results.record.write_text({"list": "[1]", "torn": "{", "no verdict": json.dumps(record)}[damage])
    assert not results.has(experiment)


def test_one_kernel_loops_are_wrong_only_where_the_sum_is_used_non_linearly():
    settings = load_experiment(EXPERIMENTS / "wrong_adjoints.toml", True, ADAPTED["wrong_adjoints"]).settings
    table = WRONG_ADJOINTS.measure(settings.model_copy(update={"scene": scene_from_dict(SCENE)}), no_progress)
    for way in (RIGHT, LINEAR):
        assert table.where(way=way)["error"].max() < 1e-10
    for way in (CLAMP, WALLS):
        assert table.where(way=way, parameter="initial_positions")["error"].max() > 1e-2
