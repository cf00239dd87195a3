"""Fits of measured experiments: error bars that hold the truth, tangents that are right, and mistakes in sentences."""

import pickle
from html import escape
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

import cortado
from bad_scenes import one_sentence
from cortado import ComputationError, DivergedError, InputError, measured
from cortado.optimisation.fitting.certainty import correlation_time, independent_frames, score_covariance
from cortado.optimisation.fitting.doubts import TOO_LARGE_IN_MOTION, still_and_moving
from cortado.optimisation.fitting.fit import with_error
from cortado.optimisation.fitting.least_squares import whitened
from cortado.optimisation.fitting.observations import Frames
from cortado.sensors import PressureProbe, WallForce, WaveGauge
from scenes import box, plane, pool

STEPS, TIME_STEP = 12, 0.005
TRUE = 2.0
SYRUP = {"name": "water", "rest_density": 1300.0, "viscosity": TRUE, "colour": [0.45, 0.12, 0.03]}
TABLES = {"container": box([0.0, 0.0], [0.48, 0.36], slip="no"), "forces": {"viscosity": "stress"}, "phase": [SYRUP]}
SOLVER = {"kind": "pcisph", "time_step": TIME_STEP, "minimum_iterations": 3, "maximum_iterations": 3}
SCENE = pool([0.18, 0.24], [0.48, 0.36], 0.03, solver=SOLVER, **TABLES)


def design(frames, rows, columns):
    """(frames, m, 2): a front that moves, seen by two parameters."""
    t = np.linspace(0.1, 1.0, frames)[:, None, None]
    y, x = np.mgrid[:rows, :columns]
    front = np.exp(-(((x - columns * (0.2 + 0.5 * t)) / 2.0) ** 2))
    return np.stack([t * front, t**2 * front * (1.0 - y / rows)], axis=-1).reshape(frames, -1, 2)


def noise_of(random, frames, rows, columns, kept):
    fresh = random.standard_normal((frames, rows, columns))
    fresh = np.stack([gaussian_filter(one, 2, mode="wrap") for one in fresh])
    fresh += 0.2 * random.standard_normal((frames, 1, 1))
    for f in range(1, frames):
        fresh[f] = kept * fresh[f - 1] + np.sqrt(1.0 - kept**2) * fresh[f]
    return fresh.reshape(frames, -1)


def linear_fit(J, y):
    flat = J.reshape(-1, J.shape[-1])
    inverse = np.linalg.inv(flat.T @ flat)
    estimate = inverse @ flat.T @ y.ravel()
    return estimate, y - J @ estimate, inverse


def test_bars_hold_the_truth_where_a_count_of_pixels_does_not():
    """Of 60 linear fits with noise that is correlated in frames and over time."""
    from scipy.stats import t as student

    random, times = np.random.default_rng(0), np.arange(8.0)
    J = design(8, 12, 16)
    held, counted = [], []
    for _ in range(60):
        y = noise_of(random, 8, 12, 16, 0.5)
        estimate, r, inverse = linear_fit(J, y)
        counted.append(np.abs(estimate) < 1.96 * np.sqrt(np.diag(inverse) * np.mean(r**2)))
        time = correlation_time(J, r, inverse, times)
        white = whitened(J, times, time)
        estimate, r, inverse = linear_fit(white, whitened(y, times, time))
        score = score_covariance(white, r, inverse, independent_frames(times, time))
        size = np.sqrt(np.diag(inverse @ score.B @ inverse))
        freedom = [score.degrees_of_freedom(inverse, unit) for unit in np.eye(2)]
        held.append(np.abs(estimate) < student.ppf(0.975, freedom) * size)
    assert 0.91 < np.mean(held) < 0.99
    assert np.mean(counted) < 0.5


