"""The frames of one run, in memory and on disk."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from operator import index
from pathlib import Path
from typing import Any, Self, overload

import numpy as np
from numpy.typing import NDArray

from cortado.errors import InputError, shown
from cortado.io import vtkhdf
from cortado.io.notebook import as_text, with_picture
from cortado.restart import Elapsed, RestartState, RunConstants
from cortado.words import counted


@dataclass(frozen=True, eq=False)
class Frame:
    """One recorded state of a run, ``trajectory[k]``; n particles in d dimensions."""

    positions: NDArray[Any]
    """(n, d) [m]"""
    velocities: NDArray[Any]
    """(n, d) [m/s]"""
    mass_fractions: NDArray[Any] | None
    """(n, phases) [-]; None with one phase"""
    time: float
    """[s]"""

    def __repr__(self) -> str:
        return f"Frame({counted(len(self.positions), 'particle')}, t = {self.time:.4g} s)"


@dataclass(frozen=True, eq=False)
class Trajectory:
    """What a run leaves: recorded frames, and what the pressure solver did at every step.

    ``trajectory[k]`` is the `Frame` k, counted from the end where k is negative; ``trajectory[2:5]`` and
    ``trajectory[::10]`` are trajectories of these frames alone; ``len``, ``for`` and ``reversed`` go over the frames.

    Raises:
        InputError: arrays whose shapes do not belong together.
    """

    times: NDArray[Any]
    """(frames,) [s]"""
    steps: NDArray[Any]
    """(frames,) [-] steps taken before each frame; 0 is the first state"""
    positions: NDArray[Any]
    """(frames, n, d) [m]"""
    velocities: NDArray[Any]
    """(frames, n, d) [m/s]"""
    iterations: NDArray[Any]
    """(steps,) [-] pressure iterations used at each step"""
    density_errors: NDArray[Any]
    """(steps,) [-] average (rho - rho_0) / rho_0 at the end of each step"""
    converged: NDArray[Any]
    """(steps,) bool: whether the pressure solver reached its tolerance"""
    mass_fractions: NDArray[Any] | None = None
    """(frames, n, phases) [-]; None with one phase"""
    substeps: int = 0
    """[-] explicit steps of diffusion within each step"""
    constants: RunConstants | None = None
    """what a restart needs besides; None in a file of an earlier version"""

    def __post_init__(self) -> None:
        frames = {len(self.times), len(self.steps), len(self.positions), len(self.velocities)}
        steps = {len(self.iterations), len(self.density_errors), len(self.converged)}
        if self.positions.ndim != 3 or self.positions.shape != self.velocities.shape or len(frames) > 1:
            raise InputError(
                f"Positions and velocities must both be (frames, n, d) with a time and a step per frame, "
                f"but found {self.positions.shape}, {self.velocities.shape}, {self.times.shape} and "
                f"{self.steps.shape}."
            )
        if len(steps) > 1:
            raise InputError(
                f"Iterations, density errors and converged must be of one length, but have {sorted(steps)}."
            )

    def __repr__(self) -> str:
        times = f", {self.times[0]:.4g} to {self.times[-1]:.4g} s" if len(self) else ""
        return f"Trajectory({counted(len(self), 'frame')} of {counted(self.particles, 'particle')}{times})"

    def _repr_html_(self) -> str:
        """Its first, middle and last frame, coloured by speed."""
        from cortado.figures.particle_sets import particles

        if not len(self):
            return as_text(repr(self))
        shown = [self[k] for k in sorted({0, len(self) // 2, len(self) - 1})]
        titles = [f"t = {frame.time:.4g} s" for frame in shown]
        speeds = [np.linalg.norm(frame.velocities, axis=1) for frame in shown]
        sets, label = [frame.positions for frame in shown], "speed [m/s]"
        return with_picture(self, lambda path: particles(sets, titles, path, colours=speeds, colour_label=label))

    def __len__(self) -> int:
        """Number of frames."""
        return len(self.times)

    @overload
    def __getitem__(self, k: int) -> Frame: ...

    @overload
    def __getitem__(self, k: slice) -> Trajectory: ...

    def __getitem__(self, k: int | slice) -> Frame | Trajectory:
        """A frame, or a trajectory of some; what the pressure solver did stays that of the whole run.

        Raises:
            IndexError: there is no such frame.
            InputError: k is neither a whole number nor a slice.
        """
        if isinstance(k, slice):
            return self._chosen(k)
        try:
            place = index(k)
        except TypeError:
            raise InputError(f"a frame is asked for by {shown(k)}, but must be by a whole number or a slice.") from None
        if place not in range(-len(self), len(self)):
            raise IndexError(f"frame {place} is asked for, but there are {len(self)} frames.")
        fractions = None if self.mass_fractions is None else self.mass_fractions[place]
        return Frame(self.positions[place], self.velocities[place], fractions, float(self.times[place]))

    def __iter__(self) -> Iterator[Frame]:
        return (self[k] for k in range(len(self)))

    def _chosen(self, frames: slice) -> Trajectory:
        """The trajectory of some frames."""
        constants = self.constants
        if constants is not None and constants.outlets is not None:
            constants = replace(constants, outlets=constants.outlets[frames])
        names = ("times", "steps", "positions", "velocities", "mass_fractions")
        arrays = {name: getattr(self, name) for name in names}
        chosen: dict[str, Any] = {name: None if array is None else array[frames] for name, array in arrays.items()}
        return replace(self, **chosen, constants=constants)

    @property
    def dimension(self) -> int:
        """2 or 3."""
        return self.positions.shape[2]

    @property
    def particles(self) -> int:
        """n"""
        return self.positions.shape[1]

    @property
    def not_converged(self) -> int:
        """Number of steps at which the pressure solver did not reach its tolerance."""
        return int(np.count_nonzero(~self.converged))

    @property
    def last_state(self) -> RestartState:
        """The state of the last frame, from which `Simulation.run` goes on bit for bit.

        Raises:
            InputError: there is no frame, or the trajectory is from a file that does not hold all of it.
        """
        if not len(self):
            raise InputError("The trajectory has no frame, but must have one to go on from.")
        if self.constants is None:
            raise InputError("The trajectory is from an earlier version of Cortado, without what a restart needs.")
        outlets = self.constants.outlets
        elapsed = Elapsed(int(self.steps[-1]), float(self.times[-1]), None if outlets is None else outlets[-1])
        fractions = None if self.mass_fractions is None else self.mass_fractions[-1]
        return RestartState(self.positions[-1], self.velocities[-1], fractions, self.constants, elapsed)

    def save(self, path: str | Path) -> None:
        """Writes a VTKHDF file, which ParaView opens; a file of that name is replaced.

        Raises:
            InputError: no frames, or a path that cannot be written.
            ComputationError: the disk is full.
        """
        single = self.positions.dtype == np.float32
        with vtkhdf.TrajectoryWriter(
            path,
            times=self.times,
            particles=self.particles,
            dimension=self.dimension,
            precision="float32" if single else "float64",
            steps=len(self.iterations),
            scalars=fraction_names(0 if self.mass_fractions is None else self.mass_fractions.shape[2]),
            constants=None if self.constants is None else self.constants.arrays(),
        ) as writer:
            writer.append_steps(self.iterations, self.density_errors, self.converged)
            for k, step in enumerate(self.steps):
                fractions = {} if self.mass_fractions is None else fraction_fields(self.mass_fractions[k])
                writer.append(self.positions[k], self.velocities[k], step=int(step), **fractions)

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Reads a file written by `save` or by `TrajectoryWriter`, whose writer may be dead or still at work.

        Raises:
            InputError: the file is missing, damaged, or none of Cortado's trajectories.
        """
        arrays = vtkhdf.read(path)
        names = ("times", "steps", "positions", "velocities", "iterations", "density_errors", "converged")
        phases = sum(name.startswith(FRACTION) for name in arrays)
        fractions = np.stack([arrays[name] for name in fraction_names(phases)], axis=-1) if phases else None
        constants = RunConstants.of(arrays["constants"], len(arrays["times"]))
        found = {name: arrays[name] for name in names}
        return cls(**found, mass_fractions=fractions, constants=constants)


FRACTION = "mass_fraction_"


def fraction_names(phases: int) -> list[str]:
    """Names of the scalar fields that hold the mass fractions of several phases; none for one phase."""
    return [f"{FRACTION}{k}" for k in range(phases)] if phases > 1 else []


def fraction_fields(fractions: NDArray[Any]) -> dict[str, NDArray[Any]]:
    """Mass fractions (n, phases) as scalar fields by name."""
    return dict(zip(fraction_names(fractions.shape[1]), fractions.T, strict=False))
