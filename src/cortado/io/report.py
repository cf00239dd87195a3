"""A run folder as one page: report.html holds its pictures inside and opens from disk, without a network."""

from __future__ import annotations

import base64
import html
import json
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from cortado.errors import InputError
from cortado.io.files import write_atomically
from cortado.io.run_folder import RunFolder

Figures = list[tuple[str, str | Path]]
"""(caption, path) of each picture or video"""
_KINDS = {".png": "image/png", ".jpg": "image/jpeg", ".svg": "image/svg+xml", ".gif": "image/gif"}
_VIDEOS = {".mp4": "video/mp4", ".webm": "video/webm"}

_STYLE = """
:root { color-scheme: light; }
body { margin: 0 auto; max-width: 62rem; padding: 2.5rem 1.5rem 4rem; background: #fcfbf9; color: #2b2a28;
       font: 16px/1.55 system-ui, -apple-system, "Segoe UI", sans-serif; }
h1 { font-size: 1.7rem; font-weight: 600; margin: 0 0 1.5rem; }
h2 { font-size: 1.1rem; font-weight: 600; margin: 2.5rem 0 .8rem; }
table { border-collapse: collapse; }
th, td { text-align: left; vertical-align: top; padding: .35rem 1.6rem .35rem 0;
         border-bottom: 1px solid #e6e2db; }
th { font-weight: 500; color: #6d6860; white-space: nowrap; }
td { font-variant-numeric: tabular-nums; overflow-wrap: anywhere; }
figure { margin: 0 0 2rem; }
img, video { max-width: 100%; height: auto; display: block; border: 1px solid #e6e2db; border-radius: 6px;
             background: white; }
figcaption { margin-top: .5rem; color: #6d6860; font-size: .93rem; }
details { margin-top: 1rem; }
summary { cursor: pointer; color: #6d6860; }
pre { overflow-x: auto; padding: .9rem 1.1rem; background: #f3f0ea; border-radius: 6px; font-size: .85rem; }
"""


def write_report(
    folder: RunFolder,
    title: str,
    summary: Iterable[tuple[str, object]],
    figures: Iterable[tuple[str, str | Path]],
) -> Path:
    """Writes the report of a run and returns its path.

    Args:
        folder: the run; its scene and environment are shown as well.
        title: heading of the page.
        summary: rows (label, value).
        figures: (caption, path) of pictures (png, jpg, svg, gif) or videos (mp4, webm), embedded in the page.

    Raises:
        InputError: a picture that cannot be read or has an unknown ending, or a page that cannot be written.
    """
    rows = "\n".join(f"<tr><th>{_safe(label)}</th><td>{_safe(value)}</td></tr>" for label, value in summary)
    pictures = "\n".join(_figure(caption, Path(path)) for caption, path in figures)
    page = f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{_safe(title)}</title>
<style>{_STYLE}</style>
</head>
<body>
<h1>{_safe(title)}</h1>
<table>
{rows}
</table>
<h2>Figures</h2>
{pictures or "<p>None.</p>"}
<h2>How it was made</h2>
{_details("Scene", folder.scene)}
{_details("Environment", folder.environment)}
</body>
</html>
"""
    write_atomically(folder.report, page.encode(errors="backslashreplace"))  # names of files may not be UTF-8
    return folder.report


def _safe(text: object) -> str:
    return html.escape(str(text))


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
        shown = f"<video controls loop {source}></video>"
    else:
        shown = f'<img alt="{_safe(caption)}" {source}>'
    return f"<figure>{shown}<figcaption>{_safe(caption)}</figcaption></figure>"


def _details(label: str, path: Path) -> str:
    """A JSON file of the run, folded away."""
    if not path.exists():
        return ""
    text = path.read_text(encoding="utf-8")
    with suppress(ValueError):  # what is not JSON is shown as it stands
        text = json.dumps(json.loads(text), indent=2, ensure_ascii=False)
    return f"<details><summary>{_safe(label)}</summary><pre>{_safe(text)}</pre></details>"