def test_of_one_number_per_frame_it_is_the_textbook_formula():
    """But for the factor 1 + 2 / n of a correlation time that is estimated."""
    random = np.random.default_rng(1)
    J, y = random.standard_normal((30, 1, 3)), random.standard_normal((30, 1))
    _, r, inverse = linear_fit(J, y)
    score = score_covariance(J, r, inverse, 30.0)
    wanted = inverse * (r**2).sum() / 27.0 * (1.0 + 2.0 / 30.0)
    assert inverse @ score.B @ inverse == pytest.approx(wanted, rel=0.03, abs=2e-4)
    assert score.degrees_of_freedom(inverse, np.eye(3)[0]) == pytest.approx(27.0, rel=0.02)


@pytest.mark.parametrize("true", [0.0, 3.0])
def test_a_correlation_time_is_found(true):
    random, times, found = np.random.default_rng(2), np.arange(40.0), []
    J = np.stack([np.ones(40), times / 40.0], axis=-1)[:, None, :].repeat(5, axis=1)
    kept = np.exp(-1.0 / true) if true else 0.0
    for _ in range(20):
        y = random.standard_normal((40, 5))
        for f in range(1, 40):
            y[f] = kept * y[f - 1] + np.sqrt(1.0 - kept**2) * y[f]
        _, r, inverse = linear_fit(J, y)
        found.append(correlation_time(J, r, inverse, times))
        assert np.corrcoef(whitened(y, times, true)[1:].ravel(), whitened(y, times, true)[:-1].ravel())[0, 1] < 0.3
    assert np.median(found) == pytest.approx(true, rel=0.25, abs=0.4)


@pytest.mark.parametrize(
    ("value", "error", "text"),
    [(0.8312, 0.0402, "0.83 ± 0.04"), (1.0, 0.15, "1.00 ± 0.15"), (1302.0, 26.0, "1302 ± 26"), (0.0, 3e-5, "0.000000")],
)
def test_a_value_has_the_digits_that_its_error_leaves(value, error, text):
    assert with_error(value, error).startswith(text)


def test_frames_between_steps_are_interpolated():
    frames = Frames.of(np.array([0.0, 0.25, 1.0]), 0.1, 10)
    assert frames.needed == {0, 2, 3, 10}
    assert frames.between({k: np.array([float(k)]) for k in frames.needed}).ravel() == pytest.approx([0.0, 2.5, 10.0])


@pytest.fixture(scope="module")
def simulation():
    return cortado.Simulation(SCENE, precision="float64")


def clean(simulation, **observations):
    found = measured.Experiment(simulation, observations)
    return found.measured_again(found.predicted({"viscosity": TRUE, **found.start}))


@pytest.fixture(scope="module")
def experiment(simulation):
    times = TIME_STEP * np.linspace(2.0, STEPS, 6)
    renderer = simulation.renderer(resolution=(16, 12))
    first = simulation.positions[::5] + 0.004
    empty = np.zeros((6, 1))
    return clean(
        simulation,
        camera=measured.Video(renderer, times, np.zeros((6, 12, 16, 3)), calibrate=("translation", "width")),
        tracers=measured.Tracks(simulation, first, times - 0.3 * TIME_STEP, np.zeros((6, *first.shape))),
        gauge=measured.SensorSeries(WaveGauge([0.1, 0.0], radius=0.08), times, empty, 2),
        scales=measured.SensorSeries(WallForce(), times[-4:], empty[-4:], 2, columns=["force_y"]),
    )


def assert_slopes(experiment, at, directions, h):
    """The derivatives along directions are those of differences over a step, and are given with what is predicted."""
    predicted, slopes = experiment.linearised(at, directions)
    for k, direction in enumerate(directions):
        moved = ({n: v + way * h * direction.get(n, 0.0) for n, v in at.items()} for way in (1.0, -1.0))
        ends = [experiment.predicted(one) for one in moved]
        for name, slope in slopes.items():
            difference = (ends[0][name] - ends[1][name]) / (2.0 * h)
            assert np.linalg.norm(difference - slope[..., k]) <= 1e-5 * np.linalg.norm(slope[..., k]), (name, direction)
    assert all(np.array_equal(predicted[name], one) for name, one in experiment.predicted(at).items())


