"""``cortado examples``: what comes with Cortado, listed or copied."""

import ast
import textwrap
import tomllib
from pathlib import Path

from cortado.errors import InputError, shown
from cortado.files.input_files import examples_folder
from cortado.files.output_files import is_taken, sentences, write_atomically
from cortado.files.terminal import is_quiet

ALL = "all"
DATA = (".csv", ".mp4")
"""What an example may read, with its own name at the beginning: example_ANY.csv."""


def list_examples(names: list[str], folder: Path) -> str:
    """The examples, a line each; or, where some are named, these copied into a folder, which is made."""
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
    """Nothing is copied unless all of it can be: a file that is there is kept. What an example reads goes with it."""
    examples = [folder / source.name for source in sources]
    beside = (path for source in sources for path in sorted(source.parent.glob(f"{source.stem}_*")))
    sources = [*sources, *(path for path in beside if path.suffix in DATA)]
    targets = [folder / source.name for source in sources]
    for target in targets:
        if is_taken(target):
            raise InputError(f"{target} is already there; choose another folder with --to, or remove it.")
    with sentences(folder):
        folder.mkdir(parents=True, exist_ok=True)
    for source, target in zip(sources, targets, strict=True):
        write_atomically(target, source.read_bytes())
    return "" if is_quiet() else "\n".join(f"{example}: {_command(example)}" for example in examples)


def _command(path: Path) -> str:
    """How an example is run."""
    if path.suffix == ".py":
        return f"python {path}"
    tables = tomllib.loads(path.read_text("utf-8"))
    command = next((name for name in ("optimise", "fit", "dataset") if name in tables), "run")
    return f"cortado {command} {path}"


def _line(path: Path) -> str:
    """Its name and what it says of itself, first of all."""
    text = path.read_text("utf-8")
    if path.suffix == ".py":
        first = (ast.get_docstring(ast.parse(text)) or "").split("\n")[0]
    else:
        first = text.split("\n")[0].lstrip("# ")
    return textwrap.fill(first, 110, initial_indent=f"{path.name:<28}  ", subsequent_indent=" " * 30)
