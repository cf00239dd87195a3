"""What one begins with: ``cortado new``, a commented scene, one of ten, and ``cortado examples``."""

import ast
import textwrap
import tomllib
from pathlib import Path

from cortado.errors import InputError, shown
from cortado.files.disk import SCHEMA, examples_folder, is_taken, make_folder, write_atomically
from cortado.files.terminal import is_quiet

DAM = "dam"
"""The template that explains every line, in 2-D and in 3-D."""
TEMPLATES = Path(__file__).parents[1] / "templates"
"""The folder of the templates, each a scene whose first line says what it is and how it is run."""
IN_3D = "_3d"
"""Ending of the name of a file of `DAM` in 3-D."""
SCENE_FILE, SCENE_NAME = "SCENE.toml", 'name = "SCENE"'
"""What the first line calls the file, and the line with the name that a scene takes from its file."""
ALL = "all"
DATA = (".csv", ".mp4")
"""Endings of files that an example may read, with its own name at the beginning: example_ANY.csv."""


def templates() -> list[str]:
    """Return the names of the templates."""
    return [DAM, *sorted({path.stem.removesuffix(IN_3D) for path in TEMPLATES.glob("*.toml")} - {DAM})]


def new_scene(path: Path, template: str, dimension: int | None) -> str:
    """Write a scene, and beside it the schema by which editors complete and check it; no existing file is replaced."""
    if template not in templates():
        raise InputError(f"--template is {shown(template)}, but must be one of {', '.join(templates())}.")
    if dimension is not None and template != DAM:
        raise InputError(f"--dimension is given, but must be left out, as only {DAM} is there in 2-D and in 3-D.")
    if dimension not in (None, 2, 3):
        raise InputError(f"--dimension is {dimension}, but must be 2 or 3.")
    if path.name in ("", ".."):
        raise InputError("NAME must be the name of a file, such as dam.toml.")
    file = path if path.suffix == ".toml" else path.with_name(f"{path.name}.toml")
    if is_taken(file):
        raise InputError(f"{file} is already there; choose another NAME, or remove it.")
    schema = file.with_name(SCHEMA.name)
    make_folder(file.parent)
    text, options = scene_text(file, f"{template}{IN_3D}" if dimension == 3 else template)
    write_atomically(file, text)
    if not is_taken(schema):
        write_atomically(schema, SCHEMA.read_bytes())
    return f"The scene is {file}; {schema} tells editors what may stand in it. Run it: cortado run {file}{options}"


def scene_text(file: Path, template: str) -> tuple[str, str]:
    """Return the scene of a template's file for a new file, and the options with which it is run."""
    text = (TEMPLATES / f"{template}.toml").read_text(encoding="utf-8")
    name = "".join(letter if letter.isprintable() and letter not in '"\\' else "_" for letter in file.name)
    own = text.replace(SCENE_FILE, name, 1).replace(SCENE_NAME, f'name = "{name.removesuffix(".toml")}"')
    return f"#:schema ./{SCHEMA.name}\n{own}", text.splitlines()[0].partition(SCENE_FILE)[2]


def list_examples(names: list[str], folder: Path) -> str:
    """List the examples, a line each; or copy the named ones into a folder, which is made."""
    found = {path.stem: path for path in sorted(examples_folder().iterdir()) if path.suffix in (".toml", ".py")}
    if not found:
        raise InputError(f"{examples_folder()} holds no examples: install Cortado again.")
    if not names:
        return "\n".join([*map(_line, found.values()), "", "cortado examples --copy NAME copies one here, or all."])
    return _copied([found[name] for name in _chosen(names, list(found))], folder)


def _chosen(names: list[str], known: list[str]) -> list[str]:
    plain = [name.removesuffix(".toml").removesuffix(".py") for name in names]
    for name, given in zip(plain, names, strict=True):
        if name not in (*known, ALL):
            raise InputError(f"--copy is {shown(given)}, but must be {ALL} or one of {', '.join(known)}.")
    return known if ALL in plain else list(dict.fromkeys(plain))


def _copied(sources: list[Path], folder: Path) -> str:
    """Copy examples with the files that they read; nothing is copied unless all of it can be: existing files are
    kept."""
    examples = [folder / source.name for source in sources]
    beside = (path for source in sources for path in sorted(source.parent.glob(f"{source.stem}_*")))
    sources = [*sources, *(path for path in beside if path.suffix in DATA)]
    targets = [folder / source.name for source in sources]
    for target in targets:
        if is_taken(target):
            raise InputError(f"{target} is already there; choose another folder with --to, or remove it.")
    make_folder(folder)
    for source, target in zip(sources, targets, strict=True):
        write_atomically(target, source.read_bytes())
    return "" if is_quiet() else "\n".join(f"{example}: {_command(example)}" for example in examples)


def _command(path: Path) -> str:
    """Return the command that runs an example."""
    if path.suffix == ".py":
        return f"python {path}"
    tables = tomllib.loads(path.read_text("utf-8"))
    command = next((name for name in ("optimise", "fit", "dataset") if name in tables), "run")
    return f"cortado {command} {path}"


def _line(path: Path) -> str:
    """Return an example's name and the first words of its description."""
    text = path.read_text("utf-8")
    if path.suffix == ".py":
        first = (ast.get_docstring(ast.parse(text)) or "").split("\n")[0]
    else:
        first = text.split("\n")[0].lstrip("# ")
    return textwrap.fill(first, 110, initial_indent=f"{path.name:<28}  ", subsequent_indent=" " * 30)
