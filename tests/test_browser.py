"""Pages in Chromium without a window: the particles of a report, and ``cortado view``. Nothing may go wrong in their
console, particles are seen, and play, scrub and buttons do what they say."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from chromium import chromium, listened
from PIL import Image

from bad_tasks import TINY_BLOCK, TINY_SCENE
from cortado.cli import main
from cortado.cli.views import opened

PORT = 18410
PATIENCE = 20.0
"""[s] that a page has to show what it should."""
SIZE = {"width": 800, "height": 560}
"""Of the window in pixels: Chromium draws them without a GPU."""
PANEL = 330
"""Pixels on the right that the viewer's panel covers, at most."""


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    pytest.importorskip("playwright", reason="no Playwright: pip install playwright")
    from playwright.sync_api import Error

    with ExitStack() as stack:
        try:
            found = stack.enter_context(chromium())
        except Error as error:
            pytest.skip(f"no Chromium: install it, or playwright install chromium ({str(error).splitlines()[0]})")
        yield found


@pytest.fixture
def page(browser) -> Iterator[Any]:
    found = browser.new_page(viewport=SIZE)
    complaints = listened(found)
    yield found
    found.close()
    assert complaints == []


def pixels(seen: Any) -> np.ndarray:
    return np.asarray(Image.open(BytesIO(seen.screenshot())).convert("RGB")).astype(int)


def scene_of(page: Any) -> np.ndarray:
    """What the viewer shows beside its panel, and below what it has to say about slow browsers."""
    return pixels(page)[200:, :-PANEL]


def coloured(picture: np.ndarray) -> float:
    """The share of pixels that are neither grey, as lines are, nor paper."""
    return float(np.mean(np.ptp(picture, axis=2) > 30))


def differ(a: np.ndarray, b: np.ndarray) -> bool:
    return a.shape != b.shape or float(np.mean(np.abs(a - b).max(axis=2) > 20)) > 0.002


def report(folder: Path, text: str, steps: int) -> str:
    (folder / "scene.toml").write_text(text)
    main(["run", str(folder / "scene.toml"), "--steps", str(steps), "--out", str(folder / "a"), "--no-pictures"])
    return (folder / "a/report.html").resolve().as_uri()


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    """The folder of a run, which is in ``a``."""
    folder = tmp_path_factory.mktemp("run")
    report(folder, TINY_SCENE, 120)
    return folder


def test_a_report_plays(page, run):
    page.goto((run / "a/report.html").as_uri())
    view = page.locator(".particle-view")
    canvas, clock = view.locator("canvas"), view.locator("output")
    first = pixels(canvas)
    assert 0.02 < coloured(first) < 0.6 and clock.text_content() == "0.000 s"
    view.locator("[data-play]").click()
    page.wait_for_function("parseFloat(document.querySelector('.particle-view output').textContent) > 0.05")
    view.locator("[data-play]").click()
    stopped = clock.text_content()
    page.wait_for_timeout(300)
    assert clock.text_content() == stopped and differ(pixels(canvas), first)
    slider = view.locator("input")
    for share, time in ((1.0, 120 * 0.0021), (0.0, 0.0)):
        slider.evaluate(f"(own) => {{ own.value = {share} * own.max; own.dispatchEvent(new Event('input')); }}")
        page.wait_for_function(f"parseFloat(document.querySelector('.particle-view output').textContent) == {time:.3f}")
    page.wait_for_timeout(100)
    assert not differ(pixels(canvas), first)
    slider.evaluate("(own) => { own.value = own.max; own.dispatchEvent(new Event('input')); }")
    page.wait_for_timeout(100)
    last = pixels(canvas)
    view.locator("select").select_option("speed")
    page.wait_for_timeout(100)
    assert differ(pixels(canvas), last) and "m/s" in view.locator("p").text_content()


def test_a_report_is_turned(page, tmp_path):
    page.goto(report(tmp_path, TINY_BLOCK, 4))
    canvas = page.locator(".particle-view canvas")
    canvas.scroll_into_view_if_needed()
    first, box = pixels(canvas), canvas.bounding_box()
    page.mouse.move(box["x"] + 200, box["y"] + 100)
    page.mouse.down()
    page.mouse.move(box["x"] + 300, box["y"] + 100, steps=4)
    page.mouse.up()
    page.wait_for_timeout(100)
    turned = pixels(canvas)
    assert differ(turned, first) and 0.02 < coloured(turned) < 0.6
    page.locator("[data-reset]").click()
    page.wait_for_timeout(100)
    assert not differ(pixels(canvas), first)


@pytest.fixture
def look(page, tmp_path, monkeypatch) -> Iterator[Callable[[str], Any]]:
    pytest.importorskip("viser", reason="no viser: pip install viser")
    monkeypatch.chdir(tmp_path)
    with ExitStack() as stack:

        def open_view(text: str) -> Any:
            Path("scene.toml").write_text(text)
            path = Path("a") if Path("a").exists() else Path("scene.toml")
            shown = opened(path, [], "cpu", None, PORT)
            stack.callback(shown.window.close)
            page.goto(shown.window.address)
            until(page, shown, lambda: coloured(scene_of(page)) > 0.01)
            return shown

        yield open_view


def until(page: Any, shown: Any, come: Callable[[], bool]) -> None:
    waited = 0.0
    while not come():
        assert waited < PATIENCE, "the page does not show it"
        shown.tick()
        page.wait_for_timeout(100)
        waited += 0.1


def choose(page: Any, colour: str) -> None:
    page.get_by_label("Colour").click()
    page.get_by_role("option", name=colour, exact=True).click()


def test_a_scene_runs_in_the_viewer(page, look):
    shown = look(TINY_BLOCK)
    first = scene_of(page)
    until(page, shown, lambda: differ(scene_of(page), first))
    page.get_by_text("Run", exact=True).click()
    until(page, shown, lambda: not shown.running.value)
    for colour, unit in (("density", "kg/m³"), ("pressure", "Pa")):
        choose(page, colour)
        until(page, shown, page.get_by_text(f"{colour} [{unit}]").is_visible)


def test_a_run_is_scrubbed_in_the_viewer(page, look, run, monkeypatch):
    monkeypatch.chdir(run)
    shown = look(TINY_SCENE)
    until(page, shown, lambda: shown.slider.value > 2)
    page.get_by_text("Play", exact=True).click()
    until(page, shown, lambda: not shown.playing.value)
    seen = []
    for key, frame in (("Home", 0), ("End", len(shown.trajectory) - 1)):
        page.get_by_role("slider").first.press(key)
        until(page, shown, page.get_by_text(f"t = {shown.trajectory.times[frame]:.4g} s", exact=True).is_visible)
        page.wait_for_timeout(500)
        seen.append(scene_of(page))
    assert differ(*seen)


def test_a_viewer_is_loaded_again_and_looked_at_twice(browser, page, look):
    shown = look(TINY_SCENE)
    page.reload()
    until(page, shown, lambda: coloured(scene_of(page)) > 0.01)
    other = browser.new_page(viewport=SIZE)
    other.goto(shown.window.address)
    until(page, shown, lambda: coloured(scene_of(other)) > 0.01)
    other.get_by_text("Run", exact=True).click()
    until(page, shown, lambda: not shown.running.value)
    until(page, shown, lambda: not page.get_by_label("Run", exact=True).is_checked())
    other.close()
    page.get_by_text("Run", exact=True).click()
    until(page, shown, lambda: shown.running.value)
