"""What all pictures share: a look, a size, and a file that appears whole."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from typing import Any

from cortado.files.atomic import write_atomically

PALETTE = ("#3d6b8e", "#c0763b", "#5b8a5a", "#8c5f7d", "#a89a4b", "#6b7a80", "#a8504f", "#4f8f8b")
"""Muted colours that stay apart in print and for most eyes."""
INK, FAINT = "#2b2a28", "#8a857c"
DASHED: dict[str, Any] = {"linestyle": (0, (5, 4)), "linewidth": 1.2}
STYLE = {
    "font.size": 11,
    "axes.titlesize": 12,
    "axes.edgecolor": FAINT,
    "axes.labelcolor": INK,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#ece8e1",
    "text.color": INK,
    "xtick.color": FAINT,
    "ytick.color": FAINT,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "lines.linewidth": 1.8,
    "legend.frameon": False,
}


@contextmanager
def drawing(path: str | Path, width: float = 9.0, height: float = 5.2) -> Iterator[Any]:
    """A figure of so many inches, saved under `path` in one go when the block ends well."""
    import matplotlib
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    content = BytesIO()
    with matplotlib.rc_context(STYLE):
        layout = ConstrainedLayoutEngine(w_pad=0.12, h_pad=0.12)
        figure = Figure(figsize=(width, height), dpi=150, layout=layout)
        FigureCanvasAgg(figure)
        yield figure
        figure.savefig(content, format="png")
    write_atomically(Path(path), content.getvalue())


def whole_numbers(axis: Any) -> None:
    """Ticks of an axis at whole numbers only."""
    from matplotlib.ticker import MaxNLocator

    axis.set_major_locator(MaxNLocator(integer=True, steps=[1, 2, 5, 10]))
