"""The command ``cortado run``, which runs a scene and writes results during the run. A stopped run can be resumed."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np

from cortado.cli.run_report import RunSummary, write_run_report
from cortado.device.modules import compile_ahead
from cortado.device.threads import frame_parts, require
from cortado.errors import DivergedError, InputError, warn
from cortado.files.disk import locked
from cortado.files.terminal import announce, keeping, track
from cortado.files.vtkhdf import TrajectoryWriter
from cortado.particles.state import State
from cortado.pictures.pages import Section
from cortado.rollout.rollout import Progress, Rollout
from cortado.rollout.run_checks import trouble
from cortado.rollout.step_bounds import done_of, ends_at_a_time
from cortado.runs.frames import Marks, append_frame, frame_writer
from cortado.runs.recording import EverySteps, FrameChoice
from cortado.runs.run_folder import RunFolder
from cortado.runs.trajectory import Trajectory
from cortado.scene.restart import RestartState
from cortado.scene.scene import Scene, load_scene
from cortado.simulation import Simulation
from cortado.watching import Watch

OFTEN, SHARE = 5.0, 20.0
"""Least time between two writes of sensor readings and diagnostics [s], and least ratio of this time to a write's
duration."""


@dataclass(frozen=True)
class RunRequest:
    out: Path
    steps: int | None = None
    time: float | None = None
    """Simulated time [s], as an alternative to a number of steps."""
    overrides: Sequence[str] = ()
    device: str = "cpu"
    precision: str = "float32"
    frames: FrameChoice = field(default_factory=lambda: EverySteps(1))
    record: Sequence[str] = ()
    """Names of the particle quantities in each recorded frame."""
    state: Path | None = None
    """Run folder or trajectory file with the initial state."""
    resume: bool = False
    overwrite: bool = False
    pictures: bool = False
    command: Sequence[str] = ()
    report: bool = True

    def folder(self, scene: Scene, simulation: Simulation, kind: str, settings: dict[str, Any]) -> RunFolder:
        given = self.out, scene.to_json(), self.command
        noted: dict[str, Any] = {"kind": kind, "settings": settings, "device": str(simulation.device)}
        if self.resume:
            return RunFolder.resume(*given, **noted)
        return RunFolder.create(*given, overwrite=self.overwrite, **noted)

    def settings(self, rollout: Rollout, state: RestartState | None) -> dict[str, Any]:
        """Return the settings that must not change when the run is resumed."""
        found = {"steps": rollout.steps, "precision": self.precision, **self.frames.settings}
        if np.isfinite(rollout.step_sizes.end):
            found |= {"steps": None, "time": self.time}
        if self.record:
            found["record"] = sorted(self.record)
        if state is not None:
            told = repr((state.clock.steps, state.clock.time, state.clock.time_step)).encode()
            content = told + b"".join(state[name].tobytes() for name in sorted(state.fields))
            found["state"] = sha256(content).hexdigest()[:16]
        return found


@dataclass
class RunRecording:
    """A rollout that writes frames, diagnostics of the time steps, and sensor readings."""

    simulation: Simulation
    rollout: Rollout
    folder: RunFolder
    frames: FrameChoice
    watch: Watch
    kept: Trajectory | None = None
    """Frames that an earlier process recorded."""

    def go_on(self) -> int:
        if not self.folder.trajectory.exists():
            return 0
        found, begun = Trajectory.load(self.folder.trajectory), self.rollout.clocks[0].steps
        readings = self.folder.read_sensors()
        known = min(len(found.converged), self.watch.logs[0].known(readings))
        frames = found[: int(np.count_nonzero(found.steps - begun <= known))]
        if len(frames) < 2:  # the first one alone is what a new run begins with
            return 0
        step, state = int(frames.steps[-1]) - begun, self.rollout.initial.following()
        state.set({name: frames.last_state[name] for name in self.simulation.frame(state)})
        noted = {name: column[:step] for name, column in frames.diagnostics.items()}
        self.rollout.progress, self.kept = Progress(step, state, noted), frames
        self.watch.logs[0].go_on(step, readings)
        return step

    def run(self) -> State:
        """All results are written before a `DivergedError` is raised."""
        rollout, steps = self.rollout, self.rollout.steps
        times, first = self.frames.announced(rollout), self.simulation.frame(rollout.initial)
        constants, origin, start = self.simulation.constants(rollout), rollout.origins[0], rollout.clocks[0].time
        noted, expected = rollout.diagnostics, self.frames.expected(rollout)
        kept = 1 if self.kept is None else len(self.kept)
        layout = {"times": times, "constants": constants, "steps": steps, "expected": expected, "kept": kept}
        marks = None if self.frames.rate is None else Marks(start, self.frames.rate)
        whole = (100, "run, % of its time") if ends_at_a_time(rollout) else (rollout.steps, "run")
        file = frame_writer(self.folder.trajectory, first, noted, origin, marks, quantities=self.watch.names, **layout)
        with file as writer, track(*whole) as advance:
            notes, done = Notes(self, writer), 0
            if self.kept is None:
                append_frame(writer, first, rollout.clocks[0].steps, self.watch.frame(0, rollout.initial))
                self.watch.read(0, rollout.initial)
            else:
                self.kept.write_frames(writer)
                done = done_of(rollout, rollout.progress.step, float(self.kept.times[-1]))
                advance(done)
            size = float(rollout.time_steps[0])

            def time_of(step: int) -> float:
                return float(rollout.clocks[0].times(np.array(step), size))

            def is_frame(step: int) -> bool:
                before, now = time_of(step - 1), time_of(step)
                return self.frames.is_due(step, before - start, now - start) or rollout.is_last(step)

            def record(step: int, state: State) -> None:
                frame, number = self.simulation.frame(state), rollout.clocks[0].steps + step
                append_frame(writer, frame, number, self.watch.frame(step, state), time_of(step))

            def observe(step: int) -> None:
                nonlocal done
                notes.now_and_then(step)
                before, done = done, done_of(rollout, step, time_of(step))
                advance(done - before)

            try:
                last = self.watch.run(is_frame, record, observe)
                self.watch.end(last)
            finally:
                notes.write()
                self.folder.write_metrics(rollout.diagnostics)
        if writer.frames_written < len(times):  # the file has room for frames that never came
            Trajectory.load(self.folder.trajectory).save(self.folder.trajectory)
        return last


class Notes:
    def __init__(self, recording: RunRecording, writer: TrajectoryWriter):
        self._recording, self._writer = recording, writer
        self._step, self._next = recording.rollout.progress.step, time.monotonic() + OFTEN

    def now_and_then(self, step: int) -> None:
        self._step = step
        if (begun := time.monotonic()) >= self._next:
            self._recording.rollout.log.read(step)
            self.write()
            ended = time.monotonic()
            self._next = ended + max(OFTEN, SHARE * (ended - begun))

    def write(self) -> None:
        rollout = self._recording.rollout
        self._recording.watch.look()
        if self._step > len(rollout.diagnostics["converged"]):  # an interrupt within a chunk of steps
            rollout.log.read(self._step)
        self._recording.folder.write_sensors(self._recording.watch.readings())
        first = self._writer.steps_written
        self._writer.append_steps(**{name: column[first:] for name, column in rollout.diagnostics.items()})


def run_scene(scene_file: Path, asked: RunRequest) -> str:
    state = None
    if (path := asked.state) is not None:
        file = RunFolder.open(path, ", but --state must be the folder of one").trajectory if path.is_dir() else path
        earlier = Trajectory.load(file)
        if not len(earlier):
            raise InputError(f"{file} holds no frame, but --state must have a frame from which the run continues.")
        state = earlier.last_state
    scene = load_scene(scene_file, asked.overrides)
    scene = scene.lasting(asked.time, asked.steps) if state is None else scene.going_on(state)
    simulation = Simulation(scene, asked.device, asked.precision)
    rollout = simulation.rollout(asked.steps, state=state, time=asked.time)
    numbers = simulation.numbers_in_frame(components=3)  # as in the file
    frames = frame_parts(asked.frames.expected(rollout), numbers, simulation.precision.bytes)
    require(frames, "take a larger --record-every or fewer steps")
    watch = Watch(simulation, rollout, asked.record)

    def kept() -> str:
        there = folder.trajectory.exists()
        return f"the frames so far are in {folder.trajectory}; --resume goes on with them" if there else ""

    with locked(asked.out):
        folder = asked.folder(scene, simulation, "run", asked.settings(rollout, state))
        recording = RunRecording(simulation, rollout, folder, asked.frames, watch)
        begun = recording.go_on() if asked.resume else 0
        if asked.resume:
            announce(f"It goes on after step {begun}." if begun else "No step of it is known: it begins anew.")
        with keeping(kept):
            _compute(recording, asked)
    for told in trouble(rollout, scene):
        warn(told)
    return f"The results are in {folder.path}; open report.html, or trajectory.vtkhdf in ParaView."


def _compute(recording: RunRecording, asked: RunRequest) -> None:
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
        summary = RunSummary(simulation, rollout, last, time.perf_counter() - begun, recording.watch.readings())
        announce(str(summary))
        folder.write_result(**_for_machines(simulation, rollout), **summary.for_machines(), failures=[])
        report(Section("In numbers", head=("", "value", "unit"), rows=summary.rows()))


def _for_machines(simulation: Simulation, rollout: Rollout) -> dict[str, Any]:
    noted = {name: np.asarray(values, dtype=np.float64) for name, values in rollout.diagnostics.items() if len(values)}
    return {
        "particles": simulation.particles,
        "steps": len(rollout.diagnostics["converged"]),
        "mean": {name: values.mean() for name, values in noted.items()},
        "greatest": {name: values.max() for name, values in noted.items()},
    }
