"""The pages of the site: each can be reached, its links lead somewhere, its pictures are described."""

import re
from pathlib import Path

import outer_pages
import pytest

DOCS = Path(__file__).parents[1] / "docs"
PAGES = sorted(path for path in DOCS.rglob("*.md"))
CODE = re.compile(r"^(```+|~~~+).*?^\1$|^(?: {4}.*\n)+|`[^`\n]+`", re.MULTILINE | re.DOTALL)


def prose(path: Path) -> str:
    """A page without its code."""
    return CODE.sub("", path.read_text(encoding="utf-8"))


def entries(page: Path) -> set[Path]:
    """The pages that the tables of contents of a page list."""
    found = set()
    for body in re.findall(r"^```\{toctree\}\n(.*?)^```", page.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL):
        names = [line.strip() for line in body.splitlines() if line.strip() and not line.startswith(":")]
        found |= {path for name in names for path in page.parent.glob(f"{name}.md")}
    return found


def test_every_page_is_in_one_table_of_contents():
    """A new page gets its line in docs/index.md."""
    listed = [entry for page in PAGES for entry in entries(page)]
    assert sorted([*listed, DOCS / "index.md"]) == PAGES


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(DOCS).as_posix())
def test_a_page_has_one_title_links_and_pictures_that_are_there(page):
    text = prose(page)
    assert len(re.findall(r"^# .+", text, re.MULTILINE)) == 1
    assert [alt for alt in re.findall(r"!\[(.*?)\]\(", text, re.DOTALL) if len(alt) < 10] == []
    links = [link for link in re.findall(r"\]\(([^)#\s]+)", text) if "://" not in link]
    assert [link for link in links if not (page.parent / link).exists()] == []


@pytest.mark.parametrize("page, file", outer_pages.OUTER.items())
def test_a_page_from_elsewhere_is_there_and_says_where(page, file):
    assert (DOCS.parent / file).exists()
    assert f"](../{file})" in (DOCS / f"{page}.md").read_text(encoding="utf-8")
