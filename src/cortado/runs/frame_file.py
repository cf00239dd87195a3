"""When frames of a run are due, and frames as a VTKHDF file takes them, one by one while the run goes on."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cortado.files import vtkhdf
from cortado.scene.quantity_names import QUANTITIES
from cortado.scene.restart import Origin

SAME = 1e-9
"""Of a frame: a state that comes earlier than a frame is due by less is that frame, as times are rounded."""


@dataclass(frozen=True)
class Marks:
    """Frame k is due at the time start + k / rate, and is the first state at that time or after it."""

    start: float
    """[s] when the run began"""
    rate: float
    """[1/s] frames in a second that is simulated"""

    def passed(self, times: NDArray[Any]) -> NDArray[np.int64]:
        """(n,) the number of the last mark at or before each of the times (n,) [s]."""
        return np.floor((np.asarray(times) - self.start) * self.rate + SAME).astype(np.int64)

    def at(self, numbers: NDArray[Any]) -> NDArray[np.float64]:
        """(n,) [s] the times of marks of these numbers (n,)."""
        return self.start + np.asarray(numbers) / self.rate

    def due(self, times: NDArray[Any]) -> NDArray[np.float64]:
        """(frames,) [s] when frames recorded at ``times`` (frames,) were due. The last state of a run, which may be at
        no mark, and states that are farther apart than marks have their own times."""
        numbers = self.passed(times)
        one_by_one = np.diff(numbers, prepend=numbers[:1] - 1) == 1
        return np.where(one_by_one, self.at(numbers), times)

    def chosen(self, times: NDArray[Any], stride: int) -> Marks | None:
        """The marks of every so many frames of a run, of those recorded at ``times`` (frames,) [s]; None where they are
        not evenly spaced among the marks, but for the last."""
        numbers = self.passed(times)
        apart = np.diff(numbers)
        every = 1 if stride == 1 else int(apart[0]) if len(apart) else 0
        if not len(numbers) or every < 1 or (stride != 1 and ((apart[:-1] != every).any() or apart[-1] > every)):
            return None
        return Marks(float(self.at(numbers[0])), self.rate / every)


def common_rate(each: Iterable[Marks | None]) -> float | None:
    """[1/s] how many frames in a second all of several runs record; None where not all of them say so, or another
    number."""
    rates = {None if marks is None else marks.rate for marks in each}
    return rates.pop() if len(rates) == 1 else None


FRACTION = "mass_fraction_"


def frame_writer(
    path: str | Path,
    times: NDArray[Any],
    first: Mapping[str, NDArray[Any]],
    constants: Mapping[str, NDArray[Any]],
    steps: int,
    diagnostics: Mapping[str, NDArray[Any]],
    origin: Origin | None,
    quantities: Iterable[str] = (),
    marks: Marks | None = None,
    expected: int | None = None,
    kept: int = 1,
) -> vtkhdf.TrajectoryWriter:
    """A file with room for frames at ``times`` (frames,) [s] that hold the same fields as the first, with
    ``quantities`` of these names, and for what is noted of so many steps, which have the names and types of
    ``diagnostics``; all of it of particles of an origin. ``marks``: when frames are due, where times choose them. The
    disk must have room for all frames, or for as many as are ``expected``. A file of that name is replaced once it has
    all frames that are ``kept`` of it."""
    particles, dimension = first["positions"].shape[-2:]
    single = first["positions"].dtype == np.float32
    vectors = [name for name in quantities if len(QUANTITIES[name].shape(particles, dimension)) == 2]
    numbers = [name for name in quantities if name not in vectors]
    return vtkhdf.TrajectoryWriter(
        path,
        times=times,
        particles=particles,
        dimension=dimension,
        precision="float32" if single else "float64",
        steps=steps,
        scalars=[*fraction_names(first["mass_fractions"].shape[-1] if "mass_fractions" in first else 0), *numbers],
        vectors=vectors,
        others=_others(first),
        constants=constants,
        diagnostics={name: column.dtype for name, column in diagnostics.items()},
        origin="" if origin is None else origin.to_json(),
        marks=None if marks is None else (marks.start, marks.rate),
        expected=expected,
        kept=kept,
    )


def append_frame(
    writer: vtkhdf.TrajectoryWriter,
    frame: Mapping[str, NDArray[Any]],
    step: int,
    quantities: Mapping[str, NDArray[Any]] | None = None,
    time: float | None = None,
) -> None:
    """Write the fields of a frame, after so many steps, with its quantities, to a file of `frame_writer`; its ``time``
    [s] where that was not known."""
    fractions = frame["mass_fractions"].T if "mass_fractions" in frame else ()
    scalars = {**dict(zip(fraction_names(len(fractions)), fractions, strict=True)), **(quantities or {})}
    writer.append(frame["positions"], frame["velocities"], step=step, time=time, others=_others(frame), **scalars)


def _others(frame: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    return {name: frame[name] for name in frame if name not in ("positions", "velocities", "mass_fractions")}


def fraction_names(phases: int) -> list[str]:
    """Names of the scalar fields that hold the mass fractions of several phases; none for one phase."""
    return [f"{FRACTION}{k}" for k in range(phases)]
