"""``cortado run``: a scene, forward."""

import time
import warnings
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from cortado.commands.run_summary import RunSummary
from cortado.device.compiling import compile_ahead
from cortado.device.memory import frame_parts, require
from cortado.device.state import State
from cortado.errors import CortadoWarning, DivergedError
from cortado.figures import density_errors, images, particles
from cortado.io.folder_lock import locked
from cortado.io.interruption import keeping
from cortado.io.progress import announce, track
from cortado.io.report import Figures, Section, write_report
from cortado.io.run_folder import RunFolder
from cortado.io.terminal import say
from cortado.io.trajectory import Trajectory, append_frame, frame_writer
from cortado.io.video import MOST_FRAMES, write_video
from cortado.rollout import Rollout
from cortado.scene.in_words import scene_in_words
from cortado.scene.scene import Scene, load_scene
from cortado.shading.film import lacking, run_pictures
from cortado.shading.scene_view import trajectory_view
from cortado.simulation import Simulation, check_steps, not_converged_sentence


def run_scene(
    scene_file: Path,
    steps: int,
    out: Path,
    overrides: list[str],
    device: str,
    precision: str,
    record_every: int,
    overwrite: bool,
    command: list[str],
    pictures: bool = False,
) -> str:
    """Run a scene, write its folder, shaded ``pictures`` too if wished, and return a sentence that says where the
    results are."""
    scene = load_scene(scene_file, overrides)
    simulation = Simulation(scene, device, precision)
    rollout = simulation.rollout(check_steps(steps))
    numbers = simulation.numbers_in_frame(components=3)  # as in the file
    frames = frame_parts(2 + steps // record_every, numbers, simulation.precision.bytes)
    require(frames, "take a larger --record-every or fewer steps")
    noted: dict[str, Any] = {"device": str(simulation.device), "settings": run_settings(steps, precision, record_every)}
    with locked(out):
        folder = RunFolder.create(out, scene.to_json(), command, overwrite=overwrite, **noted)
        with keeping(lambda: f"the frames so far are in {folder.trajectory}" if folder.trajectory.exists() else ""):
            _compute(simulation, rollout, folder, record_every, pictures)
    converged = rollout.diagnostics["converged"]
    if not converged.all():
        warnings.warn(not_converged_sentence(converged, scene), CortadoWarning, stacklevel=2)
    return f"The results are in {folder.path}; open report.html, or trajectory.vtkhdf in ParaView."


def run_settings(steps: int, precision: str, record_every: int) -> dict[str, Any]:
    """What tells one run of a scene from another."""
    return {"steps": steps, "precision": precision, "record_every": record_every}


def _compute(simulation: Simulation, rollout: Rollout, folder: RunFolder, record_every: int, pictures: bool) -> None:
    """Run, say how it went, and fill the folder, also where the run diverges."""
    compile_ahead(rollout.solver, simulation.device)
    begun = time.perf_counter()
    try:
        last = _write_trajectory(simulation, rollout, folder, record_every)
    except DivergedError as error:
        _write_report(simulation, rollout, folder, Section("What came out", failures=[error]), pictures)
        told = error.with_advice(f"{error.advice}; the frames so far are in {folder.path}")
        folder.write_result(**_for_machines(simulation, rollout), failures=[str(told)])
        raise told from error
    summary = RunSummary.of(simulation, rollout, last, time.perf_counter() - begun)
    announce(str(summary))
    numbers = Section("In numbers", head=("", "value", "unit"), rows=summary.rows())
    _write_report(simulation, rollout, folder, numbers, pictures)
    folder.write_result(**_for_machines(simulation, rollout), **summary.for_machines(), failures=[])


def _for_machines(simulation: Simulation, rollout: Rollout) -> dict[str, Any]:
    """How a run went, by names: of the steps that it came to, the mean of what the solver notes, and the greatest."""
    noted = {name: np.asarray(values, dtype=np.float64) for name, values in rollout.diagnostics.items() if len(values)}
    return {
        "particles": simulation.particles,
        "steps": len(rollout.diagnostics["converged"]),
        "mean": {name: values.mean() for name, values in noted.items()},
        "greatest": {name: values.max() for name, values in noted.items()},
    }


def _write_trajectory(simulation: Simulation, rollout: Rollout, folder: RunFolder, record_every: int) -> State:
    """Run, with a frame for every so many steps; returns the last state."""
    steps = rollout.steps
    recorded = np.array([*range(0, steps, record_every), steps])
    times, first = rollout.clocks[0].times(recorded, rollout.time_steps[0]), simulation.frame(rollout.initial)
    constants = simulation.constants(rollout)
    with (
        frame_writer(folder.trajectory, times, first, constants, steps, rollout.diagnostics) as writer,
        track(steps, "run") as advance,
    ):

        def observe(step: int, state: State) -> None:
            if step % record_every == 0 or step == steps:
                append_frame(writer, simulation.frame(state), step)
            advance()

        append_frame(writer, first, 0)
        try:
            return rollout.forward(observe, keep=False)
        finally:
            found = rollout.diagnostics
            writer.append_steps(**found)
            for step, row in enumerate(zip(*found.values(), strict=True), 1):
                folder.append_metrics(step=step, **dict(zip(found, row, strict=True)))


def _rendered(simulation: Simulation, trajectory: Trajectory, shown: list[int], folder: Path) -> Figures:
    """Pictures of a scene that says how it is rendered, and a video where it can be written."""
    renderer = simulation.renderer()

    def image(frame: int) -> np.ndarray:
        return renderer.render(trajectory[frame])

    titles = [f"t = {trajectory.times[frame]:.3f} s" for frame in shown]
    path = images(map(image, shown), titles, folder / "rendered.png")
    figures: Figures = [("The same, rendered.", path)]
    if len(trajectory.times) > 1 and find_spec("av"):
        frames = range(0, len(trajectory.times), -(-len(trajectory.times) // MOST_FRAMES))
        figures.append(("The same, in motion.", write_video(folder / "run.mp4", map(image, frames), 20)))
    return figures


def _shaded(simulation: Simulation, trajectory: Trajectory, folder: Path) -> Figures:
    """Shaded pictures and a film; none, and a sentence, where a package is missing."""
    missing = lacking(simulation.scene)
    if missing:
        say(missing)
        return []
    return run_pictures(simulation.scene, trajectory, folder, simulation.device)


def _write_report(simulation: Simulation, rollout: Rollout, folder: RunFolder, told: Section, pictures: bool) -> None:
    """The report with its figures, shaded ``pictures`` among them if wished; ``told``: what came out."""
    scene = simulation.scene
    trajectory = Trajectory.load(folder.trajectory)
    shown = sorted({0, len(trajectory.times) // 2, len(trajectory.times) - 1})
    speeds = [np.linalg.norm(trajectory.velocities[frame], axis=1) for frame in shown]
    shaded = _shaded(simulation, trajectory, folder.figures) if pictures else []
    figures: Figures = [
        (
            f"The fluid at the start, half-way and at the end{', seen along the third axis' * (scene.dimension == 3)}.",
            particles(
                [trajectory.positions[frame] for frame in shown],
                [f"t = {trajectory.times[frame]:.3f} s" for frame in shown],
                folder.figures / "particles.png",
                colours=speeds,
                colour_label="speed [m/s]",
                container=scene.container.extent(),
            ),
        )
    ]
    if scene.render is not None:
        figures += _rendered(simulation, trajectory, shown, folder.figures)
    solver: Figures = []
    if len(trajectory.converged) and "density_errors" in trajectory.diagnostics and scene.forces.pressure:
        path = folder.figures / "density_errors.png"
        density_errors(trajectory, path, tolerance=scene.solver.density_tolerance)
        solver.append(("Average density error of each step, and the tolerance asked.", path))
    films = [(caption, path) for caption, path in shaded if Path(path).suffix == ".mp4"]
    sections = [
        Section("What was asked", _asked(simulation, rollout)),
        Section("What it looks like", figures=films),
        Section("To turn and to play", view=trajectory_view(scene, trajectory)),
        told,
        Section("Pictures", figures=[*(pair for pair in shaded if pair not in films), *figures]),
        Section("The solver", _converged(rollout, scene), figures=solver),
    ]
    write_report(folder, scene.name, sections)


def _asked(simulation: Simulation, rollout: Rollout) -> list[str]:
    """The run in words."""
    scene, step = simulation.scene, float(rollout.time_steps[0])
    length = f"{rollout.steps} steps of {step:g} s, {rollout.steps * step:.4g} s of fluid"
    wall = f" Walls are made of {len(simulation.walls)} particles." if len(simulation.walls) else ""
    substeps = f" Each step has {rollout.substeps} substeps of diffusion." if rollout.substeps else ""
    where = f"{simulation.precision.name} on {simulation.device}"
    question = f"How do they move: {scene_in_words(scene, simulation.particles)}"
    return [question, f"{length}, in {where}.{wall}{substeps}"]


def _converged(rollout: Rollout, scene: Scene) -> list[str]:
    """Whether steps did."""
    converged = rollout.diagnostics["converged"]
    if not len(converged):
        return []
    if converged.all():
        return ["The pressure converged in every step."]
    return [not_converged_sentence(converged, scene)]
