"""Runs and searches are killed at any moment; what is left must open, and a search must go on with the same bits."""

import json
import shutil
import signal
from collections.abc import Sequence
from pathlib import Path

from cortado.runs.trajectory import Trajectory
from fuzz import bases
from fuzz.answers import leftovers, run_complaints, same_frames, search_complaints
from fuzz.cases import Case
from fuzz.processes import Kill, Outcome, by_fork
from fuzz.toml_text import to_toml

STEPS, EVALUATIONS = 120, 30
RUNS = (
    ("dam_break_plane", "float32"),
    ("dam_break_plane", "float64"),
    ("periodic", "float32"),
    ("jet", "float32"),
    ("recover_gravity_small", "float32"),
)
SEARCHES = (
    ("recover_gravity_small", "float32"),
    ("nozzle_search", "float64"),
    ("match_image", "float32"),
    ("latte_art_small", "float32"),
)
_SIGNALS = (*[signal.SIGKILL] * 8, signal.SIGTERM, signal.SIGINT)


def prepare_runs(folder: Path) -> list[Outcome]:
    """The same runs undisturbed; the second time, as the first may have compiled kernels."""
    return _undisturbed(folder, RUNS, bases.scenes(), lambda precision: _run_words(precision, STEPS))


def prepare_searches(folder: Path) -> list[Outcome]:
    """The same searches undisturbed."""
    return _undisturbed(folder, SEARCHES, bases.tasks(), _search_words)


def kill_run(case: Case) -> None:
    """A run is killed; its frames are those of the undisturbed run, and the next run in its folder succeeds."""
    name, precision, whole = _choose(case, RUNS)
    (case.folder / "file.toml").write_text(to_toml(bases.scenes()[name]))
    _cortado_killed(case, _run_words(precision, STEPS), _seconds(whole))
    out = case.folder / "out"
    case.complaints += run_complaints(out, finished=False)
    if not case.complaints and (out / "trajectory.vtkhdf").exists():
        part = Trajectory.load(out / "trajectory.vtkhdf")
        differing = same_frames(part, Trajectory.load(whole / "out" / "trajectory.vtkhdf"))
        case.notes.append(f"{len(part.times)} frames")
        if differing is not None:
            case.complaints.append(f"the {differing} that a killed run left differ from those of the same run")
    case.cortado(*_run_words(precision, 2), "--overwrite", codes=(0,))
    case.complaints += [f"{name} is left behind" for name in leftovers(out)]


def kill_search(case: Case) -> None:
    """A search is killed, perhaps twice; resumed, or begun again if there is nothing yet, it has the same bits."""
    name, precision, whole = _choose(case, SEARCHES)
    (case.folder / "file.toml").write_text(to_toml(_longer(bases.tasks()[name])))
    words = _search_words(precision)
    _cortado_killed(case, words, _seconds(whole))
    out, twice = case.folder / "out", case.random.random() < 0.2
    if twice:
        _cortado_killed(case, [*words, "--resume"], _seconds(whole), 2)
    if twice or not (out / "report.html").exists():
        resumed = case.cortado(*words, "--resume", codes=(0, 2))
        if resumed.code == 2:
            case.notes.append("begun again")
            if (out / "checkpoint" / "replay.log").exists():
                case.complaints.append(f"it has evaluations, but is not resumed: {resumed.err.strip()}")
            case.cortado(*words, "--overwrite", codes=(0,))
    case.complaints += search_complaints(out, finished=True)
    case.complaints += [f"{name} is left behind" for name in leftovers(out)]
    for file in ("metrics.jsonl", *_logs(whole / "out")):
        if not (out / file).exists() or (out / file).read_bytes() != (whole / "out" / file).read_bytes():
            case.complaints.append(f"{file} differs from that of the undisturbed search")


def _cortado_killed(case: Case, words: Sequence[str], seconds: float, *codes: int) -> None:
    """Run a command that gets a signal before it would end, or just after; ``codes`` may it end with besides."""
    start = 4.0 if case.in_console else 0.0
    after = float(case.random.uniform(0.0, 1.05 * seconds + start))
    number = _SIGNALS[case.random.integers(len(_SIGNALS))]
    case.notes.append(f"{number.name} after {after:.2f} s")
    case.cortado(*words, kill=Kill(after, number), codes=(0, -number, 128 + number, *codes))


def _choose(case: Case, choices: Sequence[tuple[str, str]]) -> tuple[str, str, Path]:
    """A base, its precision, and the folder of its undisturbed run."""
    name, precision = choices[case.random.integers(len(choices))]
    case.notes.append(f"{name} in {precision}")
    return name, precision, case.folder.parent / "prepared" / case.family / f"{name}-{precision}"


def _run_words(precision: str, steps: int) -> list[str]:
    return ["run", "file.toml", "--no-pictures", "--out", "out", "--steps", str(steps), "--precision", precision]


def _search_words(precision: str) -> list[str]:
    return ["optimise", "file.toml", "--no-pictures", "--out", "out", "--precision", precision]


def _longer(tables: bases.Tables) -> bases.Tables:
    tables["optimise"]["iterations"] = EVALUATIONS
    return tables


def _undisturbed(folder: Path, choices, files, words) -> list[Outcome]:  # type: ignore[no-untyped-def]
    outcomes = []
    for name, precision in choices:
        tables, place = files[name], folder / f"{name}-{precision}"
        place.mkdir()
        (place / "file.toml").write_text(to_toml(_longer(tables) if "optimise" in tables else tables))
        for overwrite in ([], ["--overwrite"]):
            outcome = by_fork([*words(precision), *overwrite], place)
            if outcome.code:
                raise RuntimeError(f"{name} fails undisturbed: {outcome.err}")
        outcomes.append(outcome)
        (place / "seconds.json").write_text(json.dumps(outcome.seconds))
        shutil.rmtree(place / "out" / "figures")
    return outcomes


def _seconds(whole: Path) -> float:
    """How long the undisturbed run took."""
    return float(json.loads((whole / "seconds.json").read_text()))


def _logs(out: Path) -> list[str]:
    """The replay logs, one for each of several searches."""
    return sorted(str(path.relative_to(out)) for path in out.glob("checkpoint/**/replay.log"))
