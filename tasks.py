"""What ``make`` does, for machines without it, such as Windows: ``python -m tasks test``."""

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parent
VENV = ROOT / ".venv"
STAMPS = {"test": VENV / ".ready", "pictures,view": VENV / ".demo"}
"""What says that extras are installed."""
BIN = VENV / ("Scripts" if sys.platform == "win32" else "bin")
INSTALL = ("python", "-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--editable")
COMMANDS: dict[str, tuple[str, ...]] = {
    "demo": ("cortado", "optimise", "examples/latte_art_small.toml", "--out", "runs/demo", "--overwrite"),
    "lint": ("ruff", "check", "."),
    "types": ("mypy",),
    "tests": ("pytest",),
    "unit": ("pytest", "-m", "not slow and not validation"),
    "validation": ("pytest", "-m", "validation"),
    "slow": ("pytest", "-m", "slow"),
    "fuzz": ("python", "-m", "fuzz"),
}
"""By name, as the Makefile has them."""
SEVERAL = {"setup": (), "test": ("lint", "types", "tests"), **{name: (name,) for name in COMMANDS}}


def main(arguments: list[str]) -> int:
    """Runs a task, with what else is given as options of its last command."""
    name, *options = arguments or [""]
    if name not in SEVERAL:
        print(f"python -m tasks TASK, one of: {', '.join(SEVERAL)}", file=sys.stderr)
        return 2
    set_up("pictures,view" if name == "demo" else "test")
    steps = [COMMANDS[part] for part in SEVERAL[name]]
    for number, step in enumerate(steps, 1):
        code = run((*step, *options) if number == len(steps) else step)
        if code:
            return code
    return 0


def set_up(extra: str) -> None:
    """Make the virtual environment, and install Cortado in it with what extras have, unless nothing has changed since
    that, or since all that tests need was installed."""
    sources = [ROOT / "pyproject.toml", *(path for path in (ROOT / "cpp").rglob("*") if path.is_file())]
    changed, stamp = max(path.stat().st_mtime for path in sources), STAMPS[extra]
    if any(done.exists() and done.stat().st_mtime >= changed for done in {stamp, STAMPS["test"]}):
        return
    print(f"Installing Cortado in {VENV.name}, once: some minutes.")
    if not BIN.exists():
        subprocess.run([sys.executable, "-m", "venv", str(VENV)], check=True)
    if run((*INSTALL, f".[{extra}]")):
        sys.exit(1)
    if run(("python", "-c", "import cortado.reference._engine")):
        print("Installed without the reference engine (C++): CONTRIBUTING.md says how to see why.", file=sys.stderr)
    stamp.touch()


def run(command: tuple[str, ...]) -> int:
    """Its exit code; the program is that of the virtual environment."""
    return subprocess.run([str(BIN / command[0]), *command[1:]], cwd=ROOT).returncode


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
