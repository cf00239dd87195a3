"""What docstrings below the fields of a class say, read from its source when somebody asks for it.

Pydantic can read them as it makes a model, but then every process waits for it, a third of a second for all tables of a
scene, though only a schema has them.
"""

import ast
import inspect
from functools import cache
from itertools import pairwise
from sys import modules


def field_docstrings(cls: type) -> dict[str, str]:
    """The docstrings of fields by name, those of parents included; none of a class without a source."""
    found: dict[str, str] = {}
    for one in reversed(cls.__mro__):
        found |= _of_module(one.__module__).get(one.__qualname__, {})
    return found


@cache
def _of_module(name: str) -> dict[str, dict[str, str]]:
    """Those of all classes of a module that are in no other class or function."""
    try:
        source = inspect.getsource(modules[name])
    except (KeyError, OSError, TypeError):
        return {}
    return {one.name: _in_body(one) for one in ast.parse(source).body if isinstance(one, ast.ClassDef)}


def _in_body(node: ast.ClassDef) -> dict[str, str]:
    return {
        field.target.id: inspect.cleandoc(text.value.value)
        for field, text in pairwise(node.body)
        if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name)
        if isinstance(text, ast.Expr) and isinstance(text.value, ast.Constant) and isinstance(text.value.value, str)
    }
