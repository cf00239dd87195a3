"""Commands that compare and show existing runs, and commands that make many runs."""

from functools import partial
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, UseAppendAction, arg

from cortado.cli import arguments
from cortado.errors import InputError
from cortado.scene.scene import read_toml


def compare(
    first: Annotated[Positional[Path], arg(metavar="RUN")],
    second: Annotated[Positional[Path], arg(metavar="RUN|DATA.csv")],
    json: arguments.Json = False,
) -> arguments.Work:
    """Compare two runs, or the sensors of a run with measured data.

    Args:
        first: The folder of a run.
        second: The folder of another run, or a table of measured data with the columns of sensors.csv.
    """
    from cortado.cli.compare import compare_runs, compare_with_data

    return partial(compare_with_data if second.suffix.lower() == ".csv" else compare_runs, first, second, json)


def sweep(
    file: Annotated[Positional[Path], arg(metavar="FILE.toml")],
    sets: Annotated[UseAppendAction[tuple[str, ...]], arg(name="set", metavar="KEY=VALUE,VALUE")] = (),
    zips: Annotated[UseAppendAction[tuple[str, ...]], arg(name="zip", metavar="KEY=VALUE,VALUE")] = (),
    steps: int | None = None,
    time: float | None = None,
    out: Path = Path("runs/sweep"),
    device: str = "cpu",
    precision: arguments.Precision = "float32",
    frames: arguments.FrameOptions = arguments.ALL_FRAMES,
    pictures: arguments.Flag = True,
    scheduler: str | None = None,
    workers: int | None = None,
) -> arguments.Work:
    """Run a scene, or optimise a task, with every combination of some values, each in its own folder. Finished runs are
    not repeated.

    Args:
        file: The scene file, or the task file.
        sets: A key and its values, such as solver.time_step=0.001,0.002; several --set make every combination.
        zips: Keys that change together: the first values of all --zip make one run, the second values the next.
        steps: Number of steps of the run with the smallest time step, 200 if left out; all runs end at the same time.
        time: Simulated time of a scene [s], instead of steps.
        out: Folder of the sweep, with a folder for each combination and a table of all results.
        pictures: Leave out the figures and reports of a scene's runs; drawing them takes longer than a short run.
        device: Device of each worker: "cpu", or "cuda:0" for the first GPU.
        scheduler: Address of a Dask scheduler, such as tcp://10.0.0.1:8786, whose workers compute.
        workers: Number of worker processes on this machine; with "cuda" each worker has its own GPU.
    """
    frames.check()
    combinations, together = arguments.as_text(sets), arguments.as_text(zips)
    read_toml(file)
    from cortado.cli.sweep import RunRequest, run_sweep

    asked = RunRequest(out, steps, time, device=device, precision=precision, report=pictures)
    return partial(run_sweep, file, combinations, together, asked, frames, arguments.Where(scheduler, workers))


def convergence(
    runs: Annotated[Positional[tuple[Path, ...]], arg(metavar="RUN|SWEEP")],
    quantities: Annotated[UseAppendAction[tuple[str, ...]], arg(name="quantity", metavar="FILE.py:FUNCTION")] = (),
    json: arguments.Json = False,
) -> arguments.Work:
    """Compute the order, the limit and the error of convergence from runs with different spacings or time steps.

    Args:
        runs: Folders of at least three runs that end at the same time, or the folder of a sweep.
        quantities: Your own function of a cortado.Trajectory that returns one more number; may be given again.
    """
    from cortado.cli.compare import convergence_table

    return partial(convergence_table, runs, arguments.as_text(quantities), json)


def dataset(
    file: Annotated[Positional[Path], arg(metavar="SCENE.toml|TASK.toml")],
    runs: int = 100,
    out: Path = Path("runs/dataset"),
    overrides: arguments.Overrides = (),
    device: str = "cpu",
    precision: arguments.Precision = "float32",
    scheduler: str | None = None,
    workers: int | None = None,
) -> arguments.Work:
    """Compute many runs of a scene with varied values, as training data for learned simulators. Repeating the command
    computes missing runs, and a larger number of runs extends the data set.

    Args:
        file: A scene file with the table [dataset], which says which values vary.
        runs: Number of runs, including the runs for validation and tests.
        out: Folder of the data set: train.h5, valid.h5, test.h5 and metadata.json, as LagrangeBench reads them.
        overrides: Replace a value of the file, such as dataset.steps=200; may be given again.
        device: Device of each worker: "cpu", or "cuda:0" for the first GPU.
        scheduler: Address of a Dask scheduler, such as tcp://10.0.0.1:8786, whose workers compute.
        workers: Number of worker processes on this machine; with "cuda" each worker has its own GPU.
    """
    words = arguments.text_overrides(file, overrides)
    from cortado.cli.dataset import make_dataset

    return partial(make_dataset, file, runs, out, words, device, precision, arguments.Where(scheduler, workers))


