"""The commands ``cortado gradients ...``: their arguments and their help."""

from functools import partial
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, UseAppendAction, arg
from tyro.extras import SubcommandApp

from cortado.cli.arguments import Flag, Overrides, Scene, as_text, require_at_least
from cortado.cli.command import Work, command

gradients = SubcommandApp()


@command(gradients, answers=True)
def check(
    scene: Scene,
    steps: int = 50,
    parameters: tuple[str, ...] = ("gravity",),
    loss: str = "positions",
    perturbation: float = 0.05,
    out: Path | None = None,
    overrides: Overrides = (),
    device: str = "cpu",
    json: Flag = False,
    seed: int = 0,
) -> Work:
    """Check the gradients of a scene, in float64: are they right, up to which step are they useful, what to use beyond.

    Args:
        scene: The scene file.
        steps: Number of time steps.
        parameters: Parameters whose horizon is measured; the adjoint is checked for all of them.
        loss: How far the fluid has come, by "positions" of particles, "centre-of-mass" or "image".
        perturbation: How large a meaningful perturbation of a parameter is, relative to its size.
        out: Folder for a figure and the numbers.
        overrides: Replace a value of the scene, such as solver.time_step=0.002; may be given again.
        device: "cpu", or "cuda:0" for the first GPU.
        json: Print JSON for machines instead of a table.
        seed: Of the random directions.
    """
    require_at_least(0, seed, "--seed")
    from cortado.cli.commands.check import check_scene

    words = as_text(overrides)
    return partial(check_scene, scene, steps, parameters, loss, perturbation, out, words, device, json, seed)


@command(gradients)
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
    from cortado.cli.commands.figure import measure_figure

    return partial(measure_figure, experiment, out, as_text(overrides), reduced, redraw)


@command(gradients)
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
    from cortado.cli.commands.study import run_study

    return partial(run_study, folder, out, reduced, as_text(only))
