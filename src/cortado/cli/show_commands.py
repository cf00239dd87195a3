"""Commands that show a run: pictures and films, files for other programs, the viewer."""

from functools import partial
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from cortado.cli.arguments import Device, Flag, Overrides, as_text, require_at_least
from cortado.cli.command import Work
from cortado.errors import InputError


def picture(
    runs: Annotated[Positional[tuple[Path, ...]], arg(metavar="RUN|SWEEP")],
    frame: int | None = None,
    film: Flag = False,
    lines: int | None = None,
    camera: str | None = None,
    colour: str | None = None,
    out: Path | None = None,
    overrides: Overrides = (),
    device: Device = "cpu",
) -> Work:
    """Draw a shaded picture, or a film, of a run that `cortado run` wrote, or of several side by side.

    Args:
        runs: Folders of up to nine runs, or of a sweep of them.
        frame: Number of a recorded frame, counted from the end where it is negative; the last one if left out.
        film: A film of all frames in its place; stopped by Ctrl-C, it goes on with the same command.
        lines: Rows of pixels, such as 720, 1080 or 2160, with 16 columns for 9 of them.
        camera: How the camera of a film moves: "orbit", "dolly", or "follow:NAME" for a solid of that name.
        colour: What colours the fluid, such as speed, pressure, vorticity, age or phase.
        out: Where to write it, a film as .mp4 or .webp; if left out into the run's figures, of several beside them.
        overrides: Replace a key of [picture], such as picture.width=1920; may be given again.
    """
    words = as_text(overrides)
    if film and frame is not None:
        raise InputError("--frame is given, but must be left out, as --film has all frames.")
    if lines is not None:
        _refuse(words, ("width", "height"), "--lines says so already")
    if colour is not None:
        _refuse(words, ("colour",), "--colour says so already")
    if not film:
        _refuse(words, ("film_frames", "film_speed"), "one picture is drawn: add --film")
    from cortado.cli.commands.picture import camera_override, draw_runs, picture_settings

    replaced, settings = camera_override(camera) + words, picture_settings(lines, colour)
    return partial(draw_runs, runs, -1 if frame is None else frame, film, out, replaced, device, settings)


def export(
    run: Annotated[Positional[Path], arg(metavar="RUN")],
    to: Literal["usd", "glb", "ply", "obj", "vtp"],
    out: Path | None = None,
    every: int = 1,
    overrides: Overrides = (),
) -> Work:
    """Write a run that `cortado run` wrote for other programs: its surface, its particles and its solids over time.

    Args:
        run: The folder of the run.
        to: "usd" for Blender and Houdini, one file; or a series of files, "glb", "ply", "obj", or "vtp" for ParaView.
        out: The folder to write, empty or missing; one of that name in the run's folder if left out.
        every: Frames of the run from one that is written to the next.
        overrides: Replace a key of [picture], such as picture.colour=speed; may be given again.
    """
    require_at_least(1, every, "--every")
    words = as_text(overrides)
    for word in words:
        if word.partition("=")[0].strip() not in ("picture.colour", "picture.surface"):
            raise InputError(
                f"--set is {word}, but must replace picture.colour or picture.surface: others act in pictures."
            )
    from cortado.cli.commands.export import export_run

    return partial(export_run, run, to, out, every, words)


def view(
    path: Annotated[Positional[Path], arg(metavar="RUN|SCENE.toml|TASK.toml")],
    overrides: Overrides = (),
    device: Device = "cpu",
    precision: str | None = None,
    port: int = 8080,
) -> Work:
    """Show a run in the browser, or a scene that runs meanwhile, with gravity on sliders, or the search of a task, with
    a button for its next step; Ctrl-C ends it.

    Args:
        path: The folder of a run, a scene file, or a task file.
        overrides: Replace a value of the scene, such as solver.time_step=0.002; may be given again.
        precision: "float32" or "float64", of a scene or a task that runs; "float32" if left out.
        port: Of the page on this machine; the next one that is free if it is taken.
    """
    from cortado.cli.commands.view import view as show

    return partial(show, path, as_text(overrides), device, precision, port)


def _refuse(overrides: list[str], keys: tuple[str, ...], why: str) -> None:
    """Raises `InputError` where --set replaces one of some keys of [picture]."""
    for override in overrides:
        name = override.partition("=")[0].strip()
        if name.removeprefix("picture.") in keys:
            raise InputError(f"--set {name} is given, but must be left out, as {why}.")
