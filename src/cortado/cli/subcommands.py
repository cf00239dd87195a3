"""The commands of ``cortado`` and ``cortado gradients``, with their arguments and help texts.

Commands for existing runs and for many runs are in `cortado.cli.runs_and_sweeps`.
"""

import ast
import textwrap
import tomllib
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, UseAppendAction, arg
from tyro.extras import SubcommandApp

from cortado.cli import arguments
from cortado.cli.arguments import command
from cortado.cli.runs_and_sweeps import compare, convergence, dataset, export, picture, sweep, view
from cortado.errors import InputError, shown
from cortado.files.disk import SCHEMA, examples_folder, is_taken, make_folder, write_atomically
from cortado.files.terminal import is_quiet
from cortado.version import __version__

gradients = SubcommandApp()
app = SubcommandApp()


@command(gradients, answers=True)
def check(
    scene: arguments.Scene,
    steps: int = 50,
    parameters: tuple[str, ...] = ("gravity",),
    loss: str = "positions",
    perturbation: float = 0.05,
    out: Path | None = None,
    overrides: arguments.Overrides = (),
    device: arguments.Device = "cpu",
    json: arguments.Flag = False,
    seed: int = 0,
) -> arguments.Work:
    """Check a scene's gradients in float64: whether they are right, up to which step they are useful, and which
    estimator suits longer runs.

    Args:
        scene: The scene file.
        steps: Number of time steps.
        parameters: Parameters whose horizon is measured; the adjoint is checked for all parameters of the scene.
        loss: Measure of the fluid's motion: "positions" of particles, "centre-of-mass" or "image".
        perturbation: Size of a meaningful change of a parameter, relative to its value.
        out: Folder for a figure and the numbers.
        overrides: Replace a value of the scene, such as solver.time_step=0.002; may be given again.
        json: Print JSON for machines instead of a table.
        seed: Seed of the random directions.
    """
    arguments.require_at_least(0, seed, "--seed")
    words = arguments.text_overrides(scene, overrides)
    from cortado.cli.describe import check_scene

    return partial(check_scene, scene, steps, parameters, loss, perturbation, out, words, device, json, seed)


app.command(gradients, name="gradients", help="Check the gradients of a scene.")


@command(app)
def new(
    name: Annotated[Positional[Path], arg(metavar="NAME")], template: str = "dam", dimension: int | None = None
) -> arguments.Work:
    """Write a commented scene file that can be run at once, and the schema for editors.

    Args:
        name: Name of the file, such as dam.toml or dam.
        template: The kind of scene: dam, baffled_tank, drop, honey, jet, moored_raft, pillar, pour, raft,
            rayleigh_taylor, shaken, stirred, stirred_tank or tap_and_drain.
        dimension: Dimension of the template dam, 2 or 3; 2 if left out.
    """
    return partial(new_scene, name, template, dimension)


@command(app, answers=True)
def examples(
    copy: Annotated[UseAppendAction[tuple[str, ...]], arg(metavar="NAME")] = (), to: Path | None = None
) -> arguments.Work:
    """List the examples that come with Cortado, or copy some of them.

    Args:
        copy: Name of an example to copy, or "all"; may be given again.
        to: Folder to copy to, created if missing; the current folder if left out.
    """
    if to is not None and not copy:
        raise InputError("--to is given, but must be left out, as --copy is not given.")
    return partial(list_examples, arguments.as_text(copy), to or Path())


@command(app, answers=True)
def describe(
    scene: arguments.Scene,
    steps: int | None = None,
    time: float | None = None,
    frames: arguments.FrameOptions = arguments.ALL_FRAMES,
    picture: Path | None = None,
    overrides: arguments.Overrides = (),
    device: arguments.Device = "cpu",
    precision: arguments.Precision = "float32",
    json: arguments.Json = False,
) -> arguments.Work:
    """Describe a scene before a run: its particles, time step limits, memory, computing time, size on disk and length
    of the film.

    Args:
        scene: The scene file, or a task file.
        steps: Number of time steps of the run; 200 if neither steps nor time is given.
        time: Simulated time of the run [s], instead of steps.
        picture: Draw the first state into this PNG file.
        overrides: Replace a value of the scene, such as solver.time_step=0.002; may be given again.
    """
    frames.check()
    steps = arguments.steps_or_time(steps, time)
    words = arguments.text_overrides(scene, overrides)
    from cortado.cli.describe import RunRequest, describe_scene

    asked = RunRequest(Path("runs/run"), steps, time, words, device, precision, frames.choice())
    return partial(describe_scene, scene, asked, picture, json)


