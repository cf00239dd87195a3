"""Chromium without a window, for looking at pages: the site's, a report's, the viewer's. Needs Playwright."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

SOFTWARE = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]
"""So that WebGL is drawn also where there is no GPU."""


@contextmanager
def chromium() -> Iterator[Any]:
    """A browser: the installed one, or Playwright's own where the command is not found. Raises `ImportError` without
    Playwright, and Playwright's ``Error`` without a browser."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=SOFTWARE)
        try:
            yield browser
        finally:
            browser.close()


def listened(page: Any) -> list[str]:
    """What goes wrong on a page from now on: errors in its console or in its scripts, and files that do not come."""
    found: list[str] = []
    page.on("console", lambda message: found.append(message.text) if message.type == "error" else None)
    page.on("pageerror", lambda error: found.append(str(error)))
    page.on("requestfailed", lambda request: found.append(f"does not get {request.url}"))
    return found
