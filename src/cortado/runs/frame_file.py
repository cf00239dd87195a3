"""Frames of a run as a VTKHDF file takes them, one by one while the run goes on."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cortado.files import vtkhdf
from cortado.runs.marks import Marks
from cortado.scene.quantities import QUANTITIES
from cortado.scene.restart import Origin

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
