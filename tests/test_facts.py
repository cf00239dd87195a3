"""What pages say is so today: their options, files and keys are there, and their defaults are those of the code."""

import importlib
import inspect
import re
import shlex
from pathlib import Path

import pytest
import scene_page

import cortado
from cortado.cli import main
from cortado.cli.arguments import STEPS
from cortado.scene.appearance import Picture
from cortado.scene.scene import Scene
from cortado.scene.solvers import COURANT
from program_texts import sources

ROOT = Path(__file__).parents[1]
OUTER = ("README.md", "CONTRIBUTING.md", "RELEASE.md", "NOTICE.md", "validation/README.md")
FILES = [path for path in sorted((ROOT / "docs").rglob("*.md")) if "records" not in path.parts]
TODAY = {path.relative_to(ROOT).as_posix(): path.read_text("utf-8") for path in [*FILES, *(ROOT / n for n in OUTER)]}
"""All pages but records, which may name what is gone."""
PROGRAM = re.compile(r"^    python (\S.*)$|`python (\S[^`]*)`", re.MULTILINE)
PROGRAMS = sorted({(a or b).partition("  #")[0] for text in TODAY.values() for a, b in PROGRAM.findall(text)})
OF_OTHERS = {"build", "cibuildwheel", "pip", "twine", "venv", "pytest"}
OPTIONS_OF_OTHERS = {"--editable", "--exclude-editable", "--find-links", "--ignore-requires-python"}
OPTIONS_OF_OTHERS |= {"--no-deps", "--platform", "--strict"}
COMMANDS = ("compare", "completion", "convergence", "dataset", "describe", "examples", "export", "fit")
COMMANDS += ("gradients check", "new", "optimise", "picture", "run", "schema", "sweep", "view")


def has(text: str, option: str) -> bool:
    """Whether a program reads an option, from its text: argparse names it, and tyro makes it of an argument's name."""
    name = option.removeprefix("--").replace("-", "_")
    return f'"{option}"' in text or re.search(rf"\b{name.removeprefix('no_')}: ", text) is not None


def program_fault(program: str) -> str | None:
    """What of a program is not there, if something is not."""
    words = shlex.split(program)
    module = words[1] if words[0] == "-m" else ""
    if module.partition(".")[0] in OF_OTHERS:
        return None
    place = ROOT / (module.replace(".", "/") if module else words[0])
    place = place.with_suffix(".py") if module and not place.exists() else place
    if not place.exists():
        return f"there is no {place}"
    text = sources(place) + (sources(ROOT / "benchmarks") if module.startswith("benchmarks") else "")
    lacking = [word for word in words if word.startswith("--") and not has(text, word)]
    files = [word for word in words[1:] if re.fullmatch(r"[\w/.-]+/[\w.-]+\.(toml|csv|jsonl|py)", word)]
    lacking += [file for file in files if not file.startswith("runs/") and not (ROOT / file).exists()]
    return f"{program} lacks {lacking}" if lacking else None


def test_programs_that_pages_name_are_there_with_their_options():
    assert len(PROGRAMS) > 20
    assert [fault for program in PROGRAMS if (fault := program_fault(program))] == []


def test_an_option_that_a_page_names_is_there(capsys):
    """Of a command of Cortado's, of a program of the repository, or of a program of others that is named here."""
    for command in COMMANDS:
        with pytest.raises(SystemExit):
            main([*command.split(), "--help"])
    known = {*re.findall(r"--[a-z][\w-]*", capsys.readouterr().out), "--version", "--help", *OPTIONS_OF_OTHERS}
    folders = ("benchmarks", "validation", "experiments", "tests", "docs/site", "examples")
    text, spelt = "".join(sources(ROOT / folder) for folder in folders), re.compile(r"(?<![\w-])--[a-z][\w-]*")
    named = {(option, page) for page, words in TODAY.items() for option in spelt.findall(words)}
    assert len(named) > 100
    assert sorted((option, page) for option, page in named if option not in known and not has(text, option)) == []


