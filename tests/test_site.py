"""The pages of the site: each can be reached, its links lead somewhere, its pictures are described."""

import re
from pathlib import Path

import mathml
import outer_pages
import pytest

DOCS = Path(__file__).parents[1] / "docs"
PAGES = sorted(path for path in DOCS.rglob("*.md"))
CODE = re.compile(r"^(```+|~~~+).*?^\1$|^(?: {4}.*\n)+|`[^`\n]+`", re.MULTILINE | re.DOTALL)


def prose(path: Path) -> str:
    """A page without its code."""
    return CODE.sub("", path.read_text(encoding="utf-8"))


def entries(page: Path) -> list[Path]:
    """The pages that the tables of contents of a page list."""
    found = []
    for body in re.findall(r"^```\{toctree\}\n(.*?)^```", page.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL):
        names = [line.strip() for line in body.splitlines() if line.strip() and not line.startswith(":")]
        found += [path for name in names for path in page.parent.glob(f"{name}.md")]
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


def test_bars_around_a_number_are_no_relations():
    """Without a form, a bar inside of a formula has room on both sides, and its superscript hangs below it."""
    left, right = (
        f'<mo form="{form}" stretchy="false" lspace="0" rspace="0">&#x0007C;</mo>' for form in ("prefix", "postfix")
    )
    made = mathml.mathml(r"a \lvert c_i - c_j \rvert^2 + P(x | y) \lvert z \rvert", "inline")
    assert re.findall(r"<mo[^>]*>&#x0007C;</mo>", made) == [
        left,
        right,
        '<mo stretchy="false">&#x0007C;</mo>',
        left,
        right,
    ]
    assert f"<msup>{right}<mn>2</mn></msup>" in made


def test_primes_are_as_large_as_their_letter():
    made = mathml.mathml(r"\alpha f'' + f'(x) + g^2", "block")
    assert made.count("<msup>") == 1 and 'display="block"' in made
    for prime in ("2", "3"):
        assert f'<mrow><mi>f</mi><mo lspace="0" rspace="0">&#x0203{prime};</mo></mrow>' in made