@command(app)
def run(
    scene: arguments.Scene,
    steps: int | None = None,
    time: float | None = None,
    out: Path = Path("runs/run"),
    overrides: arguments.Overrides = (),
    device: arguments.Device = "cpu",
    precision: arguments.Precision = "float32",
    frames: arguments.FrameOptions = arguments.ALL_FRAMES,
    state: Path | None = None,
    resume: arguments.Flag = False,
    overwrite: arguments.Flag = False,
    pictures: arguments.Flag = True,
    record: Annotated[UseAppendAction[tuple[str, ...]], arg(metavar="NAME")] = (),
) -> arguments.Work:
    """Run a scene forward and write its trajectory.

    Args:
        scene: The scene file.
        steps: Number of time steps; 200 if neither steps nor time is given.
        time: Simulated time [s], instead of steps; the last step ends at this time or later.
        out: Folder of the run.
        overrides: Replace a value of the scene, such as solver.time_step=0.002; may be given again.
        state: Start from the last state of another run, given by its folder or a trajectory file.
        resume: Continue the run in the folder after it was stopped or killed.
        overwrite: Replace an earlier run in the same folder.
        pictures: Leave out the shaded pictures and the film.
        record: A quantity of the particles to record in every frame, such as pressure or vorticity; may be given again.
    """
    arguments.require_one_of_both(resume, overwrite)
    frames.check()
    steps = arguments.steps_or_time(steps, time)
    wanted, words, told = (
        arguments.as_text(record),
        arguments.text_overrides(scene, overrides),
        arguments.command_line(),
    )
    from cortado.cli.run import RunRequest, run_scene

    asked = (steps, time, words, device, precision, frames.choice(), wanted, state, resume, overwrite, pictures, told)
    return partial(run_scene, scene, RunRequest(out, *asked))


command(app, answers=True)(compare)


@command(app)
def optimise(
    task: arguments.Task,
    out: Path = Path("runs/optimise"),
    overrides: arguments.Overrides = (),
    device: arguments.Device = "cpu",
    precision: arguments.Precision = "float32",
    resume: arguments.Flag = False,
    overwrite: arguments.Flag = False,
    scheduler: str | None = None,
    workers: int | None = None,
    pictures: arguments.Flag = True,
) -> arguments.Work:
    """Optimise the parameters that a task file names, and check the result against the goals in the file.

    Args:
        task: A scene file with the tables [problem] and [optimise].
        out: Folder of the run.
        overrides: Replace a value of the file, such as optimise.iterations=50; may be given again.
        resume: Continue the stopped run in the folder; its results are the same, bit for bit, as without the stop.
        overwrite: Replace an earlier run in the same folder.
        scheduler: Address of a Dask scheduler, whose workers compute the samples of an ensemble.
        workers: Number of local worker processes for the samples; with "cuda" each worker has its own GPU.
        pictures: Leave out the shaded pictures and the films.
    """
    arguments.require_one_of_both(resume, overwrite)
    words, told = arguments.text_overrides(task, overrides), arguments.command_line()
    from cortado.cli.optimise import RunRequest, optimise_task

    asked = RunRequest(out, None, None, words, device, precision, overwrite=overwrite, command=told)
    return partial(
        optimise_task, task, replace(asked, resume=resume, pictures=pictures), arguments.Where(scheduler, workers)
    )


