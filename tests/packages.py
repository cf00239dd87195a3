"""Packages that register solvers and forces, as pip would have installed them."""

import sys
from pathlib import Path

TOY = '''
from typing import Annotated

import warp as wp

import cortado
from cortado.errors import InputError, SceneError
from cortado.scene.tables import quantity
from cortado.scene.parameters import Axis, Parameter
from own_forces import Breeze
from solvers import MakeFalling, MakeRemembering


def law(x, v, k):
    return -k * v


def drag(k: Annotated[float, quantity("1/s", ge=0.0)] = 2.0, name: str = "drag"):
    return cortado.forces.Body(law, name, k=k)


class Settings:
    """Its keys are judged by it: ``count`` and ``way`` by their types, ``most`` by what it says itself."""

    parameters = ()

    def __init__(self, count: int, way: bool = True, most=1.0):
        if most == 0.0:
            raise InputError("most is 0, but there must be some.")
        if most < 0.0:
            raise SceneError(None, "most", most, "at least 0")
        self.most = 1.0 / (most - 13.0)

    def force(self, setting):
        return None


class Failing:
    """Ends or fails at one of its uses, which ``at`` names."""

    batches = True
    shares = ()

    def __init__(self, at: str, ends: bool = False):
        self._at, self._ends = at, ends
        self._reach("__init__")

    def _reach(self, place):
        if place == self._at:
            raise SystemExit(0) if self._ends else RuntimeError("toys break")

    @property
    def parameters(self):
        self._reach("parameters")
        return [Parameter("failing.k", "", "nothing", Axis.SCALAR, lambda source: self._reach("value") or 1.0)]

    def force(self, setting):
        self._reach("force")
        return 3.0 if self._at == "made" else Acting(self._reach)

    def build(self, setting):
        self._reach("build")
        return MakeFalling().build(setting)


class Acting:
    batches, is_last = True, None

    def __init__(self, reach):
        self._reach = reach

    @property
    def shares(self):
        self._reach("shares")
        return ()

    def accelerate(self, step, before, after):
        self._reach("accelerate")
        wp.copy(after, before)

    def tangent(self, step, dot, before, after):
        self._reach("tangent")
        wp.copy(after, before)

    def adjoint(self, step, acceleration_bar, bar):
        self._reach("adjoint")


def clashing(kind=1):
    return Settings(1)


nothing = None
'''
ENTRIES = {
    "cortado.forces": {
        "drag": "toy_parts:drag",
        "breeze": "toy_parts:Breeze",
        "settings": "toy_parts:Settings",
        "failing": "toy_parts:Failing",
        "clashing": "toy_parts:clashing",
        "number": "toy_parts:MakeFalling",
        "nothing": "toy_parts:nothing",
        "lost": "toy_parts:lost",
        "broken": "toy_broken",
    },
    "cortado.solvers": {
        "remembering": "toy_parts:MakeRemembering",
        "falling": "toy_parts:MakeFalling",
        "failing": "toy_parts:Failing",
    },
}


def install(folder: Path, name: str = "toy", entries=ENTRIES) -> None:
    """Put a package into a folder that is, or will be, on the path of modules."""
    (folder / "toy_parts.py").write_text(TOY)
    (folder / "toy_broken.py").write_text("import a_module_that_there_is_not\n")
    info = folder / f"{name}-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
    groups = (f"[{group}]\n" + "".join(f"{k} = {v}\n" for k, v in own.items()) for group, own in entries.items())
    (info / "entry_points.txt").write_text("\n".join(groups))


def on_path(folder: Path, monkeypatch, **options) -> None:
    """Install it for one test of this process."""
    install(folder, **options)
    monkeypatch.syspath_prepend(folder)
    for module in ("toy_parts", "toy_broken"):
        monkeypatch.delitem(sys.modules, module, raising=False)
