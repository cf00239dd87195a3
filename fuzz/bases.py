"""Small scenes and tasks that all is well with: those of the repository, coarser, and the ones in `fuzz/scenes`."""

import copy
import tomllib
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

from cortado.scene.model import OTHER_TABLES

Tables = dict[str, Any]

ROOT = Path(__file__).parent.parent
FOLDERS = ("examples", "docs/figures", "experiments/scenes", "fuzz/scenes")
SPACINGS = {
    "baffles": 0.026,
    "beach": 0.07,
    "dam_break": 0.16,
    "dam_break_large": 0.16,
    "drop": 0.012,
    "drop_large": 0.012,
    "fountain": 0.014,
    "identify": 0.01,
    "ink": 0.05,
    "latte_art": 0.006,
    "latte_art_heart": 0.006,
    "latte_art_large": 0.008,
    "latte_art_small": 0.008,
    "long_dam_break": 0.05,
    "match_image": 0.061,
    "match_image_fractions": 0.1,
    "materials": 0.02,
    "pour": 0.007,
    "recover_gravity": 0.25,
    "recover_gravity_small": 0.25,
    "ring": 0.009,
    "rotor": 0.0095,
    "shaken": 0.03,
    "shear": 0.04,
    "splash_8000": 0.25,
    "surface_tension": 0.0026,
    "turned_cup": 0.0065,
    "two_dams": 0.12,
}
"""Spacing [m] in place of a file's own, for some hundred particles."""
STEPS, ITERATIONS = 4, 2
"""Of a task."""


@cache
def _bases() -> Mapping[str, Tables]:
    found = {}
    for folder in FOLDERS:
        for path in sorted((ROOT / folder).glob("*.toml")):
            tables = tomllib.loads(path.read_text(encoding="utf-8"))
            for table in (*tables.get("solid", ()), *tables.get("fluid", ())):
                if "file" in table:
                    table["file"] = str(path.parent / table["file"])
            found[path.stem] = _small(tables, SPACINGS.get(path.stem))
    return found


def scenes() -> dict[str, Tables]:
    """Scenes by name, without the tables of tasks."""
    kept = ((name, {k: v for k, v in t.items() if k not in OTHER_TABLES}) for name, t in _bases().items())
    return {name: copy.deepcopy(tables) for name, tables in kept}


def tasks() -> dict[str, Tables]:
    """Tasks by name."""
    return {name: copy.deepcopy(tables) for name, tables in _bases().items() if "optimise" in tables}


def _small(tables: Tables, spacing: float | None) -> Tables:
    if spacing is not None:
        tables["discretisation"]["spacing"] = spacing
    if "render" in tables:
        tables["render"]["resolution"] = [24, 16]
    if "optimise" in tables:
        problem, optimise = tables["problem"], tables["optimise"]
        problem["steps"] = min(problem["steps"], STEPS)
        problem["frames"] = min(problem.get("frames", 1), 2)
        for name, value in problem.get("target", {}).items():
            problem["target"][name] = _fewer(value)
        for name, value in optimise["start"].items():
            optimise["start"][name] = _fewer(value)
        optimise["iterations"] = ITERATIONS
        optimise["knots"] = 2
        if not any(_has_rows(value) for value in optimise["start"].values()):
            del optimise["knots"]
        optimise.pop("check", None)
    return tables


def _has_rows(value: Any) -> bool:
    return isinstance(value, list) and isinstance(value[0], list)


def _fewer(value: Any) -> Any:
    """No more rows than there are steps."""
    return value[:STEPS] if _has_rows(value) else value
