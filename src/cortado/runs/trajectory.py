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

SUFFIXES = (".vtkhdf", ".hdf")


@dataclass(frozen=True, eq=False)
class Frame:
    """One recorded state of a run with n particles in d dimensions: ``trajectory[k]``."""

    positions: NDArray[Any]
    """Positions of particles (n, d) [m]."""
    velocities: NDArray[Any]
    """Velocities of particles (n, d) [m/s]."""
    mass_fractions: NDArray[Any] | None
    """Mass fractions (n, phases) [-], or None for a single phase."""
    time: float
    """Time of the state [s]."""
    quantities: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    """Recorded quantities by name, such as ``density``, (n,) or (n, k)."""
    others: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    """Further fields of the state by name; see `Trajectory`."""

    def __getitem__(self, name: str) -> NDArray[Any]:
        """Return a recorded quantity, the speed or a field of the state. Raises `InputError` for unknown names."""
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
    check_quantity(name, others=tuple(fields))
    if name in fields:
        return fields[name]
    if name == "speed" and name not in quantities:
        return np.linalg.norm(fields["velocities"], axis=-1)
    if name not in quantities:
        found = f"{', '.join(quantities)} and the speed" if quantities else "only the speed"
        advice = f'record {name}, as in simulation.run(steps, record=["{name}"]), or take simulation.quantity'
        raise InputError(f"{name} was not recorded, but the trajectory has {found}: {advice}.")
    return quantities[name]


