"""The documents: their code runs as printed, their links lead somewhere, their pages and films are up to date."""

import importlib.util
import re
import runpy
import shlex
import shutil
import tomllib
from functools import cache
from pathlib import Path
from textwrap import dedent

import mathml
import matplotlib.pyplot
import numpy as np
import outer_pages
import pytest
import rows
import scene_page
import task_page
import trimesh

import cortado
from cortado.cli import main
from cortado.optimisation.solved_task import load_fit
from cortado.optimisation.task_files import load_task
from cortado.optimisation.task_tables import FitTables, TaskTables
from cortado.scene.scene import Scene, load_scene
from scenes import plane

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
DOCUMENTS = {path.relative_to(DOCS).as_posix(): path.read_text(encoding="utf-8") for path in sorted(DOCS.rglob("*.md"))}
BLOCK = re.compile(r"```(?:python|\{code-cell\} python)\n(?:---\n.*?\n---\n)?(.*?)```", re.DOTALL)
"""Code, in a tutorial a cell, which may begin with what is said about its picture."""
CODE = {name: BLOCK.findall(text) for name, text in DOCUMENTS.items()}
TODAY = {name: text for name, text in DOCUMENTS.items() if not name.startswith("records/")}
"""Without records, which may name what is gone."""
COMMANDS = {
    command
    for text in TODAY.values()
    for found in re.findall(r"^    cortado (.*)$|`cortado ([^`\n]+)`", text, re.MULTILINE)
    for command in found
    if command
}
TUTORIALS = [name for name in CODE if name.startswith("tutorials/")]


@pytest.mark.filterwarnings("error:.*limit of stability:cortado.errors.CortadoWarning")
@pytest.mark.parametrize("name", [name for name, blocks in CODE.items() if blocks])
def test_the_code_runs_as_printed(name, tmp_path, monkeypatch):
    """All of a document in one go, in a folder that has the examples."""
    if name == "torch.md":
        pytest.importorskip("torch", reason="PyTorch is not installed", exc_type=ImportError)
    shutil.copytree(ROOT / "examples", tmp_path / "examples")
    shutil.copytree(ROOT / "docs" / "figures", tmp_path / "docs" / "figures")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("matplotlib.pyplot.show", lambda: shown.append(matplotlib.pyplot.gcf()))
    shown = []
    exec(compile("\n".join(CODE[name]), name, "exec"), {"__name__": "__main__"})
    matplotlib.pyplot.close("all")
    assert len(shown) == (1 if name in TUTORIALS else 0)


DRAG = """
from cortado.particles.particle_kernels import pointwise_kernels


class DragForce(FollowForce):
    shares = ("drag",)

    def __init__(self, setting):
        self.kernels = drag_kernels(setting.discretisation)


class Drag:
    parameters = [Parameter("drag", "1/s", "linear drag", Axis.SCALAR, lambda simulation: 2.0)]

    def force(self, setting):
        return DragForce(setting)
"""


def slower(x, v):
    return -2.0 * v


def test_the_force_with_kernels_runs_as_printed(tmp_path, monkeypatch):
    """From a file, as Warp wants the text of kernels."""
    (program,) = re.findall(r"^```py\n(.*?)^```$", DOCUMENTS["adding_parts.md"], re.DOTALL | re.MULTILINE)
    file = tmp_path / "follow.py"
    file.write_text(program, encoding="utf-8")
    monkeypatch.chdir(ROOT)
    runpy.run_path(str(file), run_name="__main__")
    (kernels,) = re.findall(r"^ {7}@cache\n(?: {7}.*\n|\n)+", DOCUMENTS["adding_parts.md"], re.MULTILINE)
    file.write_text(program + dedent(kernels) + DRAG, encoding="utf-8")
    drag = cortado.Simulation(plane(), precision="float64", forces=[runpy.run_path(str(file))["Drag"]()])
    like = cortado.Simulation(plane(), precision="float64", forces=[cortado.forces.Body(slower)])
    still = cortado.losses.FinalPositions(drag.positions)
    np.testing.assert_allclose(drag.run(10).positions, like.run(10).positions, rtol=0.0, atol=1e-14)
    assert cortado.certify(cortado.Problem(drag, 10, still), ["drag"]).right


def test_a_tutorial_is_short_and_ends_in_a_picture():
    """That it is drawn without an error is the test before."""
    for name in TUTORIALS:
        assert "plt.show()" in CODE[name][-1] and "alt: " in DOCUMENTS[name]
        assert len(DOCUMENTS[name].splitlines()) <= 90


def test_a_command_is_one(capsys):
    """It has the options that are written, and files that are named are there."""

    @cache
    def told(*name):
        with pytest.raises(SystemExit) as end:
            main([*name, "--help"])
        assert end.value.code == 0, name
        return capsys.readouterr().out

    for command in COMMANDS:
        words = shlex.split(command, comments=True)
        known = told(*words[: 2 if words[0] == "gradients" else 1])
        assert [word for word in words if word.startswith("--") and word not in known] == [], command
        files = [word for word in words if word.endswith(".toml") and "/" in word]
        assert [file for file in files if not (ROOT / file).exists()] == []


