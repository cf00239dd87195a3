"""The command line; ``cortado`` alone shows what it can do.

Exit codes: 0 done, 1 the computation failed (or a check did), 2 the input is wrong, 130 interrupted. A mistake of the
user's, or of the machine, is one sentence on stderr, never a traceback.
"""

import io
import logging
import os
import sys
import warnings
from collections.abc import Callable, Sequence
from contextlib import redirect_stderr, redirect_stdout, suppress
from functools import partial, wraps
from inspect import Parameter, signature
from pathlib import Path
from signal import SIGINT
from typing import Annotated, Any, Literal

import tyro
from tyro.conf import Positional, UseAppendAction, arg
from tyro.extras import SubcommandApp

from cortado import __version__
from cortado.device.kernel_cache import complaint, start_warp
from cortado.errors import ComputationError, CortadoError, CortadoWarning, InputError
from cortado.io.interruption import Interrupted
from cortado.io.terminal import quietly, say, tell, to_stdout
from cortado.io.usage import usage_sentence

app = SubcommandApp()
gradients = SubcommandApp()
app.command(gradients, name="gradients", help="Check the gradients of a scene; the gradient study.")

BROKEN_PIPE = 141
"""Exit code where nobody reads the result: that of a process which the signal SIGPIPE ended."""
Work = Callable[[], str]
"""What a command does once its arguments are understood; returns what it prints."""
Scene = Annotated[Positional[Path], arg(metavar="SCENE.toml")]
Overrides = Annotated[UseAppendAction[tuple[str, ...]], arg(name="set", metavar="KEY=VALUE")]
Quiet = Annotated[bool, arg(help="Say nothing but results, warnings and errors.")]


def _command(group: SubcommandApp, answers: bool = False) -> Callable[[Callable[..., Work]], Callable[..., Work]]:
    """Makes a function a command of a group, with an option --quiet. What it prints at the end is either what was asked
    for, as it ``answers``, or a line about the files that it wrote."""

    def register(function: Callable[..., Work]) -> Callable[..., Work]:
        @wraps(function)
        def command(*arguments: Any, quiet: bool = False, **options: Any) -> Work:
            work = function(*arguments, **options)
            return partial(_quiet, work, answers) if quiet else work

        own = signature(function)
        option = Parameter("quiet", Parameter.KEYWORD_ONLY, default=False, annotation=Quiet)
        command.__signature__ = own.replace(parameters=[*own.parameters.values(), option])  # type: ignore[attr-defined]
        command.__annotations__ = {**function.__annotations__, "quiet": Quiet}
        del command.__wrapped__  # of which tyro would take the annotations
        group.command(command)
        return function

    return register


def _quiet(work: Work, answers: bool) -> str:
    with quietly():
        text = work()
    return text if answers else ""


@_command(app)
def new(
    name: Annotated[Positional[Path], arg(metavar="NAME")],
    dimension: int = 2,
) -> Work:
    """Write a commented scene that runs at once, and the schema with which editors check it.

    Args:
        name: The file, dam.toml or only dam.
        dimension: 2 or 3.
    """
    from cortado.commands.new import new_scene

    return partial(new_scene, name, dimension)


@_command(app, answers=True)
def examples(
    copy: Annotated[UseAppendAction[tuple[str, ...]], arg(metavar="NAME")] = (),
    to: Path = Path(),
) -> Work:
    """List the examples that come with Cortado, or copy some of them.

    Args:
        copy: One to copy, or all of them with the name "all"; may be given again.
        to: The folder to copy to; made if it is missing.
    """
    from cortado.commands.examples import list_examples

    return partial(list_examples, _words(copy), to)


@_command(app, answers=True)
def describe(
    scene: Scene,
    steps: int = 200,
    picture: Path | None = None,
    overrides: Overrides = (),
    device: str = "cpu",
    precision: str = "float32",
    json: bool = False,
) -> Work:
    """Describe a scene before it is run: its particles, what limits its time step, its memory, its time.

    Args:
        scene: The scene file, or a task file.
        steps: Number of time steps that it shall run.
        picture: Draw its first state into this PNG file.
        overrides: Replace a value of the scene, such as solver.time_step=0.002; may be given again.
        device: "cpu", or "cuda:0" for the first GPU.
        precision: "float32" or "float64".
        json: Print JSON for machines.
    """
    from cortado.commands.describe import describe_scene

    return partial(describe_scene, scene, steps, _words(overrides), device, precision, picture, json)