def picture(
    runs: Annotated[Positional[tuple[Path, ...]], arg(metavar="RUN|SWEEP")],
    frame: int | None = None,
    film: arguments.Flag = False,
    lines: int | None = None,
    camera: str | None = None,
    colour: str | None = None,
    out: Path | None = None,
    overrides: arguments.Overrides = (),
    device: arguments.Device = "cpu",
) -> arguments.Work:
    """Draw a shaded picture or a film of a run that `cortado run` wrote, or of several runs side by side.

    Args:
        runs: Folders of up to nine runs, or the folder of a sweep.
        frame: Number of a recorded frame; a negative number counts from the end; the last frame if left out.
        film: Draw a film of all frames instead; after Ctrl-C the same command continues the film.
        lines: Height of the picture in pixels, such as 720, 1080 or 2160; the picture has the ratio 16:9.
        camera: Motion of a film's camera: "orbit", "dolly", or "follow:NAME" for a solid of that name.
        colour: Quantity that colours the fluid, such as speed, pressure, vorticity, age or phase.
        out: File to write (film: .mp4 or .webp); if left out, in the run's figures, or beside several runs.
        overrides: Replace a key of [picture], such as picture.width=1920; may be given again.
    """
    words = arguments.as_text(overrides)
    if film and frame is not None:
        raise InputError("--frame is given, but must be left out, as --film shows all frames.")
    if lines is not None:
        _refuse(words, ("width", "height"), "--lines already sets the size of the picture")
    if colour is not None:
        _refuse(words, ("colour",), "--colour already sets the colour")
    if not film:
        _refuse(words, ("film_frames", "film_speed"), "one picture is drawn: add --film")
    from cortado.cli.existing_runs import camera_override, draw_runs

    given, replaced = {"lines": lines, "colour": colour}, camera_override(camera) + words
    settings = {name: value for name, value in given.items() if value is not None}
    return partial(draw_runs, runs, -1 if frame is None else frame, film, out, replaced, device, settings)


def export(
    run: Annotated[Positional[Path], arg(metavar="RUN")],
    to: Literal["usd", "glb", "ply", "obj", "vtp"],
    out: Path | None = None,
    every: int = 1,
    overrides: arguments.Overrides = (),
) -> arguments.Work:
    """Export the surface, particles and solids of a run over time for other programs.

    Args:
        run: The folder of the run.
        to: "usd" for one file for Blender and Houdini; "glb", "ply", "obj", or "vtp" (ParaView) for a series of files.
        out: The folder to write, empty or missing; if left out, a folder in the run's folder with the format's name.
        every: Write only every n-th frame of the run, such as 2 for every second frame.
        overrides: Replace a key of [picture], such as picture.colour=speed; may be given again.
    """
    arguments.require_at_least(1, every, "--every")
    words = arguments.as_text(overrides)
    for word in words:
        if word.partition("=")[0].strip() not in ("picture.colour", "picture.surface"):
            wanted = "must replace picture.colour or picture.surface: other keys only affect pictures"
            raise InputError(f"--set is {word}, but {wanted}.")
    from cortado.cli.existing_runs import export_run

    return partial(export_run, run, to, out, every, words)


def view(
    path: Annotated[Positional[Path], arg(metavar="RUN|SCENE.toml")],
    overrides: arguments.Overrides = (),
    device: arguments.Device = "cpu",
    precision: str | None = None,
    port: int = 8080,
) -> arguments.Work:
    """Show a run in the browser, or run a scene there, with sliders for gravity; Ctrl-C ends it.

    Args:
        path: The folder of a run, or a scene file.
        overrides: Replace a value of the scene, such as solver.time_step=0.002; may be given again.
        precision: "float32" or "float64" for a scene; "float32" if left out.
        port: Port of the page on this machine; if it is taken, the next free one.
    """
    from cortado.cli.views import view as show

    return partial(show, path, arguments.as_text(overrides), device, precision, port)


def _refuse(overrides: list[str], keys: tuple[str, ...], why: str) -> None:
    for override in overrides:
        name = override.partition("=")[0].strip()
        if name.removeprefix("picture.") in keys:
            raise InputError(f"--set {name} is given, but must be left out, as {why}.")
