"""The experiments of the report's figures in their reduced form, the files of experiments, and the two commands."""

import json
import shutil
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from bad_scenes import assert_one_sentence
from cortado.cli import main
from cortado.reference import Simulation, Terms
from experiments.__main__ import EXPERIMENTS as EXPERIMENTS_PROGRAM
from experiments.experiment_files import load_experiment
from experiments.forces import ABLATIONS, FULL
from experiments.gravity_and_precision import ANALYTIC, DIFFERENCES
from experiments.image_horizon import ADJOINT, TAPE
from experiments.pressure_terms import ONE_STEP, PROPAGATED
from experiments.scenes import varied
from experiments.tables import Table
from experiments.term_sizes import term_sizes
from scenes import scene

EXPERIMENTS = Path(__file__).parents[1] / "experiments"
FIGURES = ["figure_1", "figure_2_small", "figure_3_small", "figure_4", "figure_5", "figure_6", "figure_7"]


@pytest.fixture
def gradients(cortado_command):
    return partial(cortado_command, program=EXPERIMENTS_PROGRAM)


@pytest.fixture(scope="module")
def measured(tmp_path_factory):
    """The reduced form of a figure, measured once: (its numbers, its folder)."""
    folder = tmp_path_factory.mktemp("study")

    def figure(name):
        out = folder / name
        if not out.exists():
            main(["figure", str(EXPERIMENTS / f"{name}.toml"), "--reduced", "--out", str(out)], EXPERIMENTS_PROGRAM)
        return Table.read_csv(out / "data.csv"), out

    return figure


def norms(table, **values):
    return table.where(**values)["norm"]


@pytest.mark.parametrize("name", FIGURES)
def test_a_figure_is_measured_drawn_and_judged(name, measured):
    _, out = measured(name)
    picture = Image.open(out / "figure.png")
    pixels = np.asarray(picture.convert("L"))
    assert picture.width >= 1200 and 0.005 < np.mean(pixels < 200) < 0.9
    title, *sentences = (out / "verdict.txt").read_text().splitlines()
    record = json.loads((out / "verdict.json").read_text())
    assert record["verdict"] == sentences and record["settings"]["title"] == title and record["reduced"]
    assert len(sentences) >= 2 and all(s.endswith(".") and any(c.isdigit() for c in s) for s in sentences)
    assert "nan" not in " ".join(sentences)


def test_pictures_come_nearer_to_the_target(measured):
    table, _ = measured("figure_1")
    losses = table.where(picture="")["loss"]
    assert losses[-1] < 0.5 * losses[len(losses) // 3 * 2]
    assert table.values("picture")[:3] == ["", "target", "iteration 0"]
    assert len(table.where(picture="target")) == 32 * 32


def test_autograd_and_the_adjoint_agree_with_differences_while_little_has_grown(measured):
    table, _ = measured("figure_3_small")
    names = TAPE, ADJOINT, "finite differences, step 0.1 m/s²"
    tape, adjoint, difference = (np.stack([table.where(source=name)[axis] for axis in "xyz"]) for name in names)
    np.testing.assert_allclose(tape, adjoint, rtol=1e-4, atol=1e-4 * np.abs(adjoint).max())
    assert np.linalg.norm(difference - adjoint) < 0.05 * np.linalg.norm(adjoint)


def test_analytic_norms_grow_with_gravity_and_differences_less(measured):
    table, _ = measured("figure_4")
    exact, differences = (norms(table, method=method, precision="float64") for method in (ANALYTIC, DIFFERENCES))
    assert exact[1] > 5.0 * exact[0] and differences[1] < 0.8 * exact[1]
    np.testing.assert_allclose(norms(table, method=ANALYTIC, precision="float32"), exact, rtol=0.05)


def test_without_pressure_there_is_free_fall(measured):
    table, _ = measured("figure_6")
    assert table.values("forces") == list(ABLATIONS)
    steps, fall = table.where(forces="neither")["step"], norms(table, forces="neither")
    np.testing.assert_allclose(fall, np.sqrt(125) * 0.0021**2 * steps * (steps + 1) / 2, rtol=1e-9)
    for name in ("no pressure", "pressure without its derivative"):
        np.testing.assert_allclose(norms(table, forces=name), fall, rtol=1e-2)
    assert norms(table, forces=FULL)[-1] > 3.0 * fall[-1] < norms(table, forces="no viscosity")[-1]


def test_differences_follow_the_derivative_until_they_do_not(measured):
    table, _ = measured("figure_5")
    exact, found = (norms(table, forces=FULL, difference=step) for step in (0.0, 0.01))
    np.testing.assert_allclose(found[1:120], exact[1:120], rtol=0.05)
    assert len(norms(table, forces="pressure without its derivative", difference=0.01)) == 0


def test_terms_differ_once_there_is_pressure(measured):
    table, _ = measured("figure_7")
    last = [rows["norm"][-1] for _, rows in table.where(quantity=PROPAGATED, precision="float64").groups("terms")]
    assert len(set(last)) == 3 and last[2] > 2.0 * last[0]
    sizes = {name: rows["norm"][130:] for (name,), rows in table.where(quantity=ONE_STEP).groups("terms")}
    both, hessian, density = sizes.values()
    assert (both <= 3.0 * (hessian + density)).all() and (density > hessian).mean() > 0.8


def test_sizes_of_terms_are_those_of_the_exact_tangent():
    fluid = varied(scene(), forces={"viscosity": "none"})
    sizes = term_sizes(fluid, 6, "float64", {"all": Terms()})["all"]
    down = {"gravity": (0.0, -1.0, 0.0)}
    exact = Simulation(fluid).tangent({"gravity": fluid.forces.gravity}, down, 6).velocity_tangents.high
    by_pressure = np.diff(exact, axis=0) / fluid.solver.time_step - down["gravity"]
    np.testing.assert_allclose(sizes, np.linalg.norm(by_pressure, axis=(1, 2)), rtol=1e-9, atol=1e-12)
    assert (sizes[:4] > 0.1).all()


@pytest.mark.parametrize("file", sorted(EXPERIMENTS.glob("*.toml")), ids=lambda file: file.stem)
@pytest.mark.parametrize("reduced", [False, True])
def test_every_experiment_can_be_read(file, reduced):
    assert load_experiment(file, reduced).name == file.stem


GOOD = (EXPERIMENTS / "figure_6.toml").read_text().replace("scenes/", f"{EXPERIMENTS}/scenes/")


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('kind = "forces"', 'kind = "force"', ["experiment.toml: kind is 'force'", '"forces"']),
        ("steps = 400", "steps = 4", ["experiment.toml: steps is 4", "from 8"]),
        ("steps = 400", "step = 400", ["step is not a key", "did you mean steps?"]),
        ("impact = 150", "", ["impact is missing", "a whole number"]),
        ("impact = 150", "impact = 150\ndifferences = [0.1, -0.1]", ["differences[1] is -0.1", "greater than 0 m/s2"]),
        ("[reduced]", "[[reduced]]", ["reduced is"]),
        ("scenes/splash.toml", "scenes/absent.toml", ["absent.toml: the scene cannot be read"]),
        ("scene = ", "scene = { dimension = 2 } #", ["experiment.toml: discretisation is missing"]),
    ],
)
def test_a_bad_experiment_is_refused_in_a_sentence(tmp_path, monkeypatch, gradients, old, new, words):
    monkeypatch.chdir(tmp_path)
    assert old in GOOD
    Path("experiment.toml").write_text(GOOD.replace(old, new, 1))
    code, out, err = gradients("figure", "experiment.toml")
    assert (code, out) == (2, "")
    assert_one_sentence(err.removesuffix("\n"))
    assert all(word in err for word in words), err
    assert not Path("runs").exists()


