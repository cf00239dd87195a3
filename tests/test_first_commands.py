"""The commands with which one begins: `cortado` alone, `new`, `examples`, `schema`, `completion`; and --quiet."""

import json
import os
import re
import shlex
import shutil
import subprocess
import tomllib
from pathlib import Path

import jsonschema
import pytest

import cortado
from bad_scenes import assert_refused
from bad_tasks import TINY_SCENE
from cortado.cli import main
from cortado.cli.process import usage_sentence
from cortado.cli.subcommands import COMMANDS, app, gradients, scene_text, templates
from cortado.files.disk import SCHEMA, examples_folder
from cortado.optimisation.task_tables import file_schema, file_schema_text

ROOT = Path(__file__).parents[1]
EXAMPLES = sorted(examples_folder().glob("*.toml"))
VALIDATOR = jsonschema.Draft202012Validator(file_schema())


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def without_pictures(monkeypatch):
    """Runs draw none, which takes seconds: tests/test_shading.py is about them."""
    monkeypatch.setattr("cortado.cli.run_report.run_pictures", lambda *_: [])


# ---- what there is -----------------------------------------------------------------------------------------------
def commands():
    return {*app._subcommands, *(f"gradients {name}" for name in gradients._subcommands)} - {"gradients"}


def test_cortado_alone_shows_every_command(cortado_command):
    code, out, err = cortado_command()
    assert (code, err) == (0, "") and cortado.__version__ in out
    assert all(f"  cortado {name} " in out for name in commands())
    assert all(len(line) <= 100 for line in out.splitlines())
    assert cortado_command("--version") == (0, f"cortado {cortado.__version__}\n", "")
    for words in ([], ["gradients"]):
        code, out, err = cortado_command(*words, "--help")
        assert (code, err) == (0, "") and out.startswith(" ".join(["usage: cortado", *words]))


def test_what_it_shows_can_be_typed(monkeypatch):
    assert cortado.Simulation  # imported before its imports are replaced
    monkeypatch.setattr("cortado.device.modules.start_warp", lambda: pytest.fail("the command was understood"))
    for example in COMMANDS:
        words = shlex.split(example)[1:]
        for word in words:
            if word.endswith(".toml"):
                Path(word).parent.mkdir(parents=True, exist_ok=True)
                Path(word).touch()
        with pytest.raises(pytest.fail.Exception, match="understood"):
            main(words)


def test_the_help_of_each_is_named_where_it_is_misused(cortado_command):
    for name in commands():
        code, out, err = cortado_command(*name.split(), "--help")
        assert (code, err) == (0, "") and out.startswith(f"usage: cortado {name}") and "--quiet" in out
        assert usage_sentence("", [*name.split(), "x"]).endswith(f"see cortado {name} --help.")


# ---- new ---------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(("dimension", "pictures"), [(2, True), (3, False)])
def test_a_new_scene_runs_at_once(cortado_command, request, dimension, pictures):
    """With its pictures in the plane."""
    if not pictures:
        request.getfixturevalue("without_pictures")
    code, out, err = cortado_command("new", "dam", "--dimension", dimension)
    assert (code, err) == (0, "") and "cortado run dam.toml" in out
    text = Path("dam.toml").read_text()
    particles = int(re.search(r"(\d+) particles in", text)[1])
    assert cortado.Simulation("dam.toml").particles == particles
    small = [word for key in ("width=64", "height=64") for word in ("--set", f"picture.{key}")]
    code, out, err = cortado_command("run", "dam.toml", "--steps", 3, "--quiet", *small)
    assert (code, err) == (0, "")


@pytest.mark.parametrize("template", sorted(set(templates()) - {"dam"}))
def test_a_template_is_a_scene_that_says_how_it_is_run(cortado_command, template):
    code, out, err = cortado_command("new", "a/mine", "--template", template)
    text, first = Path("a/mine.toml").read_text(), Path("a/mine.toml").read_text().splitlines()[1]
    told = re.fullmatch(
        r"# .+: ([\d,]+) particles in [23]-D\. Run it: cortado run mine\.toml( --time \S+ --fps \d+)", first
    )
    assert (code, err) == (0, "") and out.endswith(f"Run it: cortado run a/mine.toml{told[2]}\n")
    VALIDATOR.validate(tomllib.loads(text))
    scene = cortado.load_scene("a/mine.toml")
    bodies = [*scene.fluid, *scene.emitter]
    count = sum(len(body.particles(scene.discretisation.spacing)) for body in bodies)
    assert count == pytest.approx(int(told[1].replace(",", "")), rel=0.1), "but for those where solids are"
    assert ("open at the top" in text) is (getattr(scene.container, "lid", True) is False)


