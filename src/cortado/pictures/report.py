"""A run folder as one page: report.html holds its pictures and films inside and opens from disk, without a network."""

from __future__ import annotations

import base64
import html
import json
import shlex
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from cortado.errors import InputError
from cortado.files.disk import write_atomically
from cortado.pictures import particle_view
from cortado.runs.run_folder import RunFolder

Figures = list[tuple[str, str | Path]]
"""(caption, path) of each picture or video"""
_KINDS = {".png": "image/png", ".jpg": "image/jpeg", ".svg": "image/svg+xml", ".gif": "image/gif"}
_VIDEOS = {".mp4": "video/mp4", ".webm": "video/webm"}
MOST_NUMBERS = 12
"""Most numbers that are written out one by one."""


@dataclass(frozen=True)
class Section:
    """A part of a report with words, figures and a table; empty ones are left out."""

    title: str
    words: Sequence[object] = ()
    """Paragraphs."""
    failures: Sequence[object] = ()
    """Paragraphs about what went wrong, which are marked."""
    figures: Sequence[tuple[str, str | Path]] = ()
    """(caption, path) of pictures (png, jpg, svg, gif) or videos (mp4, webm), embedded in the page"""
    view: str = ""
    """HTML of `particle_view`."""
    head: Sequence[str] = ()
    """Heads of the columns of the table."""
    rows: Sequence[Sequence[object]] = ()
    """Rows of the table; the first entry of each names the others."""


def write_report(folder: RunFolder, title: str, sections: Sequence[Section]) -> Path:
    """Write the report of a run and return its path.

    Args:
        folder: the run; the command that made it, its scene and its environment end the page.
        title: heading of the page.
        sections: in their order.

    Raises:
        InputError: a picture that cannot be read or has an unknown ending, or a page that cannot be written.
    """
    parts = "\n".join(_section(section) for section in sections)
    script = particle_view.script() if any(section.view for section in sections) else ""
    style = f"{Path(__file__).with_suffix('.css').read_text(encoding='utf-8')}\n{particle_view.style()}"
    page = f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{_safe(title)}</title>
<style>
{style}</style>
</head>
<body>
<h1>{_safe(title)}</h1>
{parts}
<h2>How to run it again</h2>
{_again(folder)}
{_details("Scene", folder.scene)}
{_details("Where it ran", folder.environment)}
{script}
</body>
</html>
"""
    write_atomically(folder.report, page.encode(errors="backslashreplace"))  # names of files may not be UTF-8
    return folder.report


def written(value: Any) -> str:
    """Write out a number, or a few of them; of more, their count and range."""
    array = np.asarray(value)
    if array.dtype.kind not in "fiub":
        return str(value)
    if array.ndim == 0:
        return _number(value)
    if array.size > MOST_NUMBERS:
        shape = " × ".join(map(str, array.shape))
        return f"{shape} numbers from {_number(np.nanmin(array))} to {_number(np.nanmax(array))}, in result.json"
    rows = array.reshape(-1, array.shape[-1]) if array.size else array.reshape(0, 1)
    return "; ".join(f"({', '.join(_number(number) for number in row)})" for row in rows)


def _number(value: Any) -> str:
    return f"{value}" if isinstance(value, int | np.integer | bool | np.bool_) else f"{float(value):.6g}"


def _safe(text: object) -> str:
    return html.escape(str(text))


def _section(section: Section) -> str:
    parts = [f"<p>{_safe(paragraph)}</p>" for paragraph in section.words]
    parts += [f'<p class="failed">{_safe(paragraph)}</p>' for paragraph in section.failures]
    parts += [_figure(caption, Path(path)) for caption, path in section.figures]
    parts += [section.view] if section.view else []
    parts += [_table(section)] if section.rows else []
    return "\n".join([f"<h2>{_safe(section.title)}</h2>", *parts]) if parts else ""


def _table(section: Section) -> str:
    head = "".join(f'<th scope="col">{_safe(word)}</th>' for word in section.head)
    rows = "\n".join(
        f'<tr><th scope="row">{_safe(first)}</th>{"".join(f"<td>{_safe(written(entry))}</td>" for entry in rest)}</tr>'
        for first, *rest in section.rows
    )
    return f'<div class="wide"><table>\n{f"<tr>{head}</tr>" if head else ""}\n{rows}\n</table></div>'


def _figure(caption: str, path: Path) -> str:
    kind = (_KINDS | _VIDEOS).get(path.suffix.lower())
    if kind is None:
        raise InputError(f"{path} cannot be shown; a report takes {', '.join(_KINDS | _VIDEOS)}.")
    try:
        content = base64.b64encode(path.read_bytes()).decode()
    except OSError as problem:
        raise InputError(f"The picture {path} cannot be read: {problem}.") from problem
    source = f'src="data:{kind};base64,{content}"'
    if kind.startswith("video"):
        shown = f'<video controls loop muted playsinline aria-label="{_safe(caption)}" {source}></video>'
    else:
        shown = f'<img alt="{_safe(caption)}" {source}>'
    return f"<figure>{shown}<figcaption>{_safe(caption)}</figcaption></figure>"


def _again(folder: RunFolder) -> str:
    """Return HTML of the command of the run, and of those that went on with it."""
    try:
        noted = json.loads(folder.environment.read_text(encoding="utf-8"))
        commands = [noted["command"], *(session["command"] for session in noted["resumed"])]
    except (OSError, ValueError, KeyError):
        return "<p>The command is not known.</p>"
    lines = "\n".join(shlex.join(command) for command in commands)
    return (
        f"<pre>{_safe(lines)}</pre>\n<p>With --overwrite it takes the place of this run. The folder of the run is "
        f"{_safe(folder.path)}; scene.json in it is the scene with everything that was replaced.</p>"
    )


def _details(label: str, path: Path) -> str:
    """Return HTML of a JSON file of the run, folded away."""
    if not path.exists():
        return ""
    text = path.read_text(encoding="utf-8")
    with suppress(ValueError):  # what is not JSON is shown as it stands
        text = json.dumps(json.loads(text), indent=2, ensure_ascii=False)
    return f"<details><summary>{_safe(label)}</summary><pre>{_safe(text)}</pre></details>"