@_command(app)
def run(
    scene: Scene,
    steps: int = 200,
    out: Path = Path("runs/run"),
    overrides: Overrides = (),
    device: str = "cpu",
    precision: str = "float32",
    record_every: int = 1,
    overwrite: bool = False,
    pictures: bool = True,
) -> Work:
    """Run a scene forward and write its trajectory.

    Args:
        scene: The scene file.
        steps: Number of time steps.
        out: Folder of the run.
        overrides: Replace a value of the scene, such as solver.time_step=0.002; may be given again.
        device: "cpu", or "cuda:0" for the first GPU.
        precision: "float32" or "float64".
        record_every: Steps from one frame of the trajectory to the next.
        overwrite: Replace an earlier run in the same folder.
        pictures: Draw shaded pictures and a film; --no-pictures leaves them out.
    """
    _require_at_least(1, record_every, "--record-every")
    from cortado.commands.run import run_scene

    words, told = _words(overrides), _command_line()
    return partial(run_scene, scene, steps, out, words, device, precision, record_every, overwrite, told, pictures)


@_command(app, answers=True)
def compare(
    first: Annotated[Positional[Path], arg(metavar="RUN")],
    second: Annotated[Positional[Path], arg(metavar="RUN")],
    json: bool = False,
) -> Work:
    """Compare two runs: their scenes and settings, their last states, their metrics, and where they were made.

    Args:
        first: The folder of a run.
        second: The folder of another.
        json: Print JSON for machines.
    """
    from cortado.commands.compare import compare_runs

    return partial(compare_runs, first, second, json)


@_command(app)
def optimise(
    task: Annotated[Positional[Path], arg(metavar="TASK.toml")],
    out: Path = Path("runs/optimise"),
    overrides: Overrides = (),
    device: str = "cpu",
    precision: str = "float32",
    resume: bool = False,
    overwrite: bool = False,
    scheduler: str | None = None,
    workers: int | None = None,
    pictures: bool = True,
) -> Work:
    """Optimise what a task file names, and check the result as the file asks.

    Args:
        task: A scene file with the tables [problem] and [optimise].
        out: Folder of the run.
        overrides: Replace a value of the file, such as optimise.iterations=50; may be given again.
        device: "cpu", or "cuda:0" for the first GPU.
        precision: "float32" or "float64".
        resume: Go on with the run in the folder, bit for bit.
        overwrite: Replace an earlier run in the same folder.
        scheduler: Address of a scheduler of Dask's, whose workers compute the samples of an ensemble.
        workers: Number of worker processes on this machine that do; on a GPU each has one of its own.
        pictures: Draw shaded pictures and films; --no-pictures leaves them out.
    """
    if resume and overwrite:
        raise InputError("--resume and --overwrite are both given, but only one of them can be meant.")
    from cortado.commands.executor import Where
    from cortado.commands.optimise import optimise_task

    where, words, told = Where(scheduler, workers), _words(overrides), _command_line()
    return partial(optimise_task, task, out, words, device, precision, resume, overwrite, told, where, pictures)


@_command(app)
def picture(
    run: Annotated[Positional[Path], arg(metavar="RUN")],
    frame: int = -1,
    film: bool = False,
    out: Path | None = None,
    overrides: Overrides = (),
    device: str = "cpu",
) -> Work:
    """Draw a shaded picture, or a film, of a run that `cortado run` wrote.

    Args:
        run: The folder of the run.
        frame: Number of a recorded frame, counted from the end where it is negative.
        film: A film of all frames in its place.
        out: Where to write it; into the run's figures if left out.
        overrides: Replace a key of [picture], such as picture.width=1920; may be given again.
        device: "cpu", or "cuda:0" for the first GPU.
    """
    from cortado.commands.picture import draw_run

    return partial(draw_run, run, frame, film, out, _words(overrides), device)


