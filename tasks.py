"""What ``make`` does: ``python -m tasks test`` is the same where there is no make, such as on Windows.

``sanitize`` needs GCC or Clang, and CMake.
"""

import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

ROOT = Path(__file__).parent
VENV = ROOT / ".venv"
STAMPS = {"test": VENV / ".ready", "pictures,view": VENV / ".demo", "docs": VENV / ".docs"}
"""What says that extras are installed."""
BIN = VENV / ("Scripts" if sys.platform == "win32" else "bin")
INSTALL = ("python", "-m", "pip", "install", "--quiet", "--no-compile", "--disable-pip-version-check", "--editable")
"""Modules are compiled when they are first imported; to compile all takes as long as to install them."""
DOCS = "--fresh-env --write-all --fail-on-warning --keep-going"
ENGINE = (*INSTALL, "./reference", "--no-deps")
"""Needs a C++ compiler. What it depends on, Cortado, is installed at the same time."""
COMMANDS: dict[str, tuple[str, ...]] = {
    "demo": ("cortado", "optimise", "examples/latte_art_small.toml", "--out", "runs/demo", "--overwrite"),
    "lint": ("ruff", "check", "."),
    "format": ("ruff", "format", "--check", "."),
    "types": ("mypy",),
    "tests": ("pytest", "--short"),
    "tests-all": ("pytest",),
    "unit": ("pytest", "-m", "not slow and not validation"),
    "validation": ("pytest", "-m", "validation"),
    "slow": ("pytest", "-m", "slow"),
    "fuzz": ("python", "-m", "fuzz"),
    "docs": tuple(f"sphinx-build {DOCS} --quiet docs build/docs".split()),
    "docs-links": ("sphinx-build", "--builder", "linkcheck", "--quiet", "docs", "build/docs-links"),
    "docs-browser": ("python", "docs/site/look.py", "build/docs"),
}
SEVERAL: dict[str, tuple[str, ...]] = {
    "setup": (),
    "test": ("lint", "format", "tests"),
    "test-all": ("lint", "format", "tests-all"),
    **{name: (name,) for name in COMMANDS},
    "docs-browser": ("docs", "docs-browser"),
}
EXTRAS = {"demo": ("pictures,view",), **{name: ("test", "docs") for name in COMMANDS if name.startswith("docs")}}
"""What a task needs; all others need what tests do."""
BESIDE = {"test": "types", "test-all": "types"}
"""What runs beside the last command of a task: it has one core busy for most of a minute."""
SANITIZED = "build/sanitize"
MADE = {"docs": "build/docs/index.html"}
"""What a task says at its end."""


def main(arguments: list[str]) -> int:
    """Runs a task, with what else is given as options of its last command."""
    if os.environ.pop("PYTHONDONTWRITEBYTECODE", ""):  # else each of a hundred processes compiles what it imports
        os.environ["PYTHONPYCACHEPREFIX"] = str(VENV / "pycache")
    name, *options = arguments or [""]
    if name not in SEVERAL and name != "sanitize":
        print(f"python -m tasks TASK, one of: {', '.join((*SEVERAL, 'sanitize'))}", file=sys.stderr)
        return 2
    for extra in EXTRAS.get(name, ("test",)):
        set_up(extra)
    if name == "sanitize":
        return sanitize()
    for part in SEVERAL[name]:
        is_last = part == SEVERAL[name][-1]
        with ThreadPoolExecutor() as pool:
            beside = [pool.submit(run, COMMANDS[BESIDE[name]])] if is_last and name in BESIDE else []
            code = run((*COMMANDS[part], *(options if is_last else ())))
        code = code or max((other.result() for other in beside), default=0)
        if code:
            return code
        if part in MADE:
            print(MADE[part])
    return 0


def set_up(extra: str) -> None:
    """Make the virtual environment, and install Cortado in it with what extras have, unless nothing has changed since
    that, or since all that tests need was installed, which is more than a demo does."""
    build = ROOT / "reference" / "pyproject.toml", *(ROOT / "reference" / "cpp").rglob("*")
    sources = [ROOT / "pyproject.toml", *(path for path in build if path.is_file() and extra == "test")]
    changed, stamp = max(path.stat().st_mtime for path in sources), STAMPS[extra]
    enough = {stamp} if extra == "docs" else {stamp, STAMPS["test"]}
    if any(done.exists() and done.stat().st_mtime >= changed for done in enough):
        return
    print(f"Installing Cortado in {VENV.name}, once: some minutes.")
    if not BIN.exists():
        subprocess.run([sys.executable, "-m", "venv", str(VENV)], check=True)
    with ThreadPoolExecutor() as beside:
        engine = beside.submit(engine_built) if extra == "test" else None
        if run((*INSTALL, f".[{extra}]")):
            sys.exit(1)
    if engine and not engine.result():
        print("Installed without the reference engine (C++): CONTRIBUTING.md says how to see why.", file=sys.stderr)
    stamp.touch()


def engine_built() -> bool:
    """Compile the reference engine and install it; ends where it has to be there and cannot."""
    required = os.environ.get("CORTADO_REQUIRE_ENGINE", "") not in ("", "0")
    if run(ENGINE, quiet=not required) == 0:
        return True
    if required:
        sys.exit(1)
    return False


def sanitize() -> int:
    """Build and run the engine's own check with the sanitizers of the compiler."""
    python = BIN / "python"
    for command in (
        (str(python), "-m", "pip", "install", "--quiet", "--disable-pip-version-check", "cmeel-eigen"),
        ("cmake", "-S", "reference/cpp", "-B", SANITIZED, "-DCORTADO_SANITIZE=ON", f"-DPython_EXECUTABLE={python}"),
        ("cmake", "--build", SANITIZED, "--parallel"),
        (f"{SANITIZED}/check_engine",),
    ):
        code = subprocess.run(command, cwd=ROOT).returncode
        if code:
            return code
    return 0


def run(command: tuple[str, ...], quiet: bool = False) -> int:
    """Its exit code; the program is that of the virtual environment."""
    out = subprocess.DEVNULL if quiet else None
    return subprocess.run([str(BIN / command[0]), *command[1:]], cwd=ROOT, stdout=out, stderr=out).returncode


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
