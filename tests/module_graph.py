"""Which modules of a package are loaded before others, as their sources say."""

import ast
from collections.abc import Iterator, Mapping
from pathlib import Path


def sources(root: Path) -> dict[str, str]:
    """Of every module, and every package, by its full name; ``root`` is the folder of the package."""
    names = {path: ".".join(path.relative_to(root.parent).with_suffix("").parts) for path in root.rglob("*.py")}
    return {name.removesuffix(".__init__"): path.read_text(encoding="utf-8") for path, name in names.items()}


def as_it_loads(statements: list[ast.stmt]) -> Iterator[ast.Import | ast.ImportFrom]:
    """Imports that are done as a module is loaded: none within functions, and none that are for types alone."""
    for node in statements:
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            yield from as_it_loads(node.orelse)
        elif isinstance(node, (ast.Import, ast.ImportFrom)):
            yield node
        elif not isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
            yield from as_it_loads([child for child in ast.iter_child_nodes(node) if isinstance(child, ast.stmt)])


def loaded_before(sources: Mapping[str, str]) -> dict[str, set[str]]:
    """Of each module, or package, those that have to be loaded before it, given sources by full name. A package is
    loaded before what is in it, but may import that."""
    found = {}
    for module, source in sources.items():
        named = set()
        for node in as_it_loads(ast.parse(source).body):
            assert isinstance(node, ast.Import) or not node.level, f"{module}: from {'.' * node.level}"
            for alias in node.names:
                base = "" if isinstance(node, ast.Import) else f"{node.module}."
                named.add(base + alias.name if base + alias.name in sources else base.removesuffix(".") or alias.name)
        around = {outer for name in named for outer in outside(name)} - {*outside(module), module}
        found[module] = {name for name in named | around if name in sources}
    return found


def outside(module: str) -> list[str]:
    """The packages that a module or a package is in."""
    parts = module.split(".")
    return [".".join(parts[:end]) for end in range(1, len(parts))]


def all_before(before: Mapping[str, set[str]], module: str) -> set[str]:
    """The same for one module, with those that are loaded before these, and so on."""
    found: set[str] = set()
    waiting = [module]
    while waiting:
        new = before[waiting.pop()] - found
        found |= new
        waiting += new
    return found
