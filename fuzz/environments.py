"""Computers on which something is missing, full, closed, read-only or odd: each a few words of shell around a command.

The scripts are for bash. ``run FILE OUT`` is the command, in place of the shell; both words may be left out.
"""

import importlib
import shlex
import signal
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from subprocess import run

from fuzz import bases
from fuzz.answers import run_complaints, search_complaints
from fuzz.cases import Case
from fuzz.judge import CODES
from fuzz.processes import Kill, Limits, Outcome, by_console, by_fork, console
from fuzz.toml_text import to_toml

PIPE = 128 + signal.SIGPIPE
"""Exit code where nobody reads the result."""
KINDS = ("run", "optimise")
COMPILING = 180.0
"""[s] that a command may take which finds no kernels that it could use again."""


@dataclass(frozen=True)
class Environment:
    """What is odd, and how it is made."""

    name: str
    script: str
    mounts: bool = False
    """Whether the script mounts something, for itself alone."""
    seconds: float = 20.0
    heard: bool = True
    """Whether stderr is open."""
    interrupted: bool = False
    """Whether SIGINT comes while the program starts."""
    codes: tuple[int, ...] = CODES


def _home(name: str, mount: str) -> Environment:
    return Environment(
        f"HOME {name}",
        f'mkdir home; {mount} unset XDG_CACHE_HOME; HOME="$PWD/home" run',
        mounts=True,
        seconds=COMPILING,
    )


def _disk(size: str) -> Environment:
    script = (
        f'mkdir disk; mount -t tmpfs -o size={size} none disk; (run "" disk/out); code=$?; cp -r disk/out .; exit $code'
    )
    return Environment(f"a disk of {size}", script, mounts=True)


def _cache(name: str, damage: str) -> Environment:
    script = f'cp -r "$cache" cache; {damage}; WARP_CACHE_PATH="$PWD/cache" run'
    return Environment(f"a cache of kernels {name}", script, seconds=COMPILING)


def _limit(words: str) -> Environment:
    return Environment(f"ulimit {words}", f"ulimit {words}; run")


ENVIRONMENTS = (
    Environment("no HOME", "unset HOME; run", seconds=COMPILING),
    Environment("HOME that is nowhere", "HOME=/nowhere/at/all run", seconds=COMPILING),
    Environment("HOME that is a file", 'touch home; HOME="$PWD/home" run', seconds=COMPILING),
    _home("read-only", "mount -t tmpfs -o ro none home;"),
    _home("full", "mount -t tmpfs -o size=16k none home; head -c 20000 /dev/zero >home/x 2>/dev/null;"),
    Environment("ASCII", "LC_ALL=C PYTHONUTF8=0 PYTHONCOERCECLOCALE=0 PYTHONIOENCODING=ascii run '' wäter; "),
    Environment("Turkish", "through='env LC_ALL=tr_TR.UTF-8'; run"),
    Environment("stdin closed", "run <&-"),
    Environment("stdout closed", "run >&-"),
    Environment("stderr closed", "run 2>&-", heard=False),
    Environment("everything closed", "run <&- >&- 2>&-", heard=False),
    Environment("stdout on a full disk", "run >/dev/full"),
    Environment("stdout and stderr on a full disk", "run >/dev/full 2>&1", heard=False),
    Environment("a reader that goes away", "set -o pipefail; (run) | true", codes=(0, PIPE)),
    Environment("a reader of both that goes away", "set -o pipefail; (run) 2>&1 | true", heard=False, codes=(0, PIPE)),
    Environment(
        "working directory removed",
        'here="$PWD"; mkdir gone; cd gone; rmdir "$here/gone"; run "$here/$file" "$here/out"',
    ),
    Environment(
        "working directory removed, and a relative --out",
        'here="$PWD"; mkdir gone; cd gone; rmdir "$here/gone"; run "$here/$file"',
    ),
    Environment("a newline in names", "cp \"$file\" $'a\\nb.toml'; run $'a\\nb.toml' $'out\\n'"),
    Environment("names that are not UTF-8", "cp \"$file\" $'caf\\xe9.toml'; run $'caf\\xe9.toml' $'out\\xe9'"),
    Environment("an escape in names", "cp \"$file\" $'\\e[31m.toml'; run $'\\e[31m.toml' $'\\e[31m'"),
    Environment("a file that is not there, with an escape", "run $'\\e[31m.toml'"),
    Environment("a long name", 'run "" "$(printf "%0250d" 0)"'),
    Environment("a name that is too long", 'run "" "$(printf "%0300d" 0)"'),
    Environment("a deep --out", 'run "" "$(printf "d/%.0s" {1..400})"'),
    Environment("--out that is a file", "touch out; run"),
    Environment("--out below a file", "touch file; run '' file/out"),
    Environment("--out that leads nowhere", "ln -s nowhere out; run"),
    Environment("--out read-only", "mkdir out; mount -t tmpfs -o ro none out; run", mounts=True),
    _disk("16k"),
    _disk("40k"),
    _disk("120k"),
    Environment("no TMPDIR", "TMPDIR=/nowhere TMP=/nowhere TEMP=/nowhere run"),
    Environment("one core", "taskset -pc 0 $$ >/dev/null; OMP_NUM_THREADS=1 run"),
    _limit("-n 16"),
    _limit("-n 40"),
    _limit("-v 4000000"),
    _limit("-v 1500000"),
    _limit("-f 8"),
    _limit("-f 60"),
    _limit("-s 2048"),
    _cache("cut short", "find cache -name '*.o' -exec truncate -s 1000 {} +"),
    _cache("of noise", "find cache -name '*.o' -exec sh -c 'head -c 9000 /dev/urandom >\"$1\"' sh {} \\;"),
    _cache("without descriptions", "find cache -name '*.meta' -exec truncate -s 0 {} +"),
    _cache("of folders", "find cache -name '*.o' -exec sh -c 'rm \"$1\"; mkdir \"$1\"' sh {} \\;"),
    Environment("a narrow terminal", "COLUMNS=1 LINES=1 TERM=dumb run"),
    Environment("python -OO", "PYTHONOPTIMIZE=2 run"),
    Environment("warnings are errors", "PYTHONWARNINGS=error run"),
    Environment("an unknown backend of pictures", "MPLBACKEND=nonsense run"),
    Environment("no folder for matplotlib", "MPLCONFIGDIR=/nowhere run"),
    Environment("umask 0777", "umask 0777; run"),
    Environment("no PATH", "PATH=/nowhere; run"),
    Environment("SIGINT at the start", "run", interrupted=True, codes=(0, 130, -signal.SIGINT)),
)


