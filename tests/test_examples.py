"""What is shipped to begin with runs: the README, the examples in Python, notebooks and scenes."""

import json
import re
import runpy
import shlex
import warnings
from pathlib import Path

import matplotlib.pyplot
import numpy as np
import pytest
import warp as wp

import cortado.cli.describe
import cortado.cli.optimise
import cortado.cli.run
import cortado.cli.subcommands
import cortado.cli.sweep
from compiling_notice import without_compiling
from cortado import CortadoWarning, load_scene
from cortado.cli import main
from cortado.cli.subcommands import new_scene, templates
from cortado.optimisation.task_files import load_task
from cortado.pictures.image_files import read_picture
from cortado.rollout.run_checks import unstable_sentence
from cortado.scene.parameter_values import Tilt

FOLDER = Path(__file__).parents[1] / "examples"
MISTAKES = {
    "first_gradient.py": ("iterations=12", "iterations=2", "gravity is"),
    "custom_loss.py": ("2.0 * (share - self.wanted)", "(share - self.wanted)", "the adjoint is not the derivative"),
    "carried_cup.py": ("2.0 * end.velocities", "-2.0 * end.velocities", "water is spilt, or sloshes"),
    "eased_stirrer.py": ('"lbfgs", ITERATIONS', '"lbfgs", 1', "the mean square of the torque is"),
    "flipped_bottle.py": ("optimiser, 4)", "optimiser, 1)", "the bottle does not plunge upright where it should"),
    "kept_level.py": ("np.full(STEPS, LEVEL)", "np.full(STEPS, 1.2 * LEVEL)", "the level is"),
    "poured_jug.py": ("(-1.0, 1.0)", "(-0.01, 0.01)", "too much of the syrup is not in the glass"),
    "steered_raft.py": ("optimiser, 16,", "optimiser, 1,", "the raft is not where it should be"),
    "stirred_tank.py": ("optimiser, ITERATIONS,", "optimiser, 1,", "the viscosity is not that of the torque"),
    "struck_pillar.py": ("values[:, 0] = true", "values[:, 0] = 2.0 * true", "the density is not that of the load"),
    "two_fluids.py": ('"tilt": [20.0, 10.0]', '"tilt": [-20.0, 10.0]', "the milk is not where the tilt sends it"),
}
"""A mistake in each, and what its check says of it."""

SHORTER = {"stirred_tank.py": ("STEPS, ITERATIONS, TIME_STEP = 25, 6,", "STEPS, ITERATIONS, TIME_STEP = 5, 4,")}
"""What makes a short run of one that takes a minute."""
DRAWN = MISTAKES.keys() - {"first_gradient.py", "custom_loss.py"}
"""Those that write a picture."""


def source_of(name: str) -> str:
    source = (FOLDER / name).read_text()
    long, short = SHORTER.get(name, ("", ""))
    assert long in source
    return source.replace(long, short)


def test_there_are_eleven_short_ones():
    paths = list(FOLDER.glob("*.py"))
    assert {path.name for path in paths} == MISTAKES.keys() and len(paths) == 11
    assert all(len(path.read_text().splitlines()) <= 60 for path in paths)


@pytest.mark.parametrize("name", MISTAKES)
def test_an_example_ends_well(name, tmp_path, monkeypatch):
    (tmp_path / name).write_text(source_of(name))
    monkeypatch.chdir(tmp_path)
    runpy.run_path(name, run_name="__main__")
    written = sorted(path.name for path in tmp_path.iterdir() if path.name != name)
    assert written == ([Path(name).stem + ".png"] if name in DRAWN else [])
    for file in written:
        assert np.ptp(read_picture(tmp_path / file)) > 0.5


@pytest.mark.parametrize("name", MISTAKES)
def test_its_check_can_fail(name, tmp_path, monkeypatch):
    right, wrong, said = MISTAKES[name]
    source = source_of(name)
    assert source.count(right) == 1
    (tmp_path / name).write_text(source.replace(right, wrong))
    monkeypatch.chdir(tmp_path)
    with pytest.raises(AssertionError, match=f"^{re.escape(said)}"):
        runpy.run_path(name, run_name="__main__")


BOOKS = {path.stem: path for path in sorted((Path(__file__).parents[1] / "docs" / "notebooks").glob("*.ipynb"))}


def cells(name):
    return json.loads(BOOKS[name].read_text(encoding="utf-8"))["cells"]


def test_notebooks_are_kept_without_outputs():
    for name in BOOKS:
        code = [cell for cell in cells(name) if cell["cell_type"] == "code"]
        assert code and not any(cell["outputs"] or cell["execution_count"] for cell in code), name


@pytest.mark.parametrize("name", BOOKS)
def test_all_cells_run(name, monkeypatch, tmp_path):
    if name == "train_a_policy":
        pytest.importorskip("optax", reason="optax is not installed")
    monkeypatch.setenv("CORTADO_QUICK", "1")
    monkeypatch.setattr(matplotlib.pyplot, "show", matplotlib.pyplot.close)
    monkeypatch.chdir(tmp_path)
    code = ["".join(cell["source"]) for cell in cells(name) if cell["cell_type"] == "code"]
    exec(compile("\n".join(code), name, "exec"), {"__name__": "__main__"})
    matplotlib.pyplot.close("all")


