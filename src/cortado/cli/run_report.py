"""The summary that ``cortado run`` prints, and the report of the run.

The report is written twice: at once without shaded pictures, and again when the pictures are drawn.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from importlib.util import find_spec
from itertools import product
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from cortado.calls import counted
from cortado.discretise.room import TOLERANCE
from cortado.files.terminal import say
from cortado.particles.state import State
from cortado.pictures.film import coloured_by, is_out, lacking
from cortado.pictures.pages import Figures, Section, scene_view, write_report
from cortado.pictures.plots import images, particles
from cortado.pictures.run_pictures import density_errors, readings, run_pictures
from cortado.pictures.shown_solids import solid_outline
from cortado.pictures.video_files import write_video
from cortado.rollout.rollout import Rollout
from cortado.rollout.run_checks import divergence_sentence, dry_sentence, not_converged_sentence
from cortado.runs.frames import Pace, SolidMotions, common_rate, posed
from cortado.runs.run_folder import RunFolder
from cortado.runs.sensor import Readings, summary
from cortado.runs.trajectory import Trajectory
from cortado.scene.drain_tables import count_name
from cortado.scene.emitter_table import OF_OPENINGS, waits
from cortado.scene.scene import Scene, scene_in_words
from cortado.simulation import Simulation
from cortado.solvers.particles import ParticleSolver


@dataclass(frozen=True)
class Energy:
    """Energies of the fluid [J], in 2-D of a layer 1 m thick. Particles in emitters and drains do not count."""

    kinetic: float
    potential: float
    """Potential energy in the current gravity, relative to the lowest corner of the container or to the origin."""

    @property
    def total(self) -> float:
        return self.kinetic + self.potential

    @classmethod
    def of(cls, simulation: Simulation, rollout: Rollout, state: State, step: int) -> "Energy":
        """Compute the energies of a state, with the gravity of the given time step, counted from 0."""
        names, out = ("positions", "velocities", "reference_density"), _out(simulation, state)
        fields = {name: array[out] for name, array in state.numpy(simulation.dimension, only=names).items()}
        masses = simulation.lattice.cell * fields["reference_density"].astype(np.float64)
        positions, velocities = (fields[name].astype(np.float64) for name in ("positions", "velocities"))
        gravity = rollout.parameters["gravity"].numpy()[0, step, : simulation.dimension].astype(np.float64)
        ends = simulation.scene.container.extent()
        corners = np.zeros((1, simulation.dimension)) if ends is None else list(product(*zip(*ends, strict=True)))
        lowest = float((np.asarray(corners) @ gravity).max())
        kinetic = 0.5 * float(masses @ (velocities**2).sum(axis=1))
        return cls(kinetic, potential=float(masses @ (lowest - positions @ gravity)))


class RunSummary:
    def __init__(
        self, simulation: Simulation, rollout: Rollout, last: State, seconds: float, readings: Mapping[str, Readings]
    ):
        """``seconds`` is the computing time of this process."""
        solver, taken, gravity = rollout.solver, rollout.taken, rollout.parameters["gravity"].numpy()
        self.steps, self.seconds, self.readings = taken, seconds, readings
        self.computed = taken - rollout.progress.step  # without the steps of an earlier process
        self.time = simulated(rollout)
        self.sizes = sizes_in_words(rollout)
        self.first = Energy.of(simulation, rollout, rollout.initial, 0)
        self.last = Energy.of(simulation, rollout, last, taken - 1)
        self.turned = bool(np.ptp(gravity[0, :taken], axis=0).any())
        """True if gravity changed during the run. Potential energies before and after a change are not comparable."""
        self.densities: tuple[float, float] | None = None
        """Least and greatest density of the last state [kg/m3], or None for solvers without particles."""
        if isinstance(solver, ParticleSolver):
            found = solver.densities(last, rollout.parameters, taken - 1)[_out(simulation, last)]
            self.densities = float(found.min()), float(found.max())
        scene, free = simulation.scene, simulation.free_particles
        self.balance = Balance.of(scene, *map(_others, (rollout.initial, last))) if scene.drain else None
        self.spilt = 0
        """Number of particles outside an open container, without particles from emitters."""
        if np.isfinite(scene.container.region(simulation.dimension).rim):
            positions = last.numpy(simulation.dimension, only=["positions"])["positions"]
            outside = ~scene.container.contains(positions[:free], TOLERANCE * scene.discretisation.spacing)
            self.spilt = int((outside & _out(simulation, last)[:free]).sum())
        self.particles, self.masses = free, simulation.masses

    @property
    def milliseconds(self) -> float:
        return 1e3 * self.seconds / max(self.computed, 1)

    def for_machines(self) -> dict[str, Any]:
        least, greatest = self.densities or (None, None)
        return {
            "energy": {"first": vars(self.first), "last": vars(self.last)},
            "mass": {"given": self.masses.given, "asked": self.masses.asked},
            "density": {"least": least, "greatest": greatest},
            "spilt": self.spilt,
            **({} if self.balance is None else {"balance": self.balance.for_machines()}),
            **({"sensors": summary(self.readings)} if self.readings else {}),
        }

    def rows(self) -> list[tuple[object, ...]]:
        energies = [
            (f"{kind} energy, {when}", f"{getattr(energy, kind):.4g}", "J")
            for when, energy in (("at the start", self.first), ("at the end", self.last))
            for kind in ("kinetic", "potential", "total")
        ]
        densities = zip(("least", "greatest"), self.densities or (), strict=False)
        computed = "all" if self.computed == self.steps else f"the last {self.computed}"
        return [
            ("steps", self.steps, ""),
            ("simulated time", f"{self.time:.4g}", "s"),
            ("time that a step took", f"{self.milliseconds:.3g}", "ms"),
            (f"time that {computed} steps took", f"{self.seconds:.3g}", "s"),
            *energies,
            *((f"fluid at the start: {words}", "", "") for words in self.masses.off.values()),
            *([] if self.balance is None else self.balance.rows()),
            *([("particles that left the cup over its rim", self.spilt, "")] if self.spilt else []),
            *((f"{which} density at the end", f"{density:.4g}", "kg/m³") for which, density in densities),
            *(
                (f"{name} {column}, {what}".replace("_", " "), f"{value:.4g}", self.readings[name].units[column])
                for name, columns in summary(self.readings).items()
                for column, found in columns.items()
                for what, value in found.items()
            ),
        ]

    def __str__(self) -> str:
        last = self.last
        last_ones = "" if self.computed == self.steps else f", the last {self.computed} of them"
        took = f"{last_ones} in {self.seconds:.3g} s, {self.milliseconds:.3g} ms a step"
        text = f"{self.steps} steps of {self.sizes}{took if self.computed else ', which were there already'}; energy "
        text += f"{last.total:.4g} J (kinetic {last.kinetic:.3g}, potential {last.potential:.3g}), at the start "
        text += f"{self.first.total:.4g} J"
        if self.turned:
            text += " in the gravity of that time"
        if self.densities is not None:
            text += f"; density {self.densities[0]:.4g} to {self.densities[1]:.4g} kg/m3"
        if self.spilt:
            text += f". Over the rim of the cup went {self.spilt} of {self.particles} particles"
        if self.balance is not None:
            text += f". {self.balance}"
        if self.masses.off:
            text += f". The fluid began with {' and '.join(self.masses.off.values())}"
        return f"{text}."


def _out(simulation: Simulation, state: State) -> NDArray[np.bool_]:
    return is_out(simulation.scene, _others(state), len(simulation.positions))


def _others(state: State) -> dict[str, NDArray[Any]]:
    return {name: state[name].numpy() for name in state.names if name.endswith(OF_OPENINGS)}


def simulated(rollout: Rollout) -> float:
    clock, size = rollout.clocks[0], float(rollout.time_steps[0])
    return clock.after(rollout.taken, size).time - clock.time


def sizes_in_words(rollout: Rollout) -> str:
    chosen = rollout.step_sizes.diagnostics(rollout.taken).get("time_steps")
    if chosen is None or not len(chosen):
        return f"{float(rollout.time_steps[0]):g} s"
    return f"{chosen.min():.3g} to {chosen.max():.3g} s"


def write_run_report(
    simulation: Simulation,
    rollout: Rollout,
    folder: RunFolder,
    told: Section,
    pictures: bool,
    read: Mapping[str, Readings] | None = None,
) -> None:
    """``told`` is the section with the results of the run."""
    scene, trajectory, step = simulation.scene, Trajectory.load(folder.trajectory), float(rollout.time_steps[0])
    length = f"{rollout.steps} steps of {step:g} s, {rollout.steps * step:.4g} s of fluid"
    if scene.solver.chooses:
        length = f"{rollout.taken} steps of {sizes_in_words(rollout)}, {simulated(rollout):.4g} s of fluid"
    wall = f" Walls are made of {len(simulation.walls)} particles." if len(simulation.walls) else ""
    substeps = f" Each step has {rollout.substeps} substeps of diffusion." if rollout.substeps else ""
    where, dry = f"{simulation.precision.name} on {simulation.device}", dry_sentence(scene, rollout)
    question = f"How does the fluid move? The scene: {scene_in_words(scene, simulation.particles)}"
    lasts = [f"{dry[0].upper()}{dry[1:]}"] if dry else []
    asked = Section("What was asked", [question, f"{length}, in {where}.{wall}{substeps}", *lasts])
    view = Section("To turn and to play", view=scene_view(scene, {scene.name: list(trajectory)}, trajectory.times))
    figures, solver = _figures(simulation, trajectory, folder.figures), _solver(rollout, trajectory, scene, folder)
    sensors: list[Section] = []
    if read:
        told_of = f"The sensors of the scene, read in every step; the numbers are in {folder.sensors.name}."
        curves = readings(read, folder.figures / "sensors.png")
        sensors = [Section("Sensors", [told_of], figures=[("What the sensors read.", curves)])]

    def write(shaded: Figures) -> None:
        films = [(caption, path) for caption, path in shaded if Path(path).suffix == ".mp4"]
        stills = [pair for pair in shaded if pair not in films]
        looks = Section("What it looks like", figures=films)
        sections = [asked, looks, view, told, *sensors, Section("Pictures", figures=[*stills, *figures]), solver]
        write_report(folder, scene.name, sections)

    write([])
    missing = lacking(scene) if pictures else None
    if missing:
        say(missing)
    elif pictures:
        values = coloured_by(scene, trajectory, lambda: simulation)
        write(run_pictures(scene, trajectory, folder.figures, simulation.device, values))


def _figures(simulation: Simulation, trajectory: Trajectory, folder: Path) -> Figures:
    scene, none = simulation.scene, np.zeros(trajectory.particles)
    shown = sorted({0, len(trajectory) // 2, len(trajectory) - 1})
    frames, motions = [trajectory[k] for k in shown], SolidMotions.of(trajectory.others, scene.dimension)
    left = [np.ravel(frame.others.get("drained", none)) == 0.0 for frame in frames]
    titles, pairs = [f"t = {frame.time:.3f} s" for frame in frames], list(zip(frames, left, strict=True))
    speeds = [np.linalg.norm(frame.velocities[here], axis=1) for frame, here in pairs]
    lines, sets = [solid_outline(posed(scene, motions, k)) for k in shown], [frame.positions[on] for frame, on in pairs]
    look: Any = {"colours": speeds, "colour_label": "speed [m/s]", "lines": lines}
    path = particles(sets, titles, folder / "particles.png", container=scene.container.extent(), **look)
    along = ", seen along the third axis" * (scene.dimension == 3)
    figures: Figures = [(f"The fluid at the start, half-way and at the end{along}.", path)]
    if scene.render is None:
        return figures
    renderer = simulation.renderer()

    def image(frame: int) -> np.ndarray:
        return renderer.render(trajectory[frame])

    path = images(map(image, shown), titles, folder / "rendered.png")
    figures.append(("The same, rendered.", path))
    if len(trajectory.times) > 1 and find_spec("av"):
        pace = Pace.of(trajectory.due, rate=common_rate([trajectory.marks]))
        path = write_video(folder / "run.mp4", map(image, pace.frames), pace.frames_per_second)
        figures.append((f"The same, {pace.in_words}.", path))
    return figures


def _solver(rollout: Rollout, trajectory: Trajectory, scene: Scene, folder: RunFolder) -> Section:
    figures: Figures = []
    if len(trajectory.converged) and "density_errors" in trajectory.diagnostics and scene.forces.pressure:
        path = folder.figures / "density_errors.png"
        density_errors(trajectory, path, tolerance=getattr(scene.solver, "density_tolerance", None))
        figures.append(("Average density error of each step, and the tolerance asked.", path))
    converged = rollout.diagnostics["converged"]
    if not len(converged):
        return Section("The solver", figures=figures)
    told = "The pressure converged in every step." if converged.all() else not_converged_sentence(converged, scene)
    torn = divergence_sentence(rollout.diagnostics, scene)
    return Section("The solver", [told, *([torn] if torn else [])], figures=figures)


@dataclass(frozen=True)
class Balance:
    """Numbers of particles that entered and left the fluid: ``first`` + ``came`` = ``last`` + the sum of ``went``."""

    first: int
    came: int
    went: Mapping[str, int]
    last: int

    @classmethod
    def of(cls, scene: Scene, first: Mapping[str, Any], last: Mapping[str, Any]) -> Self:
        """Count the particles from `Frame.others` of the first and the last frame."""
        counts = {drain.name: count_name(drain.name) for drain in scene.drain}
        went = {name: int(np.ravel(last[key])[0] - np.ravel(first[key])[0]) for name, key in counts.items()}
        states = ((np.ravel(at["drained"]), at) for at in (first, last))
        inside, left = (int(((drained == 0.0) & ~waits(scene, at, drained.size)).sum()) for drained, at in states)
        return cls(inside, left - inside + sum(went.values()), went, left)

    def for_machines(self) -> dict[str, Any]:
        return {"first": self.first, "in": self.came, "out": dict(self.went), "last": self.last}

    def rows(self) -> list[tuple[str, int, str]]:
        gone = [(f"particles that went into {name}", count, "") for name, count in self.went.items()]
        came = [("particles that came out of emitters", self.came, "")]
        return [("particles at the start", self.first, ""), *came, *gone, ("particles at the end", self.last, "")]

    def __str__(self) -> str:
        gone = " and ".join(f"{count} went into {name}" for name, count in self.went.items())
        return f"Of {counted(self.first, 'particle')} and {self.came} that came in {gone}, {self.last} are left"
