"""Pages in Chromium without a window: the particles of a report, and ``cortado view``. Nothing may go wrong in their
console, particles are seen, and play, scrub and buttons do what they say. Foreign pages get nothing of a viewer."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from io import BytesIO
from pathlib import Path
from threading import Thread
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import pytest
from chromium import chromium, listened
from PIL import Image

from bad_tasks import TINY_SCENE
from cortado.cli import main
from cortado.cli.views import opened

PORT = 18410
BLOCK = (
    TINY_SCENE.replace("dimension = 2", "dimension = 3")
    .replace("[0.0, 0.0]", "[0.0, 0.0, 0.0]")
    .replace("[0.4, 0.4]", "[0.4, 0.4, 0.2]")
    .replace("[0.7, 0.8]", "[0.7, 0.8, 0.4]")
)
"""The tiny scene in space."""
PATIENCE = 20.0
"""[s] that a page has to show what it should."""
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
    """One in whose console nothing goes wrong."""
    found = browser.new_page(viewport={"width": 1000, "height": 800})
    complaints = listened(found)
    yield found
    found.close()
    assert complaints == []


def pixels(seen: Any) -> np.ndarray:
    """(rows, columns, 3) of a page or a part of it, from 0 to 255."""
    return np.asarray(Image.open(BytesIO(seen.screenshot())).convert("RGB")).astype(int)


def scene_of(page: Any) -> np.ndarray:
    """What the viewer shows beside its panel, and below what it has to say about slow browsers."""
    return pixels(page)[200:, :-PANEL]


def coloured(picture: np.ndarray) -> float:
    """The share of pixels that are neither grey, as lines are, nor paper."""
    return float(np.mean(np.ptp(picture, axis=2) > 30))


def differ(a: np.ndarray, b: np.ndarray) -> bool:
    """Whether two pictures of a size are not the same, but for a few pixels."""
    return a.shape != b.shape or float(np.mean(np.abs(a - b).max(axis=2) > 20)) > 0.002


@pytest.fixture(params=["plane", "space"])
def report(request, tmp_path, monkeypatch) -> Path:
    monkeypatch.chdir(tmp_path)
    Path("scene.toml").write_text(TINY_SCENE if request.param == "plane" else BLOCK)
    main(["run", "scene.toml", "--steps", "120", "--out", "a", "--no-pictures"])
    return (tmp_path / "a/report.html").resolve()


def test_a_report_plays(page, report, request):
    page.goto(report.as_uri())
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


def test_a_report_is_turned(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("scene.toml").write_text(BLOCK)
    main(["run", "scene.toml", "--steps", "4", "--out", "a", "--no-pictures"])
    page.goto(Path("a/report.html").resolve().as_uri())
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
    """Opens the viewer of a file with a text, or of a folder, in the page."""
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
    """Let the viewer go on until something has come about in its page."""
    waited = 0.0
    while not come():
        assert waited < PATIENCE, "the page does not show it"
        shown.tick()
        page.wait_for_timeout(100)
        waited += 0.1


def choose(page: Any, colour: str) -> None:
    page.get_by_label("Colour").click()
    page.get_by_role("option", name=colour, exact=True).click()


@pytest.mark.parametrize("text", [TINY_SCENE, BLOCK], ids=["plane", "space"])
def test_a_scene_runs_in_the_viewer(page, look, text):
    shown = look(text)
    first = scene_of(page)
    until(page, shown, lambda: differ(scene_of(page), first))
    page.get_by_text("Run", exact=True).click()
    until(page, shown, lambda: not shown.running.value)
    for colour, unit in (("density", "kg/m³"), ("pressure", "Pa")):
        choose(page, colour)
        until(page, shown, page.get_by_text(f"{colour} [{unit}]").is_visible)


def test_a_run_is_scrubbed_in_the_viewer(page, look):
    Path("scene.toml").write_text(BLOCK)
    main(["run", "scene.toml", "--steps", "120", "--out", "a", "--no-pictures"])
    shown = look(BLOCK)
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
    other = browser.new_page(viewport={"width": 1000, "height": 800})
    other.goto(shown.window.address)
    until(page, shown, lambda: coloured(scene_of(other)) > 0.01)
    other.get_by_text("Run", exact=True).click()
    until(page, shown, lambda: not shown.running.value)
    until(page, shown, lambda: not page.get_by_label("Run", exact=True).is_checked())
    other.close()
    page.get_by_text("Run", exact=True).click()
    until(page, shown, lambda: shown.running.value)


@pytest.fixture
def foreign() -> Iterator[tuple[str, list[Any]]]:
    """The address of a page of somebody else's on this machine, and the headers with which it was asked for."""
    asked: list[Any] = []

    class Page(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            asked.append(self.headers)
            self.send_response(200)
            self.send_header("Content-Type", "text/html")
            self.end_headers()
            self.wfile.write(b"<!doctype html><title>foreign</title><link rel=icon href=data:,>")

        def log_message(self, *_: Any) -> None:
            """Says nothing."""

    server = ThreadingHTTPServer(("127.0.0.1", 0), Page)
    Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{server.server_port}/", asked
    server.shutdown()
    server.server_close()


JOIN = """([address, version]) => new Promise((done) => {
    const socket = new WebSocket(address, ["viser-v" + version]);
    socket.onopen = () => done("open");
    socket.onerror = () => done("refused");
})"""
"""What a foreign page does to drive a viewer: the address of a websocket, and the version of viser, are public."""
FETCH = """(address) => fetch(address).then((found) => found.text()).catch(() => "refused")"""
EMBED = """(address) => new Promise((done) => {
    const frame = document.createElement("iframe");
    frame.onload = () => done();
    frame.src = address;
    document.body.append(frame);
})"""


@pytest.mark.parametrize("place", ["another port", "another name", "a file", "a sandbox"])
def test_a_foreign_page_gets_nothing_of_a_viewer(browser, look, foreign, place, tmp_path):
    """Neither without the token nor, if it had leaked, with it."""
    import viser

    shown, page = look(TINY_SCENE), browser.new_page()
    parts = urlsplit(shown.window.address)
    (tmp_path / "evil.html").write_text("<!doctype html><title>a file</title>")
    own = f"evil.localhost:{parts.port}"  # a name that leads to this machine, as DNS rebinding makes one
    pages = {"another port": foreign[0], "another name": f"http://{own}/", "a file": (tmp_path / "evil.html").as_uri()}
    page.goto(pages.get(place, foreign[0]))
    frame = page.main_frame
    if place == "a sandbox":
        page.set_content('<iframe sandbox="allow-scripts" srcdoc="<!doctype html>"></iframe>')
        frame = page.frames[1]
    hosts = [parts.netloc, f"localhost:{parts.port}", *([own] if place == "another name" else [])]
    for host in hosts:
        for path in ("/", parts.path, parts.path.rstrip("/")):
            assert frame.evaluate(JOIN, [f"ws://{host}{path}", viser.__version__]) == "refused", (host, path)
            assert "<html" not in frame.evaluate(FETCH, f"http://{host}{path}"), (host, path)
    clients, running = len(shown.window.server.get_clients()), shown.running.value
    if place != "a sandbox":
        page.evaluate(EMBED, shown.window.address)
        page.wait_for_timeout(1000)
    assert len(shown.window.server.get_clients()) == clients == 1 and shown.running.value == running
    page.close()


def test_a_viewer_keeps_its_token_from_other_pages(page, look, foreign):
    shown = look(TINY_SCENE)
    address, asked = foreign
    page.evaluate("(address) => { location.href = address; }", address)
    page.wait_for_url(address)
    token = urlsplit(shown.window.address).path.strip("/")
    assert asked[0]["Referer"] is None and not any(token in str(headers) for headers in asked)
