"""Chromium without a window, for checks of the site, of reports and of the viewer. Needs Playwright."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

SOFTWARE = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]
"""Options of Chromium that draw WebGL on a CPU."""


@contextmanager
def chromium() -> Iterator[Any]:
    """Open the installed Chromium, or Playwright's Chromium if the command ``chromium`` is missing. Raises
    `ImportError` without Playwright, and Playwright's ``Error`` without a browser."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=SOFTWARE)
        try:
            yield browser
        finally:
            browser.close()


def listened(page: Any) -> list[str]:
    """Return a list that grows with the page's errors: in the console, in scripts, and for files that do not load."""
    found: list[str] = []
    page.on("console", lambda message: found.append(message.text) if message.type == "error" else None)
    page.on("pageerror", lambda error: found.append(str(error)))
    page.on("requestfailed", lambda request: found.append(f"does not get {request.url}"))
    return found
