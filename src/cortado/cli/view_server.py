"""viser's server, with a door before it, and with ears that hear only what a page may say.

Whoever has the address of the window, which ends in a random token, gets in. Every page that is open in a browser can
ask this machine for pages and open websockets to it, with the browser's own ``Origin``. Such a page can also give
itself a name that leads to this machine (DNS rebinding). So a request is refused if it has not the token, if it calls
the machine by another name, or if it comes from another page than the window's own. A program that is no browser sends
no ``Origin``, and needs the token alone.

A page may send the position of the camera, and values that controls can have. The server of viser takes any value of
any attribute of a control, and offers more that no window here has, such as a tunnel to the internet. All of that is
left aside.
"""

import logging
import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout, suppress
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
"""Names by which a browser on this machine may call it."""
ADVICE = "This window has a token in its address: open the whole address that `cortado view` has printed.\n"
HEADERS = {
    "Referrer-Policy": "no-referrer",
    "Content-Security-Policy": "frame-ancestors 'none'",
    "Cache-Control": "no-store",
}
"""So that the token goes nowhere else, and no other page shows the window within its own."""
Answer = Callable[[ServerConnection, Request], Response | None]
"""The type of websockets' ``process_request``: returns a page, or None for a websocket."""
LARGEST_NUMBER = 1e9
"""Largest number of the camera."""
LONGEST_MESSAGE = 2**16
"""Most bytes of a message; those of viser's page have some hundreds."""
Number = Annotated[float, msgspec.Meta(ge=-LARGEST_NUMBER, le=LARGEST_NUMBER)]
Direction = tuple[Number, Number, Number]
Controls = Callable[[str], Any]
"""A control by its id; None where there is none."""
KNOWN = "1.1.1"
"""A version of viser that can be guarded."""
FAREWELL = 0.3
"""Time [s] that a page has to answer when the window closes; one that is busy does not."""
_silent = logging.getLogger(__name__)
"""Of connections that fail, which is the matter of those who made them."""
_silent.disabled = True


class Door:
    """Lets browsers into a window that know the token in its address."""

    def __init__(self) -> None:
        self._token = token_hex(16)

    def address(self, port: int) -> str:
        """Return the address at which a browser finds the window."""
        return f"http://{HOST}:{port}/{self._token}/"

    def before(self, answer: Answer | None) -> Answer:
        """Wrap the answer behind the door: it is given to those who know the token, and a refusal to others."""

        def guarded(connection: ServerConnection, request: Request) -> Response | None:
            token, _, rest = request.path.removeprefix("/").partition("?")[0].partition("/")
            own = compare_digest(token.encode(errors="replace"), self._token.encode())
            if not (own and _is_from_here(request, connection.local_address[1])):
                return connection.respond(HTTPStatus.FORBIDDEN, ADVICE)
            response = answer(connection, Request(f"/{rest}", request.headers)) if answer else None
            if response is not None:
                response.headers.update(HEADERS)
            return response

        return guarded


def _is_from_here(request: Request, port: int) -> bool:
    """Test whether a request calls this machine by its own name, and comes from the page at that name or from none."""
    hosts, origins = request.headers.get_all("Host"), request.headers.get_all("Origin")
    own = [f"{name}:{port}" for name in NAMES] + (list(NAMES) if port == 80 else [])  # browsers leave out 80
    return len(hosts) == 1 and hosts[0] in own and origins in ([], [f"http://{hosts[0]}"])


class CameraMessage(msgspec.Struct, tag_field="type", tag="ViewerCameraMessage", forbid_unknown_fields=True):
    """A message with the camera of a page; viser calls a page connected from the first one on."""

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
    """A message with the value to which a control is set."""

    uuid: str
    updates: dict[str, Any]


class Hearing(sockets.ServerConnection):
    """A websocket that ignores messages which a page may not send."""

    def __init__(self, *arguments: Any, controls: Controls, **options: Any):
        super().__init__(*arguments, **options)
        self._controls = controls

    async def recv(self, decode: bool | None = None) -> Any:
        """The next message that `judged` lets through."""
        while True:
            heard = judged(await super().recv(decode), self._controls)
            if heard is not None:
                return heard


class GuardedServer:
    """A guarded server of viser's on this machine, or, where ``port`` is taken, on one of the next ports."""

    def __init__(self, port: int, label: str):
        self._door, self._guarded = Door(), False
        with redirect_stdout(StringIO()), _serving(self._serve):  # it draws a box
            self.viser: Any = viser.ViserServer(HOST, port, label, verbose=False)
        if not self._guarded:
            self.close()
            found = f"viser {viser.__version__} cannot be guarded by a token"
            raise InputError(f"{found}, so that any page could drive it: pip install viser=={KNOWN}.")
        self.viser.gui.configure_theme(show_share_button=False)

    @property
    def address(self) -> str:
        """Return the address at which a browser finds it."""
        return self._door.address(self.viser.get_port())

    def close(self) -> None:
        """Stop the server: nobody can see it from now on."""
        with redirect_stdout(StringIO()):
            self.viser.stop()

    def _serve(self, serve: Callable[..., Any], *where: Any, process_request: Any = None, **options: Any) -> Any:
        self._guarded = True
        own = {
            "process_request": self._door.before(process_request),
            "create_connection": partial(Hearing, controls=self._control),
            "max_size": LONGEST_MESSAGE,
            "close_timeout": FAREWELL,
            "logger": _silent,
        }
        return serve(*where, **options | own)

    def _control(self, name: str) -> Any:
        # viser has no public way from the id in a message to its control
        return self.viser.gui._gui_input_handle_from_uuid.get(name)


@contextmanager
def _serving(serve: Callable[..., Any]) -> Iterator[None]:
    """Make websockets open servers in the block by ``serve``, whose first argument is its usual function. Viser has no
    options for it, and a later guard would leave the first moments open."""
    usual = sockets.serve
    sockets.serve = partial(serve, usual)  # type: ignore[misc, assignment]
    try:
        yield
    finally:
        sockets.serve = usual  # type: ignore[misc]


_decoder = msgspec.msgpack.Decoder(CameraMessage | Update)
_encoder = msgspec.msgpack.Encoder()


def judged(message: bytes | str, controls: Controls) -> bytes | None:
    """Return a message as viser may read it, written again so that both read it alike; None for one to be ignored."""
    with suppress(msgspec.MsgspecError, RecursionError, TypeError):
        said = _decoder.decode(message)  # type: ignore[arg-type]  # a text is refused
        if isinstance(said, CameraMessage) or (said.updates.keys() == {"value"} and _can_be(said, controls)):
            return _encoder.encode(said)
    return None


def _can_be(said: Update, controls: Controls) -> bool:
    """Test whether the page lets its user set a control to this value."""
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
            return _is_between(control, value)
    return False


def _is_between(slider: Any, value: Any) -> bool:
    """Test whether a number is within a slider's ends, which the page rounds to the digits that it shows."""
    if isinstance(value, bool) or not isinstance(value, type(slider.value) | int):
        return False
    slack = 0.5 * 10.0**-slider.precision if isinstance(slider.value, float) else 0
    return math.isfinite(value) and slider.min - slack <= value <= slider.max + slack
