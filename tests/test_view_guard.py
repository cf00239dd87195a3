"""Who gets into the window of ``cortado view``, and what may be said to it: attacks without a browser; those of a
foreign page in one are in test_browser.py."""

import http.client
import math
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import pytest

import cortado
from bad_tasks import TINY_SCENE
from cortado.cli.views import RecordedView, opened
from signals import listen

viser = pytest.importorskip("viser")
msgspec = pytest.importorskip("msgspec")
client = pytest.importorskip("websockets.sync.client")
exceptions = pytest.importorskip("websockets.exceptions")

PORT = 18510
PATIENCE = 5.0
"""[s] that a message has to arrive."""
CAMERA = {"type": "ViewerCameraMessage", "wxyz": [1, 0.0, 0.0, 0.0], "position": [0.0, 0.0, 1.0], "fov": 1.3}
CAMERA |= {"look_at": [0.0, 0.0, 0.0], "up_direction": [0.0, 1.0, 0.0], "near": 0.01, "far": 1000}
CAMERA |= {"image_height": 800, "image_width": 1000}
"""As viser's page sends it."""


@pytest.fixture
def file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scene.toml").write_text(TINY_SCENE)
    return tmp_path / "scene.toml"


@pytest.fixture
def live(file) -> Iterator[Any]:
    shown = opened(file, [], "cpu", "float32", PORT)
    yield shown
    shown.window.close()


def place(shown: Any) -> tuple[int, str]:
    parts = urlsplit(shown.window.address)
    return parts.port, parts.path


def answer(port: int, path: str, *headers: tuple[str, str]) -> tuple[int, dict[str, str], bytes]:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=PATIENCE)
    own = {name for name, _ in headers}
    connection.putrequest("GET", path, skip_host="Host" in own, skip_accept_encoding=True)
    for name, value in headers:
        connection.putheader(name, value)
    connection.endheaders()
    found = connection.getresponse()
    return found.status, dict(found.headers), found.read()


def joined(port: int, path: str, host: str = "127.0.0.1", **options: Any) -> Any:
    there = socket.create_connection(("127.0.0.1", port))
    known = client.Subprotocol(f"viser-v{viser.__version__}")
    return client.connect(
        f"ws://{host}:{port}{path}", sock=there, subprotocols=[known], compression=None, max_size=None, **options
    )


def say(page: Any, *messages: Any) -> None:
    for message in messages:
        page.send(msgspec.msgpack.encode(message))


@contextmanager
def heard(shown: Any, **options: Any) -> Iterator[Any]:
    """A page of a window that it knows of."""
    with joined(*place(shown), **options) as page:
        say(page, CAMERA)
        until(shown.window.server.get_clients)
        yield page


def update(handle: Any, **updates: Any) -> dict[str, Any]:
    return {"type": "GuiUpdateMessage", "uuid": handle._impl.uuid, "updates": updates}


def until(come: Any) -> None:
    end = time.monotonic() + PATIENCE
    while not come():
        assert time.monotonic() < end, "it does not come about"
        time.sleep(0.01)


def test_the_address_shows_the_page(live):
    port, path = place(live)
    status, headers, found = answer(port, path)
    assert status == 200 and b"<html" in found
    assert headers["Referrer-Policy"] == "no-referrer"
    assert "frame-ancestors 'none'" in headers["Content-Security-Policy"]
    assert len(path.strip("/")) >= 22, "the token can be guessed"
    assert answer(port, path.rstrip("/"))[0] == 200 and answer(port, path + "?darkMode")[0] == 200
    assert answer(port, path, ("Host", f"localhost:{port}"))[0] == 200


def test_two_windows_have_two_tokens(live, tmp_path):
    other = opened(tmp_path / "scene.toml", [], "cpu", "float32", PORT)
    with closing(other.window):
        (port, path), (its_port, its_path) = place(live), place(other)
        assert its_port != port and its_path != path and answer(its_port, path)[0] == 403


