"""The texts of programs in which tests look for options."""

import re
from pathlib import Path


def sources(place: Path) -> str:
    """The text of a program: of a file and those beside it that it imports, or of all files of a package."""
    files = [place] if place.is_file() else sorted(place.rglob("*.py"))
    if place.is_file():
        beside = re.findall(r"^from (\w+) import", place.read_text("utf-8"), re.MULTILINE)
        files += [file for file in (place.with_name(f"{name}.py") for name in beside) if file.exists()]
    return "".join(file.read_text("utf-8") for file in files)