def test_a_scene_is_changed_in_the_file(tmp_path):
    scene = f'{{ file = "{EXPERIMENTS}/scenes/splash.toml", phase.viscosity = 0.5, forces.viscosity = "stress" }} #'
    (tmp_path / "changed.toml").write_text(GOOD.replace("scene = ", f"scene = {scene}", 1))
    settings = load_experiment(tmp_path / "changed.toml", overrides=["steps=99"]).settings
    assert (settings.scene.phase[0].viscosity, settings.scene.forces.viscosity) == (0.5, "stress")
    assert (settings.scene.solver.time_step, settings.steps) == (0.0021, 99)


def test_a_figure_is_drawn_again_from_its_numbers(measured, tmp_path, gradients):
    _, done = measured("figure_6")
    out = tmp_path / "again"
    shutil.copytree(done, out)
    table = Table.read_csv(out / "data.csv")
    Table({**table.columns, "norm": 2.0 * table["norm"]}).write_csv(out / "data.csv")
    file = EXPERIMENTS / "figure_6.toml"
    code, printed, _ = gradients("figure", file, "--reduced", "--redraw", "--out", out)
    assert code == 0 and printed.splitlines()[-1] == f"The results are in {out}; open figure.png."
    assert (out / "figure.png").read_bytes() != (done / "figure.png").read_bytes()
    code, _, err = gradients("figure", file, "--redraw", "--out", tmp_path / "absent")
    assert code == 2 and "cannot be read" in err


@pytest.fixture
def folder(tmp_path):
    made = tmp_path / "experiments"
    made.mkdir()
    (made / "quick.toml").write_text(GOOD.replace("steps = 400", "steps = 20").replace("impact = 150", "impact = 5"))
    text = (EXPERIMENTS / "figure_3.toml").read_text().replace("scenes/", f"{EXPERIMENTS}/scenes/")
    (made / "remote.toml").write_text(text.replace('"cuda:0"', '"cuda:99"'))
    return made


def test_a_study_resumes_and_leaves_out_what_needs_a_gpu(folder, tmp_path, gradients, monkeypatch):
    monkeypatch.setattr("experiments.run_study._has_gpu", lambda: False)
    out = tmp_path / "study"
    code, printed, err = gradients("study", folder, "--out", out)
    assert code == 0 and err == "quick ...\n"
    assert "Left out: it needs a GPU" in printed and printed.splitlines()[-1].startswith(f"The results are in {out}")
    data = out / "quick" / "data.csv"
    data.write_text("kept")
    code, again, err = gradients("study", folder, "--out", out)
    assert (code, again, err) == (0, printed, "") and data.read_text() == "kept"
    (folder / "quick.toml").write_text((folder / "quick.toml").read_text().replace("steps = 20", "steps = 21"))
    code, _, err = gradients("study", folder, "--out", out, "--only", "quick")
    assert (code, err) == (0, "quick ...\n") and data.read_text() != "kept"


def test_an_experiment_that_fails_does_not_stop_the_study(folder, tmp_path, gradients, monkeypatch):
    monkeypatch.setattr("experiments.run_study._has_gpu", lambda: True)
    code, printed, err = gradients("study", folder, "--out", tmp_path / "study")
    assert code == 1 and "These experiments failed: remote." in err
    assert "Failed: device is 'cuda:99'" in printed and "Analytic, all forces" in printed