EVIL = "evil.example:{port}"
STRANGERS = {
    "no token": ("/", ()),
    "no path": ("/index.html", ()),
    "wrong token": ("/" + 32 * "0" + "/", ()),
    "beginning of the token": ("{short}/", ()),
    "more than the token": ("{token}a/", ()),
    "other letters": ("{upper}/", ()),
    "not ASCII": ("/%C3%A9/", ()),
    "token in the query": ("/?token={token}", ()),
    "token behind": ("/a{token}/", ()),
    "foreign origin": ("{token}/", (("Origin", "http://127.0.0.1:1"),)),
    "https": ("{token}/", (("Origin", "https://127.0.0.1:{port}"),)),
    "null origin": ("{token}/", (("Origin", "null"),)),
    "empty origin": ("{token}/", (("Origin", ""),)),
    "origin that begins like its own": ("{token}/", (("Origin", "http://127.0.0.1:{port}.evil.example"),)),
    "origin by another name": ("{token}/", (("Origin", "http://localhost:{port}"),)),
    "two origins": ("{token}/", (("Origin", "http://127.0.0.1:{port}"), ("Origin", "http://evil.example"))),
    "foreign name": ("{token}/", (("Host", EVIL),)),
    "foreign name and origin": ("{token}/", (("Host", EVIL), ("Origin", "http://" + EVIL))),
    "name without port": ("{token}/", (("Host", "127.0.0.1"),)),
    "two names": ("{token}/", (("Host", "127.0.0.1:{port}"), ("Host", "evil.example"))),
}


def test_strangers_are_refused(live):
    """Pages and websockets."""
    port, path = place(live)
    token = path.rstrip("/")
    parts = {"port": port, "token": token, "short": token[:-1], "upper": "/" + token.strip("/").upper()}
    upgrade = [("Upgrade", "websocket"), ("Connection", "Upgrade"), ("Sec-WebSocket-Version", "13")]
    upgrade += [("Sec-WebSocket-Key", "dGhlIHNhbXBsZSBub25jZQ==")]
    upgrade += [("Sec-WebSocket-Protocol", f"viser-v{viser.__version__}")]
    for stranger, (asked, given) in STRANGERS.items():
        if stranger == "other letters" and not any(map(str.isalpha, token)):
            continue
        headers = [(name, value.format(**parts)) for name, value in given]
        for more in ([], upgrade):
            status, _, found = answer(port, asked.format(**parts), *headers, *more)
            refused = status == 403 and b"<html" not in found and token.strip("/").encode() not in found
            assert refused and not live.window.server.get_clients(), stranger


@pytest.mark.parametrize("origin", [None, "http://127.0.0.1:{port}"])
def test_its_own_page_and_programs_with_the_token_are_heard(live, origin):
    port, path = place(live)
    with joined(port, path.rstrip("/"), origin=origin and origin.format(port=port)) as page:
        assert isinstance(page.recv(PATIENCE), bytes)
        say(page, CAMERA, update(live.running, value=False))
        until(lambda: live.window.server.get_clients() and not live.running.value)


NAN, HUGE = math.nan, math.inf
HOSTILE = {
    "dropdown: no choice": ("colour", {"value": "nothing"}),
    "dropdown: no text": ("colour", {"value": ["speed"]}),
    "slider: not a number": ("gravity", {"value": NAN}),
    "slider: infinite": ("gravity", {"value": HUGE}),
    "slider: beyond its end": ("gravity", {"value": 1e6}),
    "slider: before its end": ("gravity", {"value": -1e6}),
    "slider: text": ("gravity", {"value": "3"}),
    "slider: a table": ("gravity", {"value": {"a": 1}}),
    "checkbox: a number": ("running", {"value": 0}),
    "checkbox: nothing": ("running", {"value": None}),
    "checkbox: no value": ("running", {}),
    "its label": ("running", {"label": "evil"}),
    "its state": ("running", {"disabled": True, "value": False}),
    "its callbacks": ("colour", {"update_cb": []}),
    "its ends": ("gravity", {"max": 1e9, "value": 1.0}),
    "its type": ("gravity", {"is_button": True}),
    "no such field": ("gravity", {"evil": 1}),
    "a dunder": ("gravity", {"__class__": 1}),
}


