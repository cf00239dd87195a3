"""How long a run will be that somebody asks for: steps, seconds, frames, bytes on disk, and its film."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from cortado.device.memory import frame_parts
from cortado.rollout.parameter_space import steps_of_run
from cortado.rollout.step_bounds import ROOM
from cortado.runs.pace import Pace
from cortado.runs.recording import FrameChoice
from cortado.scene.appearance import Picture
from cortado.simulation import Simulation
from cortado.words import counted

MOST = 1_000_000
"""Frames of a film; nobody looks at more."""
HEADS, PER_PARTICLE, PER_STEP = 28e3, 24.0, 50.0
"""Bytes of a trajectory file besides its frames, measured: its heads, what no step changes, what the solver notes."""


@dataclass(frozen=True)
class RunLength:
    """Of a run that is asked for by a number of steps or by a time."""

    steps: int
    """About as many, where it ends at a time and chooses its steps."""
    is_about: bool
    """Whether the number of steps is an estimate."""
    time: float | None
    """That it simulates [s]; None of a number of steps that are chosen."""
    frames: int | None
    """That it records, the first and the last among them; None where that depends on a time that is not known."""
    trajectory: float | None
    """[bytes] of them on disk."""
    film: Pace | None
    """Which frames its film shows, and how fast; None where there is no film, or its length is not known."""

    @classmethod
    def of(cls, simulation: Simulation, steps: int | None, time: float | None, choice: FrameChoice) -> "RunLength":
        """Of a run with so many steps, or for a time [s]. Raises `InputError` for what is neither."""
        solver, picture = simulation.scene.solver, simulation.scene.picture or Picture()
        is_about = solver.chooses and time is not None
        count = steps_of_run(simulation, steps, time, {}) // (ROOM if is_about else 1)
        if not solver.chooses:
            time = count * float(solver.time_step)
        frames = choice.count(count, time)
        film = None
        if frames is not None and time is not None and 1 < frames <= MOST and picture.film_frames != 0:
            film = Pace.of(np.linspace(0.0, time, frames), picture.film_frames, picture.film_speed, choice.rate)
        numbers = simulation.numbers_in_frame(components=3)  # as in the file
        size = None
        if frames is not None:
            size = sum(frame_parts(frames, numbers, simulation.precision.bytes).values())
            size += HEADS + PER_PARTICLE * simulation.particles + PER_STEP * count
        return cls(count, is_about, time, frames, size, film)

    def for_machines(self) -> dict[str, Any]:
        """By names that end in units."""
        film = {} if self.film is None else {"film_seconds": self.film.seconds, "film_speed": self.film.speed}
        return {
            "steps": self.steps,
            "steps_are_estimated": self.is_about,
            "simulated_time_s": self.time,
            "frames": self.frames,
            "trajectory_bytes": self.trajectory,
            "film_frames": None if self.film is None else len(self.film.frames),
            **film,
        }

    @property
    def in_words(self) -> str:
        """Steps, and seconds of motion."""
        motion = "" if self.time is None else f", {self.time:g} s of motion"
        about = "about " if self.is_about else ""
        guess = ", if fluid gets as fast as by a fall through the whole container" if self.is_about else ""
        return f"{about}{counted(self.steps, 'step')}{motion}{guess}"
