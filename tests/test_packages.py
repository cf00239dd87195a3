"""Solvers and forces of installed packages: named in scene files and tasks, run, searched for, judged in sentences."""

import importlib.metadata
import json
import os
import pickle
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import cortado
from bad_scenes import one_sentence
from cortado import ComputationError, InputError, Scene, SceneError, Simulation, load_scene, reference
from own_forces import Breeze
from packages import install, on_path
from scenes import aimed
from solvers import MakeRemembering

SCENE = """
dimension = 2
discretisation = {spacing = 0.05}
phase = [{name = "water", rest_density = 1000.0, viscosity = 0.05}]
fluid = [{shape = "box", lower = [0.0, 0.0], upper = [0.4, 0.4], phase = "water", velocity = [0.8, 0.1]}]
container = {shape = "box", lower = [0.0, 0.0], upper = [0.7, 0.8]}
"""
OURS = '[solver]\nkind = "pcisph"\ntime_step = 0.0021\n'
THEIRS = '[solver]\nkind = "remembering"\ntime_step = 0.0021\nrate = 0.2\n\n[[force]]\nkind = "breeze"\nk = 2.0\n'
DRAG = OURS + '\n[[force]]\nkind = "drag"\nk = 3.0\n'
TASK = """
[problem]
steps = 6
target.drag.k = 5.0

[optimise]
start."drag.k" = 3.0
bounds.drag.k = [1.0, 20.0]
logarithmic = ["drag.k"]
optimiser = "lbfgs"
learning_rate = 0.3
iterations = 12

[optimise.check]
parameter_error = 0.01
"""


@pytest.fixture
def file(tmp_path, monkeypatch):
    """Writes a scene file with a [solver] and what follows; the toy package is installed."""
    on_path(tmp_path, monkeypatch)

    def write(text):
        path = tmp_path / "scene.toml"
        path.write_text(SCENE + text)
        return path

    return write


def test_a_scene_names_them_with_the_bits_of_those_that_are_given(file):
    named = Simulation(file(THEIRS), precision="float64")
    plain = Scene.from_json(Simulation(file(OURS)).scene.to_json())
    given = Simulation(plain, precision="float64", solver=MakeRemembering(0.2), forces=[Breeze(2.0)])
    one, other = named.run(5), given.run(5)
    assert one.positions.tobytes() == other.positions.tobytes()
    assert one.others["memory"].tobytes() == other.others["memory"].tobytes()
    assert named.parameters()["breeze.k"] == 2.0 and named.parameters()["memory.rate"] == 0.2
    assert cortado.certify(aimed(named, 6), ["breeze.k", "memory.rate"]).right


def test_such_a_scene_is_written_and_read_and_goes_to_other_processes(file):
    made = load_scene(file(THEIRS))
    for again in (Scene.from_json(made.to_json()), pickle.loads(pickle.dumps(made))):
        assert again == made and again.force[0].k == 2.0 and again.solver.rate == 0.2
    changed = made.replaced("force.breeze.k=4", "solver.rate=0.1")
    assert (changed.force[0].k, changed.solver.rate, made.force[0].k) == (4, 0.1, 2.0)
    judged = aimed(Simulation(made, precision="float64"), 6)
    again = pickle.loads(pickle.dumps(judged))
    assert again.value({"breeze.k": 1.5}) == judged.value({"breeze.k": 1.5})
    assert again.fingerprint == judged.fingerprint
    assert aimed(Simulation(changed, precision="float64"), 6).fingerprint != judged.fingerprint


def test_a_force_that_is_named_and_one_that_is_given_act_together(file):
    both = Simulation(file(DRAG), precision="float64", forces=[Breeze(2.0)], batch=2)
    assert [p.name for p in both.known.own] == ["drag.k", "breeze.k", "breeze.wind", "time"]
    alone = both.in_precision("float64")
    assert len(alone.forces) == 2
    assert alone.run(3).positions.tobytes() == both.run(3)[0].positions.tobytes()


def test_a_task_searches_for_a_parameter_of_one(file, tmp_path, cortado_command):
    out = tmp_path / "out"
    options = ("--out", out, "--precision", "float64", "--no-pictures")
    code, words, told = cortado_command("optimise", file(DRAG + TASK), *options)
    assert code == 0, told
    found = json.loads((out / "result.json").read_text())["parameters"]["drag.k"]
    assert abs(found - 5.0) < 0.05 and "drag.k" in words


def test_a_key_of_one_is_swept(file, tmp_path, cortado_command):
    sweep = ("sweep", file(DRAG), "--set", "force.drag.k=1.0,4.0", "--steps", 2, "--out", tmp_path / "runs")
    code, _, told = cortado_command(*sweep)
    assert code == 0, told
    found = {Scene.from_json(path.read_text()).force[0].k for path in (tmp_path / "runs").rglob("scene.json")}
    assert found == {1.0, 4.0}


