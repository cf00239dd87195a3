"""``python -m benchmarks.fits``: how often error bars hold the truth, what a fit costs beside a search, and what it
says of a wrong model."""

from functools import partial
from pathlib import Path

from tyro.extras import SubcommandApp

from cortado.cli.arguments import Program, Work, command
from cortado.cli.process import main

from .cases import CaseName
from .coverage import cover, cover_linear
from .effort import cost_beside_search
from .film import film as draw_film
from .foreign import of_another_simulator
from .wrong import of_another_model

app = SubcommandApp()
FITS = Program("python -m benchmarks.fits", app, "Measures how right error bars are.")


@command(app, answers=True)
def effort(seed: int = 0) -> Work:
    """Fit a video, and search the same by L-BFGS-B: what do they cost, in forward runs?

    Args:
        seed: Of the noise.
    """
    return partial(cost_beside_search, seed)


@command(app, answers=True)
def wrong() -> Work:
    """Fit videos of another solver and of a finer spacing: are the truths within the bars, or does the fit doubt?"""
    return of_another_model


@command(app, answers=True)
def film(column: Path, out: Path = Path("runs/film.mp4")) -> Work:
    """Draw a column that another simulator let collapse, and film it.

    Args:
        column: What `benchmarks/peers/splishsplash_column.py` wrote.
        out: The film, an mp4.
    """
    return partial(draw_film, column, out)


@command(app, answers=True)
def foreign(column: Path | None = None, out: Path = Path("runs/fits")) -> Work:
    """Fit the film of another simulator, `examples/fit_video_film.mp4`, with both solvers and two spacings.

    Args:
        column: What the film was drawn from; if given, the viscosity is told by which it lost its energy.
        out: Folder of a picture of the residuals.
    """
    return partial(of_another_simulator, column, out)


@command(app, answers=True)
def coverage(case: CaseName = "video", runs: int = 200, processes: int = 1, out: Path = Path("runs/fits")) -> Work:
    """Fit one experiment with many kinds of noise, and count how many intervals hold the truth.

    Args:
        case: What is measured.
        runs: Number of fits.
        processes: That fit at the same time. Set CORTADO_CORES=1 besides, so that each has one core.
        out: Folder of what is done, a line for each fit; the next call goes on after it.
    """
    return partial(cover, case, runs, processes, out)


@command(app, answers=True)
def linear(case: CaseName = "drop", runs: int = 10_000) -> Work:
    """The same of the experiment's linear model, with the same noise: many more fits, in a minute.

    Args:
        case: What is measured.
        runs: Number of fits.
    """
    return partial(cover_linear, case, runs)


if __name__ == "__main__":
    main(program=FITS)