def test_values_that_no_control_has_are_left_aside(live):
    controls = {"colour": live.window.colour, "gravity": live.gravity[1], "running": live.running}

    def now() -> list[Any]:
        states = [(control, control._impl) for control in controls.values()]
        return [(at.value, at.is_button, list(at.update_cb), one.label, one.disabled) for one, at in states]

    before = now()
    with heard(live) as page:
        for k, (attack, (name, updates)) in enumerate(HOSTILE.items()):
            heard_last = 0.1 * (k + 1)
            say(page, update(controls[name], **updates), update(live.gravity[0], value=heard_last))
            until(lambda last=heard_last: live.gravity[0].value == last)
            assert now() == before, attack
    live.tick()
    goes_on(live)


packed = msgspec.msgpack.encode
UPDATE = {"type": "GuiUpdateMessage", "uuid": "a", "updates": {"value": 1}}
UPLOAD = dict.fromkeys(("source_component_uuid", "transfer_uuid", "filename", "mime_type"), "a")
NO_MESSAGES = {
    "no message": b"\x00\x01",
    "nothing": b"",
    "text": "{}",
    "no type": packed({"uuid": "a"}),
    "unknown type": packed({"type": "Evil"}),
    "type of a type": packed({"type": ["GuiUpdateMessage"]}),
    "no such control": packed(UPDATE),
    "no name": packed({**UPDATE, "uuid": []}),
    "no updates": packed({**UPDATE, "updates": 1}),
    "deep": 100_000 * b"\x91" + b"\x01",
    "long": b"\xc4" + 40_000_000 * b"\x00",
    "camera without a place": packed({"type": "ViewerCameraMessage"}),
    "camera of texts": packed({**CAMERA, "position": ["a", "b", "c"]}),
    "camera nowhere": packed({**CAMERA, "image_height": NAN}),
    "camera with more": packed({**CAMERA, "evil": 1}),
    "an upload": packed({"type": "FileTransferStartUpload", **UPLOAD, "part_count": 1, "size_bytes": 1}),
}


def test_what_is_no_message_is_left_aside(live, capfd):
    for attack, message in NO_MESSAGES.items():
        with joined(*place(live)) as page:
            try:
                page.send(message)
                say(page, CAMERA)
            except exceptions.ConnectionClosed:
                assert attack in ("deep", "long")  # of too many bytes
        live.tick()
        goes_on(live)
        assert "Traceback" not in "".join(capfd.readouterr()), attack


def goes_on(live: Any) -> None:
    """A window does what another page says, and its next picture is right."""
    with joined(*place(live)) as page:
        say(page, CAMERA, update(live.running, value=False), update(live.running, value=True))
        say(page, update(live.window.colour, value="phase"))
        say(page, update(live.gravity[0], value=0), update(live.gravity[1], value=9.81))  # as the page writes them
        until(lambda: live.gravity[1].value == 9.81 and live.window.colour.value == "phase")
    before = live._state
    live.tick()
    controls = {"gravity": np.array([0.0, 9.81])}
    expected = live.simulation.run(live.steps, controls, live.steps, before).positions[-1]
    np.testing.assert_allclose(np.array(live.window._cloud.points)[:, :2], expected, atol=1e-6)


def test_a_slider_goes_to_both_its_ends(live):
    with heard(live) as page:
        for slider in live.gravity:
            for end in (slider.max, slider.min):
                shown = round(end, slider.precision)  # as the page writes it
                say(page, update(slider, value=shown))
                until(lambda slider=slider, shown=shown: slider.value == shown)
                live.tick()
                assert live.running.value


def test_what_is_disabled_is_not_moved(file):
    simulation = cortado.Simulation(file)
    shown = RecordedView(simulation.scene, simulation.run(3), lambda: simulation, PORT)
    with closing(shown.window):
        shown.playing.value = False
        shown.playing.disabled = True
        with heard(shown) as page:
            say(page, *(update(shown.slider, value=value) for value in (1.5, 99, -1, True)))
            say(page, update(shown.playing, value=True), update(shown.slider, value=2))
            until(lambda: shown.slider.value == 2)
            assert not shown.playing.value
            shown.playing.disabled = False
            say(page, update(shown.playing, value=True))
            until(lambda: shown.playing.value)


