"""What `help()` says of public names: every argument, and an example whose calls those names take."""

import ast
import inspect
import re
import textwrap
from importlib import import_module

import pydantic
import pytest

import cortado
from cortado.scene.fluids import BoxFluid
from cortado.scene.model import Phase
from cortado.scene.solvers import ProjectionSolver
from cortado.scene.tables import field_docstrings

GIVEN = """AdjointEstimator AdjointNorms Differentiable Direction Estimate Executor Filtered ForwardPass ImageLoss Loss
GradientEstimator Observation Optimiser Outcome Readings Renderer Search Sensor Snapshot SnapshotAdjoint SnapshotBatch
TopView Volume"""
"""Protocols, and what calls return or hand on: nobody makes one by its name."""
LAYERS = ("measure", "picture", "restart_state", "rollout", "smoothed", "state", "step", "value")


def public():
    """Classes and functions by their paths, but errors, and tables of scenes, whose keys the scene reference has."""
    found = {}
    for name in cortado.__all__:
        thing = getattr(cortado, name)
        own = {f"{name}.{one}": getattr(thing, one) for one in dir(thing)} if inspect.ismodule(thing) else {name: thing}
        found |= {path: one for path, one in own.items() if getattr(one, "__module__", "").startswith("cortado")}
    for name in LAYERS:
        found[f"jax.{name}"] = getattr(import_module("cortado.optimisation.layers.user_functions"), name)
    apart = (BaseException, pydantic.BaseModel)
    return {
        path: one
        for path, one in found.items()
        if inspect.isfunction(one) or (inspect.isclass(one) and not issubclass(one, apart))
    }


PUBLIC = public()
MADE = {path: one for path, one in PUBLIC.items() if path.rpartition(".")[2] not in GIVEN.split()}
METHODS = {
    f"{name}.{method}": one
    for name in ("Fit", "Problem", "Simulation", "Trajectory")
    for method, one in inspect.getmembers(getattr(cortado, name), inspect.isroutine)
    if not method.startswith("_") and (one.__doc__ or "") and one.__module__.startswith("cortado")
}


def words(thing) -> str:
    """What `help()` shows of a function, or of a class and how it is made."""
    own = inspect.getdoc(thing) or ""
    return own + (inspect.getdoc(thing.__init__) or "" if inspect.isclass(thing) else "")


def unnamed(thing, beside: str = "") -> list[str]:
    """Arguments that the words do not name, nor those beside them."""
    if inspect.isclass(thing) and thing.__init__ is object.__init__:
        return []
    own = [name for name in inspect.signature(thing).parameters if name not in ("self", "bridge")]
    return [name for name in own if not re.search(rf"\b{name}\b", words(thing) + beside)]


def example(thing) -> str:
    """The code after the word Example; nothing if there is none."""
    text = inspect.getdoc(thing) or ""
    block = re.search(r"^Example::\n\n((?:    .*\n?|\n)+)", text, re.MULTILINE)
    line = re.search(r"^Example: ``(.+?)``$", text, re.MULTILINE)
    return textwrap.dedent(block[1]) if block else line[1] if line else ""


def faults(code: str) -> list[str]:
    """Names of Cortado in code that are not there, and calls that they do not take."""
    found = []
    for node in ast.walk(ast.parse(code)):
        if not isinstance(node, ast.Call) or not ast.unparse(node.func).startswith("cortado."):
            continue
        try:
            thing = cortado
            for part in ast.unparse(node.func).split(".")[1:]:
                thing = getattr(thing, part)
            inspect.signature(thing).bind(*node.args, **{word.arg: None for word in node.keywords})
        except (AttributeError, TypeError) as error:
            found.append(f"{ast.unparse(node)}: {error}")
    return found


RESULTS = {"Fit", "Trajectory"}
"""Classes that calls return: their fields stand in the reference."""


def test_help_names_every_argument():
    lacking = {path: unnamed(one) for path, one in MADE.items() if path not in RESULTS}
    for path, method in METHODS.items():
        lacking[path] = unnamed(method, inspect.getdoc(getattr(cortado, path.partition(".")[0])))
    assert {path: names for path, names in lacking.items() if names} == {}


def test_help_has_an_example_that_can_be_called():
    assert [path for path, one in MADE.items() if not example(one)] == [], "their docstrings end without an example"
    assert [fault for one in MADE.values() for fault in faults(example(one))] == []


@pytest.mark.parametrize("table", [cortado.Scene, Phase, BoxFluid, ProjectionSolver])
def test_help_of_a_table_lists_its_keys(table):
    """Each with its meaning, where the schema has one; its signature has the keys alone."""
    own = inspect.getdoc(table).partition("Keys:")[2]
    listed = {
        key: " ".join(text.split()) for key, text in re.findall(r"^- (\w+) ((?:.*\n?)(?:  .*\n?)*)", own, re.MULTILINE)
    }
    assert [*listed] == [*table.model_fields] == [*inspect.signature(table).parameters]
    texts = field_docstrings(table)
    assert [key for key in listed if " ".join(texts.get(key, "").split()) not in listed[key]] == []
    assert "typing" not in str(inspect.signature(table))
    assert "Keys:" not in table.model_json_schema()["description"]


def test_what_help_lacks_is_found():
    def silent(steps):
        """Do something.

        Example: ``cortado.load_scene(file="dam.toml")``
        """

    assert unnamed(silent) == ["steps"]
    assert len(faults(example(silent))) == 1 and len(faults("cortado.absent()")) == 1
    assert len(MADE) > 50 and len(METHODS) > 40
