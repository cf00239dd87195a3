"""``cortado view``: a run, a task, or a scene that runs meanwhile, in the browser."""

import atexit
import gc
from functools import cache
from pathlib import Path

from cortado.cli.viewer.live import LiveView
from cortado.cli.viewer.recorded import RecordedView
from cortado.cli.viewer.task import TaskView
from cortado.errors import InputError
from cortado.files.interruption import keeping
from cortado.files.terminal import say
from cortado.optimisation.inverse.setup import setup
from cortado.optimisation.inverse.task import load_task
from cortado.runs.run_folder import RunFolder
from cortado.runs.trajectory import Trajectory
from cortado.scene.scene import load_scene
from cortado.scene.toml import read_toml
from cortado.simulation import Simulation


def view(path: Path, overrides: list[str], device: str, precision: str | None, port: int) -> str:
    """Show a run folder, or run a task or a scene, until Ctrl-C ends it."""
    shown = opened(path, overrides, device, precision, port)
    say(f"{shown.window.address} shows it; Ctrl-C ends it.")
    atexit.register(gc.freeze)  # Python would look through all that is there once more, which takes as long as the rest
    try:
        with keeping(lambda: ""):
            while True:
                shown.tick()
    except KeyboardInterrupt:
        return ""
    finally:
        shown.window.close()


def opened(
    path: Path, overrides: list[str], device: str, precision: str | None, port: int
) -> LiveView | RecordedView | TaskView:
    """The view of a run folder, of a task file, or of a scene file."""
    if not path.exists():
        raise InputError(f"{path} does not exist, but must be the folder of a run, or the file of a scene or a task.")
    if not path.is_dir():
        if {"problem", "optimise"} & set(read_toml(path, overrides)):
            made = setup(load_task(path, overrides), device, precision or "float32")
            say("The run with the first guess, and its gradient, are computed first.")
            return TaskView(made, port)
        return LiveView(Simulation(load_scene(path, overrides), device, precision or "float32"), port)
    for option, value in (("set", overrides), ("precision", precision)):
        if value:
            raise InputError(f"--{option} is given, but must be left out, as the run is there already.")
    folder = RunFolder.open(path)
    if not folder.trajectory.exists():
        raise InputError(f"{path} has no trajectory, but must be the folder of `cortado run`, or a scene file.")
    folder.require_meshes()
    scene = folder.read_scene()
    simulation = cache(lambda: Simulation(scene, device))
    return RecordedView(scene, Trajectory.load(folder.trajectory), simulation, port)