def test_the_jacobian_is_the_limit_of_differences(experiment):
    at = {"viscosity": np.array(TRUE), "gravity": np.array([0.3, -9.0]), **experiment.start}
    at["camera.translation"] = np.array([1e-3, 2e-3, 0.0])  # else pixels look exactly along the faces between cells
    along = {"viscosity": 1.0, "gravity": [1.0, 0.5], "camera.width": 0.1, "camera.translation": [0.01, 0.02, 0.0]}
    directions = [{name: np.array(value)} for name, value in along.items()]
    assert_slopes(experiment, at, directions, 1e-4)


def test_viscosity_acts_as_in_a_run_with_the_value_that_is_tried():
    """A viscosity of 200 Pa s asks for implicit viscosity, one of 0.2 Pa s does not, whatever the scene has."""
    times = TIME_STEP * np.arange(1.0, 5.0)
    height = measured.SensorSeries(WaveGauge([0.1, 0.0], radius=0.08), times, np.ones((4, 1)), 2)
    scenes = (SCENE.replaced(f"phase.0.viscosity={own}") for own in (200.0, 0.2))
    simulations = (cortado.Simulation(one, precision="float64") for one in scenes)
    thick, thin = (measured.Experiment(one, {"gauge": height}) for one in simulations)
    for tried in (0.2, 200.0):
        both = [one.predicted({"viscosity": tried})["gauge"] for one in (thick, thin)]
        assert np.array_equal(*both)
        slopes = [one.linearised({"viscosity": tried}, [{"viscosity": 1.0}])[1]["gauge"] for one in (thick, thin)]
        assert np.array_equal(*slopes)
        run = measured.Experiment(thick.simulation.replaced(f"phase.0.viscosity={tried}"), {"gauge": height})
        assert np.array_equal(run.predicted({})["gauge"], both[0])


@pytest.fixture(scope="module")
def clocked(simulation):
    times, first = TIME_STEP * np.linspace(2.3, STEPS - 0.6, 9), simulation.positions[::5]
    tracers = measured.Tracks(simulation, first, times, np.zeros((9, *first.shape)), calibrate=["start"])
    gauge = WaveGauge([0.1, 0.0], radius=0.08)
    series = measured.SensorSeries(gauge, times, np.zeros((9, 1)), 2, calibrate=["start"])
    return clean(simulation, tracers=tracers, gauge=series)


def test_the_derivative_along_a_clock_is_that_of_time(clocked):
    at = {"viscosity": np.array(TRUE), "tracers.start": np.array(0.0013), "gauge.start": np.array(-0.0007)}
    along = [{"tracers.start": np.array(1.0)}, {"gauge.start": np.array(1.0), "viscosity": np.array(0.3)}]
    assert_slopes(clocked, at, along, 1e-5)


@pytest.mark.parametrize("late", [0.011, -0.008])
def test_a_fit_finds_by_how_much_a_clock_is_late(clocked, late):
    true = {"viscosity": TRUE, "tracers.start": late, "gauge.start": 0.0}
    found = cortado.fit(clocked.measured_again(clocked.predicted(true)), {"viscosity": 1.0}, starts=1)
    assert found.values["tracers.start"] == pytest.approx(late, rel=1e-3) and " s" in str(found)
    assert found.values["viscosity"] == pytest.approx(TRUE, rel=1e-3)


def test_a_fit_finds_what_was_measured_without_noise(experiment):
    found = cortado.fit(experiment, {"viscosity": 1.0})  # how far away the camera is no parallel ray tells
    assert found.converged and found.values["viscosity"] == pytest.approx(TRUE, rel=1e-4)
    assert found.values["camera.width"] == pytest.approx(0.48, rel=1e-4)
    assert found.labels == ["viscosity", "camera.translation[0]", "camera.translation[1]", "camera.width"]
    assert "viscosity" in str(found) and "Pa s" in str(found)


