"""Look at every page of the built site in Chromium: ``python docs/site/look.py build/docs [--pictures FOLDER]``.

A page fails if the console shows an error, a file does not load, the page is wider than the window, a table on a
telephone breaks a short entry into lines, or a picture is missing or has no description. The script needs Chromium,
installed or from Playwright.
"""

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from chromium import chromium, listened

WIDTHS = (390, 1280)
"""Width of the window [pixels] on a telephone, and on a laptop."""
PICTURED = ("index", "start", "performance", "scene_file", "adjoint", "api/gradients", "tutorials/first_splash")
LOOK = """() => {
  const found = [];
  const width = document.documentElement.clientWidth;
  if (document.documentElement.scrollWidth > width)
    found.push(`is ${document.documentElement.scrollWidth} pixels wide, not ${width}`);
  for (const cell of width < 700 ? document.querySelectorAll(".table-wrapper td") : []) {
    const text = cell.textContent.trim(), inside = document.createRange();
    inside.selectNodeContents(cell);
    if (text.length <= 12 && inside.getBoundingClientRect().height > 36) found.push(`breaks ${text} into lines`);
  }
  for (const image of document.querySelectorAll("article img")) {
    if (!image.alt || image.alt.includes("_build") || image.alt.length < 10) found.push(`no words for ${image.src}`);
    if (!image.naturalWidth) found.push(`does not show ${image.src}`);
  }
  return found;
}"""


def complaints(browser: Any, page_file: Path, width: int, picture: Path | None) -> Iterator[str]:
    """Yield the errors of a page in a window of ``width`` pixels."""
    page = browser.new_page(viewport={"width": width, "height": 800})
    found = listened(page)
    page.goto(page_file.resolve().as_uri(), wait_until="load")
    for image in page.query_selector_all("article img"):  # those further down are loaded when they are looked at
        image.scroll_into_view_if_needed()
    found += page.evaluate(LOOK)
    if picture:
        page.screenshot(path=picture, full_page=True)
    page.close()
    return (f"{page_file} at {width}: {sentence}" for sentence in found)


def main() -> None:
    """Check all pages. The exit code is 1 if a page has errors."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("site", type=Path)
    parser.add_argument("--pictures", type=Path, help="folder for pictures of some pages")
    options = parser.parse_args()
    pages = sorted(options.site.rglob("*.html"))
    if not pages:
        sys.exit(f"{options.site} holds no pages: build them with make docs.")
    found: list[str] = []
    with chromium() as browser:
        for page in pages:
            name = page.relative_to(options.site).with_suffix("").as_posix()
            for width in WIDTHS:
                pictured = options.pictures and name in PICTURED
                picture = options.pictures / f"{name.replace('/', '-')}-{width}.png" if pictured else None
                found += complaints(browser, page, width, picture)
    print(*found, sep="\n")
    print(f"{len(pages)} pages at widths of {WIDTHS}: {len(found)} complaints")
    sys.exit(bool(found))


if __name__ == "__main__":
    main()