def test_a_key_that_a_page_sets_is_one():
    """Its last name is that of a key of a scene, a task or a data set, or of a parameter."""
    found = {key for text in TODAY.values() for key in re.findall(r"--(?:set|zip) ([\w.]+)=", text)}
    read = "".join(sources(ROOT / f"src/cortado/{name}") for name in ("scene", "optimisation", "pictures"))
    assert len(found) > 15
    assert [key for key in sorted(found) if not re.search(rf"\b{key.rpartition('.')[2]}\b", read)] == []


MODULES = (*cortado._MODULES.split(), "environments", "errors", "optimisation.transforms")


def test_a_class_that_a_page_names_is_there():
    """Such as `gradients.Exact`, with or without `cortado.` before it."""
    short = {name.rpartition(".")[2]: name for name in MODULES}
    named = re.compile(rf"(?<![\w/])(?:cortado\.)?({'|'.join(short)})\.([A-Z]\w*)")
    found = {(module, name, page) for page, text in TODAY.items() for module, name in named.findall(text)}
    assert len({module for module, _, _ in found}) > 8
    there = {module: dir(importlib.import_module(f"cortado.{short[module]}")) for module, _, _ in found}
    assert sorted((page, module, name) for module, name, page in found if name not in there[module]) == []


def scene(**tables) -> Scene:
    water = {"name": "water", "rest_density": 1000.0, "viscosity": 0.001}
    whole = {"dimension": 2, "discretisation": {"spacing": 0.05}, "phase": [water], "solver": {"time_step": 0.001}}
    fluid = {"shape": "box", "lower": [0.0, 0.0], "upper": [0.5, 0.5], "phase": "water"}
    return Scene(**{**whole, "fluid": [fluid], "container": BOX, **tables})


BOX = {"shape": "box", "lower": [0.0, 0.0], "upper": [1.0, 1.0]}
PLAIN, OLD = scene(), scene(solver={"kind": "pcisph", "time_step": 0.001})
PERIODIC = scene(container={**BOX, "upper": [0.5, 0.5], "periodic": [True, True]})
FACTS = {
    "`solver.kind`": (PLAIN.solver.kind,),
    "`solver.iterations`, `solver.repairs`": (PLAIN.solver.iterations, PLAIN.solver.repairs),
    "`discretisation.kernel`, `discretisation.support` with the projection": (
        PLAIN.discretisation.kernel,
        PLAIN.discretisation.support,
    ),
    "`discretisation.kernel`, `discretisation.support` with PCISPH": (
        OLD.discretisation.kernel,
        OLD.discretisation.support,
    ),
    "`discretisation.jitter` with the projection if all axes are periodic": (PERIODIC.discretisation.jitter,),
    "`discretisation.jitter` in all other scenes": (PLAIN.discretisation.jitter,),
    "`forces.viscosity`, `forces.viscous_solve`": (PLAIN.forces.viscosity, PLAIN.forces.viscous_solve),
    "`slip` of walls and solids": (PLAIN.container.slip,),
    '`solver.courant` with `time_step = "auto"`': (COURANT,),
    "`picture.width`, `picture.height`": (Picture().width, Picture().height),
    "`precision` of `Simulation` and of commands": (
        inspect.signature(cortado.Simulation).parameters["precision"].default,
    ),
    "`--steps` of `cortado run`": (STEPS,),
}
"""The defaults that pages quote, by the words of the cookbook's table, as the code has them."""
SAID = {
    r"\bThe (\w+), the default, makes the velocity": PLAIN.solver.kind,
    r"default solver, the (\w+)": PLAIN.solver.kind,
    r"names no kernel has (\w+) with a support of": PLAIN.discretisation.kernel,
    r"Wendland C2 with a support of ([\d.]+\d)": PLAIN.discretisation.support,
    r"names no kernel has \w+ with a support of ([\d.]+\d)": PLAIN.discretisation.support,
    r"courant \(([\d.]+) if left out": COURANT,
    r"takes 400 steps; without --steps a run takes (\d+)": STEPS,
    r"The default, (\w+), has the given viscosity": PLAIN.forces.viscosity,
    r"viscous_solve = (\w+) in \[forces\], the default": PLAIN.forces.viscous_solve,
    r"(\d+) if left out\s+height = ": Picture().width,
    r"default is slip = (\w+), as that of other solids": PLAIN.container.slip,
    r"A problem in (\w+), the default of Simulation": "float32",
}
"""What pages say of defaults in passing; the group is the value."""


