"""What is shown of results: a few words, never the numbers of an array; in notebooks a picture or a table too."""

import json
import pickle
import re
import sys
from base64 import b64decode
from html import unescape
from io import BytesIO

import numpy as np
import pytest
from PIL import Image

import cortado
from cortado import Problem, Simulation, gradients, losses
from scenes import plane, plane_of_three


@pytest.fixture(scope="module")
def simulation():
    return Simulation(plane())


@pytest.fixture(scope="module")
def trajectory(simulation):
    return simulation.run(4)


@pytest.fixture(scope="module")
def problem(simulation):
    return Problem(simulation, 4, losses.FinalPositions(0.9 * simulation.positions))


@pytest.fixture(scope="module")
def result(problem):
    start = {"gravity": np.array([0.0, -9.0]), "viscosity": 0.05}
    return cortado.optimise(problem, start, "adam", learning_rate=0.01, iterations=2)


@pytest.fixture(scope="module")
def certificate(problem):
    return cortado.certify(problem)


def test_what_runs(simulation, problem):
    assert repr(simulation) == "Simulation(64 particles, 1 phase, cpu, float32)"
    three = Simulation(plane_of_three(), precision="float64")
    assert repr(three) == "Simulation(64 particles, 3 phases, cpu, float64)"
    assert repr(problem) == f"Problem(4 steps of {simulation!r}, judged by FinalPositions)"

    def height(positions, velocities, loss):
        """Never called."""

    assert repr(Problem(simulation, 1, height)) == f"Problem(1 step of {simulation!r}, judged by height)"
    assert repr(simulation.renderer(resolution=(20, 10))) == "Renderer(TopView, 20 x 10 pixels, 64 particles)"


def test_what_a_run_leaves(trajectory, problem):
    assert repr(trajectory) == "Trajectory(5 frames of 64 particles, 0 to 0.0084 s)"
    assert repr(trajectory[:0]) == "Trajectory(0 frames of 64 particles)"
    assert repr(trajectory[-1]) == "Frame(64 particles, t = 0.0084 s)"
    assert repr(problem.end({})) == "Snapshot(64 particles, float32)"
    restart = repr(trajectory.last_state)
    names = "positions: array (64, 2), velocities: array (64, 2), mass_fractions: array (64, 1), reference_density: "
    assert restart.startswith(f"RestartState(fields={{{names}array (64,)}}, clock=Clock(steps=4, time=0.0084")


def test_what_a_search_finds(result):
    words = r"Result\(gravity \(2,\), viscosity: loss [\d.e-]+ after 3 evaluations; Adam made all its 2 updates\)"
    assert re.fullmatch(words, repr(result))
    assert re.fullmatch(r"Record\(iteration 0: loss [\d.e-]+, gradient norm [\d.e-]+\)", repr(result.history[0]))


def test_what_an_estimator_says(problem):
    at = {"gravity": np.array([0.0, -9.0]), "viscosity": 0.05}
    exact = repr(problem.estimate(at))
    assert re.fullmatch(r"Estimate\(loss [\d.e-]+, gradient of gravity \(2,\), viscosity\)", exact)
    smoothed = repr(problem.estimate({"gravity": at["gravity"]}, gradients.RandomizedSmoothing({"gravity": 0.1}, 2)))
    assert smoothed.endswith(", gradient of gravity (2,), with its standard error)")


def test_a_certificate_is_a_table(certificate):
    assert repr(certificate) == "Certificate(64 particles, 4 steps, right, horizon 4, use gradients.Exact())"
    assert re.search(r"│ gravity +│ \d\.\d{3}e-\d\d +│ right +│", str(certificate))
    assert "array(" not in repr(certificate.consistency) and "array(" not in repr(certificate.horizons)
    html = certificate._repr_html_()
    assert html.startswith("<pre>") and html.endswith("</pre>") and "│ gravity" in html


def test_a_certificate_is_the_same_text_in_a_notebook(certificate, monkeypatch):
    text = str(certificate)
    monkeypatch.setattr("rich.console._is_jupyter", lambda: True)
    assert str(certificate) == text and "adjoint" in text.splitlines()[2]