@public
@dataclass(frozen=True, eq=False)
class Trajectory:
    """The recorded frames of a run, and the solver's diagnostics of every step.

    ``trajectory[k]`` is the `Frame` k; a negative k counts from the end. ``trajectory[2:5]`` and ``trajectory[::10]``
    are trajectories with a part of the frames. ``len``, ``for`` and ``reversed`` work on the frames.

    Raises:
        InputError: the shapes of the arrays do not match.

    Example::

        trajectory = simulation.run(steps=100, record_every=10)
        print(trajectory[-1].positions.shape)  # (n, d)
        trajectory.save("run.vtkhdf")
        again = cortado.Trajectory.load("run.vtkhdf")
    """

    times: NDArray[Any]
    """Times of frames (frames,) [s]."""
    steps: NDArray[Any]
    """Number of steps before each frame (frames,) [-]; 0 for the first state."""
    positions: NDArray[Any]
    """Positions of particles (frames, n, d) [m]."""
    velocities: NDArray[Any]
    """Velocities of particles (frames, n, d) [m/s]."""
    diagnostics: Mapping[str, NDArray[Any]]
    """Diagnostics of steps (steps,) by name, such as ``converged``. Names depend on the solver; see `StepLog`."""
    mass_fractions: NDArray[Any] | None = None
    """Mass fractions (frames, n, phases) [-], or None for a single phase."""
    others: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    """Further fields of the states by name, (frames, ...), such as ``outlet`` [m] and ``emitted`` [m] with an emitter;
    see `RestartState`."""
    constants: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    """Fields that are constant over time. ``reference_density`` (n,) [kg/m3] is the mass of a particle divided by its
    volume on the rest lattice. With a single phase, ``mass_fractions`` (n, 1) are constant too."""
    substeps: int = 0
    """Number of explicit diffusion substeps in each step [-]."""
    origin: Origin | None = None
    """Description of the particles' scene, or None if unknown."""
    quantities: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    """Recorded quantities by name, such as ``density``, (frames, n) or (frames, n, k)."""
    sensors: Mapping[str, Readings] = field(default_factory=dict)
    """Readings of sensors in every step, by sensor name. Trajectory files do not contain sensor readings."""
    solids: SolidMotions = field(default_factory=SolidMotions)
    """Motions of moving solids by name."""
    begun: int | None = None
    """Number of steps before the first entry of ``diagnostics`` [-], by default the number of steps before the first
    frame."""
    marks: Marks | None = None
    """Due times of frames in a run with ``--fps``, or None if frames are chosen by steps."""
    scene: Scene | None = field(default=None, repr=False)
    """Scene of the run, or None if the trajectory was read from a file."""

    def __post_init__(self) -> None:
        if self.begun is None and len(self.steps):
            object.__setattr__(self, "begun", int(self.steps[0]))
        frames = {len(self.times), len(self.steps), len(self.positions), len(self.velocities)}
        steps = {name: len(column) for name, column in self.diagnostics.items()}
        if self.positions.ndim != 3 or self.positions.shape != self.velocities.shape or len(frames) > 1:
            wanted = "Positions and velocities must both be (frames, n, d), with a time and a step for each frame"
            found = f"{self.positions.shape}, {self.velocities.shape}, {self.times.shape} and {self.steps.shape}"
            raise InputError(f"{wanted}, but have the shapes {found}.")
        if len(set(steps.values())) > 1:
            raise InputError(f"The diagnostics must have the same length, but have the lengths {steps}.")

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
        """Return a frame, or a trajectory of some frames with the diagnostics of the whole run. Raises `IndexError` for
        a missing frame, and `InputError` unless k is a whole number or a slice."""
        if isinstance(k, slice):
            names = ("times", "steps", "positions", "velocities", "mass_fractions")
            arrays = {name: getattr(self, name) for name in names}
            kept: dict[str, Any] = {name: None if array is None else array[k] for name, array in arrays.items()}
            for key, of in (("others", self.others), ("quantities", self.quantities)):
                kept[key] = {name: array[k] for name, array in of.items()}
            kept["solids"] = SolidMotions({name: motion[k] for name, motion in self.solids.items()})
            stride = k.indices(len(self))[2]
            return replace(self, **kept, marks=self.marks and self.marks.chosen(kept["times"], stride))
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
        """Return a recorded quantity of the particles or the speed by ``name``, (frames, n) or (frames, n, k). A field
        of the states may also be named, (frames, ...). Raises `InputError` for any other name. `Simulation.quantity`
        computes quantities that were not recorded."""
        return chosen(self.quantities, name, fields_of(self))

    def __iter__(self) -> Iterator[Frame]:
        return (self[k] for k in range(len(self)))

    @property
    def due(self) -> NDArray[Any]:
        """Return the times (frames,) [s] of the frames in films. With ``--fps`` the times are due times, otherwise
        ``times``."""
        return self.times if self.marks is None else self.marks.due(self.times)

    @property
    def dimension(self) -> int:
        return self.positions.shape[2]

    @property
    def particles(self) -> int:
        return self.positions.shape[1]

    @property
    def iterations(self) -> NDArray[Any]:
        """Return the pressure iterations of each step (steps,) [-]. Raises `InputError` if a solver has no
        iterations."""
        return noted(self.diagnostics, "iterations")

    @property
    def density_errors(self) -> NDArray[Any]:
        """Return the mean relative density error (rho - rho_0) / rho_0 of each step (steps,) [-], with the density rho
        and the rest density rho_0. Raises `InputError` if the solver does not record the error."""
        return noted(self.diagnostics, "density_errors")

    @property
    def converged(self) -> NDArray[Any]:
        """Return for each step (steps,) True if the solver reached its tolerance."""
        return self.diagnostics["converged"]

    @property
    def not_converged(self) -> int:
        """Return the number of steps in which the solver did not reach its tolerance."""
        return int(np.count_nonzero(~self.converged))

    @property
    def last_state(self) -> RestartState:
        """Return a copy of the last state. If `Simulation.run` continues from this state, the results are exactly those
        of a run without interruption. Raises `InputError` if there is no frame."""
        if not len(self):
            raise InputError("The trajectory has no frame, but a run continues from the last frame.")
        own = {name: array.copy() for name, array in {**fields_of(self[-1]), **self.constants}.items()}
        taken = self.diagnostics.get("time_steps", np.zeros(0))[: int(self.steps[-1]) - (self.begun or 0)]
        size = float(taken[-1]) if len(taken) else 0.0
        return RestartState(own, Clock(int(self.steps[-1]), float(self.times[-1]), size), self.origin)

    def save(self, path: str | Path) -> None:
        """Write a VTKHDF file, which ParaView opens. An existing file at ``path`` is replaced.

        Raises `InputError` if there is no frame, if the name does not end in .vtkhdf or .hdf, or if the path cannot be
        written. Raises `ComputationError` if the disk is full.
        """
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
        """Write all frames with a ``writer``."""
        for frame, step in zip(self, self.steps, strict=True):
            append_frame(writer, fields_of(frame), int(step), frame.quantities, frame.time)

    def export(self, folder: str | PathLike[str], to: str, scene: Scene | str | PathLike[str] | None = None) -> Path:
        """Export the surface of the fluid, its particles and the solids to other programs; see `docs/into_blender.md`.
        Exported colours are the colours of pictures. Return the path of the file to open, or the folder of a series of
        files.

        ``to`` is "usd" for one file with time samples, or "ply", "obj", "glb" or "vtp" for one file per frame. With
        "vtp", a file ``run.pvd`` for ParaView is added. ``scene`` is the scene or the path of its file. A trajectory
        from a file needs ``scene``. The ``folder`` must be empty or missing. In 2-D no surface is exported, and z is 0.

        Raises `InputError` for an unknown format, a folder with files, a missing or wrong scene, a missing library, or
        a ``picture.colour`` of the scene that was not recorded. Raises `ComputationError` if the disk is full.
        """
        of = self.scene if scene is None else scene
        if of is None:
            why = "as a trajectory from a file does not contain its scene"
            raise InputError(f"scene is missing, but must be given, {why}.")
        return on_top("export")(self, folder, to, of)

    def to_xarray(self) -> Any:
        """Return an ``xarray.Dataset`` with units and the dimensions time, particle, space and solid.

        The data set contains position, velocity, recorded quantities, motions of solids and, with several phases,
        mass_fraction. Raises `InputError` if xarray is missing.
        """
        return on_top("labelled")(self)

    def picture(
        self, k: int = -1, *, scene: Scene | str | Path | None = None, device: str = "cpu", **settings: Any
    ) -> ShadedPicture:
        """Draw a shaded picture of frame k, (rows, columns, 3), linear from 0 to 1. A notebook displays the returned
        picture.

        The camera is placed so that the fluid is visible in every frame. The arguments ``scene``, ``device`` and
        ``settings``, and the errors, are as in `film`.

        Example: ``cortado.pictures.write_picture("last.png", trajectory.picture(width=640, height=360))``
        """
        return on_top("trajectory_picture")(self, k, scene, device, settings)

    def film(
        self, path: str | Path, *, scene: Scene | str | Path | None = None, device: str = "cpu", **settings: Any
    ) -> Film:
        """Write a film of the run, and return the film. A notebook plays the returned film. After a stop by Ctrl-C, a
        second call with the same arguments continues the film. See `docs/pictures.md`.

        Args:
            path: path that ends in .mp4, or in .webp for an animation on web pages. A .webp cannot be continued after a
                stop.
            scene: the scene of the run or the path of its file; needed if the trajectory was loaded from a file.
            device: device that traces the rays, "cpu" or "cuda:0".
            settings: keys of the scene's table [picture], such as ``colour="speed"``, ``film_speed=0.25`` or
                ``film_frames=100``; ``lines=1080`` sets width and height; ``camera=pictures.Orbit()`` moves the
                camera.

        Raises:
            SceneError: settings are invalid.
            InputError: a package is missing, or the quantity of ``colour`` was not recorded and cannot be computed.
        """
        return on_top("trajectory_film")(self, path, scene, device, settings)

    def _repr_html_(self) -> str:
        """Show the run in a notebook, as an animation with its first, middle and last frame."""
        return on_top("trajectory_page")(self)

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read the file at ``path``, written by `save` or `TrajectoryWriter`. The process that writes the trajectory
        file may still be running, or may have been killed. Raises `InputError` if the file is missing, damaged, or not
        a trajectory of Cortado."""
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
    if name not in diagnostics:
        raise InputError(f"{name} is no diagnostic of this solver, whose diagnostics are {', '.join(diagnostics)}.")
    return diagnostics[name]
