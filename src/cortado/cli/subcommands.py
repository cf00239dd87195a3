"""Every command but those of ``cortado gradients``: their arguments and their help."""

from functools import partial
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, UseAppendAction, arg
from tyro.extras import SubcommandApp

from cortado.cli.arguments import (
    ALL_FRAMES,
    Device,
    Flag,
    FrameOptions,
    Json,
    Overrides,
    Precision,
    Scene,
    as_text,
    command_line,
    require_toml,
    steps_or_time,
)
from cortado.cli.command import Work, command
from cortado.cli.gradient_commands import gradients
from cortado.cli.many_runs import convergence, dataset, sweep
from cortado.cli.parsing import Program, completion_script
from cortado.cli.show_commands import export, picture, view
from cortado.errors import InputError

app = SubcommandApp()
app.command(gradients, name="gradients", help="Check the gradients of a scene; the gradient study.")


@command(app)
def new(
    name: Annotated[Positional[Path], arg(metavar="NAME")],
    template: str = "dam",
    dimension: int | None = None,
) -> Work:
    """Write a commented scene that runs at once, and the schema with which editors check it.

    Args:
        name: The file, dam.toml or only dam.
        template: What happens in it: dam, drop, honey, jet, pillar, pour, raft, rayleigh_taylor, shaken or stirred.
        dimension: 2 or 3, of the dam; 2 if left out.
    """
    from cortado.cli.commands.new import new_scene

    return partial(new_scene, name, template, dimension)


@command(app, answers=True)
def examples(
    copy: Annotated[UseAppendAction[tuple[str, ...]], arg(metavar="NAME")] = (),
    to: Path | None = None,
) -> Work:
    """List the examples that come with Cortado, or copy some of them.

    Args:
        copy: One to copy, or all of them with the name "all"; may be given again.
        to: The folder to copy to, this one if left out; made if it is missing.
    """
    if to is not None and not copy:
        raise InputError("--to is given, but must be left out, as --copy says of nothing that it is copied.")
    from cortado.cli.commands.examples import list_examples

    return partial(list_examples, as_text(copy), to or Path())


@command(app, answers=True)
def describe(
    scene: Scene,
    steps: int | None = None,
    time: float | None = None,
    frames: FrameOptions = ALL_FRAMES,
    picture: Path | None = None,
    overrides: Overrides = (),
    device: Device = "cpu",
    precision: Precision = "float32",
    json: Json = False,
) -> Work:
    """Describe a scene before it is run: its particles, what limits its time step, its memory, and of a run how long it
    takes, how large it is on disk, and how long its film is.

    Args:
        scene: The scene file, or a task file.
        steps: Number of time steps that it shall run; 200 if neither they nor a time are given.
        time: Seconds that it shall simulate, in the place of steps.
        picture: Draw its first state into this PNG file.
        overrides: Replace a value of the scene, such as solver.time_step=0.002; may be given again.
    """
    frames.check()
    steps = steps_or_time(steps, time)
    words = as_text(overrides)
    require_toml(scene, words)
    from cortado.cli.commands.describe import describe_scene

    return partial(describe_scene, scene, steps, time, frames.choice(), words, device, precision, picture, json)


@command(app)
def run(
    scene: Scene,
    steps: int | None = None,
    time: float | None = None,
    out: Path = Path("runs/run"),
    overrides: Overrides = (),
    device: Device = "cpu",
    precision: Precision = "float32",
    frames: FrameOptions = ALL_FRAMES,
    state: Path | None = None,
    resume: Flag = False,
    overwrite: Flag = False,
    pictures: Flag = True,
    record: Annotated[UseAppendAction[tuple[str, ...]], arg(metavar="NAME")] = (),
) -> Work:
    """Run a scene forward and write its trajectory.

    Args:
        scene: The scene file.
        steps: Number of time steps; 200 if neither they nor a time are given.
        time: Seconds that the scene is simulated, in the place of steps: the last step ends then or later.
        out: Folder of the run.
        overrides: Replace a value of the scene, such as solver.time_step=0.002; may be given again.
        state: Begin at the end of another run, which is the folder of one or a trajectory file.
        resume: Go on with the run in the folder, after it was stopped or killed.
        overwrite: Replace an earlier run in the same folder.
        pictures: Leave out the shaded pictures and the film.
        record: A quantity of the particles for the trajectory, such as pressure or vorticity; may be given again.
    """
    if resume and overwrite:
        raise InputError("--resume and --overwrite are both given, but only one of them can be meant.")
    frames.check()
    steps = steps_or_time(steps, time)
    words, wanted, told = as_text(overrides), as_text(record), command_line()
    require_toml(scene, words)
    from cortado.cli.commands.run import RunRequest, run_scene

    asked = (steps, time, words, device, precision, frames.choice(), wanted, state, resume, overwrite, pictures, told)
    return partial(run_scene, scene, RunRequest(out, *asked))