def test_links_lead_to_files():
    paths = {*ROOT.glob("*.md"), *(path for name in ("docs", "experiments") for path in (ROOT / name).rglob("*.md"))}
    links = [(path, link) for path in paths for link in re.findall(r"\]\(([^)#]+)", path.read_text(encoding="utf-8"))]
    assert links
    missing = [(path.name, link) for path, link in links if "://" not in link and not (path.parent / link).exists()]
    assert not missing


def anchors(text: str) -> set[str]:
    """Return where links to headings of a page may lead."""
    prose = re.sub(r"^(```+|~~~+).*?^\1$", "", text, flags=re.MULTILINE | re.DOTALL)
    headings = re.findall(r"^#+ (.*)$", prose, re.MULTILINE)
    shown = (re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading).lower() for heading in headings)
    return {re.sub(r"[^\w\- ]", "", heading).replace(" ", "-") for heading in shown}


def test_links_lead_to_headings():
    paths = [path for name in ("docs", "validation", "benchmarks") for path in (ROOT / name).rglob("*.md")]
    found = []
    for path in [*ROOT.glob("*.md"), *paths]:
        for file, anchor in re.findall(r"\]\(([^)\s#]*)#([^)\s]+)\)", path.read_text(encoding="utf-8")):
            target = path.parent / file if file else path
            if "://" not in file and target.suffix == ".md":
                found.append((path.name, file, anchor, anchor in anchors(target.read_text(encoding="utf-8"))))
    assert len(found) > 100
    assert [link[:3] for link in found if not link[3]] == []


def test_there_is_code_and_names_and_paths_in_files_are_there():
    assert CODE["runs.md"]
    assert len(TUTORIALS) == 8 and len(COMMANDS) > 15
    # Of "`NAME` of `path`" and the like, in what contributors read.
    text = "".join((ROOT / name).read_text(encoding="utf-8") for name in ("CONTRIBUTING.md", "docs/adding_parts.md"))
    found = re.findall(r"`(\w+)`\s+(?:of|in|there in)\s+`((?:src|tests)/\S+\.py)`", text)
    assert len(found) > 15
    assert not [(name, path) for name, path in found if not re.search(rf"\b{name}\b", (ROOT / path).read_text("utf-8"))]
    texts = [*TODAY.values(), *((ROOT / name).read_text("utf-8") for name in ("README.md", "CONTRIBUTING.md"))]
    path = r"`((?:src|tests|docs|examples|reference|fuzz|validation)/[^` *]*)`"
    found = {one for text in texts for one in re.findall(path, text)}
    assert len(found) > 50
    assert not {path for path in found if not (ROOT / path).exists()}


PAGE, FILMS = ROOT / "docs/gallery.md", ROOT / "docs/images/films"


