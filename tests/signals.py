"""Signals that tests send to processes."""

import signal

NEEDED = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
"""Those that a process must not ignore to be interrupted; it ignores those that its parent does, as shells make
background jobs ignore Ctrl-C, and nohup the end of the terminal."""


def listen() -> None:
    """What a child does before its program begins, so that it ignores none."""
    for number in NEEDED:
        signal.signal(number, signal.SIG_DFL)
