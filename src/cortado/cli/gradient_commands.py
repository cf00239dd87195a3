"""The commands ``cortado gradients ...``: their arguments and their help."""

from functools import partial
from pathlib import Path

from tyro.extras import SubcommandApp

from cortado.cli.arguments import Device, Flag, Overrides, Scene, as_text, require_at_least, require_toml
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
    device: Device = "cpu",
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
        json: Print JSON for machines instead of a table.
        seed: Of the random directions.
    """
    require_at_least(0, seed, "--seed")
    words = as_text(overrides)
    require_toml(scene, words)
    from cortado.cli.commands.check import check_scene

    return partial(check_scene, scene, steps, parameters, loss, perturbation, out, words, device, json, seed)