@_command(app)
def view(
    path: Annotated[Positional[Path], arg(metavar="RUN|SCENE.toml|TASK.toml")],
    overrides: Overrides = (),
    device: str = "cpu",
    precision: str = "float32",
    port: int = 8080,
) -> Work:
    """Show a run in the browser, or a scene that runs meanwhile, with gravity on sliders, or the search of a task, with
    a button for its next step; Ctrl-C ends it.

    Args:
        path: The folder of a run, a scene file, or a task file.
        overrides: Replace a value of the scene, such as solver.time_step=0.002; may be given again.
        device: "cpu", or "cuda:0" for the first GPU.
        precision: "float32" or "float64", of a scene or a task that runs.
        port: Of the page on this machine; the next one that is free if it is taken.
    """
    from cortado.commands.view import view as show

    return partial(show, path, _words(overrides), device, precision, port)


@_command(app)
def sweep(
    file: Annotated[Positional[Path], arg(metavar="FILE.toml")],
    sets: Annotated[UseAppendAction[tuple[str, ...]], arg(name="set", metavar="KEY=VALUE,VALUE")] = (),
    steps: int | None = None,
    out: Path = Path("runs/sweep"),
    device: str = "cpu",
    precision: str = "float32",
    scheduler: str | None = None,
    workers: int | None = None,
) -> Work:
    """Run a scene, or optimise a task, with every combination of some values, each in a folder of its own; folders that
    are finished already are not repeated.

    Args:
        file: The scene file, or the task file.
        sets: What changes, such as solver.time_step=0.001,0.002; may be given again, for every combination.
        steps: Number of time steps of a scene, 200 if left out; a task says its own.
        out: Folder of the sweep, with a folder for each combination and a table of them all.
        device: "cpu", or "cuda:0" for the first GPU, of each worker.
        precision: "float32" or "float64".
        scheduler: Address of a scheduler of Dask's, such as tcp://10.0.0.1:8786, whose workers compute.
        workers: Number of worker processes on this machine; on a GPU each has one of its own.
    """
    from cortado.commands.executor import Where
    from cortado.commands.sweep import run_sweep

    return partial(run_sweep, file, _words(sets), steps, out, device, precision, Where(scheduler, workers))