def test_they_are_there_in_processes_of_their_own(tmp_path):
    install(tmp_path)
    scene = tmp_path / "scene.toml"
    scene.write_text(SCENE + DRAG)
    paths = [str(tmp_path), str(Path(__file__).parent)]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([*paths, *sys.path])}
    program = f"import cortado; print(cortado.load_scene({str(scene)!r}).to_json())"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, env=environment, check=False)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["force"] == [{"kind": "drag", "k": 3.0}]


def test_a_scene_without_them_reads_no_entry_points(tmp_path, monkeypatch):
    def read(**group):
        raise AssertionError

    monkeypatch.setattr("cortado.scene.packages.entry_points", read)
    monkeypatch.setattr(importlib.metadata, "entry_points", read)
    (tmp_path / "scene.toml").write_text(SCENE + OURS)
    assert Simulation(tmp_path / "scene.toml").run(1).positions.shape == (2, 64, 2)


def solver(*lines):
    return "[solver]\ntime_step = 0.002\n" + "\n".join(lines)


def force(*lines):
    return OURS + "[[force]]\n" + "\n".join(lines)


def named(kind, *lines):
    return force(f'kind = "{kind}"', *lines)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (named("drg"), r"force\[0\].kind is .drg., but must be a name that an installed package registers "),
        (solver('kind = "dfsph"'), 'must be "projection" or "pcisph", or a name .*"falling", "remembering"'),
        (solver('kind = "remembering"', "minimum_iterations = 2"), r"solver.minimum_iterations is not a key .* rate\."),
        (THEIRS.replace("0.0021", "-1.0"), r"solver.time_step is -1.0, but must be greater than"),
        (force("k = 1.0"), r"force\[0\].kind is missing, but must be a text"),
        ("force = 3\n" + OURS, r"force is 3, but must be a list of at least one table, each written \[\[force\]\]"),
        (named("gravity"), r"force\[0\].kind is 'gravity', but must be another name, as gravity is a force"),
        (named("drag", "q = 1"), r"force\[0\].q is not a key of \[force\[0\]\]; its keys are kind, k, name"),
        (named("drag", "k = -1.0"), r"force\[0\].k is -1.0, but must be at least 0 1/s"),
        (named("settings"), r"force\[0\].count is missing, but must be a whole number"),
        (named("settings", "count = 1.5"), r"force\[0\].count is 1.5, but must be a whole number"),
        (named("settings", "count = 1", "way = 1"), r"force\[0\].way is 1, but must be true or false"),
        (named("settings", "count = 1", "most = 0"), r'force\[0\] of the kind "settings" cannot be made: most'),
        (named("settings", "count = 1", "most = 13.0"), r'"settings" cannot be made: ZeroDivisionError:'),
        (named("clashing"), r"force\[0\].kind clashing has an argument kind, which is a key of every such"),
        (named("number"), r"is made by toy_parts:MakeFalling, but that returned <.*must .* method force"),
        (named("lost"), r"force\[0\].kind is 'lost', for which the package toy registers toy_parts:lost, but"),
        (named("broken"), r"cannot be imported: ModuleNotFoundError: No module named 'a_module_that_there_is"),
    ],
)
def test_what_does_not_fit_is_a_sentence(file, text, said):
    path = file(text) if text.startswith("[") else file("").with_name("scene.toml")
    if not text.startswith("["):
        path.write_text(text.split("\n", 1)[0] + "\n" + SCENE + text.split("\n", 1)[1])
    with one_sentence(f"^{path}: .*{said}", error=SceneError):
        load_scene(path)


@pytest.mark.parametrize(
    ("at", "code"),
    [("__init__", 2), ("parameters", 2), ("value", 2), ("force", 2), ("shares", 1), ("accelerate", 1), ("build", 2)],
)
def test_a_part_that_fails_in_use_is_a_sentence_and_no_success(file, tmp_path, cortado_command, at, code):
    ends = at in ("parameters", "accelerate")
    keys = f'at = "{at}"', f"ends = {str(ends).lower()}"
    made = file(solver('kind = "failing"', *keys) if at == "build" else named("failing", *keys))
    found, _, told = cortado_command("run", made, "--steps", 2, "--out", tmp_path / "out", "--no-pictures")
    assert found == code and len(told.splitlines()) == 1, told
    cause = "SystemExit: 0" if ends else "RuntimeError: toys break"
    assert re.search(rf'"failing" .*: {cause} \(the package toy, .*toy_parts.py, line \d+\)', told), told


