"""Who gets into a window of ``cortado view``: who has its address, which ends in a random token.

Every page that is open in a browser can ask this machine for pages and open websockets to it, with the browser's own
``Origin``, and can give itself a name that leads to this machine (DNS rebinding). So a request is refused if it has not
the token, if it calls the machine by another name, or if it comes from another page than the window's own. A program
that is no browser sends no ``Origin``, and needs the token alone.
"""

from collections.abc import Callable
from http import HTTPStatus
from secrets import compare_digest, token_hex

from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response

HOST = "127.0.0.1"
NAMES = (HOST, "localhost")
"""By which a browser on this machine may call it."""
ADVICE = "This window has a token in its address: open the whole address that `cortado view` has printed.\n"
HEADERS = {
    "Referrer-Policy": "no-referrer",
    "Content-Security-Policy": "frame-ancestors 'none'",
    "Cache-Control": "no-store",
}
"""So that the token goes nowhere else, and no other page shows the window within its own."""
Answer = Callable[[ServerConnection, Request], Response | None]
"""What websockets calls ``process_request``: a page, or None for a websocket."""


class Door:
    """Of one window."""

    def __init__(self) -> None:
        self._token = token_hex(16)

    def address(self, port: int) -> str:
        """Where a browser finds the window."""
        return f"http://{HOST}:{port}/{self._token}/"

    def before(self, answer: Answer | None) -> Answer:
        """An answer for those who are let in, which is given what stands behind the token; a refusal for others."""

        def guarded(connection: ServerConnection, request: Request) -> Response | None:
            token, _, rest = request.path.removeprefix("/").partition("?")[0].partition("/")
            if not (self._is_own(token) and _is_from_here(request, connection.local_address[1])):
                return connection.respond(HTTPStatus.FORBIDDEN, ADVICE)
            response = answer(connection, Request(f"/{rest}", request.headers)) if answer else None
            if response is not None:
                response.headers.update(HEADERS)
            return response

        return guarded

    def _is_own(self, token: str) -> bool:
        return compare_digest(token.encode(errors="replace"), self._token.encode())


def _is_from_here(request: Request, port: int) -> bool:
    """Whether a request calls this machine by its own name, and comes from the page at that name or from none."""
    hosts, origins = request.headers.get_all("Host"), request.headers.get_all("Origin")
    own = [f"{name}:{port}" for name in NAMES] + (list(NAMES) if port == 80 else [])  # browsers leave out 80
    return len(hosts) == 1 and hosts[0] in own and origins in ([], [f"http://{hosts[0]}"])
