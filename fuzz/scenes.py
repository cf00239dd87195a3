"""Mutated scenes are run, and mutated tasks are searched."""

from pathlib import Path

from fuzz import bases
from fuzz.answers import run_complaints, search_complaints
from fuzz.cases import Case
from fuzz.mutations import mutate
from fuzz.processes import Limits, call
from fuzz.size import is_large
from fuzz.text_mutations import mutate_text, option, override
from fuzz.toml_text import to_toml

HELP = "--help"
"""Whoever says it is shown how a command is called, and nothing is run."""


def run_scene(case: Case) -> None:
    """A scene with one to three things changed runs for a few steps."""
    steps, record_every = int(case.random.integers(2, 11)), int(case.random.choice([1, 1, 1, 2, 3, 20]))
    words = ["--steps", str(steps), "--record-every", str(record_every)]
    if case.random.random() < 0.2:
        words += ["--precision", "float64"]
    overrides, odd = _write(case, "scene.toml", bases.scenes())
    outcome = case.cortado("run", "scene.toml", "--no-pictures", "--out", "out", *words, *overrides, *odd)
    if outcome.hung or outcome.swollen:
        _forgive_if_large(case, "scene.toml", overrides[1::2], steps)
    asked = None if odd else steps
    ran = outcome.code == 0 and HELP not in odd
    case.complaints += run_complaints(case.folder / "out", ran, asked, record_every)


def search_task(case: Case) -> None:
    """A task with one to three things changed is searched for a few iterations."""
    overrides, odd = _write(case, "task.toml", bases.tasks())
    precision = ["--precision", "float64"] if case.random.random() < 0.2 else []
    outcome = case.cortado("optimise", "task.toml", "--no-pictures", "--out", "out", *precision, *overrides, *odd)
    if outcome.hung or outcome.swollen:
        _forgive_if_large(case, "task.toml", overrides[1::2], 0)
    case.complaints += search_complaints(case.folder / "out", outcome.code == 0 and HELP not in odd)


def _write(case: Case, name: str, all_bases: dict[str, bases.Tables]) -> tuple[list[str], list[str]]:
    """Write a mutated file; returns overrides, and odd options of the command line."""
    chosen = str(case.random.choice(sorted(all_bases)))
    tables = all_bases[chosen]
    case.notes.append(chosen)
    overrides: list[str] = []
    odd: list[str] = []
    kind = case.random.random()
    if kind < 0.80:
        case.notes += mutate(tables, list(bases.tasks().values()), case.random)
        text = to_toml(tables).encode("utf-8", "surrogatepass")
    else:
        text = to_toml(tables).encode()
        if kind < 0.90:
            text, words = mutate_text(text, case.random)
            case.notes.append(words)
        elif kind < 0.96:
            overrides = ["--set", override(case.random)]
            case.notes.append(f"--set {overrides[1][:60]!r}")
        else:
            odd = option(case.random)
            case.notes.append(" ".join(word[:60] for word in odd))
    (case.folder / name).write_bytes(text)
    return overrides, odd


def _forgive_if_large(case: Case, name: str, overrides: list[str], steps: int) -> None:
    """A scene that is large by what was asked for may take long: it says nothing about the program."""

    def program() -> None:
        raise SystemExit(3 if is_large(Path(name), overrides, steps) else 0)

    if call(program, ("is large",), case.folder, Limits(seconds=10.0)).code == 3:
        case.complaints.clear()
        case.notes.append("large")
