"""What a notebook shows of a fit: its numbers with their bars, what is doubted, and residuals over time."""

from html import escape

from cortado.optimisation.fitting.figures import residual_figure
from cortado.optimisation.fitting.fitted import NOISE_ALONE, Fit, unit_of, with_error
from cortado.pictures.notebook import picture, table

HEAD = ("parameter", "unit", "start", "found", "95 %, from", "to")


def fit_page(fitted: Fit) -> str:
    """HTML of a fit."""
    rows = [
        (
            one.label.replace("_", " "),
            unit_of(one.label) or "-",
            f"{one.start:.4g}",
            with_error(one.value, one.error),
            f"{one.lower:.4g}",
            f"{one.upper:.4g}",
        )
        for one in fitted.numbers()
    ]
    words = "".join(f"<p>{escape(sentence)}</p>" for sentence in (*fitted.cautions, NOISE_ALONE))
    return table(HEAD, rows) + words + picture(fitted, lambda path: residual_figure(fitted, path))
