"""What a notebook shows of a result: its words, and a picture, a view or a table below."""

from base64 import b64encode
from collections.abc import Callable, Iterable, Sequence
from html import escape
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from cortado.pictures.particle_view import STYLE, script


def with_picture(found: object, draw: Callable[[Path], Any]) -> str:
    """HTML of an object: its repr, and the PNG that ``draw`` writes to a path."""
    return as_words(found) + picture(found, draw)


def with_view(found: object, view: str, draw: Callable[[Path], Any]) -> str:
    """HTML of an object: its repr, a `particle_view` in a frame of its own, where scripts run, and the PNG below."""
    page = f"<!DOCTYPE html><meta charset='utf-8'><style>{STYLE}</style>{view}{script()}"
    frame = f'<iframe srcdoc="{escape(page)}" style="width: 100%; height: 600px; border: 0"></iframe>'
    still = f"<details><summary>As a picture</summary>{picture(found, draw)}</details>"
    return as_words(found) + frame + still


def with_video(found: object, path: Path) -> str:
    """HTML of an object: its repr, and a video, or an animation, in a file, which is part of the page."""
    content = b64encode(path.read_bytes()).decode()
    if path.suffix.lower() == ".webp":
        return f'{as_words(found)}<img src="data:image/webp;base64,{content}" style="width: 100%">'
    source = f"data:video/mp4;base64,{content}"
    return f'{as_words(found)}<video controls loop muted playsinline src="{source}" style="width: 100%"></video>'


def as_words(found: object) -> str:
    """HTML of the repr of an object."""
    return f"<p>{escape(repr(found))}</p>"


def as_text(found: object) -> str:
    """HTML of an object whose text is a table: as it is, letter by letter."""
    return f"<pre>{escape(str(found))}</pre>"


def picture(found: object, draw: Callable[[Path], Any]) -> str:
    """HTML of the PNG that ``draw`` writes to a path; nothing where a package is missing that draws."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "picture.png"
        try:
            draw(path)
        except ImportError:
            return ""
        content = b64encode(path.read_bytes()).decode()
    return f'<img src="data:image/png;base64,{content}" alt="{escape(repr(found))}" style="width: 100%">'


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """HTML of a table of texts."""

    def line(kind: str, cells: Sequence[str]) -> str:
        written = (f'<{kind} style="text-align: left; padding: 0 1em .2em 0">{escape(cell)}</{kind}>' for cell in cells)
        return f"<tr>{''.join(written)}</tr>"

    return f"<table>{line('th', head)}{''.join(line('td', row) for row in rows)}</table>"
