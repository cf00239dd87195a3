"""The gradient study: ``python -m experiments figure FILE`` measures one experiment, ``... study`` all of them."""

from functools import partial
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, UseAppendAction, arg
from tyro.extras import SubcommandApp

from cortado.cli.arguments import Flag, Overrides, Program, Work, as_text, command
from cortado.cli.process import main

app = SubcommandApp()
EXPERIMENTS = Program("python -m experiments", app, "Measures, draws and judges the experiments of the gradient study.")


@command(app)
def figure(
    experiment: Annotated[Positional[Path], arg(metavar="EXPERIMENT.toml")],
    out: Path | None = None,
    overrides: Overrides = (),
    reduced: Flag = False,
    redraw: Flag = False,
) -> Work:
    """Measure and draw one experiment of the gradient study.

    Args:
        experiment: The experiment's file, such as experiments/figure_7.toml.
        out: Folder for its numbers, its picture and its verdict; runs/NAME if left out.
        overrides: Replace a setting, such as steps=100; may be given again.
        reduced: The quick form, with the settings that the file has in [reduced].
        redraw: Draw and judge the numbers that are there again.
    """
    from experiments.run_figure import measure_figure

    return partial(measure_figure, experiment, out, as_text(overrides), reduced, redraw)


@command(app)
def study(
    folder: Annotated[Positional[Path], arg(metavar="FOLDER")] = Path("experiments"),
    out: Path = Path("runs/study"),
    only: Annotated[UseAppendAction[tuple[str, ...]], arg(metavar="NAME")] = (),
    reduced: Flag = False,
) -> Work:
    """Measure and draw all experiments; those that are there already, with the same settings, are not repeated.

    Args:
        folder: Where the experiments are.
        out: Folder of the results, with a folder for each experiment.
        only: The name of an experiment, such as figure_4; may be given again.
        reduced: The quick form of each.
    """
    from experiments.run_study import run_study

    return partial(run_study, folder, out, reduced, as_text(only))


if __name__ == "__main__":
    main(program=EXPERIMENTS)