@pytest.fixture(scope="module")
def shaken(simulation):
    times, first = TIME_STEP * np.linspace(2.0, STEPS, 10), simulation.positions[::3]
    return clean(simulation, tracers=measured.Tracks(simulation, first, times, np.zeros((10, *first.shape))))


def with_shake(shaken, seed, size=2e-4):
    """All tracers of a frame are off by the same."""
    random, clean = np.random.default_rng(seed), shaken.observations["tracers"].measured
    shake = np.tile(random.standard_normal((len(clean), 2)), clean.shape[1] // 2)
    return shaken.measured_again({"tracers": clean + size * (shake + 0.1 * random.standard_normal(clean.shape))})


def test_bars_of_fits_hold_the_truth_where_counted_ones_do_not(shaken):
    """A handful; `python -m benchmarks.fits` counts 200."""
    fits = [cortado.fit(with_shake(shaken, seed), {"viscosity": 1.5}) for seed in range(6)]
    off = np.array([float(np.log(one.values["viscosity"] / TRUE)) for one in fits])
    bars = np.array([np.sqrt(one.coordinate_covariance[0, 0]) for one in fits])
    counted = np.array([np.sqrt(one.naive_covariance[0, 0]) for one in fits])
    assert 0.2 < np.mean((off / bars) ** 2) < 3.0
    assert np.mean((off / counted) ** 2) > 4.0
    assert all(one.intervals()["viscosity"][0] < TRUE < one.intervals()["viscosity"][1] for one in fits)


@pytest.fixture(scope="module")
def wrong(shaken):
    start, held = {"viscosity": 1.5, "gravity": [0.0, -9.0]}, {"gravity": ([0.0, -9.0],) * 2}
    return cortado.fit(with_shake(shaken, 0, 1e-5), start, held)


def test_a_wrong_model_is_doubted_and_a_notebook_shows_numbers_with_bars_and_doubts(shaken, wrong):
    page = wrong._repr_html_()
    assert "Pa s" in page and "±" in page and "data:image/png;base64," in page
    assert escape(wrong.doubts[0]) in page and page.count("<tr>") == 2
    assert repr(wrong).startswith("Fit(viscosity ") and "±" in repr(wrong)
    assert wrong.doubts and "model is" in wrong.doubts[0]
    assert not cortado.fit(with_shake(shaken, 0, 1e-5), {"viscosity": 1.5}).doubts


def test_a_fit_of_two_experiments_tells_more_and_its_profile_is_a_parabola(shaken):
    pair = [with_shake(shaken, seed) for seed in (0, 1)]
    both = cortado.fit(pair, {"viscosity": 1.5})
    alone = cortado.fit(pair[0], {"viscosity": 1.5})
    assert both.standard_errors["viscosity"] < 0.95 * alone.standard_errors["viscosity"]
    assert [part.label for part in both.parts] == ["tracers of experiment 1", "tracers of experiment 2"]
    found = cortado.fit(with_shake(shaken, 0, 1e-5), {"viscosity": 1.5}).profile("viscosity", points=3)
    assert found.deviance == pytest.approx(found.expected, rel=0.1, abs=0.05)


def test_the_posterior_is_that_of_the_bars(shaken):
    bounds = {"gravity": ([-5.0, -9.81], [5.0, -9.81])}
    found = cortado.fit(with_shake(shaken, 0, 1e-5), {"viscosity": 1.5, "gravity": [0.5, -9.81]}, bounds)
    assert found.log_posterior(found.u) == pytest.approx(0.0, abs=0.01)
    V = found.coordinate_covariance
    for away in np.linalg.cholesky(V).T * 2.0:
        assert found.log_posterior(found.u + away) == pytest.approx(-2.0, rel=0.1)
    assert found.log_posterior([0.0, 6.0]) == -np.inf == found.log_posterior([np.nan, 0.0])
    with pytest.raises(InputError, match=r"u has shape \(1,\), but must be \(2,\)"):
        found.log_posterior([0.0])
    with pytest.raises(InputError, match="was pickled without its experiments"):
        pickle.loads(pickle.dumps(found)).log_posterior(found.u)


@pytest.fixture(scope="module")
def weighed(simulation):
    times = TIME_STEP * np.linspace(1.0, STEPS, 20)
    scale = measured.SensorSeries(WallForce(), times, np.zeros((20, 1)), 2, columns=["force_y"])
    return clean(simulation, scale=scale)


def with_noise(experiment, size, wrong=0.0):
    """Of every observation, so much of its largest number, and something that is ``wrong`` besides."""
    random, noisy = np.random.default_rng(0), {}
    for name, one in experiment.observations.items():
        noise = size * np.nanmax(np.abs(one.measured)) * random.standard_normal(one.measured.shape)
        noisy[name] = one.measured + noise + wrong
    return experiment.measured_again(noisy)


def test_a_trend_in_a_single_series_is_doubted(weighed):
    drift = 0.04 * np.abs(weighed.observations["scale"].measured).max() * np.linspace(-1.0, 1.0, 20)[:, None]
    doubts = cortado.fit(with_noise(weighed, 0.01, wrong=drift), {"viscosity": 1.5}, starts=1).doubts
    assert any("The residuals of scale have a trend, from " in one for one in doubts)


def test_a_clock_that_is_late_is_doubted_where_it_is_not_searched(clocked, simulation):
    """By 8 ms: the tracers are where they should be then."""
    moved = clocked.predicted({"viscosity": TRUE, "tracers.start": 0.008, "gauge.start": 0.0})["tracers"]
    times, first = clocked.observations["tracers"].times, simulation.positions[::5]
    tracks = measured.Tracks(simulation, first, times, np.zeros((9, *first.shape)))
    late = measured.Experiment(simulation, {"tracers": tracks}).measured_again({"tracers": moved})
    found = cortado.fit(with_noise(late, 1e-4), {"viscosity": 1.5}, starts=1)
    assert any('clock right? Fit the clock by calibrate = ["start"]' in one for one in found.doubts)


def test_an_estimate_at_its_bound_is_doubted(shaken):
    found = cortado.fit(with_shake(shaken, 0, 1e-5), {"viscosity": 1.0}, {"viscosity": (0.5, 1.5)}, starts=1)
    assert any(one.startswith("viscosity is 1.5, its upper bound") for one in found.doubts)


@pytest.mark.parametrize(
    ("change", "words"),
    [("container.slip=free", "is container.slip right?"), ("phase.0.rest_density=1700", "is rest_density right?")],
)
def test_a_wrong_density_and_a_wrong_slip_are_named(change, words, experiment, simulation):
    """The data are those of another scene; the viscosity is known, else it makes up for the slip."""
    names = {"tracers", "scales"}
    observations = {name: one for name, one in experiment.observations.items() if name in names}
    other = cortado.Simulation(SCENE.replaced(change), precision="float64")
    wrong = measured.Experiment(other, observations).predicted({"viscosity": TRUE})
    own = measured.Experiment(simulation, observations).measured_again(wrong)
    found = cortado.fit(with_noise(own, 1e-3), {"viscosity": 2.0}, {"viscosity": (1.95, 2.05)}, starts=1)
    assert any(words in one for one in found.doubts), found.doubts


def test_points_whose_runs_diverge_are_counted(shaken, monkeypatch):
    predicted = measured.Experiment.predicted

    def lost(self, parameters):
        if parameters["viscosity"] > 2.5:
            raise DivergedError(3, "it is lost", "try less", 0)
        return predicted(self, parameters)

    monkeypatch.setattr(measured.Experiment, "predicted", lost)
    found = cortado.fit(with_shake(shaken, 0, 1e-5), {"viscosity": 1.5}, starts=8)
    assert found.refused > 0 and f"The runs at {found.refused} points" in str(found)
    assert "include noise only" in str(found) and "include noise only" in found._repr_html_()


def test_what_cannot_be_told_is_said(simulation, shaken):
    with pytest.raises(ComputationError, match=r"do not distinguish .* and "):
        times = TIME_STEP * np.arange(1.0, 3.0, 0.4)
        height = measured.SensorSeries(PressureProbe([0.09, 0.05]), times, np.ones((len(times), 1)), 2, noise=1.0)
        still = measured.Experiment(simulation, {"probe": height})
        cortado.fit(still, {"viscosity": 2.0, "gravity": [0.0, -9.0], "rest_density": 1300.0}, iterations=1)


TIMES = [0.0, 0.01, 0.02, 0.03]


def series(values, columns=("force_y",), *noise):
    return lambda _: measured.SensorSeries(WallForce(), TIMES, values, 2, list(columns), *noise)


def tracks(positions, places=((0.1, 0.1),)):
    return lambda simulation: measured.Tracks(simulation, places, TIMES, positions)


def video(frames, **options):
    return lambda simulation: measured.Video(simulation.renderer(resolution=(8, 8)), TIMES, frames, **options)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (series(np.zeros((4, 2)), ["force_x", "torque"]), "one unit"),
        (series(np.full((4, 1), np.nan)), "but not all NaN"),
        (series(np.zeros((4, 1)), ["force_y"], 0.0), "greater than 0"),
        (tracks(np.zeros((4, 1, 2)), [[9.0, 9.0]]), "must be within"),
        (tracks(np.zeros((4, 2, 2))), "positions has shape"),
        (video(np.zeros((4, 8, 8, 3)), calibrate=["up"]), "calib"),
        (lambda s: cortado.fit("experiment", {"viscosity": 1.0}), "must be a cortado.measured.Experiment, or a list"),
    ],
)
def test_a_mistake_is_a_sentence(make, words, simulation):
    with one_sentence(words):
        make(simulation)


