"""Searches through thicker and thicker fluid: what each sees, how one follows the other, and their resumption."""

import json
from pathlib import Path

import numpy as np
import pytest

import cortado.render.renderer
from bad_tasks import GOOD_TASK, PLANE_PICTURE, TINY_LATTE
from cortado import SceneError, optimise
from cortado.cli import main
from cortado.image_losses import psnr
from cortado.optimisation.optimisers import Adam
from cortado.optimisation.task_files import load_task, setup

STAGED = "optimise.extinction_schedule=[0.25, 1.0]"


@pytest.fixture
def file(tmp_path, monkeypatch):
    """A task of a picture in a plane, in the working directory."""
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "task.toml"
    path.write_text(PLANE_PICTURE)
    return path


def images(made, values):
    """What each search sees of the same parameters."""
    ends = (search.problem.end(values) for search in made.searches)
    losses = (search.problem.loss.losses[made.problem.steps] for search in made.searches)
    return [loss.image(end) for loss, end in zip(losses, ends, strict=True)]


@pytest.mark.parametrize("fineness", [0.5, 0.25])
def test_a_layer_is_as_opaque_as_its_spacing_is_thick(file, monkeypatch, fineness):
    """How fine the nodes are does not change how opaque the plane is; factors of the extinction do."""
    monkeypatch.setitem(cortado.render.renderer.FINENESS, 2, fineness)
    task = load_task(file, [STAGED, "render.extinction=20.0", "problem.distance=squared_difference"])
    made = setup(task, "cpu", "float64")
    x = made.problem.simulation.positions
    behind, fluid = np.array([0.3, 0.2, 0.1]), np.array([0.9, 0.8, 0.7])
    thin, full = (((one - behind) / (fluid - behind))[..., 0] for one in images(made, {"initial_positions": x}))
    middle = (slice(10, 13), slice(4, 7))  # of the fluid, whose coverage there is 1 within 5 %
    np.testing.assert_allclose(-np.log(1.0 - full[middle]), 20.0 * 0.05, rtol=0.05)
    np.testing.assert_allclose(-np.log(1.0 - thin[middle]), 0.25 * 20.0 * 0.05, rtol=0.05)


@pytest.mark.parametrize("view", ["top", "volume"])
def test_other_views_become_thinner_too(tmp_path, view):
    (tmp_path / "task.toml").write_text(TINY_LATTE)
    options = ["position=[0.0, 0.2, 0.2]", "look_at=[0.0, 0.0, 0.0]"] if view == "volume" else []
    overrides = [f"render.{entry}" for entry in [f"view={view}", *options]]
    made = setup(load_task(tmp_path / "task.toml", [*overrides, STAGED]), "cpu", "float32")
    thin, full = (next(iter(s.problem.loss.losses.values())).renderer.view.extinction for s in made.searches)
    assert thin == pytest.approx(0.25 * full)
    assert made.renderer.view.extinction == full


def test_a_hidden_run_is_seen_through_the_same_fluid(tmp_path):
    """The thinner picture of the answer is the thinner target, so that every search has the same answer."""
    (tmp_path / "task.toml").write_text(TINY_LATTE)
    made = setup(load_task(tmp_path / "task.toml", [STAGED]), "cpu", "float32")
    assert len(made.searches) == 2
    for search in made.searches:
        assert search.problem.value(made.task.true_parameters) == pytest.approx(0.0, abs=1e-12)


def test_the_schedule_grows_to_one(file):
    for schedule in ("[]", "[0.5]", "[1.0, 1.0]", "[0.5, 0.25, 1.0]", "[0.0, 1.0]", '["a", 1.0]', "1.0"):
        with pytest.raises(SceneError, match=r"optimise\.extinction_schedule .*the last of them 1"):
            load_task(file, [f"optimise.extinction_schedule={schedule}"])
    file.write_text(GOOD_TASK)
    with pytest.raises(SceneError, match=r'optimise\.extinction_schedule .*left out, as problem\.loss is not "image"'):
        load_task(file, [STAGED])


def test_each_search_begins_where_the_last_one_ended(file):
    main(["optimise", "task.toml", "--no-pictures", "--set", STAGED, "--out", "run"])
    metrics = [json.loads(line) for line in Path("run/metrics.jsonl").read_text().splitlines()]
    assert [line["iteration"] for line in metrics] == list(range(10))  # 4 updates and the last iterate, twice
    made = setup(load_task(file, [STAGED]), "cpu", "float32")
    assert metrics[0]["loss"] == pytest.approx(made.searches[0].value(made.start), rel=1e-6)
    assert metrics[5]["loss"] != pytest.approx(made.searches[1].value(made.start), rel=1e-2)
    assert metrics[5]["loss"] > metrics[9]["loss"]


def test_searches_resume_bit_for_bit(file):
    """Even when interrupted in the second one; and with another schedule they are refused."""
    main(["optimise", "task.toml", "--no-pictures", "--set", STAGED, "--out", "whole"])
    main(["optimise", "task.toml", "--no-pictures", "--set", STAGED, "--out", "cut"])
    log, metrics = Path("cut/checkpoint/1/replay.log"), Path("cut/metrics.jsonl")
    log.write_bytes(log.read_bytes()[: int(0.6 * log.stat().st_size)])
    metrics.write_text("".join(metrics.read_text().splitlines(keepends=True)[:7]))
    main(["optimise", "task.toml", "--no-pictures", "--set", STAGED, "--out", "cut", "--resume"])
    for name in ("metrics.jsonl", "checkpoint/replay.log", "checkpoint/1/replay.log"):
        assert (Path("cut") / name).read_bytes() == (Path("whole") / name).read_bytes()
    again = ["--set", "optimise.extinction_schedule=[0.5, 1.0]", "--out", "cut", "--resume"]
    with pytest.raises(SystemExit, match="2"):
        main(["optimise", "task.toml", "--no-pictures", *again])


def test_thin_fluid_first_gathers_what_thick_fluid_leaves_behind(file):
    """Particles from random places fill a picture if they begin as thin fluid: Figure 1 in small."""
    scene = ["discretisation.spacing=0.025", "discretisation.support=3.0", "fluid.0.upper=[0.5, 0.5]"]
    scene += ["container.upper=[1.0, 1.0]", "render.resolution=[40, 40]"]
    scene += ["optimise.bounds={initial_positions=[[0.0, 0.0], [1.0, 1.0]]}"]
    schedules = ("[1.0]", "[0.0625, 0.25, 1.0]")
    thick, thin = (_reached(file, [*scene, f"optimise.extinction_schedule={one}"]) for one in schedules)
    assert thick < 20.0 and thin > 28.0


def _reached(file, overrides):
    """Peak signal-to-noise ratio [dB] after 180 iterations in all."""
    made = setup(load_task(file, overrides), "cpu", "float32")
    found = made.start
    for search in made.searches:
        found = optimise(search, found, Adam(0.012), 180 // len(made.searches), made.bounds).last_parameters
    return psnr(made.image(made.problem.end(found)), made.targets[0])
