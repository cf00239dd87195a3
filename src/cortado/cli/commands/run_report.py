"""The report of ``cortado run``, at first without shaded pictures, which take long, then with them."""

from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from cortado.cli.commands.run_summary import simulated, sizes_in_words
from cortado.files.image_encoding import write_video
from cortado.files.terminal import say
from cortado.pictures.film import lacking
from cortado.pictures.plots import images, particles
from cortado.pictures.report import Figures, Section, write_report
from cortado.pictures.run_pictures import run_pictures, trajectory_view
from cortado.pictures.run_plots import density_errors, readings
from cortado.pictures.shown_run import coloured_by
from cortado.pictures.shown_solids import solid_outline
from cortado.rollout.outcome import divergence_sentence, dry_sentence, not_converged_sentence
from cortado.rollout.rollout import Rollout
from cortado.runs.frame_file import common_rate
from cortado.runs.pace import Pace
from cortado.runs.run_folder import RunFolder
from cortado.runs.sensors.readings import Readings
from cortado.runs.solid_motion import posed, solid_motions
from cortado.runs.trajectory import Trajectory
from cortado.scene.scene import Scene, scene_in_words
from cortado.simulation import Simulation


def write_run_report(
    simulation: Simulation,
    rollout: Rollout,
    folder: RunFolder,
    told: Section,
    pictures: bool,
    read: Mapping[str, Readings] | None = None,
) -> None:
    """Write the report, and shaded ``pictures`` too if wished; ``told``: what came out; ``read``: by sensors."""
    scene, trajectory = simulation.scene, Trajectory.load(folder.trajectory)
    asked = Section("What was asked", _asked(simulation, rollout))
    view = Section("To turn and to play", view=trajectory_view(scene, trajectory))
    figures, solver = _figures(simulation, trajectory, folder.figures), _solver(rollout, trajectory, scene, folder)

    sensors = [_sensors(read, folder)] if read else []

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
    """Plain ones, of the first, the middle and the last frame."""
    scene = simulation.scene
    shown = sorted({0, len(trajectory.times) // 2, len(trajectory.times) - 1})
    titles = [f"t = {trajectory.times[frame]:.3f} s" for frame in shown]
    motions = solid_motions(scene, trajectory.others)
    path = particles(
        [trajectory.positions[frame] for frame in shown],
        titles,
        folder / "particles.png",
        colours=[np.linalg.norm(trajectory.velocities[frame], axis=1) for frame in shown],
        colour_label="speed [m/s]",
        container=scene.container.extent(),
        lines=[solid_outline(posed(scene, motions, frame)) for frame in shown],
    )
    along = ", seen along the third axis" * (scene.dimension == 3)
    figures: Figures = [(f"The fluid at the start, half-way and at the end{along}.", path)]
    return figures if scene.render is None else figures + _rendered(simulation, trajectory, shown, folder)


def _rendered(simulation: Simulation, trajectory: Trajectory, shown: list[int], folder: Path) -> Figures:
    """Pictures of a scene that says how it is rendered, and a video where it can be written."""
    renderer = simulation.renderer()

    def image(frame: int) -> np.ndarray:
        return renderer.render(trajectory[frame])

    titles = [f"t = {trajectory.times[frame]:.3f} s" for frame in shown]
    path = images(map(image, shown), titles, folder / "rendered.png")
    figures: Figures = [("The same, rendered.", path)]
    if len(trajectory.times) > 1 and find_spec("av"):
        pace = Pace.of(trajectory.due, rate=common_rate([trajectory.marks]))
        path = write_video(folder / "run.mp4", map(image, pace.frames), pace.frames_per_second)
        figures.append((f"The same, {pace.in_words}.", path))
    return figures


def _sensors(read: Mapping[str, Readings], folder: RunFolder) -> Section:
    """What sensors have read."""
    path = readings(read, folder.figures / "sensors.png")
    told = f"The sensors of the scene, read in every step; the numbers are in {folder.sensors.name}."
    return Section("Sensors", [told], figures=[("What the sensors read.", path)])


def _asked(simulation: Simulation, rollout: Rollout) -> list[str]:
    """The run in words."""
    scene = simulation.scene
    step = float(rollout.time_steps[0])
    length = f"{rollout.steps} steps of {step:g} s, {rollout.steps * step:.4g} s of fluid"
    if scene.solver.chooses:
        length = f"{rollout.taken} steps of {sizes_in_words(rollout)}, {simulated(rollout):.4g} s of fluid"
    wall = f" Walls are made of {len(simulation.walls)} particles." if len(simulation.walls) else ""
    substeps = f" Each step has {rollout.substeps} substeps of diffusion." if rollout.substeps else ""
    where = f"{simulation.precision.name} on {simulation.device}"
    question = f"How does the fluid move? The scene: {scene_in_words(scene, simulation.particles)}"
    dry = dry_sentence(scene, rollout)
    told = [f"{dry[0].upper()}{dry[1:]}"] if dry else []
    return [question, f"{length}, in {where}.{wall}{substeps}", *told]


def _solver(rollout: Rollout, trajectory: Trajectory, scene: Scene, folder: RunFolder) -> Section:
    """Whether steps converged, and their errors of density."""
    figures: Figures = []
    if len(trajectory.converged) and "density_errors" in trajectory.diagnostics and scene.forces.pressure:
        path = folder.figures / "density_errors.png"
        density_errors(trajectory, path, tolerance=getattr(scene.solver, "density_tolerance", None))
        figures.append(("Average density error of each step, and the tolerance asked.", path))
    converged = rollout.diagnostics["converged"]
    if not len(converged):
        return Section("The solver", figures=figures)
    every = "The pressure converged in every step."
    told = [every if converged.all() else not_converged_sentence(converged, scene)]
    torn = divergence_sentence(rollout.diagnostics, scene)
    return Section("The solver", [*told, torn] if torn else told, figures=figures)