def prepare(folder: Path) -> list[Outcome]:
    """The run and the search where nothing is odd, so that their kernels are compiled."""
    outcomes = []
    for kind in KINDS:
        _write(folder, kind)
        outcomes.append(by_fork([kind, "file.toml", "--out", kind], folder, Limits(COMPILING)))
        if outcomes[-1].code:
            raise RuntimeError(f"{kind} fails where nothing is odd: {outcomes[-1].err}")
    return outcomes


def run_in_environment(case: Case) -> None:
    """A small run, or a small search, by the real command in one of the environments."""
    environment = ENVIRONMENTS[case.number // 2]
    kind = KINDS[case.number % 2]
    case.notes += [environment.name, kind]
    if environment.mounts and not _can_mount():
        case.notes.append("left out, as nothing can be mounted here")
        return
    _write(case.folder, kind)
    limits = Limits(environment.seconds)
    kill = None
    if environment.interrupted:
        kill = Kill(float(case.random.uniform(0.02, 3.0)), signal.SIGINT)
    kernels = Path(importlib.import_module("warp").config.kernel_cache_dir).parent
    script = shell_script(environment, kind, kernels)
    words = [*(["unshare", "--mount"] if environment.mounts else []), "bash", "-c", script]
    outcome = by_console(words, case.folder, limits=limits, kill=kill)
    case.judged(outcome, limits, environment.codes, environment.heard)
    out = case.folder / "out"
    if out.is_dir() and environment.name != "umask 0777":
        check = run_complaints if kind == "run" else search_complaints
        case.complaints += check(out, outcome.code == 0)


def _write(folder: Path, kind: str) -> None:
    tables = bases.scenes()["dam_break_plane"] if kind == "run" else bases.tasks()["recover_gravity_small"]
    (folder / "file.toml").write_text(to_toml({**tables, "name": "wäter"}))


def shell_script(environment: Environment, kind: str, cache: Path) -> str:
    """What bash is given to run one command; ``cache`` is where compiled kernels are."""
    options = "--no-pictures --steps 5" if kind == "run" else "--no-pictures"
    command = f'{shlex.join(console())} {kind} "${{1:-$file}}" {options} --out "${{2:-out}}"'
    return (
        f"file=file.toml; cache={shlex.quote(str(cache))}; run() {{ exec $through {command}; }}; {environment.script}"
    )


@cache
def _can_mount() -> bool:
    return run(["unshare", "--mount", "mount", "-t", "tmpfs", "none", "/mnt"], capture_output=True).returncode == 0
