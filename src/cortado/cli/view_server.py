"""A viser server that checks the origin of connections and the messages of a page.

The window's address ends in a random token. The server refuses requests without the token, with another host name, or
with the ``Origin`` of a foreign page. The checks protect against other web pages and against DNS rebinding. Programs
other than browsers send no ``Origin`` and need only the token.

A page may send only the position of the camera and valid values of controls. All other messages of viser are ignored,
such as a message that opens a tunnel to the internet.
"""

import logging
import math
from collections.abc import Callable
from contextlib import redirect_stdout, suppress
from functools import partial
from http import HTTPStatus
from io import StringIO
from secrets import compare_digest, token_hex
from typing import Annotated, Any

import msgspec
import viser
import websockets.asyncio.server as sockets
from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response

from cortado.errors import InputError

HOST = "127.0.0.1"
NAMES = (HOST, "localhost")
ADVICE = "This window has a token in its address: open the whole address that `cortado view` has printed.\n"
HEADERS = {
    "Referrer-Policy": "no-referrer",
    "Content-Security-Policy": "frame-ancestors 'none'",
    "Cache-Control": "no-store",
}
"""HTTP headers that hide the token from other sites and forbid embedding the page in frames."""
Answer = Callable[[ServerConnection, Request], Response | None]
"""Type of ``process_request`` in websockets. The function returns a page, or None to open a websocket."""
LARGEST_NUMBER = 1e9
Number = Annotated[float, msgspec.Meta(ge=-LARGEST_NUMBER, le=LARGEST_NUMBER)]
Direction = tuple[Number, Number, Number]
Controls = Callable[[str], Any]
_silent = logging.getLogger(__name__)
"""Logger that drops messages about failed connections."""
_silent.disabled = True


class CameraMessage(msgspec.Struct, tag_field="type", tag="ViewerCameraMessage", forbid_unknown_fields=True):
    wxyz: tuple[Number, Number, Number, Number]
    position: Direction
    fov: Number
    near: Number
    far: Number
    image_height: Number
    image_width: Number
    look_at: Direction
    up_direction: Direction


class Update(msgspec.Struct, tag_field="type", tag="GuiUpdateMessage", forbid_unknown_fields=True):
    uuid: str
    updates: dict[str, Any]


class Hearing(sockets.ServerConnection):
    """A websocket that drops forbidden messages from a page."""

    def __init__(self, *arguments: Any, controls: Controls, **options: Any):
        super().__init__(*arguments, **options)
        self._controls = controls

    async def recv(self, decode: bool | None = None) -> Any:
        while True:
            heard = judged(await super().recv(decode), self._controls)
            if heard is not None:
                return heard


class GuardedServer:
    """A guarded viser server on this machine. If ``port`` is taken, the server uses one of the next ports."""

    def __init__(self, port: int, label: str):
        self._token, self._guarded = token_hex(16), False
        usual = sockets.serve
        sockets.serve = partial(self._serve, usual)  # type: ignore[misc, assignment]  # viser has no option for it
        try:
            with redirect_stdout(StringIO()):  # it draws a box
                self.viser: Any = viser.ViserServer(HOST, port, label, verbose=False)
        finally:
            sockets.serve = usual  # type: ignore[misc]
        if not self._guarded:
            self.close()
            found = f"viser {viser.__version__} cannot be guarded by a token"
            raise InputError(f"{found}, so that any web page could control the view: pip install viser==1.1.1.")
        self.viser.gui.configure_theme(show_share_button=False)

    @property
    def address(self) -> str:
        return f"http://{HOST}:{self.viser.get_port()}/{self._token}/"

    def close(self) -> None:
        with redirect_stdout(StringIO()):
            self.viser.stop()

    def _serve(self, serve: Callable[..., Any], *where: Any, process_request: Any = None, **options: Any) -> Any:
        def control(name: str) -> Any:  # viser has no public way from the id in a message to its control
            return self.viser.gui._gui_input_handle_from_uuid.get(name)

        self._guarded = True
        own = {
            "process_request": partial(self._answer, process_request),
            "create_connection": partial(Hearing, controls=control),
            "max_size": 2**16,  # bytes
            "close_timeout": 0.3,  # seconds
            "logger": _silent,
        }
        return serve(*where, **options | own)

    def _answer(self, answer: Answer | None, connection: ServerConnection, request: Request) -> Response | None:
        token, _, rest = request.path.removeprefix("/").partition("?")[0].partition("/")
        own, port = compare_digest(token.encode(errors="replace"), self._token.encode()), connection.local_address[1]
        hosts, origins = request.headers.get_all("Host"), request.headers.get_all("Origin")
        names = [f"{name}:{port}" for name in NAMES] + (list(NAMES) if port == 80 else [])  # browsers leave out 80
        is_from_here = len(hosts) == 1 and hosts[0] in names and origins in ([], [f"http://{hosts[0]}"])
        if not (own and is_from_here):
            return connection.respond(HTTPStatus.FORBIDDEN, ADVICE)
        response = answer(connection, Request(f"/{rest}", request.headers)) if answer else None
        if response is not None:
            response.headers.update(HEADERS)
        return response


_decoder = msgspec.msgpack.Decoder(CameraMessage | Update)
_encoder = msgspec.msgpack.Encoder()


def judged(message: bytes | str, controls: Controls) -> bytes | None:
    """Return an accepted message, encoded again, or None for a refused message."""
    with suppress(msgspec.MsgspecError, RecursionError, TypeError):
        said = _decoder.decode(message)  # type: ignore[arg-type]  # a text is refused
        if isinstance(said, CameraMessage) or (said.updates.keys() == {"value"} and _can_be(said, controls)):
            return _encoder.encode(said)
    return None


def _can_be(said: Update, controls: Controls) -> bool:
    control, value = controls(said.uuid), said.updates["value"]
    if control is None or control.disabled or not control.visible:
        return False
    match control:
        case viser.GuiButtonHandle():
            return value is True
        case viser.GuiCheckboxHandle():
            return isinstance(value, bool)
        case viser.GuiDropdownHandle():
            return isinstance(value, str) and value in control.options
        case viser.GuiSliderHandle():
            if isinstance(value, bool) or not isinstance(value, type(control.value) | int):
                return False
            # the page rounds to the digits shown
            slack = 0.5 * 10.0**-control.precision if isinstance(control.value, float) else 0
            return math.isfinite(value) and control.min - slack <= value <= control.max + slack
    return False
