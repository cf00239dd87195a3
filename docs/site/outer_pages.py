"""Add pages of the repository outside this folder to the site, and adapt links to these pages.

For each outer page, the folder has a stub with the page's name. Sphinx reads the outer page in place of the stub.
"""

import re
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
OUTER = {
    "contributing": "CONTRIBUTING.md",
    "changelog": "CHANGELOG.md",
    "release": "RELEASE.md",
    "notice": "NOTICE.md",
    "validation": "validation/README.md",
    "benchmarks": "benchmarks/README.md",
    "experiments": "experiments/README.md",
}
"""Path of the outer page in the repository, by the name of the page in the site."""
LINK = re.compile(r"\]\(([^)\s#:]+)(#[^)\s]*)?\)")


def _read(app: Any, name: str, source: list[str]) -> None:
    file = OUTER.get(name)
    here = Path(app.srcdir)
    if file:
        source[0] = (ROOT / file).read_text(encoding="utf-8")
        app.env.note_dependency(str(ROOT / file))
    folder = (ROOT / file).parent if file else (here / name).parent
    source[0] = LINK.sub(lambda link: _towards(link, folder, here / name), source[0])


def _towards(link: re.Match[str], folder: Path, page: Path) -> str:
    """Return a link. A link to a file that the site shows as a page leads to this page."""
    target = (folder / link[1]).resolve()
    found = next((f"{name}.md" for name, file in OUTER.items() if ROOT / file == target), None)
    docs = ROOT / "docs"
    if found is None and target.is_relative_to(docs):
        found = target.relative_to(docs).as_posix()
    if found is None:
        return link[0]
    up = "../" * (len(page.relative_to(docs).parts) - 1)
    return f"]({up}{found}{link[2] or ''})"


def setup(app: Any) -> dict[str, bool]:
    app.connect("source-read", _read)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