@command(app, answers=True)
def fit(
    task: arguments.Task,
    out: Path = Path("runs/fit"),
    overrides: arguments.Overrides = (),
    device: arguments.Device = "cpu",
    precision: arguments.Precision = "float32",
    overwrite: arguments.Flag = False,
) -> arguments.Work:
    """Fit parameters with error bars to measured experiments, such as a video or a time series of forces.

    Args:
        task: A scene file with the tables [fit] and [problem]; [problem] names the measured data.
        out: Folder of the run.
        overrides: Replace a value of the file, such as fit.profiles=0; may be given again.
        overwrite: Replace an earlier run in the same folder.
    """
    words, told = arguments.text_overrides(task, overrides), arguments.command_line()
    from cortado.cli.optimise import RunRequest, fit_task

    asked = RunRequest(out, None, None, words, device, precision, overwrite=overwrite, command=told)
    return partial(fit_task, task, asked)


for function in (picture, export, view, sweep):
    command(app)(function)
command(app, answers=True)(convergence)
command(app)(dataset)


@command(app, answers=True)
def schema() -> arguments.Work:
    """Print the JSON schema of scenes and tasks, with which editors complete and check files."""
    from cortado.optimisation.task_tables import file_schema_text

    return lambda: file_schema_text().rstrip("\n")


@command(app, answers=True)
def completion(shell: Annotated[Positional[Literal["bash", "zsh"]], arg(metavar="SHELL")]) -> arguments.Work:
    """Print the completion script of a shell. To load it, use: eval "$(cortado completion bash)".

    Args:
        shell: bash or zsh.
    """
    return partial(CORTADO.completion_script, shell)


_GROUPS = {
    "Begin": (
        ("cortado new dam.toml", "write a commented scene that runs at once"),
        ("cortado describe dam.toml", "particles, memory, time, what limits its time step"),
        ("cortado run dam.toml --out runs/dam", "run it; open runs/dam/report.html"),
        ("cortado picture runs/dam", "a shaded picture of it; --film for a film"),
        ("cortado export runs/dam --to usd", "for Blender, Houdini; --to vtp for ParaView"),
        ("cortado view runs/dam", "play it in the browser; a scene runs there, live"),
        ("cortado examples", "list the examples; --copy NAME brings one here"),
    ),
    "Go on": (
        ("cortado run dam.toml --out runs/fine --set discretisation.spacing=0.02", "replace a value"),
        ("cortado compare runs/dam runs/fine", "two runs: the same scene? how far apart?"),
        ("cortado optimise task.toml --out runs/found", "find what a task file asks for; --resume goes on"),
        ("cortado fit task.toml --out runs/fit", "a viscosity with an error bar, from a video or a force"),
        ("cortado sweep dam.toml --set phase.0.viscosity=0.05,0.1", "every combination of some values"),
        ("cortado picture runs/sweep --film", "its runs side by side"),
        ("cortado convergence runs/sweep", "of several spacings: the order, the limit"),
        ("cortado dataset dam.toml --runs 100 --out data", "varied runs to train on, as LagrangeBench's"),
        ("cortado gradients check dam.toml --steps 20", "are gradients right, and for how long?"),
    ),
    "Set up": (
        ("cortado schema", "the JSON schema of scenes, for editors"),
        ("cortado completion bash", "completion of commands and options by the shell"),
    ),
}
COMMANDS = [command for group in _GROUPS.values() for command, _ in group]


def overview() -> str:
    lines = [f"Cortado {__version__}, a differentiable SPH fluid simulator."]
    for title, entries in _GROUPS.items():
        lines += ["", f"{title}:"]
        for typed, meaning in entries:
            fits = len(typed) <= 41
            lines += [f"  {typed:<41}  {meaning}"] if fits else [f"  {typed}", f"  {'':<41}  {meaning}"]
    lines += ["", "Every command has --help, and --quiet for no more than results, warnings and errors."]
    return "\n".join(lines)


SUMMARY = "A differentiable SPH fluid simulator. --version prints which one; cortado alone gives examples."
CORTADO = arguments.Program("cortado", app, SUMMARY, overview)
DAM = "dam"
"""Name of the template with a comment on every line."""
TEMPLATES = Path(__file__).with_name("templates")
IN_3D = "_3d"
SCENE_FILE, SCENE_NAME = "SCENE.toml", 'name = "SCENE"'
"""Placeholders in a template for the file name and for the line with the scene's name."""
ALL = "all"
DATA = (".csv", ".mp4")


