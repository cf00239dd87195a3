"""Commands of many runs: sweeps, how they converge, and data sets."""

from functools import partial
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, UseAppendAction, arg

from cortado.cli.arguments import ALL_FRAMES, Flag, FrameOptions, Json, Overrides, Precision, as_text, require_toml
from cortado.cli.command import Work


def sweep(
    file: Annotated[Positional[Path], arg(metavar="FILE.toml")],
    sets: Annotated[UseAppendAction[tuple[str, ...]], arg(name="set", metavar="KEY=VALUE,VALUE")] = (),
    zips: Annotated[UseAppendAction[tuple[str, ...]], arg(name="zip", metavar="KEY=VALUE,VALUE")] = (),
    steps: int | None = None,
    time: float | None = None,
    out: Path = Path("runs/sweep"),
    device: str = "cpu",
    precision: Precision = "float32",
    frames: FrameOptions = ALL_FRAMES,
    pictures: Flag = True,
    scheduler: str | None = None,
    workers: int | None = None,
) -> Work:
    """Run a scene, or optimise a task, with every combination of some values, each in a folder of its own; folders that
    are finished already are not repeated.

    Args:
        file: The scene file, or the task file.
        sets: What changes, such as solver.time_step=0.001,0.002; may be given again, for every combination.
        zips: What changes together: the first value of one with the first of the others; given again for each of them.
        steps: Time steps of a scene with the smallest one of the sweep, 200 if left out; longer ones end at its time.
        time: Seconds that a scene is simulated, in the place of steps.
        out: Folder of the sweep, with a folder for each combination and a table of them all.
        pictures: Leave out the figures and the reports of runs of a scene, which take longer than short runs do.
        device: "cpu", or "cuda:0" for the first GPU, of each worker.
        scheduler: Address of a scheduler of Dask's, such as tcp://10.0.0.1:8786, whose workers compute.
        workers: Number of worker processes on this machine; on a GPU each has one of its own.
    """
    frames.check()
    combinations, together = as_text(sets), as_text(zips)
    require_toml(file)
    from cortado.cli.commands.executor import Where
    from cortado.cli.commands.sweep import run_sweep

    where = Where(scheduler, workers)
    asked = (combinations, together, steps, time, out, device, precision, where, frames, pictures)
    return partial(run_sweep, file, *asked)


def convergence(
    runs: Annotated[Positional[tuple[Path, ...]], arg(metavar="RUN|SWEEP")],
    quantities: Annotated[UseAppendAction[tuple[str, ...]], arg(name="quantity", metavar="FILE.py:FUNCTION")] = (),
    json: Json = False,
) -> Work:
    """Tell how fast a scene converges: of runs with different spacings or time steps the order, limit and error.

    Args:
        runs: Folders of at least three runs until the same time, or of a sweep of them.
        quantities: A number of your own besides: a function of a cortado.Trajectory; may be given again.
    """
    from cortado.cli.commands.convergence import convergence_table

    return partial(convergence_table, runs, as_text(quantities), json)


def dataset(
    file: Annotated[Positional[Path], arg(metavar="SCENE.toml|TASK.toml")],
    runs: int = 100,
    out: Path = Path("runs/dataset"),
    overrides: Overrides = (),
    device: str = "cpu",
    precision: Precision = "float32",
    scheduler: str | None = None,
    workers: int | None = None,
) -> Work:
    """Compute many runs of a scene with varied values, to train learned simulators on; the same command goes on with
    those that are missing.

    Args:
        file: A file with the table [dataset], which says what varies.
        runs: How many, those for validation and tests included.
        out: Folder of the data set: train.h5, valid.h5, test.h5 and metadata.json, as LagrangeBench reads them.
        overrides: Replace a value of the file, such as dataset.steps=200; may be given again.
        device: "cpu", or "cuda:0" for the first GPU, of each worker.
        scheduler: Address of a scheduler of Dask's, such as tcp://10.0.0.1:8786, whose workers compute.
        workers: Number of worker processes on this machine; on a GPU each has one of its own.
    """
    words = as_text(overrides)
    require_toml(file, words)
    from cortado.cli.commands.dataset import make_dataset
    from cortado.cli.commands.executor import Where

    return partial(make_dataset, file, runs, out, words, device, precision, Where(scheduler, workers))