def test_in_a_kernel_objects_are_shown(monkeypatch, tmp_path):
    """The first steps, as Jupyter runs them: particles, a film, a picture and the result of a search."""
    nbformat = pytest.importorskip("nbformat", reason="nbformat is not installed")
    client = pytest.importorskip("nbclient", reason="nbclient is not installed")
    monkeypatch.setenv("CORTADO_QUICK", "1")
    book = nbformat.read(BOOKS["first_steps"], as_version=4)
    client.NotebookClient(book, timeout=120, resources={"metadata": {"path": str(tmp_path)}}).execute()
    outputs = [output for cell in book.cells if cell.cell_type == "code" for output in cell.outputs]
    shown = [kind for output in outputs for kind in output.get("data", {})]
    assert shown.count("text/html") == 3 and shown.count("image/png") == 1
    said = "".join(output.text for output in outputs if output.get("name") == "stderr")  # a line may come in parts
    assert without_compiling(said) == ""


ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
LOADERS = {"optimise": load_task, "sweep": load_task}
COMMANDS = re.findall(r"^    cortado (.*)$", README, re.MULTILINE)


@pytest.fixture(autouse=True)
def root(monkeypatch):
    monkeypatch.chdir(ROOT)


IN_THE_PLANE = {"examples/latte_art_small.toml": "docs/figures/dam_break_plane.toml", "17.0, -11.0": "17.0"}
IN_THE_PLANE |= {"0.0, 0.0": "0.0", "1.0, 0.0": "1.0"}
"""What of the README's code is another in a scene whose kernels many others have."""


@pytest.mark.filterwarnings("error:.*limit of stability:cortado.errors.CortadoWarning")
@pytest.mark.parametrize("changes", [{}, IN_THE_PLANE], ids=["printed", "plane"])
def test_the_code_runs(changes, capsys):
    (code,) = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    assert len(code.splitlines()) <= 25
    for word, other in changes.items():
        assert word in code
        code = code.replace(word, other)
    names: dict = {}
    exec(compile(code, "README.md", "exec"), names)
    shape, ratio, _ = [line for line in capsys.readouterr().out.splitlines() if line[0] in "([0123456789"]
    assert re.fullmatch(r"\(21, \d+, 2\)" if changes else r"\(21, \d+, 3\)", shape)
    assert float(ratio) == pytest.approx(1.0, abs=1e-9)
    np.testing.assert_allclose(names["result"].parameters["tilt"], names["true_tilt"]["tilt"], atol=0.01)


@pytest.mark.parametrize("command", COMMANDS)
def test_a_command_is_one(command, monkeypatch):
    for module, function in (
        (cortado.cli.subcommands, "new_scene"),
        (cortado.cli.describe, "describe_scene"),
        (cortado.cli.run, "run_scene"),
        (cortado.cli.optimise, "optimise_task"),
        (cortado.cli.describe, "check_scene"),
        (cortado.cli.sweep, "run_sweep"),
    ):
        monkeypatch.setattr(module, function, lambda *arguments: "done")
    words = shlex.split(command)
    main(words)
    load = next((LOADERS[word] for word in words if word in LOADERS), load_scene)
    for word in words:
        if word.endswith(".toml"):
            assert load(word) is not None


def test_the_readme_has_commands_files_and_targets_that_are_there():
    wanted = {"new", "describe", "run", "optimise", "sweep", "gradients"}
    assert {command.split()[0] for command in COMMANDS} == wanted
    linked = re.findall(r"\]\(([^):]+)\)", README)
    named = re.findall(r"\b(?:docs|examples|tests|validation)/[\w/.]+\w", README)
    assert len(linked) >= 3 and len(named) >= 8
    assert [name for name in [*linked, *named] if not (ROOT / name).exists()] == []
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    targets = re.findall(r"^    make (\w+)$", README, re.MULTILINE)
    assert targets == ["demo", "test"]
    assert set(targets) <= set(re.search(r"^TASKS := (.*)$", makefile, re.MULTILINE)[1].split())
    assert re.findall(r"(?<![\w.:/])/(?:home|root|work|tmp|Users|mnt)\b", README) == []


FOLDERS = ("examples", "docs/figures", "experiments/scenes")
FILES = [path for folder in FOLDERS for path in sorted((ROOT / folder).glob("*.toml"))]
TASKS = [path for path in FILES if "[optimise]" in path.read_text(encoding="utf-8")]


ON_A_GPU = {"latte_art", "latte_art_heart", "latte_art_large", "long_dam_break", "pour", "recover_gravity"}


@pytest.mark.parametrize("name", [path.stem for path in TASKS if path.parent == FOLDER])
def test_a_search_meets_its_own_check(name, tmp_path, cortado_command):
    """As users run it, but for its films: other tests shorten what they take from these files."""
    if name in ON_A_GPU and not wp.is_cuda_available():
        pytest.skip("there is no CUDA device")
    options = ["--device", "cuda:0" if name in ON_A_GPU else "cpu", "--no-pictures", "--out", tmp_path / "run"]
    code, said, wrong = cortado_command("optimise", f"examples/{name}.toml", *options)
    assert code == 0, said + wrong


def loaded(path: Path) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error", CortadoWarning)
        load_scene(path)


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_no_scene_is_warned_of(path):
    loaded(path)


@pytest.mark.parametrize(("template", "dimension"), [("dam", 2), ("dam", 3), *((one, None) for one in templates()[1:])])
def test_no_new_scene_is_warned_of(tmp_path, template, dimension):
    new_scene(tmp_path / "scene.toml", template, dimension)
    loaded(tmp_path / "scene.toml")


@pytest.mark.parametrize("path", TASKS, ids=lambda path: path.stem)
def test_no_search_is_warned_of(path):
    task = load_task(path)
    tilt = Tilt(task.scene.forces.gravity)
    start = {name: value for name, value in task.start.items() if not isinstance(value, str)}
    for values in (start, dict(task.true_parameters)):
        if "tilt" in values:
            values["gravity"] = tilt.gravity(np.atleast_2d(values.pop("tilt")))
        assert not task.problem.steps or unstable_sentence(values, task.scene, set()) is None