@_command(gradients, answers=True)
def check(
    scene: Scene,
    steps: int = 50,
    parameters: tuple[str, ...] = ("gravity",),
    loss: str = "positions",
    perturbation: float = 0.05,
    out: Path | None = None,
    overrides: Overrides = (),
    device: str = "cpu",
    json: bool = False,
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
    _require_at_least(0, seed, "--seed")
    from cortado.commands.check import check_scene

    words = _words(overrides)
    return partial(check_scene, scene, steps, parameters, loss, perturbation, out, words, device, json, seed)


@_command(gradients)
def figure(
    experiment: Annotated[Positional[Path], arg(metavar="EXPERIMENT.toml")],
    out: Path | None = None,
    overrides: Overrides = (),
    reduced: bool = False,
    redraw: bool = False,
) -> Work:
    """Measure and draw one experiment of the gradient study.

    Args:
        experiment: The experiment's file, such as experiments/figure_7.toml.
        out: Folder for its numbers, its picture and its verdict; runs/NAME if left out.
        overrides: Replace a setting, such as steps=100; may be given again.
        reduced: The quick form, with the settings that the file has in [reduced].
        redraw: Draw and judge the numbers that are there again.
    """
    from cortado.commands.figure import measure_figure

    return partial(measure_figure, experiment, out, _words(overrides), reduced, redraw)


@_command(gradients)
def study(
    folder: Annotated[Positional[Path], arg(metavar="FOLDER")] = Path("experiments"),
    out: Path = Path("runs/study"),
    only: Annotated[UseAppendAction[tuple[str, ...]], arg(metavar="NAME")] = (),
    reduced: bool = False,
) -> Work:
    """Measure and draw all experiments; those that are there already, with the same settings, are not repeated.

    Args:
        folder: Where the experiments are.
        out: Folder of the results, with a folder for each experiment.
        only: The name of an experiment, such as figure_4; may be given again.
        reduced: The quick form of each.
    """
    from cortado.commands.study import run_study

    return partial(run_study, folder, out, reduced, _words(only))


@_command(app, answers=True)
def bench(
    particles: tuple[int, ...] = (8000,),
    steps: int = 20,
    repeats: int = 5,
    device: str = "cpu",
    precision: str = "float32",
    engine: Literal["warp", "reference"] = "warp",
    json: bool = False,
) -> Work:
    """Time a dam break: each pass of a step, the step, a rollout and its gradient, beside what the hardware allows.

    Args:
        particles: Numbers of fluid particles, about; one measurement for each.
        steps: Number of time steps.
        repeats: The median of so many repeats counts.
        device: "cpu", or "cuda:0" for the first GPU.
        precision: "float32" or "float64"; of the reference engine also "float80" and "float128".
        engine: The one in Warp, or the reference engine in C++.
        json: Print JSON for machines, with more numbers, instead of tables.
    """
    _require_at_least(1, len(particles), "the number of --particles")
    _require_at_least(1, min(particles), "--particles")
    _require_at_least(1, repeats, "--repeats")
    from cortado.commands.bench import bench_dam_break, bench_reference

    if engine == "reference":
        return partial(bench_reference, particles, steps, repeats, precision, json)
    else:
        return partial(bench_dam_break, particles, steps, repeats, device, precision, json)


@_command(app, answers=True)
def schema() -> Work:
    """Print the JSON schema of scenes and tasks, with which editors complete and check them."""
    from cortado.commands.schema import print_schema

    return print_schema


@_command(app, answers=True)
def completion(shell: Annotated[Positional[Literal["bash", "zsh"]], arg(metavar="SHELL")]) -> Work:
    """Print what makes a shell complete commands and options: eval "$(cortado completion bash)".

    Args:
        shell: bash or zsh.
    """
    return partial(_completion, shell)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run a command; exits with its code unless that is 0."""
    arguments = sys.argv[1:] if arguments is None else arguments
    os.environ["MPLBACKEND"] = "agg"  # pictures go to files, whatever the user has chosen for windows
    try:
        with warnings.catch_warnings():
            warnings.showwarning = _show_warning  # type: ignore[assignment]
            work = _understood(arguments)
            logging.getLogger("matplotlib").setLevel(logging.ERROR)  # where its folder cannot be written it goes on
            start_warp()
            text = work()
            if text:
                tell(text)
    except ComputationError as error:
        sys.exit(_say(error, 1))
    except CortadoError as error:
        sys.exit(_say(error, 2))
    except KeyboardInterrupt as stop:
        stop = stop if isinstance(stop, Interrupted) else Interrupted(SIGINT)
        sys.exit(_say(stop, stop.code))
    except BrokenPipeError:
        sys.exit(BROKEN_PIPE)
    except Exception as error:
        sentence = complaint(error)
        if sentence is None:
            raise
        say(sentence)
        sys.exit(1)


def _understood(arguments: Sequence[str]) -> Work:
    """The command that the arguments name; prints help or the version and exits where they ask for it."""
    box = io.StringIO()
    try:
        with redirect_stderr(box), to_stdout():
            if not arguments:
                from cortado.commands.overview import overview

                print(overview())
                sys.exit(0)
            if list(arguments) == ["--version"]:
                print(f"cortado {__version__}")
                sys.exit(0)
            return _parsed(arguments)
    except SystemExit as end:
        if not end.code:
            raise
        raise InputError(usage_sentence(box.getvalue(), arguments)) from None


def _parsed(arguments: Sequence[str]) -> Any:
    return app.cli(
        prog="cortado",
        description="A differentiable SPH fluid simulator. --version prints which one; cortado alone gives examples.",
        args=arguments,
        config=(tyro.conf.OmitArgPrefixes, tyro.conf.FlagCreatePairsOff),
    )


def _completion(shell: str) -> str:
    """The script for a shell, as tyro prints it and exits; bash completes names of files where nothing else fits."""
    box = io.StringIO()
    with redirect_stdout(box), suppress(SystemExit):
        _parsed(["--tyro-print-completion", shell])
    return box.getvalue().rstrip("\n").replace("complete -F ", "complete -o bashdefault -o default -F ")


def _require_at_least(least: int, value: int, option: str) -> None:
    if value < least:
        raise InputError(f"{option} is {value}, but must be at least {least}.")


def _words(options: Sequence[str]) -> list[str]:
    """What was given to --set or --only; raises `InputError` for bytes that are no text."""
    for option in options:
        try:
            option.encode()
        except UnicodeEncodeError:
            raise InputError(f"{option!r} is among the options, but must be text in UTF-8.") from None
    return list(options)


def _command_line() -> list[str]:
    return ["cortado", *sys.argv[1:]]


def _say(error: BaseException, code: int) -> int:
    say(str(error))
    return code


def _show_warning(message: Warning, category: type[Warning], *rest: object) -> None:
    if issubclass(category, CortadoWarning):
        say(f"Warning: {message}")