def test_nothing_is_shared(live, monkeypatch):
    asked = []
    for name in ("request_share_url", "disconnect_share_url"):
        monkeypatch.setattr(live.window.server, name, lambda name=name: asked.append(name))
    with joined(*place(live)) as page:
        say(page, CAMERA, {"type": "ShareUrlRequest"}, {"type": "ShareUrlDisconnect"})
        say(page, update(live.gravity[0], value=3.0))
        until(lambda: live.gravity[0].value == 3.0)
    time.sleep(0.2)
    assert asked == []
    sent = live.window.server._websock_server._broadcast_buffer.message_from_id.values()
    themes = [one for one in sent if type(one).__name__ == "ThemeConfigurationMessage"]
    assert [theme.show_share_button for theme in themes] == [False]


@pytest.mark.parametrize("reads", [True, False], ids=["reads", "reads nothing"])
def test_it_ends_within_a_second_while_pages_are_connected(file, reads):
    shown = opened(file, [], "cpu", "float32", PORT)
    pages = [joined(*place(shown), max_queue=None if reads else 1) for _ in range(2)]  # 1: it stops at the second
    for page in pages:
        say(page, CAMERA)
    until(lambda: len(shown.window.server.get_clients()) == 2)
    shown.tick()
    begun = time.monotonic()
    shown.window.close()
    took = time.monotonic() - begun
    for page in pages:
        page.socket.close()
    assert took < 1.0
    with pytest.raises(OSError):
        socket.create_connection(("127.0.0.1", PORT), timeout=1.0)


def test_ctrl_c_ends_the_command_while_a_page_is_connected(file):
    words = [sys.executable, "-m", "cortado", "view", str(file), "--port", str(PORT)]
    pipe = subprocess.PIPE
    with ExitStack() as ended:
        command = ended.enter_context(subprocess.Popen(words, stdout=pipe, stderr=pipe, text=True, preexec_fn=listen))
        ended.callback(command.kill)
        assert command.stderr is not None
        line = next(line for line in command.stderr if "shows it" in line)
        parts = urlsplit(line.split()[0])
        page = joined(parts.port, parts.path, max_queue=1)
        say(page, CAMERA)
        time.sleep(0.5)
        command.send_signal(signal.SIGINT)
        out, err = command.communicate(timeout=3.0)  # of which Python needs most to end, on a busy machine
        page.socket.close()
        err = [line for line in err.splitlines() if not line.startswith("Compiling")]
        assert (command.returncode, out, err) == (0, "", [])


def test_a_viser_that_cannot_be_guarded_is_not_started(file, monkeypatch):
    """The canary of where the guard takes hold: `websockets.asyncio.server.serve`, which viser calls by this name."""
    import websockets.asyncio.server as own

    serve = own.serve

    class Elsewhere:
        asyncio = type("asyncio", (), {"server": type("server", (), {"serve": staticmethod(serve)})})

        def __getattr__(self, name: str) -> Any:
            return getattr(__import__("websockets"), name)

    monkeypatch.setattr("viser.infra._infra.websockets", Elsewhere())
    with pytest.raises(cortado.InputError, match=r"viser .* cannot be guarded"):
        opened(file, [], "cpu", "float32", PORT)
    assert own.serve is serve
    with pytest.raises(OSError):
        socket.create_connection(("127.0.0.1", PORT), timeout=1.0)


def test_messages_are_those_of_viser(live):
    """The canary of what is judged: viser's page says the same fields as the guard knows."""
    from dataclasses import fields

    from viser import _messages

    assert {field.name for field in fields(_messages.ViewerCameraMessage)} == {*CAMERA} - {"type"}
    assert {field.name for field in fields(_messages.GuiUpdateMessage)} == {"uuid", "updates"}
    kinds = {type(live.window.server.gui._gui_input_handle_from_uuid[one._impl.uuid]) for one in live.gravity}
    assert kinds == {viser.GuiSliderHandle}
