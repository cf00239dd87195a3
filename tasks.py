"""What ``make`` does, for machines without it, such as Windows: ``python -m tasks test``."""

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parent
VENV = ROOT / ".venv"
READY = VENV / ".ready"
BIN = VENV / ("Scripts" if sys.platform == "win32" else "bin")
INSTALL = ("python", "-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--editable", ".[test]")
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
    set_up()
    steps = [COMMANDS[part] for part in SEVERAL[name]]
    for number, step in enumerate(steps, 1):
        code = run((*step, *options) if number == len(steps) else step)
        if code:
            return code
    return 0


def set_up() -> None:
    """Make the virtual environment, and install Cortado in it, unless nothing has changed since."""
    sources = [ROOT / "pyproject.toml", *(path for path in (ROOT / "cpp").rglob("*") if path.is_file())]
    if READY.exists() and READY.stat().st_mtime >= max(path.stat().st_mtime for path in sources):
        return
    if not BIN.exists():
        subprocess.run([sys.executable, "-m", "venv", str(VENV)], check=True)
    if run(INSTALL):
        sys.exit(1)
    if run(("python", "-c", "import cortado.reference._engine")):
        print("Installed without the reference engine (C++): CONTRIBUTING.md says how to see why.", file=sys.stderr)
    READY.touch()


def run(command: tuple[str, ...]) -> int:
    """Its exit code; the program is that of the virtual environment."""
    return subprocess.run([str(BIN / command[0]), *command[1:]], cwd=ROOT).returncode


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
