"""``cortado run``: a scene, forward."""

import time
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cortado.cli.commands.run_report import write_run_report
from cortado.cli.commands.run_summary import RunSummary
from cortado.device.compiling import compile_ahead
from cortado.device.memory import frame_parts, require
from cortado.errors import CortadoWarning, DivergedError
from cortado.files.folder_lock import locked
from cortado.files.interruption import keeping
from cortado.files.progress import announce, track
from cortado.particles.state import State
from cortado.rollout.durations import expected_frames, expected_of
from cortado.rollout.outcome import trouble
from cortado.rollout.rollout import Rollout
from cortado.runs.frame_file import append_frame, frame_writer
from cortado.runs.report import Section
from cortado.runs.run_folder import RunFolder
from cortado.runs.trajectory import Trajectory
from cortado.scene.restart import Clock
from cortado.scene.scene import load_scene
from cortado.simulation import Simulation
from cortado.watching import Watch


def run_scene(
    scene_file: Path,
    steps: int | None,
    out: Path,
    overrides: list[str],
    device: str,
    precision: str,
    record_every: int,
    overwrite: bool,
    command: list[str],
    pictures: bool = False,
    record: Sequence[str] = (),
    seconds: float | None = None,
) -> str:
    """Run a scene, for so many ``steps`` or ``seconds``, ``record`` quantities of its particles in every frame, write
    its folder, shaded ``pictures`` too if wished, and return a sentence that says where the results are."""
    scene = load_scene(scene_file, overrides)
    simulation = Simulation(scene, device, precision)
    rollout = simulation.rollout(steps, time=seconds)
    numbers = simulation.numbers_in_frame(components=3)  # as in the file
    frames = frame_parts(expected_frames(rollout, record_every), numbers, simulation.precision.bytes)
    require(frames, "take a larger --record-every or fewer steps")
    watch = Watch(simulation, rollout, record)
    asked = run_settings(rollout.steps if steps is None else steps, precision, record_every)
    if np.isfinite(rollout.step_sizes.end):
        asked = {**asked, "steps": None, "time": seconds}
    noted: dict[str, Any] = {"device": str(simulation.device), "settings": asked}
    with locked(out):
        folder = RunFolder.create(out, scene.to_json(), command, overwrite=overwrite, **noted)
        with keeping(lambda: f"the frames so far are in {folder.trajectory}" if folder.trajectory.exists() else ""):
            _compute(simulation, rollout, folder, record_every, pictures, watch)
    for told in trouble(rollout, scene):
        warnings.warn(told, CortadoWarning, stacklevel=2)
    return f"The results are in {folder.path}; open report.html, or trajectory.vtkhdf in ParaView."


def run_settings(steps: int, precision: str, record_every: int) -> dict[str, Any]:
    """What tells one run of a scene from another."""
    return {"steps": steps, "precision": precision, "record_every": record_every}


def _compute(
    simulation: Simulation, rollout: Rollout, folder: RunFolder, record_every: int, pictures: bool, watch: Watch
) -> None:
    """Run, say how it went, and fill the folder, also where the run diverges."""
    compile_ahead(rollout.solver, simulation.device)
    begun = time.perf_counter()
    try:
        last = _write_trajectory(simulation, rollout, folder, record_every, watch)
    except DivergedError as error:
        told = error.with_advice(f"{error.advice}; the frames so far are in {folder.path}")
        folder.write_result(**_for_machines(simulation, rollout), failures=[str(told)])
        write_run_report(
            simulation, rollout, folder, Section("What came out", failures=[error]), pictures, watch.readings()
        )
        raise told from error
    if rollout.taken < rollout.steps:  # the file has room for frames that never came
        Trajectory.load(folder.trajectory).save(folder.trajectory)
    summary = RunSummary.of(simulation, rollout, last, time.perf_counter() - begun)
    announce(str(summary))
    folder.write_result(**_for_machines(simulation, rollout), **summary.for_machines(), failures=[])
    numbers = Section("In numbers", head=("", "value", "unit"), rows=summary.rows())
    write_run_report(simulation, rollout, folder, numbers, pictures, watch.readings())


def _for_machines(simulation: Simulation, rollout: Rollout) -> dict[str, Any]:
    """How a run went, by names: of the steps that it came to, the mean of what the solver notes, and the greatest."""
    noted = {name: np.asarray(values, dtype=np.float64) for name, values in rollout.diagnostics.items() if len(values)}
    return {
        "particles": simulation.particles,
        "steps": len(rollout.diagnostics["converged"]),
        "mean": {name: values.mean() for name, values in noted.items()},
        "greatest": {name: values.max() for name, values in noted.items()},
    }


def _write_trajectory(
    simulation: Simulation, rollout: Rollout, folder: RunFolder, record_every: int, watch: Watch
) -> State:
    """Run, with a frame for every so many steps; returns the last state."""
    steps, clock, size = rollout.steps, rollout.clocks[0], float(rollout.time_steps[0])
    recorded = np.array([*range(0, steps, record_every), steps])
    times, first = Clock(clock.steps, clock.time).times(recorded, size), simulation.frame(rollout.initial)
    constants, origin = simulation.constants(rollout), rollout.origins[0]
    noted, expected = rollout.diagnostics, expected_frames(rollout, record_every)
    with (
        frame_writer(folder.trajectory, times, first, constants, steps, noted, origin, watch.names, expected) as writer,
        track(expected_of(rollout), "run") as advance,
    ):

        def observe(step: int, state: State) -> None:
            if step % record_every == 0 or rollout.is_last(step):
                when = float(clock.times(np.array(step), size))
                append_frame(writer, simulation.frame(state), step, watch.frame(step, state), when)
            watch.step(step, state)
            advance()

        append_frame(writer, first, 0, watch.frame(0, rollout.initial))
        watch.step(0, rollout.initial)
        try:
            return rollout.forward(observe, keep=False)
        finally:
            folder.write_sensors(watch.readings())
            found = rollout.diagnostics
            writer.append_steps(**found)
            for step, row in enumerate(zip(*found.values(), strict=True), 1):
                folder.append_metrics(step=step, **dict(zip(found, row, strict=True)))