def entries():
    spec = importlib.util.spec_from_file_location("gallery", ROOT / "docs/site/gallery.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.ENTRIES


def test_every_scene_takes_its_values():
    for entry in (one for one in entries().values() if one.values):
        scene = load_scene(entry.scene, [*entry.values, f"discretisation.spacing={entry.spacing}"])
        assert scene.discretisation.spacing == entry.spacing


def test_what_is_on_the_page_can_be_made_and_is_there():
    text = PAGE.read_text("utf-8")
    named, shown = re.findall(r"gallery\.py --only (\w+)", text), re.findall(r"films/(\w+)\.webp", text)
    assert named == shown and set(named) <= set(entries()) and len(named) >= 13
    sizes = [(FILMS / f"{name}.webp").stat().st_size for name in named]
    assert max(sizes) < 650_000 and sum(sizes) < 12_000_000
    assert all((FILMS / f"{name}.jpg").exists() for name in named)


PAGES = sorted(path for path in DOCS.rglob("*.md"))
CODE_OF_A_PAGE = re.compile(r"^(```+|~~~+).*?^\1$|^(?: {4}.*\n)+|`[^`\n]+`", re.MULTILINE | re.DOTALL)


def pages_of(page: Path) -> list[Path]:
    """The pages that the tables of contents of a page list."""
    found = []
    for body in re.findall(r"^```\{toctree\}\n(.*?)^```", page.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL):
        names = [line.strip() for line in body.splitlines() if line.strip() and not line.startswith(":")]
        found += [path for name in names for path in page.parent.glob(f"{name}.md")]
    return found


def test_every_page_is_in_one_table_of_contents():
    """A new page gets its line in docs/index.md."""
    listed = [entry for page in PAGES for entry in pages_of(page)]
    assert sorted([*listed, DOCS / "index.md"]) == PAGES


def test_a_page_has_one_title_and_pictures_with_words():
    for page in PAGES:
        text = CODE_OF_A_PAGE.sub("", page.read_text(encoding="utf-8"))
        assert len(re.findall(r"^# .+", text, re.MULTILINE)) == 1, page
        assert [alt for alt in re.findall(r"!\[(.*?)\]\(", text, re.DOTALL) if len(alt) < 10] == [], page


def test_a_page_from_elsewhere_is_there_and_says_where():
    for page, file in outer_pages.OUTER.items():
        assert (DOCS.parent / file).exists(), file
        assert f"](../{file})" in (DOCS / f"{page}.md").read_text(encoding="utf-8"), page


def test_bars_and_primes_of_formulas_are_as_they_should():
    """Without a form, a bar inside of a formula has room on both sides, and its superscript hangs below it."""
    bar = '<mo form="{}" stretchy="false" lspace="0" rspace="0">&#x0007C;</mo>'
    left, right, alone = bar.format("prefix"), bar.format("postfix"), '<mo stretchy="false">&#x0007C;</mo>'
    made = mathml.mathml(r"a \lvert c_i - c_j \rvert^2 + P(x | y) \lvert z \rvert", "inline")
    assert re.findall(r"<mo[^>]*>&#x0007C;</mo>", made) == [left, right, alone, left, right]
    assert f"<msup>{right}<mn>2</mn></msup>" in made
    made = mathml.mathml(r"\alpha f'' + f'(x) + g^2", "block")
    assert made.count("<msup>") == 1 and 'display="block"' in made
    for prime in ("2", "3"):
        assert f'<mrow><mi>f</mi><mo lspace="0" rspace="0">&#x0203{prime};</mo></mrow>' in made


@pytest.mark.parametrize("module", [scene_page, task_page])
def test_a_page_is_up_to_date(module):
    asked = f"run: python docs/site/{module.__name__}.py"
    assert module.PAGE.read_text(encoding="utf-8") == module.page(), asked


@pytest.mark.parametrize("module, models", [(scene_page, [Scene]), (task_page, [TaskTables, FitTables])])
def test_every_table_has_an_example_and_every_key_is_explained(module, models):
    tables = {name: table for model in models for name, table in model.model_json_schema()["$defs"].items()}
    assert module.examples().keys() == tables.keys()
    text = module.page()
    for name, table in tables.items():
        assert [key for key in table["properties"] if f"\n| `{key}` |" not in text] == [], name
    assert not re.findall(r"\| \.? \|\n", text), "a key without a meaning"


def test_a_key_of_several_tables_stands_once():
    """And each table has all of its keys, those that it shares or its own."""
    tables, text = Scene.model_json_schema()["$defs"], scene_page.page()
    for heading, _, models in scene_page.PARTS:
        section = re.search(rf"^{re.escape(heading)}\n(.*?)(?=^## |\Z)", text, re.MULTILINE | re.DOTALL)[1]
        lines = [line for line in section.splitlines() if line.startswith("| `")]
        assert len(lines) == len(set(lines)), heading
        shared, *own = re.split(r"^### .*\n", section, flags=re.MULTILINE)
        for name, part in zip([name for name, below, _ in models if below], own, strict=True):
            for key, row in rows.rows_of(tables[name], {}).items():
                wanted = f"| `{key}` |" if key in rows.TAGS else " | ".join(["", *row]).strip().rstrip(".")
                assert wanted.replace("`|", "`\\|") in shared + part, (name, key)


def parts(text: str) -> list[tuple[str, str]]:
    """Of a file its tables, each with its name; what comes before the first has the name ""."""
    found = re.split(r"^(?=\[)", text.strip() + "\n", flags=re.MULTILINE)
    return [(re.match(r"\[*([\w.]*)", part)[1] if part.startswith("[") else "", part) for part in found if part]


def replaced(whole: str, example: str) -> str:
    """A file in which the tables of an example stand in the place of those with the same names."""
    names = {name for name, _ in parts(example)}
    kept = [(name, part) for name, part in parts(whole) if name not in names]
    return "\n".join(part for _, part in sorted([*kept, *parts(example)], key=lambda named: named[0] != ""))


@pytest.mark.parametrize("model, example", scene_page.examples().items())
def test_an_example_of_a_scene_is_one(model, example, tmp_path):
    np.save(tmp_path / "drop.npy", np.full((2, 3), 0.3) + [[0.0, 0.0, 0.0], [0.05, 0.0, 0.0]])
    block = trimesh.creation.box(extents=[200.0, 200.0, 200.0])
    block.export(tmp_path / "block.stl")
    file = tmp_path / "scene.toml"
    file.write_text(replaced(scene_page.WHOLE, example))
    scene = load_scene(file)
    (table, given) = list(tomllib.loads(example).items())[-1]
    file.write_text(scene_page.WHOLE)
    assert getattr(scene, table) != getattr(load_scene(file), table) or given["shape"] == "none"


@pytest.mark.parametrize("model, example", task_page.examples().items())
def test_an_example_of_a_task_is_one(model, example, tmp_path):
    file = tmp_path / "task.toml"
    is_fit = example in [part[3] for part in task_page.FIT_PARTS]
    file.write_text(scene_page.WHOLE + replaced(task_page.WHOLE_FIT if is_fit else task_page.WHOLE, example))
    assert (load_fit if is_fit else load_task)(file) is not None
