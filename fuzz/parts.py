"""Parts of a package that fail: where they are made, asked for a force or built, and while a run goes on."""

import sys
from pathlib import Path

from fuzz.cases import Case
from fuzz.files import PLANE
from fuzz.toml_text import to_toml

FAULTS = (
    "raise ValueError('no luck')",
    "raise KeyError('push')",
    "raise SystemExit(0)",
    "raise SystemExit('bye')",
    "raise SystemExit",
    "sys.exit(0)",
    "raise StopIteration",
    "raise GeneratorExit",
    "raise RecursionError('deep')",
    "raise MemoryError",
    "raise OSError(28, 'No space left on device')",
    "raise UnicodeDecodeError('utf-8', b'x', 0, 1, 'odd')",
    "raise Odd('odd')",
    "raise cortado.InputError('rate is 3, but must be less.')",
    "raise cortado.SceneError(None, 'rate', 3, 'less')",
    "1 / 0",
    "[].pop()",
    "None.nothing",
    "assert False",
    "warnings.warn('odd')",
    "return 3",
    "return None",
    "return object()",
)
PLACES = ("made", "force", "stepped", "parameters", "called", "loaded")
TEXT = """
import sys
import warnings

import cortado




class Odd(BaseException):
    pass


def fault():
    {fault}


class Part:
    def __init__(self, rate: float = 1.0):
        {made}

    @property
    def parameters(self):
        {parameters}
        return ()

    def force(self, setting):
        {force}
        return Force()


class Force:
    shares = ()

    def accelerate(self, *arguments, **options):
        {stepped}

    tangent = adjoint = accelerate

    def __getattr__(self, name):
        {called_fault}
        raise AttributeError(name)


{loaded}
"""


def run_a_part(case: Case) -> None:
    """A scene names a part of a package that fails somewhere; what is said is one sentence, and never exit code 0 for a
    part that ends the program."""
    fault, place = str(case.random.choice(FAULTS)), str(case.random.choice(PLACES))
    at = {name: ("return fault()" if name == place else "pass") for name in PLACES}
    at["loaded"] = "fault()" if place == "loaded" else ""
    text = TEXT.format(fault=fault, called_fault=at.pop("called"), **at)
    module = f"fuzzed_part_{case.number}"
    (case.folder / f"{module}.py").write_text(text)
    info = case.folder / f"fuzzed{case.number}-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: fuzzed{case.number}\nVersion: 1.0\n")
    group = "cortado.solvers" if case.random.random() < 0.3 else "cortado.forces"
    (info / "entry_points.txt").write_text(f"[{group}]\nfuzzed = {module}:Part\n")
    block = {"shape": "box", "lower": [0.0, 0.0], "upper": [0.2, 0.2], "phase": "water"}
    tables: dict[str, object] = {**PLANE, "fluid": [block]}
    if group == "cortado.solvers":
        tables["solver"] = {"kind": "fuzzed", "time_step": 0.002}
        (case.folder / f"{module}.py").write_text(text.replace("def force(", "def build("))
    else:
        tables["force"] = [{"kind": "fuzzed"}]
    (case.folder / "scene.toml").write_text(to_toml(tables))
    case.notes.append(f"{group}: {fault} where it is {place}")

    def program(folder: Path) -> None:
        from cortado.cli import main

        sys.path.insert(0, str(folder))
        main(["run", "scene.toml", "--steps", "2", "--no-pictures", "--out", "out"])
        raise SystemExit(0 if (folder / "out" / "trajectory.vtkhdf").exists() else 3)

    outcome = case.read(program, case.folder, codes=(0, 1, 2))
    is_named = any(word in outcome.err for word in ("fuzzed", "the force Force", "rate is 3", "memory"))
    if outcome.code in (1, 2) and not is_named:
        case.complaints.append("what is said names neither the package nor the part")