def test_defaults_that_depend_on_the_solver_are_those_of_scenes():
    given = scene(discretisation={"spacing": 0.05, "kernel": "cubic_spline"}).discretisation.support
    support = f"`{PLAIN.discretisation.support}` with the projection if `kernel` is left out too, else `{given}`"
    kernel = f'`"{PLAIN.discretisation.kernel}"` with the projection if `support` is left out too, else'
    wide = scene(discretisation={"spacing": 0.05, "support": 3.0}).discretisation.kernel
    jitter = f"`{PERIODIC.discretisation.jitter}` with the projection if all axes are periodic, else"
    said = {"support": support, "kernel": f'{kernel} `"{wide}"`', "jitter": f"{jitter} `{PLAIN.discretisation.jitter}`"}
    assert said == scene_page.DEFAULTS
    assert all(default in TODAY["docs/scene_file.md"] for default in scene_page.DEFAULTS.values())


def test_the_table_of_defaults_is_that_of_the_code():
    table = TODAY["docs/cookbook.md"].partition("## What you get if you say nothing")[2].partition("\n## ")[0]
    found = dict(re.findall(r"^\| (`.*?) \| (`.*`) \|$", table, re.MULTILINE))
    assert found == {words: ", ".join(f"`{value}`" for value in values) for words, values in FACTS.items()}


def test_pages_agree_on_defaults():
    """Most of these sentences have to be there, so that the patterns find something."""
    link = re.compile(r'\[(?!forces)([^\]]*)\]\([^)]*\)|[*`"#]')
    pages = [" ".join(link.sub(r"\1", text).split()) for text in TODAY.values()]
    found = {words: {said for page in pages for said in re.findall(words, page)} for words in SAID}
    assert {words: said for words, said in found.items() if not said <= {str(SAID[words])}} == {}
    assert sum(map(bool, found.values())) >= 8


MOST = 35
"""Words of a sentence, at most."""
NOT_PROSE = re.compile(
    r"\A---\n.*?\n---\n|^(```+).*?^\1$|^ {4}\S[^\n]*$|<!--.*?-->|\$\$.*?\$\$", re.MULTILINE | re.DOTALL
)
INLINE = re.compile(r"`[^`]*`|\$[^$]*\$|!?\[([^\]]*)\]\([^)]*\)")


def sentences(text: str) -> list[str]:
    """Those of a page, of its lists and of cells of its tables; code and formulas count as one word each."""
    found = []
    for block in re.split(r"\n\s*\n", NOT_PROSE.sub("\n\n", text)):
        rows = [cell for line in block.splitlines() for cell in line.split("|")] if block.lstrip()[:1] == "|" else None
        for part in rows or re.split(r"\n(?=\s*(?:[-*]|\d+\.) )", block):
            words = " ".join(INLINE.sub(lambda one: one[1] or "X", part).split())
            found += re.split(r"(?<=[.!?:])\s+(?=[A-Z*\[\"(])", words)
    return found


def test_sentences_are_short():
    found = [(len(re.findall(r"\S*\w\S*", one)), page, one) for page in TODAY for one in sentences(TODAY[page])]
    assert [one for one in found if one[0] > MOST] == []


def test_pages_are_no_longer_than_readers_bear():
    """A page has at most 3,500 words, code included, the README 700, and all pages for users 60,000 besides code; the
    reference of scenes is generated."""
    words = {page: len(text.split()) for page, text in TODAY.items()}
    long = {page: count for page, count in words.items() if count > (700 if page == "README.md" else 3500)}
    assert set(long) <= {"docs/scene_file.md"}
    pages = [NOT_PROSE.sub("", text) for page, text in TODAY.items() if page.startswith("docs/")]
    assert sum(len(re.findall(r"\S*\w\S*", page)) for page in pages) <= 60_000