@command(app, answers=True)
def compare(
    first: Annotated[Positional[Path], arg(metavar="RUN")],
    second: Annotated[Positional[Path], arg(metavar="RUN|DATA.csv")],
    json: Json = False,
) -> Work:
    """Compare two runs: their scenes and settings, their last states, their metrics, and where they were made. Or
    compare the sensors of a run with measured data.

    Args:
        first: The folder of a run.
        second: The folder of another, or a table of measured data with the columns of sensors.csv.
    """
    if second.suffix.lower() == ".csv":
        from cortado.cli.commands.measured import compare_with_data

        return partial(compare_with_data, first, second, json)
    from cortado.cli.commands.compare import compare_runs

    return partial(compare_runs, first, second, json)


@command(app)
def optimise(
    task: Annotated[Positional[Path], arg(metavar="TASK.toml")],
    out: Path = Path("runs/optimise"),
    overrides: Overrides = (),
    device: Device = "cpu",
    precision: Precision = "float32",
    resume: Flag = False,
    overwrite: Flag = False,
    scheduler: str | None = None,
    workers: int | None = None,
    pictures: Flag = True,
) -> Work:
    """Optimise what a task file names, and check the result as the file asks.

    Args:
        task: A scene file with the tables [problem] and [optimise].
        out: Folder of the run.
        overrides: Replace a value of the file, such as optimise.iterations=50; may be given again.
        resume: Go on with the run in the folder, bit for bit.
        overwrite: Replace an earlier run in the same folder.
        scheduler: Address of a scheduler of Dask's, whose workers compute the samples of an ensemble.
        workers: Number of worker processes on this machine that do; on a GPU each has one of its own.
        pictures: Leave out the shaded pictures and the films.
    """
    if resume and overwrite:
        raise InputError("--resume and --overwrite are both given, but only one of them can be meant.")
    words, told = as_text(overrides), command_line()
    require_toml(task, words)
    from cortado.cli.commands.executor import Where
    from cortado.cli.commands.optimise import optimise_task

    where = Where(scheduler, workers)
    return partial(optimise_task, task, out, words, device, precision, resume, overwrite, told, where, pictures)


@command(app, answers=True)
def fit(
    task: Annotated[Positional[Path], arg(metavar="TASK.toml")],
    out: Path = Path("runs/fit"),
    overrides: Overrides = (),
    device: Device = "cpu",
    precision: Precision = "float32",
    overwrite: Flag = False,
) -> Work:
    """Fit parameters to measured experiments, such as a video or a series of forces, with error bars.

    Args:
        task: A scene file with the tables [problem], of measured data, and [fit].
        out: Folder of the run.
        overrides: Replace a value of the file, such as fit.profiles=0; may be given again.
        overwrite: Replace an earlier run in the same folder.
    """
    words, told = as_text(overrides), command_line()
    require_toml(task, words)
    from cortado.cli.commands.fit import fit_task

    return partial(fit_task, task, out, words, device, precision, overwrite, told)


for show in (picture, export, view):
    command(app)(show)
command(app)(sweep)
command(app, answers=True)(convergence)
command(app)(dataset)


@command(app, answers=True)
def schema() -> Work:
    """Print the JSON schema of scenes and tasks, with which editors complete and check them."""
    from cortado.cli.commands.schema import print_schema

    return print_schema


@command(app, answers=True)
def completion(shell: Annotated[Positional[Literal["bash", "zsh"]], arg(metavar="SHELL")]) -> Work:
    """Print what makes a shell complete commands and options: eval "$(cortado completion bash)".

    Args:
        shell: bash or zsh.
    """
    return partial(completion_script, CORTADO, shell)


def _overview() -> str:
    from cortado.cli.commands.overview import overview

    return overview()


CORTADO = Program(
    "cortado",
    app,
    "A differentiable SPH fluid simulator. --version prints which one; cortado alone gives examples.",
    _overview,
)
