"""``cortado run``: a scene, forward."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np

from cortado.cli.commands.run_recording import RunRecording
from cortado.cli.commands.run_report import write_run_report
from cortado.cli.commands.run_summary import RunSummary
from cortado.device.compiling import compile_ahead
from cortado.device.memory import frame_parts, require
from cortado.errors import DivergedError, InputError, warn
from cortado.files.interruption import keeping
from cortado.files.output_files import locked
from cortado.files.terminal import announce
from cortado.pictures.report import Section
from cortado.rollout.outcome import trouble
from cortado.rollout.rollout import Rollout
from cortado.runs.recording import EverySteps, FrameChoice
from cortado.runs.run_folder import RunFolder
from cortado.runs.trajectory import Trajectory
from cortado.scene.restart import RestartState
from cortado.scene.scene import load_scene
from cortado.simulation import Simulation
from cortado.watching import Watch


@dataclass(frozen=True)
class RunRequest:
    """What is asked of one run of a scene."""

    out: Path
    """Its folder."""
    steps: int | None = None
    time: float | None = None
    """How long it is simulated [s], in the place of the steps."""
    overrides: Sequence[str] = ()
    device: str = "cpu"
    precision: str = "float32"
    frames: FrameChoice = field(default_factory=lambda: EverySteps(1))
    record: Sequence[str] = ()
    """Quantities of the particles for every frame."""
    state: Path | None = None
    """A run or a trajectory that it begins at the end of."""
    resume: bool = False
    overwrite: bool = False
    pictures: bool = False
    """Shaded ones, and the film."""
    command: Sequence[str] = ()
    report: bool = True
    """Whether figures are drawn, and report.html is written."""

    def settings(self, simulation: Simulation, rollout: Rollout, state: RestartState | None) -> dict[str, Any]:
        """What tells one run of a scene from another."""
        in_time = bool(np.isfinite(rollout.step_sizes.end))
        asked = run_settings(rollout.steps, self.precision, self.frames)
        return {
            **({**asked, "steps": None, "time": self.time} if in_time else asked),
            **({"record": sorted(self.record)} if self.record else {}),
            **({"state": _checksum(state)} if state is not None else {}),
        }


def run_settings(steps: int, precision: str, frames: FrameChoice) -> dict[str, Any]:
    """What tells one run of a number of steps from another of the same scene."""
    return {"steps": steps, "precision": precision, **frames.settings}


def run_scene(scene_file: Path, asked: RunRequest) -> str:
    """Run a scene, write its folder, and return a sentence that says where the results are."""
    state = None if asked.state is None else _last_state(asked.state)
    scene = load_scene(scene_file, asked.overrides)
    scene = scene.lasting(asked.time, asked.steps) if state is None else scene.going_on(state)
    simulation = Simulation(scene, asked.device, asked.precision)
    rollout = simulation.rollout(asked.steps, state=state, time=asked.time)
    numbers = simulation.numbers_in_frame(components=3)  # as in the file
    frames = frame_parts(asked.frames.expected(rollout), numbers, simulation.precision.bytes)
    require(frames, "take a larger --record-every or fewer steps")
    watch, settings = Watch(simulation, rollout, asked.record), asked.settings(simulation, rollout, state)
    noted: dict[str, Any] = {"device": str(simulation.device), "settings": settings}
    with locked(asked.out):
        if asked.resume:
            folder = RunFolder.resume(asked.out, scene.to_json(), asked.command, **noted)
        else:
            folder = RunFolder.create(asked.out, scene.to_json(), asked.command, overwrite=asked.overwrite, **noted)
        recording = RunRecording(simulation, rollout, folder, asked.frames, watch)
        begun = recording.go_on() if asked.resume else 0
        if asked.resume:
            announce(f"It goes on after step {begun}." if begun else "No step of it is known: it begins anew.")
        with keeping(lambda: _kept(folder)):
            _compute(recording, asked)
    for told in trouble(rollout, scene):
        warn(told)
    return f"The results are in {folder.path}; open report.html, or trajectory.vtkhdf in ParaView."


def _kept(folder: RunFolder) -> str:
    there = folder.trajectory.exists()
    return f"the frames so far are in {folder.trajectory}; --resume goes on with them" if there else ""


def _last_state(path: Path) -> RestartState:
    """The last state of a trajectory, or of the run in a folder; raises `InputError`."""
    file = RunFolder.open(path, ", but --state must be the folder of one").trajectory if path.is_dir() else path
    found = Trajectory.load(file)
    if not len(found):
        raise InputError(f"{file} holds no frame, but --state must be a trajectory to go on from.")
    return found.last_state


def _checksum(state: RestartState) -> str:
    """By which one state is told from another."""
    told = repr((state.clock.steps, state.clock.time, state.clock.time_step)).encode()
    return sha256(told + b"".join(state[name].tobytes() for name in sorted(state.fields))).hexdigest()[:16]


def _compute(recording: RunRecording, asked: RunRequest) -> None:
    """Run, say how it went, and fill the folder, also where the run diverges."""
    simulation, rollout, folder = recording.simulation, recording.rollout, recording.folder

    def report(told: Section) -> None:
        if asked.report:
            write_run_report(simulation, rollout, folder, told, asked.pictures, recording.watch.readings())

    compile_ahead(rollout.solver, simulation.device)
    begun = time.perf_counter()
    try:
        last = recording.run()
    except DivergedError as error:
        told = error.with_advice(f"{error.advice}; the frames so far are in {folder.path}")
        folder.write_result(**_for_machines(simulation, rollout), failures=[str(told)])
        report(Section("What came out", failures=[error]))
        raise told from error
    with keeping(lambda: f"the run is whole, and in {folder.path}; cortado picture {folder.path} --film films it"):
        summary = RunSummary.of(simulation, rollout, last, time.perf_counter() - begun, recording.watch.readings())
        announce(str(summary))
        folder.write_result(**_for_machines(simulation, rollout), **summary.for_machines(), failures=[])
        report(Section("In numbers", head=("", "value", "unit"), rows=summary.rows()))


def _for_machines(simulation: Simulation, rollout: Rollout) -> dict[str, Any]:
    """How a run went, by names: of the steps that it came to, the mean of what the solver notes, and the greatest."""
    noted = {name: np.asarray(values, dtype=np.float64) for name, values in rollout.diagnostics.items() if len(values)}
    return {
        "particles": simulation.particles,
        "steps": len(rollout.diagnostics["converged"]),
        "mean": {name: values.mean() for name, values in noted.items()},
        "greatest": {name: values.max() for name, values in noted.items()},
    }
