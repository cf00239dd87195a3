"""Pictures of the study, in the style of all other pictures."""

from __future__ import annotations

from collections.abc import Callable
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING

from cortado.files.disk import write_atomically
from cortado.pictures.plots import STYLE

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def blank(width: float = 9.0, height: float = 5.2) -> Figure:
    """An empty figure of so many inches; `cortado.pictures.plots` has the colours."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    figure = Figure(figsize=(width, height), dpi=150, layout=ConstrainedLayoutEngine(w_pad=0.12, h_pad=0.12))
    FigureCanvasAgg(figure)
    return figure


def save(draw: Callable[[], Figure], path: Path) -> None:
    """Draw in our style, and write the picture in one go."""
    import matplotlib

    content = BytesIO()
    with matplotlib.rc_context(STYLE):
        draw().savefig(content, format="png")
    write_atomically(path, content.getvalue())