def templates() -> list[str]:
    return [DAM, *sorted({path.stem.removesuffix(IN_3D) for path in TEMPLATES.glob("*.toml")} - {DAM})]


def new_scene(path: Path, template: str, dimension: int | None) -> str:
    """Existing files are not replaced."""
    if template not in templates():
        raise InputError(f"--template is {shown(template)}, but must be one of {', '.join(templates())}.")
    if dimension is not None and template != DAM:
        raise InputError(f"--dimension is given, but must be left out, as only {DAM} exists in 2-D and in 3-D.")
    if dimension not in (None, 2, 3):
        raise InputError(f"--dimension is {dimension}, but must be 2 or 3.")
    if path.name in ("", ".."):
        raise InputError("NAME must be the name of a file, such as dam.toml.")
    file = path if path.suffix == ".toml" else path.with_name(f"{path.name}.toml")
    if is_taken(file):
        raise InputError(f"{file} is already there; choose another NAME, or remove it.")
    schema = file.with_name(SCHEMA.name)
    make_folder(file.parent)
    text, options = scene_text(file, f"{template}{IN_3D}" if dimension == 3 else template)
    write_atomically(file, text)
    if not is_taken(schema):
        write_atomically(schema, SCHEMA.read_bytes())
    return f"The scene is {file}; {schema} tells editors what may stand in it. Run it: cortado run {file}{options}"


def scene_text(file: Path, template: str) -> tuple[str, str]:
    """Return the text of a template for a new ``file``, and the options for running the scene."""
    text = (TEMPLATES / f"{template}.toml").read_text(encoding="utf-8")
    name = "".join(letter if letter.isprintable() and letter not in '"\\' else "_" for letter in file.name)
    own = text.replace(SCENE_FILE, name, 1).replace(SCENE_NAME, f'name = "{name.removesuffix(".toml")}"')
    return f"#:schema ./{SCHEMA.name}\n{own}", text.splitlines()[0].partition(SCENE_FILE)[2]


def list_examples(names: list[str], folder: Path) -> str:
    """Nothing is copied if one of the files exists already."""
    found = {path.stem: path for path in sorted(examples_folder().iterdir()) if path.suffix in (".toml", ".py")}
    if not found:
        raise InputError(f"{examples_folder()} holds no examples: install Cortado again.")
    if not names:
        return "\n".join([*map(_line, found.values()), "", "cortado examples --copy NAME copies one here, or all."])
    plain = [name.removesuffix(".toml").removesuffix(".py") for name in names]
    for name, given in zip(plain, names, strict=True):
        if name not in (*found, ALL):
            raise InputError(f"--copy is {shown(given)}, but must be {ALL} or one of {', '.join(found)}.")
    examples = [found[name] for name in (found if ALL in plain else dict.fromkeys(plain))]
    beside = (path for source in examples for path in sorted(source.parent.glob(f"{source.stem}_*")))
    targets = {folder / source.name: source for source in (*examples, *(one for one in beside if one.suffix in DATA))}
    for target in targets:
        if is_taken(target):
            raise InputError(f"{target} is already there; choose another folder with --to, or remove it.")
    make_folder(folder)
    for target, source in targets.items():
        write_atomically(target, source.read_bytes())
    return "" if is_quiet() else "\n".join(f"{folder / one.name}: {_command(folder / one.name)}" for one in examples)


def _command(path: Path) -> str:
    if path.suffix == ".py":
        return f"python {path}"
    tables = tomllib.loads(path.read_text("utf-8"))
    command = next((name for name in ("optimise", "fit", "dataset") if name in tables), "run")
    return f"cortado {command} {path}"


def _line(path: Path) -> str:
    text = path.read_text("utf-8")
    if path.suffix == ".py":
        first = (ast.get_docstring(ast.parse(text)) or "").split("\n")[0]
    else:
        first = text.split("\n")[0].lstrip("# ")
    return textwrap.fill(first, 110, initial_indent=f"{path.name:<28}  ", subsequent_indent=" " * 30)
