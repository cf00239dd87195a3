"""viser's server, with a door before it and with ears that hear only what a page may say."""

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout
from functools import partial
from io import StringIO
from typing import Any

import viser
import websockets.asyncio.server as sockets

from cortado.cli.viewer.door import HOST, Door
from cortado.cli.viewer.messages import LONGEST, Controls, judged
from cortado.errors import InputError

KNOWN = "1.1.1"
"""A version of viser that can be guarded."""
FAREWELL = 0.3
"""[s] that a page has to answer when the window closes; one that is busy does not."""
_silent = logging.getLogger(__name__)
"""Of connections that fail, which is the matter of those who made them."""
_silent.disabled = True


class Hearing(sockets.ServerConnection):
    """A websocket that leaves aside what a page may not say."""

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
    """A server of viser's on this machine, or, where ``port`` is taken, on one of the next ones."""

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
        """Where a browser finds it."""
        return self._door.address(self.viser.get_port())

    def close(self) -> None:
        """Nobody can see it from now on."""
        with redirect_stdout(StringIO()):
            self.viser.stop()

    def _serve(self, serve: Callable[..., Any], *where: Any, process_request: Any = None, **options: Any) -> Any:
        self._guarded = True
        own = {
            "process_request": self._door.before(process_request),
            "create_connection": partial(Hearing, controls=self._control),
            "max_size": LONGEST,
            "close_timeout": FAREWELL,
            "logger": _silent,
        }
        return serve(*where, **options | own)

    def _control(self, name: str) -> Any:
        # viser has no public way from the id in a message to its control
        return self.viser.gui._gui_input_handle_from_uuid.get(name)


@contextmanager
def _serving(serve: Callable[..., Any]) -> Iterator[None]:
    """Within it a server of websockets is made by ``serve``, which is given the usual way: viser has no options for it,
    and a guard that came later would leave the first moments open."""
    usual = sockets.serve
    sockets.serve = partial(serve, usual)  # type: ignore[misc, assignment]
    try:
        yield
    finally:
        sockets.serve = usual  # type: ignore[misc]
