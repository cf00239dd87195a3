"""The scripts of `examples/wave_flume`, which import each other."""

import runpy
import sys
from pathlib import Path
from typing import Any

FOLDER = Path(__file__).parents[1] / "examples" / "wave_flume"


def names_of(script: str) -> dict[str, Any]:
    """Run a script as a module, and return its names; what it imports from its folder is its own."""
    before = set(sys.modules)
    sys.path.insert(0, str(FOLDER))
    try:
        return runpy.run_path(str(FOLDER / script))
    finally:
        sys.path.remove(str(FOLDER))
        for name in {path.stem for path in FOLDER.glob("*.py")} & (set(sys.modules) - before):
            del sys.modules[name]