def test_what_is_no_force_names_the_package_that_made_it(file):
    said = 'the force float, which "failing" of the package toy made, has no shares, but must have shares, accelerate'
    with pytest.raises(InputError, match=said):
        Simulation(file(named("failing", 'at = "made"')))


@pytest.mark.parametrize("mode", ["tangent", "adjoint"])
def test_a_part_that_fails_in_a_derivative_is_a_sentence(file, mode):
    judged = aimed(Simulation(file(named("failing", f'at = "{mode}"')), precision="float64"), 6)
    with pytest.raises(ComputationError, match=rf'"failing" fails in {mode} of Acting: RuntimeError: toys break'):
        judged.tangent({}, {"gravity": [0.0, 1.0]}) if mode == "tangent" else judged.value_and_gradient({})


def test_two_packages_of_one_name_are_told(file, tmp_path):
    install(tmp_path, "other", {"cortado.forces": {"drag": "toy_parts:law"}})
    with pytest.raises(SceneError, match=r"a name that one package has: the package .* and the package .* register it"):
        load_scene(file(DRAG))


def test_a_package_that_takes_a_name_of_ours_is_told(tmp_path, monkeypatch):
    on_path(tmp_path, monkeypatch, entries={"cortado.solvers": {"pcisph": "a:b", "falling": "toy_parts:MakeFalling"}})
    (tmp_path / "scene.toml").write_text(SCENE + solver('kind = "falling"'))
    with pytest.raises(SceneError, match='the package toy registers "pcisph" under '):
        load_scene(tmp_path / "scene.toml")


def test_two_forces_of_one_kind_need_names(file):
    twice = DRAG + '[[force]]\nkind = "drag"\n'
    with pytest.raises(InputError, match=r"parameter drag\.k of a force has the name of another one"):
        Simulation(file(twice))
    named = Simulation(file(twice + 'name = "air"\n'))
    assert [p.name for p in named.known.own] == ["drag.k", "air.k"]
    assert load_scene(file(twice + 'name = "air"\n'), ["force.air.k=7.0"]).force[1].k == 7.0


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (TASK.replace('"drag.k" = 3', '"drag.q" = 3'), r"start.'drag.q' is unknown, but must be one of .*drag.k"),
        (TASK.replace("5.0", "[1.0, 2.0]", 1), r"problem.target.*drag.k.* is of shape"),
        (TASK.replace('["drag.k"]', '["drag.q"]'), r"logarithmic\[0\] is 'drag.q', but must be one of .*drag.k"),
    ],
)
def test_what_does_not_fit_in_a_task_is_a_sentence(file, cortado_command, text, said):
    code, _, told = cortado_command("optimise", file(DRAG + text), "--out", "out")
    assert code == 2 and len(told.splitlines()) == 1
    assert re.search(said, told), told


def test_the_package_of_the_page_is_one(tmp_path, monkeypatch):
    """Its two files, and the scene, as printed; what pip would make of them is written here."""
    page = (Path(__file__).parents[1] / "docs" / "own_parts.md").read_text()
    module, project, table = (
        re.search(rf"^```{kind}(.*?)^```$", page[page.index("## A package that") :], re.DOTALL | re.MULTILINE)[1]
        for kind in ("py3\n", r"toml\n(?=\[project)", r"toml\n(?=\[\[force)")
    )
    entries = tomllib.loads(project)["project"]["entry-points"]
    on_path(tmp_path, monkeypatch, name="my-parts", entries=entries)
    (tmp_path / "my_parts.py").write_text(module)
    (tmp_path / "scene.toml").write_text(SCENE + OURS + table)
    assert Simulation(tmp_path / "scene.toml").parameters()["drag.k"] == 3.0


def test_a_solver_without_iterations_is_described(tmp_path, monkeypatch, cortado_command):
    """That of the page, which has no diagnostics of PCISPH."""
    page = (Path(__file__).parents[1] / "docs" / "own_parts.md").read_text()
    blocks = re.findall(r"^```py[a-z0-9]*\n(.*?)^```$", page, re.DOTALL | re.MULTILINE)
    block = next(one for one in blocks if "class Dust(" in one)
    on_path(tmp_path, monkeypatch, entries={"cortado.solvers": {"dust": "my_dust:MakeDust"}})
    (tmp_path / "my_dust.py").write_text(block.partition("dusty = ")[0])
    (tmp_path / "scene.toml").write_text(SCENE + '[solver]\nkind = "dust"\ntime_step = 0.002\n')
    code, words, told = cortado_command("describe", tmp_path / "scene.toml")
    assert code == 0 and "memory" in words, told


def test_the_reference_engine_has_none(file):
    with pytest.raises(InputError, match=r"scene has \[\[force\]\], but must leave it out for the reference engine"):
        reference.Simulation(file(DRAG))
