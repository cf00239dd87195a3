"""What ``cortado run`` writes while it runs, so that it can go on after it was stopped, or killed, at any moment."""

import time
from dataclasses import dataclass

import numpy as np

from cortado.files.terminal import track
from cortado.files.vtkhdf import TrajectoryWriter
from cortado.particles.state import State
from cortado.rollout.rollout import Progress, Rollout
from cortado.rollout.step_bounds import done_of, ends_at_a_time
from cortado.runs.frame_file import Marks, append_frame, frame_writer
from cortado.runs.recording import FrameChoice
from cortado.runs.run_folder import RunFolder
from cortado.runs.trajectory import Trajectory
from cortado.simulation import Simulation
from cortado.watching import Watch

OFTEN, SHARE = 5.0, 20.0
"""What was noted of the steps is written every so many seconds, or as often as that takes a 20th of the time."""


@dataclass
class RunRecording:
    """Runs a rollout and writes its frames, what the solver noted of its steps, and what sensors read."""

    simulation: Simulation
    rollout: Rollout
    folder: RunFolder
    frames: FrameChoice
    watch: Watch
    kept: Trajectory | None = None
    """Frames of an earlier process, from the last of which the rollout goes on."""

    def go_on(self) -> int:
        """Have the rollout go on from the last frame in the folder up to which everything is known; returns the number
        of steps before it, 0 where there is no such frame."""
        if not self.folder.trajectory.exists():
            return 0
        found, begun = Trajectory.load(self.folder.trajectory), self.rollout.clocks[0].steps
        readings = self.folder.read_sensors()
        known = min(len(found.converged), self.watch.known(readings))
        frames = found[: int(np.count_nonzero(found.steps - begun <= known))]
        if len(frames) < 2:  # the first one alone is what a new run begins with
            return 0
        step, state = int(frames.steps[-1]) - begun, self.rollout.initial.following()
        state.set({name: frames.last_state[name] for name in self.simulation.frame(state)})
        noted = {name: column[:step] for name, column in frames.diagnostics.items()}
        self.rollout.progress, self.kept = Progress(step, state, noted), frames
        self.watch.go_on(step, readings)
        return step

    def run(self) -> State:
        """Take the steps; returns the last state. Raises `DivergedError` with everything before written."""
        rollout, steps = self.rollout, self.rollout.steps
        times, first = self.frames.announced(rollout), self.simulation.frame(rollout.initial)
        constants, origin, start = self.simulation.constants(rollout), rollout.origins[0], rollout.clocks[0].time
        noted, expected = rollout.diagnostics, self.frames.expected(rollout)
        kept = 1 if self.kept is None else len(self.kept)
        known = first, constants, steps, noted, origin, self.watch.names
        marks = None if self.frames.rate is None else Marks(start, self.frames.rate)
        whole = (100, "run, % of its time") if ends_at_a_time(rollout) else (rollout.steps, "run")
        file = self.folder.trajectory, times, *known, marks, expected, kept
        with frame_writer(*file) as writer, track(*whole) as advance:
            notes, done = Notes(self, writer), 0
            if self.kept is None:
                append_frame(writer, first, rollout.clocks[0].steps, self.watch.frame(0, rollout.initial))
                self.watch.step(0, rollout.initial)
            else:
                self.kept.write_frames(writer)
                done = done_of(rollout, rollout.progress.step, float(self.kept.times[-1]))
                advance(done)
            size = float(rollout.time_steps[0])

            def observe(step: int, state: State) -> None:
                nonlocal done
                before, now = (float(rollout.clocks[0].times(np.array(k), size)) for k in (step - 1, step))
                if self.frames.is_due(step, before - start, now - start) or rollout.is_last(step):
                    number = rollout.clocks[0].steps + step
                    append_frame(writer, self.simulation.frame(state), number, self.watch.frame(step, state), now)
                self.watch.step(step, state)
                notes.now_and_then(step)
                before, done = done, done_of(rollout, step, now)
                advance(done - before)

            try:
                last = rollout.forward(observe, keep=False)
            finally:
                notes.write()
                self.folder.write_metrics(rollout.diagnostics)
        if writer.frames_written < len(times):  # the file has room for frames that never came
            Trajectory.load(self.folder.trajectory).save(self.folder.trajectory)
        return last


class Notes:
    """What is known of the steps besides frames, written in time."""

    def __init__(self, recording: RunRecording, writer: TrajectoryWriter):
        self._recording, self._writer = recording, writer
        self._step, self._next = recording.rollout.progress.step, time.monotonic() + OFTEN

    def now_and_then(self, step: int) -> None:
        """After a step, write if it is time."""
        self._step = step
        if (begun := time.monotonic()) >= self._next:
            self._recording.rollout.log.read(step)
            self.write()
            ended = time.monotonic()
            self._next = ended + max(OFTEN, SHARE * (ended - begun))

    def write(self) -> None:
        """What sensors read, and what the solver noted of the steps that were observed."""
        rollout = self._recording.rollout
        if self._step > len(rollout.diagnostics["converged"]):  # an interrupt within a chunk of steps
            rollout.log.read(self._step)
        self._recording.folder.write_sensors(self._recording.watch.readings())
        first = self._writer.steps_written
        self._writer.append_steps(**{name: column[first:] for name, column in rollout.diagnostics.items()})
