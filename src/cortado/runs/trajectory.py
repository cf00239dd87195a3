"""The frames of one run, in memory and on disk."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from operator import index
from os import PathLike
from pathlib import Path
from typing import Any, Self, overload

import numpy as np
from numpy.typing import NDArray

from cortado.calls import counted, public
from cortado.errors import InputError, shown
from cortado.files import vtkhdf
from cortado.files.disk import as_path
from cortado.files.image_encoding import ShadedPicture
from cortado.lazy import on_top
from cortado.runs.frames import FRACTION, Film, Marks, SolidMotions, append_frame, fraction_names, frame_writer
from cortado.runs.sensor import Readings
from cortado.scene.parameters import QUANTITIES, check_quantity
from cortado.scene.restart import Clock, Origin, RestartState
from cortado.scene.scene import Scene


@dataclass(frozen=True, eq=False)
class Frame:
    """One recorded state of a run, ``trajectory[k]``, of n particles in d dimensions."""

    positions: NDArray[Any]
    """(n, d) [m]"""
    velocities: NDArray[Any]
    """(n, d) [m/s]"""
    mass_fractions: NDArray[Any] | None
    """(n, phases) [-]; None with one phase"""
    time: float
    """[s]"""
    quantities: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    """(n,) or (n, k) recorded quantities by name, such as ``density``"""
    others: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    """further fields of the state by name; see `Trajectory`"""

    def __getitem__(self, name: str) -> NDArray[Any]:
        """Return a recorded quantity, the speed or a field of the state; raise `InputError` for any other name."""
        return chosen(self.quantities, name, fields_of(self))

    def moved(self, duration: float) -> Frame:
        """Return the frame extrapolated by ``duration`` [s], which may be negative, with constant velocities."""
        if duration == 0.0:
            return self
        return replace(self, positions=self.positions + duration * self.velocities, time=self.time + duration)

    def __repr__(self) -> str:
        return f"Frame({counted(len(self.positions), 'particle')}, t = {self.time:.4g} s)"


def fields_of(of: Frame | Trajectory) -> dict[str, NDArray[Any]]:
    fractions = {} if of.mass_fractions is None else {"mass_fractions": of.mass_fractions}
    return {"positions": of.positions, "velocities": of.velocities, **fractions, **of.others}


def chosen(quantities: Mapping[str, NDArray[Any]], name: str, fields: Mapping[str, NDArray[Any]]) -> NDArray[Any]:
    """Return a recorded quantity, the speed or one of ``fields``; raise `InputError` for any other name."""
    check_quantity(name, others=tuple(fields))
    if name in fields:
        return fields[name]
    if name == "speed" and name not in quantities:
        return np.linalg.norm(fields["velocities"], axis=-1)
    if name not in quantities:
        found = f"{', '.join(quantities)} and the speed are" if quantities else "only the speed is"
        advice = f'record it, as in simulation.run(steps, record=["{name}"]), or ask simulation.quantity for it'
        raise InputError(f"{name} was not recorded, {found} there: {advice}.")
    return quantities[name]


SUFFIXES = (".vtkhdf", ".hdf")


@public
@dataclass(frozen=True, eq=False)
class Trajectory:
    """The recorded frames of a run, and the solver's diagnostics of every step.

    ``trajectory[k]`` is the `Frame` k; a negative k counts from the end. ``trajectory[2:5]`` and ``trajectory[::10]``
    are trajectories of only these frames. ``len``, ``for`` and ``reversed`` work on the frames.

    Raises:
        InputError: arrays whose shapes do not belong together.

    Example::

        trajectory = simulation.run(steps=100, record_every=10)
        print(trajectory[-1].positions.shape)  # (n, d)
        trajectory.save("run.vtkhdf")
        again = cortado.Trajectory.load("run.vtkhdf")
    """

    times: NDArray[Any]
    """(frames,) [s]"""
    steps: NDArray[Any]
    """(frames,) [-] steps taken before each frame; 0 is the first state"""
    positions: NDArray[Any]
    """(frames, n, d) [m]"""
    velocities: NDArray[Any]
    """(frames, n, d) [m/s]"""
    diagnostics: Mapping[str, NDArray[Any]]
    """(steps,) by name: ``converged`` and the solver's other notes; see `StepLog`"""
    mass_fractions: NDArray[Any] | None = None
    """(frames, n, phases) [-]; None with one phase"""
    others: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    """(frames, ...) further fields of the states by name; with an emitter also ``outlet`` [m] and ``emitted`` [m], see
    `RestartState`"""
    constants: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    """fields that no step changes: ``reference_density`` (n,), a particle's mass over its volume on the rest lattice
    [kg/m3], and with one phase ``mass_fractions`` (n, 1)"""
    substeps: int = 0
    """[-] explicit steps of diffusion within each step"""
    origin: Origin | None = None
    """description of the particles' scene; None if unknown"""
    quantities: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    """(frames, n) or (frames, n, k) recorded quantities by name, such as ``density``"""
    sensors: Mapping[str, Readings] = field(default_factory=dict)
    """readings of sensors in every step, by sensor name; files do not contain them"""
    solids: SolidMotions = field(default_factory=SolidMotions)
    """motions of the moving solids, by name"""
    begun: int | None = None
    """number of steps before the first entry of ``diagnostics``, by default before the first frame [-]"""
    marks: Marks | None = None
    """times at which frames of a run with ``--fps`` are due; None if frames are chosen by steps"""
    scene: Scene | None = field(default=None, repr=False)
    """scene of the run; None if the trajectory was read from a file"""

    def __post_init__(self) -> None:
        if self.begun is None and len(self.steps):
            object.__setattr__(self, "begun", int(self.steps[0]))
        frames = {len(self.times), len(self.steps), len(self.positions), len(self.velocities)}
        steps = {name: len(column) for name, column in self.diagnostics.items()}
        if self.positions.ndim != 3 or self.positions.shape != self.velocities.shape or len(frames) > 1:
            raise InputError(
                f"Positions and velocities must both be (frames, n, d) with a time and a step per frame, "
                f"but found {self.positions.shape}, {self.velocities.shape}, {self.times.shape} and "
                f"{self.steps.shape}."
            )
        if len(set(steps.values())) > 1:
            raise InputError(f"The diagnostics must be of one length, but have {steps}.")

    def __repr__(self) -> str:
        times = f", {self.times[0]:.4g} to {self.times[-1]:.4g} s" if len(self) else ""
        return f"Trajectory({counted(len(self), 'frame')} of {counted(self.particles, 'particle')}{times})"

    def __len__(self) -> int:
        return len(self.times)

    @overload
    def __getitem__(self, k: int) -> Frame: ...

    @overload
    def __getitem__(self, k: slice) -> Trajectory: ...

    def __getitem__(self, k: int | slice) -> Frame | Trajectory:
        """Return a frame, or a trajectory of some frames with the diagnostics of the whole run. Raise `IndexError` if
        there is no such frame, and `InputError` unless k is a whole number or a slice."""
        if isinstance(k, slice):
            return self._chosen(k)
        try:
            place = index(k)
        except TypeError:
            raise InputError(f"The number of a frame is {shown(k)}, but must be a whole number or a slice.") from None
        if place not in range(-len(self), len(self)):
            raise IndexError(f"There is no frame {place}, as the trajectory has {len(self)} frames.")
        fractions = None if self.mass_fractions is None else self.mass_fractions[place]
        own, others = ({n: a[place] for n, a in each.items()} for each in (self.quantities, self.others))
        return Frame(self.positions[place], self.velocities[place], fractions, float(self.times[place]), own, others)

    def quantity(self, name: str) -> NDArray[Any]:
        """Return by ``name`` a recorded quantity of the particles or the speed, (frames, n) or (frames, n, k), or a
        field (frames, ...) of the states; raise `InputError` for any other name. `Simulation.quantity` computes
        others."""
        return chosen(self.quantities, name, fields_of(self))

    def __iter__(self) -> Iterator[Frame]:
        return (self[k] for k in range(len(self)))

    def _chosen(self, frames: slice) -> Trajectory:
        names = ("times", "steps", "positions", "velocities", "mass_fractions")
        arrays = {name: getattr(self, name) for name in names}
        kept: dict[str, Any] = {name: None if array is None else array[frames] for name, array in arrays.items()}
        each = {name: getattr(self, name) for name in ("others", "quantities")}
        kept |= {key: {name: array[frames] for name, array in own.items()} for key, own in each.items()}
        kept["solids"] = SolidMotions({name: motion[frames] for name, motion in self.solids.items()})
        kept["marks"] = None if self.marks is None else self.marks.chosen(kept["times"], frames.indices(len(self))[2])
        return replace(self, **kept)

    @property
    def due(self) -> NDArray[Any]:
        """Return the times (frames,) [s] at which films show the frames: due times with ``--fps``, else ``times``."""
        return self.times if self.marks is None else self.marks.due(self.times)

    @property
    def dimension(self) -> int:
        return self.positions.shape[2]

    @property
    def particles(self) -> int:
        return self.positions.shape[1]

    @property
    def iterations(self) -> NDArray[Any]:
        """Return the pressure iterations (steps,) [-] of each step; raise `InputError` if the solver does not record
        them."""
        return noted(self.diagnostics, "iterations")

    @property
    def density_errors(self) -> NDArray[Any]:
        """Return the average (rho - rho_0) / rho_0 (steps,) [-] of each step; raise `InputError` if it is not
        recorded."""
        return noted(self.diagnostics, "density_errors")

    @property
    def converged(self) -> NDArray[Any]:
        """Return booleans (steps,): True where the solver reached its tolerance."""
        return self.diagnostics["converged"]

    @property
    def not_converged(self) -> int:
        """Return the number of steps in which the solver did not reach its tolerance."""
        return int(np.count_nonzero(~self.converged))

    @property
    def last_state(self) -> RestartState:
        """Return a copy of the last state, from which `Simulation.run` continues with the same bits as without a stop.
        Raise `InputError` if there is no frame."""
        if not len(self):
            raise InputError("The trajectory has no frame, but must have one to continue from.")
        own = {name: array.copy() for name, array in {**fields_of(self[-1]), **self.constants}.items()}
        taken = self.diagnostics.get("time_steps", np.zeros(0))[: int(self.steps[-1]) - (self.begun or 0)]
        size = float(taken[-1]) if len(taken) else 0.0
        return RestartState(own, Clock(int(self.steps[-1]), float(self.times[-1]), size), self.origin)

    def save(self, path: str | Path) -> None:
        """Write a VTKHDF file, which ParaView opens; a file at this ``path`` is replaced. Raise `InputError` without
        frames, for a name that does not end in .vtkhdf or .hdf, or if the path cannot be written, and
        `ComputationError` if the disk is full."""
        if Path(as_path("path", path)).suffix.lower() not in SUFFIXES:
            wanted = f"must be a VTKHDF file, whose name ends in {' or '.join(SUFFIXES)}"
            raise InputError(f"path is {str(path)!r}, but {wanted}.")
        first = {name: array[0] if len(array) else array for name, array in fields_of(self).items()}
        layout: dict[str, Any] = {"times": self.times, "constants": self.constants, "steps": len(self.converged)}
        known = first, self.diagnostics, self.origin, self.marks
        with frame_writer(path, *known, quantities=self.quantities, **layout) as writer:
            writer.append_steps(**self.diagnostics)
            self.write_frames(writer)

    def write_frames(self, writer: vtkhdf.TrajectoryWriter) -> None:
        """Write all frames with the ``writer`` of a file that has room for them."""
        for frame, step in zip(self, self.steps, strict=True):
            append_frame(writer, fields_of(frame), int(step), frame.quantities, frame.time)

    def export(self, folder: str | PathLike[str], to: str, scene: Scene | str | PathLike[str] | None = None) -> Path:
        """Export the fluid's surface and particles, coloured as in pictures, and the solids to other programs: see
        `docs/into_blender.md`. Return the file to open, or the folder of a series.

        ``to``: "usd", one file with time samples; "ply", "obj", "glb" or "vtp", files for each frame, the last with
        ``run.pvd`` for ParaView. ``scene``: the scene or its file's path; needed for a trajectory from a file. The
        ``folder`` must be empty or missing. In 2-D no surface is exported, and z is 0.

        Raise `InputError` for another format, a folder with files, no scene or another one, a missing library, or a
        ``picture.colour`` of the scene that was not recorded, and `ComputationError` if the disk is full.
        """
        of = self.scene if scene is None else scene
        if of is None:
            raise InputError(
                "scene is missing, but must be given, as a trajectory from a file does not contain its scene."
            )
        return on_top("export")(self, folder, to, of)

    def to_xarray(self) -> Any:
        """Return an ``xarray.Dataset`` with units and the dimensions time, particle, space and solid: position,
        velocity, recorded quantities, motions of solids and, with several phases, mass_fraction. Raise `InputError` if
        xarray is missing."""
        return on_top("labelled")(self)

    def picture(
        self, k: int = -1, *, scene: Scene | str | Path | None = None, device: str = "cpu", **settings: Any
    ) -> ShadedPicture:
        """Draw a shaded picture of frame k, (rows, columns, 3), linear from 0 to 1; a notebook displays it. The camera
        is placed so that the fluid is visible in every frame. Arguments ``scene``, ``device``, ``settings`` and errors
        are as in `film`.

        Example: ``cortado.pictures.write_picture("last.png", trajectory.picture(width=640, height=360))``
        """
        return on_top("trajectory_picture")(self, k, scene, device, settings)

    def film(
        self, path: str | Path, *, scene: Scene | str | Path | None = None, device: str = "cpu", **settings: Any
    ) -> Film:
        """Write a film of the run and return it; a notebook plays it. A film stopped by Ctrl-C keeps its frames, and
        the same call continues it. See `docs/pictures.md`.

        Args:
            path: ends in .mp4, or in .webp: an animation for web pages; the call cannot continue a stopped one.
            scene: the run's scene or its file's path; needed if the trajectory was loaded from a file.
            device: device that traces the rays, "cpu" or "cuda:0".
            settings: keys of the scene's table [picture], such as ``colour="speed"``, ``film_speed=0.25`` or
                ``film_frames=100``; ``lines=1080`` sets width and height; ``camera=pictures.Orbit()`` moves the camera.

        Raises:
            SceneError: settings that do not fit.
            InputError: a package is missing, or the quantity of ``colour`` was not recorded and cannot be computed.
        """
        return on_top("trajectory_film")(self, path, scene, device, settings)

    def _repr_html_(self) -> str:
        """Show an animation of the run in a notebook, with its first, middle and last frame."""
        return on_top("trajectory_page")(self)

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read the file at ``path`` that `save` or `TrajectoryWriter` wrote; its writer may be running or killed. Raise
        `InputError` if the file is missing, damaged, or none of Cortado's trajectories."""
        arrays = vtkhdf.read(as_path("path", path))
        names = ("times", "steps", "positions", "velocities", "diagnostics", "others", "constants")
        phases = sum(name.startswith(FRACTION) for name in arrays)
        fractions = np.stack([arrays[name] for name in fraction_names(phases)], axis=-1) if phases else None
        try:
            origin = Origin.from_json(arrays["origin"]) if arrays["origin"] else None
        except (ValueError, TypeError, AttributeError) as problem:
            raise InputError(f"{path} is damaged: the scene of its particles cannot be read: {problem}.") from problem
        recorded = {name: arrays[name] for name in QUANTITIES if name in arrays}
        for name, array in recorded.items():
            _, *row = QUANTITIES[name].shape(1, arrays["positions"].shape[2])
            recorded[name] = np.ascontiguousarray(array[..., : row[0]]) if row else array
        solids = SolidMotions.of(arrays["others"], arrays["positions"].shape[2])
        marks = None if arrays["marks"] is None else Marks(*arrays["marks"])
        more: dict[str, Any] = {"mass_fractions": fractions, "origin": origin, "quantities": recorded, "solids": solids}
        return cls(**{name: arrays[name] for name in names}, **more, marks=marks)


def noted(diagnostics: Mapping[str, NDArray[Any]], name: str) -> NDArray[Any]:
    """Return the diagnostic (steps,) with this name; raise `InputError` if the solver does not record it."""
    if name not in diagnostics:
        raise InputError(f"{name} is no diagnostic of this solver, whose diagnostics are {', '.join(diagnostics)}.")
    return diagnostics[name]