def test_there_are_fourteen_templates_and_the_help_names_them(cortado_command):
    assert len(templates()) == 14
    told = " ".join(cortado_command("new", "--help")[1].split())
    assert all(re.search(rf"\b{name}\b", told) for name in templates())
    assert_refused(
        cortado_command("new", "x", "--template", "lake"), "--template is 'lake', but must be one of dam, baffled_tank"
    )
    assert_refused(cortado_command("new", "x", "--template", "drop", "--dimension", 3), "--dimension is given")


@pytest.mark.parametrize("template", ["dam", "dam_3d"])
@pytest.mark.usefixtures("without_pictures")
def test_so_it_does_with_all_that_is_switched_off(cortado_command, folder, template):
    text, _ = scene_text(Path("dam.toml"), template)
    Path("dam.toml").write_text(re.sub(r"^#(?=[a-z\[])", "", text, flags=re.MULTILINE))
    scene = cortado.load_scene("dam.toml")
    assert len(scene.phase) == len(scene.fluid) == 2 and scene.render is not None and scene.forces.surface_tension
    VALIDATOR.validate(tomllib.loads(Path("dam.toml").read_text()))
    assert cortado_command("run", "dam.toml", "--steps", 2)[0] == 0


def test_nothing_is_replaced(cortado_command):
    Path("scene.schema.json").write_text("{}")
    assert (
        cortado_command("new", "a/b/dam.toml")[0] == 0
        and Path("a/b/scene.schema.json").read_bytes() == SCHEMA.read_bytes()
    )
    assert_refused(cortado_command("new", "a/b/dam"), "already there", "NAME")
    assert cortado_command("new", "dam")[0] == 0 and Path("scene.schema.json").read_text() == "{}"
    Path("gone.toml").symlink_to("nowhere")
    assert_refused(cortado_command("new", "gone"), "already there")


def test_what_is_no_name_of_a_file_is_refused(cortado_command):
    for name in ["", ".", "..", "dam.toml/under"]:
        Path("dam.toml").write_text("")
        assert_refused(cortado_command("new", name), "NAME" if len(name) < 3 else "cannot be written")
        assert_refused(cortado_command("new", "x", "--dimension", 4), "--dimension is 4")
        assert os.listdir() == ["dam.toml"]


def test_names_may_hold_anything_that_a_file_may_but_not_be_too_long(cortado_command):
    name = 'a "b" \\ c\n'
    assert cortado_command("new", name)[0] == 0
    assert cortado.load_scene(f"{name}.toml").dimension == 2
    long = "a" * 300
    assert_refused(cortado_command("new", long), "cannot be written: File name too long")
    assert_refused(cortado_command("examples", "--copy", "pour", "--to", long), "cannot be written: File name too long")
    assert_refused(cortado_command("describe", long), "cannot be read: File name too long")
    Path("scene.toml").write_text(TINY_SCENE)
    assert_refused(cortado_command("describe", "scene.toml", "--picture", f"{long}.png"), "cannot be written")
    assert_refused(cortado_command("compare", long, long), "There is no run in ")
    assert_refused(cortado_command("run", "scene.toml", "--out", long), "cannot be written")


# ---- examples ----------------------------------------------------------------------------------------------------
def test_examples_are_listed_and_copied(cortado_command):
    code, out, err = cortado_command("examples")
    shown = [path.name for path in (ROOT / "examples").iterdir() if path.suffix in (".toml", ".py")]
    assert (code, err) == (0, "") and all(name in out for name in shown)
    assert cortado_command("examples", "--copy", "fit_heights", "--to", "fit")[0] == 0
    assert sorted(os.listdir("fit")) == ["fit_heights.toml", "fit_heights_left.csv", "fit_heights_right.csv"]
    assert cortado_command("examples", "--copy", "fit_video", "--to", "film")[0] == 0
    assert sorted(os.listdir("film")) == ["fit_video.toml", "fit_video_film.mp4"]
    code, out, _ = cortado_command("examples", "--copy", "pour", "--copy", "first_gradient.py", "--to", "a/b")
    assert (code, sorted(os.listdir("a/b"))) == (0, ["first_gradient.py", "pour.toml"])
    assert "cortado optimise a/b/pour.toml" in out and "python a/b/first_gradient.py" in out
    assert Path("a/b/pour.toml").read_bytes() == (ROOT / "examples/pour.toml").read_bytes()