def pictures(html: str) -> list[np.ndarray]:
    """(rows, columns) greys of every picture in a page."""
    found = re.findall(r'src="data:image/png;base64,([^"]*)"', html)
    return [np.asarray(Image.open(BytesIO(b64decode(one))).convert("L")) for one in found]


def cells(html: str) -> list[list[str]]:
    """The rows of the table in a page, below its head."""
    rows = re.findall("<tr>(.*?)</tr>", html)[1:]
    return [[unescape(cell) for cell in re.findall("<td[^>]*>(.*?)</td>", row)] for row in rows]


@pytest.mark.parametrize("name", ["simulation", "trajectory"])
def test_a_notebook_shows_a_picture(name, request):
    found = request.getfixturevalue(name)
    html = found._repr_html_()
    (pixels,) = pictures(html)
    assert pixels.shape[1] >= 1000 and 0.001 < np.mean(pixels < 200) < 0.9
    assert html.startswith(f"<p>{repr(found)[:10]}")


def test_a_notebook_shows_what_a_search_found(result, problem, simulation):
    before = problem.value({})
    html = result._repr_html_()
    ends, losses = pictures(html)
    assert min(ends.shape[1], losses.shape[1]) >= 1000
    thirds = np.array_split(ends < 200, 3, axis=1)
    assert all(0.02 < np.mean(one) < 0.5 for one in thirds)  # first, found and target
    (name, unit, first, found), (_, other_unit, _, number) = cells(html)
    assert (name, unit, first, other_unit) == ("gravity", "m/s²", "0, -9", "Pa s")
    assert found == ", ".join(f"{g:.4g}" for g in result.parameters["gravity"]) and float(number) > 0.0
    assert problem.value({}) == before and pickle.loads(pickle.dumps(result)).problem is None


def test_a_search_of_images_shows_images(simulation):
    renderer = simulation.renderer(resolution=(30, 20))
    loss = losses.Image(renderer, np.ones(renderer.shape))
    problem = Problem(simulation, 3, losses.Frames({1: loss, 3: loss}))
    start = {"initial_positions": simulation.positions}
    html = cortado.optimise(problem, start, "adam", learning_rate=1e-3, iterations=1)._repr_html_()
    assert len(pictures(html)) == 2
    ((name, unit, first, _),) = cells(html)
    assert (name, unit) == ("initial positions", "m") and first.startswith("(64, 2) numbers, ")


def test_a_search_of_a_function_shows_its_losses(monkeypatch):
    def square(parameters):
        return float(parameters["gravity"] ** 2), {"gravity": 2.0 * parameters["gravity"]}

    result = cortado.optimise(square, {"gravity": 3.0}, "adam", learning_rate=0.1, iterations=2)
    html = result._repr_html_()
    assert len(pictures(html)) == 1 and cells(html) == [["gravity", "-", "3", f"{result.parameters['gravity']:.4g}"]]
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    assert pictures(result._repr_html_()) == [] and "Result(gravity" in result._repr_html_()


def test_a_first_guess_that_diverges_has_no_picture(result, monkeypatch):
    def lost(*_):
        raise cortado.DivergedError(1, 2, "try less")

    monkeypatch.setattr(Problem, "states", lost)
    assert len(pictures(result._repr_html_())) == 1


def test_a_notebook_plays_a_trajectory(trajectory):
    (page,) = re.findall(r'<iframe srcdoc="([^"]*)"', trajectory._repr_html_())
    data = json.loads(unescape(page).partition('"application/json">')[2].partition("</script>")[0])
    assert len(data["times"]) == len(trajectory) and data["particles"] == 64
    assert data["radius"] == pytest.approx(0.56 * 0.05, rel=0.3)


def test_a_trajectory_of_nothing_has_no_picture(trajectory):
    assert trajectory[:0]._repr_html_() == "<pre>Trajectory(0 frames of 64 particles)</pre>"


def test_no_repr_is_long(simulation, trajectory, problem, result, certificate):
    """Whatever the number of particles, parameters and steps."""
    shown = [simulation, trajectory, trajectory[0], problem, result, result.history[0], certificate, problem.end({})]
    assert all(len(repr(one)) < 200 and "\n" not in repr(one) and "[" not in repr(one) for one in shown)