def test_a_background_that_stays_tells_how_large_the_noise_is():
    random = np.random.default_rng(0)
    moves = np.linspace(0.0, 1.0, 8)[:, None] * np.r_[np.zeros(40), np.linspace(0.2, 1.0, 30)]
    noise = 0.01 * random.standard_normal(moves.shape)
    still, moving = still_and_moving(moves - noise, noise)
    assert still == pytest.approx(0.01, rel=0.2) and moving == pytest.approx(0.01, rel=0.2)
    wrong = noise + 0.05 * (moves > 0.0)
    hidden = np.where(np.arange(70) % 7 == 0, np.nan, moves - wrong)
    still, moving = still_and_moving(hidden, np.where(np.isnan(hidden), 0.0, wrong))
    assert still == pytest.approx(0.01, rel=0.2) and moving > 2.0 * TOO_LARGE_IN_MOTION * still
    assert still_and_moving(moves[:, 30:], noise[:, 30:]) == (np.inf, 0.0)  # too few that stay
    assert still_and_moving(moves, 1e-9 * noise)[0] == pytest.approx(0.002)  # rounding of what was measured


def test_a_tracer_at_the_edge_of_a_period_swims_with_the_fluid_on_both_sides():
    room = box([0.0, 0.0], [0.7, 0.8], periodic=[True, False])
    channel = cortado.Simulation(plane(fluid=[box([0.0, 0.0], [0.7, 0.4], phase="water")], container=room))
    for edge in (0.0, 0.7, -1.4):
        tracks = measured.Tracks(channel, [[edge, 0.2]], TIMES, np.zeros((4, 1, 2)))
        moved = channel.positions + 0.1 * np.outer(channel.positions[:, 0] > 0.35, [1.0, 0.0])
        assert tracks.value(SimpleNamespace(positions=moved), {}) == pytest.approx([edge + 0.05, 0.2])
