"""What a notebook shows of a result: its words, and a picture, a view or a table below."""

from base64 import b64encode
from collections.abc import Callable
from html import escape
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from cortado.io.particle_view import STYLE, script


def with_picture(found: object, draw: Callable[[Path], Any]) -> str:
    """HTML of an object: its repr, and the PNG that ``draw`` writes to a path."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "picture.png"
        draw(path)
        picture = b64encode(path.read_bytes()).decode()
    words = escape(repr(found))
    return f'<p>{words}</p><img src="data:image/png;base64,{picture}" alt="{words}" style="width: 100%">'


def with_view(found: object, view: str, draw: Callable[[Path], Any]) -> str:
    """HTML of an object: its repr, a `particle_view` in a frame of its own, where scripts run, and the PNG below."""
    words, _, picture = with_picture(found, draw).partition("<img")
    page = f"<!DOCTYPE html><meta charset='utf-8'><style>{STYLE}</style>{view}{script()}"
    frame = f'<iframe srcdoc="{escape(page)}" style="width: 100%; height: 600px; border: 0"></iframe>'
    return f"{words}{frame}<details><summary>As a picture</summary><img{picture}</details>"


def as_text(found: object) -> str:
    """HTML of an object whose text is a table: as it is, letter by letter."""
    return f"<pre>{escape(str(found))}</pre>"