def test_all_of_them_or_none(cortado_command):
    Path("pour.toml").write_text("mine")
    assert_refused(cortado_command("examples", "--copy", "all"), "pour.toml is already there", "--to")
    assert os.listdir() == ["pour.toml"]
    assert cortado_command("examples", "--copy", "all", "--to", "all")[0] == 0
    assert len(os.listdir("all")) == len([path for path in (ROOT / "examples").iterdir() if path.is_file()])
    assert_refused(
        cortado_command("examples", "--copy", "por"), "--copy is 'por', but must be all or one of carried_cup, "
    )
    assert_refused(cortado_command("examples", "--copy", "pour", "--to", "pour.toml"), "pour.toml")


def test_what_is_copied_is_a_name_and_no_path(cortado_command):
    for name in ["a/../pour", "/tmp/pour.toml", "./pour", "..", ""]:
        for names in (["--copy", name], ["--copy", "pour", "--copy", name]):
            code, out, err = cortado_command("examples", *names, "--to", "here")
            assert (code, out, err.count("\n")) == (2, "", 1)
            assert err.startswith(f"--copy is {name!r}, but must be all or one of carried_cup, ")
            assert not os.listdir()


# ---- schema ------------------------------------------------------------------------------------------------------
def test_the_schema_that_is_shipped_is_that_of_the_tables(cortado_command):
    VALIDATOR.check_schema(VALIDATOR.schema)
    assert SCHEMA.read_text("utf-8") == file_schema_text(), "renew it: see docs/adding_parts.md"
    assert json.loads(cortado_command("schema")[1]) == VALIDATOR.schema


def test_it_bears_the_examples():
    for path in EXAMPLES:
        VALIDATOR.validate(tomllib.loads(path.read_text("utf-8")))


def test_it_refuses_what_cortado_refuses():
    for old, new in [
        ("dimension = 2", "dimension = 4"),
        ("spacing", "spacin"),
        ('shape = "box"', 'shape = "ball"'),
        ('shape = "box"\n', ""),
        ("time_step = 0.0021", "time_step = -0.0021"),
    ]:
        assert old in TINY_SCENE
        VALIDATOR.validate(tomllib.loads(TINY_SCENE))
        wrong = tomllib.loads(TINY_SCENE.replace(old, new, 1))
        with pytest.raises(jsonschema.ValidationError):
            VALIDATOR.validate(wrong)
        with pytest.raises(cortado.SceneError):
            cortado.Scene(**wrong)


# ---- completion and --quiet --------------------------------------------------------------------------------------
@pytest.mark.skipif(shutil.which("bash") is None, reason="bash is not installed")
def test_bash_completes(cortado_command):
    """A description of several lines, of which all but the first would be taken for words, is not written."""
    code, script, err = cortado_command("completion", "bash")
    assert (code, err) == (0, "")

    def completed(typed):
        ask = f"COMP_WORDS=({typed}); COMP_CWORD={len(typed.split()) - 1}; _tyro_cortado"
        line = f'{script}\n{ask}; printf "%s\n" "${{COMPREPLY[@]}}"'
        return subprocess.run(["bash", "-c", line], capture_output=True, text=True, timeout=60).stdout.split()

    assert completed("cortado optim") == ["optimise"] and completed("cortado gradients c") == ["check"]
    assert completed("cortado run --rec") == ["--record", "--record-every"]
    for command in ("run", "gradients check"):
        options = completed(f"cortado {command} --")
        assert "--help" in options and all(option.startswith("--") for option in options), options


def test_zsh_has_a_script(cortado_command):
    code, script, _ = cortado_command("completion", "zsh")
    assert code == 0 and script.startswith("#compdef cortado")
    assert_refused(cortado_command("completion", "fish"), "'fish', but must be one of 'bash', 'zsh'")


def test_quiet_says_nothing_but_what_was_asked_for(cortado_command, monkeypatch, request):
    monkeypatch.setattr("cortado.files.terminal.LINE_INTERVAL", 0.0)
    Path("scene.toml").write_text(TINY_SCENE)
    assert cortado_command("run", "scene.toml", "--steps", 2, "--quiet") == (0, "", "")
    assert Path("runs/run/report.html").exists()
    request.getfixturevalue("without_pictures")  # from now on
    assert cortado_command("new", "dam", "--quiet") == (0, "", "")
    assert cortado_command("examples", "--quiet")[1] == cortado_command("examples")[1] != ""
    assert_refused(cortado_command("run", "scene.toml", "--quiet"), "already holds a run")
    _, _, err = cortado_command(
        "run", "scene.toml", "--quiet", "--overwrite", "--set", "solver.time_step=0.02", "--steps", 1
    )
    assert "limit of stability" in err
    assert "The results are in" in cortado_command("run", "scene.toml", "--steps", 2, "--out", "a")[1]
