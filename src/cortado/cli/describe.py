"""The commands ``cortado describe``, for a scene and the cost of its run, and ``cortado gradients check``."""

import json
import math
import time
from collections import Counter
from collections.abc import Sequence
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from cortado.arrays import check_steps
from cortado.calls import counted, point_in_words
from cortado.certificate import certify
from cortado.cli.run import RunRequest
from cortado.device.threads import frame_parts, gradient_parts, simulation_parts, step_parts
from cortado.discretise.shapes import EXCESS
from cortado.errors import ComputationError, DivergedError, InputError, shown
from cortado.files.disk import make_folder, write_atomically
from cortado.files.terminal import note, tell, timed_note
from cortado.losses import CentreOfMass, FinalPositions, Image, Loss
from cortado.optimisation.task_files import load_task, task_in_words
from cortado.pictures.image_files import write_picture
from cortado.pictures.painter import colours_of, painter, plan
from cortado.problem import Problem
from cortado.rollout.checkpoints import MEMORY_BUDGET
from cortado.rollout.parameter_space import steps_of_run
from cortado.rollout.rollout import Rollout
from cortado.rollout.scene_parameters import SceneParameters
from cortado.rollout.step_bounds import ROOM, scheduled_bounds
from cortado.runs.frames import Pace
from cortado.runs.recording import FrameChoice
from cortado.scene.appearance import Picture
from cortado.scene.emitter_table import EmitterTable
from cortado.scene.scene import load_scene, overrides_of, read_toml
from cortado.scene.stability import chosen_limits, is_implicit, stability_limits, viscous_limit
from cortado.simulation import Simulation
from cortado.solvers.particles import ParticleSolver
from cortado.watching import Watch

FIRST_STEPS, MOST_STEPS, ENOUGH = 4, 100, 0.5
"""Least and greatest number of timed steps, and the computing time after which no more steps are timed [s]."""
SAME = 1e-6
"""Relative tolerance for time steps that are rounded to float32."""


def measured_speed(simulation: Simulation) -> tuple[int, float]:
    """Return the number of timed steps and the computing time per step [s]."""
    steps = FIRST_STEPS
    while True:
        rollout = simulation.rollout(steps)
        run = partial(Watch(simulation, rollout).run, lambda _: False, lambda _, state: None)
        for _ in range(2):  # the first time compiles, the second captures graphs
            run()
        begun = time.perf_counter()
        run()
        wp.synchronize_device(simulation.device)
        seconds = (time.perf_counter() - begun) / steps
        if steps == MOST_STEPS or steps * seconds > 0.5 * ENOUGH:
            return steps, seconds
        steps = min(math.ceil(ENOUGH / seconds), MOST_STEPS)


class RunLength:
    def __init__(self, simulation: Simulation, steps: int | None, time: float | None, choice: FrameChoice):
        solver, picture = simulation.scene.solver, simulation.scene.picture or Picture()
        self.is_about = solver.chooses and time is not None
        self.steps = steps_of_run(simulation, steps, time, {}) // (ROOM if self.is_about else 1)
        """Number of steps. The number is an estimate if the solver chooses the steps of a timed run."""
        self.time = time = time if solver.chooses else self.steps * float(solver.time_step)
        """Simulated time [s]. The time is None for a given number of steps whose lengths the solver chooses."""
        self.frames = frames = choice.count(self.steps, time)
        """Number of recorded frames, including the first and last state, or None if it is unknown."""
        self.trajectory: float | None = None
        """Size of the recorded frames on disk [bytes]."""
        if frames is not None:
            numbers = simulation.numbers_in_frame(components=3)  # as in the file
            size = sum(frame_parts(frames, numbers, simulation.precision.bytes).values())
            self.trajectory = size + (28e3 + 24.0 * simulation.particles + 50.0 * self.steps)  # headers and diagnostics
        self.film: Pace | None = None
        if frames is not None and time is not None and 1 < frames <= 1_000_000 and picture.film_frames != 0:
            self.film = Pace.of(np.linspace(0.0, time, frames), picture.film_frames, picture.film_speed, choice.rate)


def describe_scene(scene_file: Path, asked: RunRequest, picture: Path | None, as_json: bool) -> str:
    if picture is not None and picture.suffix.lower() != ".png":
        raise InputError(f"--picture is {str(picture)!r}, but must be the name of a PNG file, such as first.png.")
    is_task, steps, time = "optimise" in read_toml(scene_file), asked.steps, asked.time
    of_search = overrides_of(asked.overrides, ("problem", "optimise")) if is_task else []
    scene = load_scene(scene_file, [one for one in asked.overrides if one not in of_search]).lasting(time, steps)
    count = sum(body.count(scene.discretisation.spacing) for body in (*scene.fluid, *scene.emitter))
    with timed_note(f"About {count:,.0f} particles are made") if count > 1e6 else nullcontext():
        simulation = Simulation(scene, asked.device, asked.precision)
    drawn = {}
    if picture is not None:
        make_folder(picture.parent)
        free = slice(simulation.free_particles)
        colours = colours_of(scene, simulation.mass_fractions, simulation.particles)[free]
        write_picture(picture, plan(scene, simulation.positions[free], colours, simulation.device))
        drawn = {"picture": str(picture.absolute())}
    note("Some steps and pictures are timed.")
    found = _described(simulation, length := RunLength(simulation, steps, time, asked.frames))
    for quality in ("traced", "quick")[: 0 if length.film is None else scene.dimension - 1]:
        found[f"{quality}_picture_seconds".removeprefix("traced_")] = seconds_of_picture(simulation, quality)
    found |= {"search": task_in_words(load_task(scene_file, asked.overrides))} if is_task else {}
    found |= drawn
    return json.dumps(found, indent=2) if as_json else _as_text(found, length)


def _described(simulation: Simulation, length: RunLength) -> dict[str, Any]:
    scene = simulation.scene
    of_phase = Counter(np.argmax(simulation.mass_fractions, axis=1).tolist())
    (size, limits, chosen_by), ends = _time_step(simulation), scene.container.extent()
    masses, spacing, film = simulation.masses, scene.discretisation.spacing, length.film
    columns = [emitter.particles(spacing) for emitter in scene.emitter]  # what they hold in reserve is not to be seen
    fluid = np.concatenate([simulation.positions[: simulation.free_particles], *columns])
    viscosity, limit = str(scene.forces.viscosity), viscous_limit(scene, {})
    if viscosity == "stress" and math.isfinite(limit):
        when = "implicit, at the end of a step" if is_implicit(scene) else "explicit, at the start of a step"
        viscosity = f"stress, {when}; an explicit one bears steps of {limit:.3g} s"
    found: dict[str, Any] = {
        "name": scene.name,
        "dimension": scene.dimension,
        "particles": simulation.particles,
        "particles_of_phase": {phase.name: of_phase[k] for k, phase in enumerate(scene.phase)},
        "particles_in_emitter": simulation.particles - simulation.free_particles,
        "emitters": [of_emitter(emitter, spacing) for emitter in scene.emitter],
        "wall_particles": len(simulation.walls),
        "fluid_size_m": (np.ptp(fluid, axis=0) + spacing).tolist(),
        "container_size_m": None if ends is None else (ends[1] - ends[0]).tolist(),
        "mass_of_phase_kg": masses.given,
        "mass_asked_of_phase_kg": masses.asked,
        "mass_in_words": [masses.off.get(name, f"{mass:.3g} kg of {name}") for name, mass in masses.given.items()],
        "gravity_m_s2": list(scene.forces.gravity),
        "spacing_m": spacing,
        "time_step_s": size,
        "time_step_chosen_by": chosen_by,
        "time_step_limits_s": {name: limit if math.isfinite(limit) else None for name, limit in limits.items()},
        "viscosity": viscosity,
        "scheduled_until_s": {name: course.times[-1] for name, course in scene.schedule.courses.items()},
        "device": str(simulation.device),
        "precision": simulation.precision.name,
        "steps": length.steps,
        "steps_are_estimated": length.is_about,
        "simulated_time_s": length.time,
        "frames": length.frames,
        "trajectory_bytes": length.trajectory,
        "film_frames": None if film is None else len(film.frames),
        **({} if film is None else {"film_seconds": film.seconds, "film_speed": film.speed}),
        "memory_bytes": None,
        "gradient_memory_bytes": None,
    }
    if isinstance(simulation.solver, ParticleSolver):
        rollout = Rollout(simulation.solver, 1)
        forward, backward = estimated_bytes(simulation, rollout)
        own = sum(step_parts(length.steps, simulation.precision.bytes).values())
        checkpoints = min(length.steps * sum(array.capacity for array in rollout.initial.arrays()), MEMORY_BUDGET)
        found |= {"memory_bytes": forward + own, "gradient_memory_bytes": backward + own + checkpoints}
    try:
        measured, seconds = measured_speed(simulation)
    except DivergedError as error:
        return {**found, "diverged": str(error)}
    taken = {"milliseconds_per_step": 1e3 * seconds, "measured_steps": measured}
    return {**found, **taken, "expected_seconds": length.steps * seconds, "sensors": len(scene.sensor)}


def _time_step(simulation: Simulation) -> tuple[float, dict[str, float], str | None]:
    """Return the first time step [s], the limits of the time step [s] by name, and the name of the smallest limit."""
    scene = simulation.scene
    if scene.solver.time_step != "auto":
        return scene.solver.time_step, stability_limits(scene), None
    first = simulation.rollout(1).step_sizes.of_step(0)
    assert first is not None
    size, limits = float(first[0]), chosen_limits(scene)
    scheduled = scheduled_bounds(scene, {}, SceneParameters(simulation, 1))
    limits |= {name: bound(0.0) for name, bound in scheduled.items()}
    if size < min(limits.values()) * (1.0 - SAME):
        limits["speed"] = size
    return size, limits, min(limits, key=lambda name: limits[name])


def of_emitter(emitter: EmitterTable, spacing: float) -> dict[str, Any]:
    dry, areas = emitter.dry_after(spacing), {"area": emitter.area(spacing), "area_asked": emitter.asked_area()}
    known = {"name": emitter.name, "fed_by": list(emitter.fed_by), "speed_m_s": emitter.speed(spacing), **areas}
    return {**known, "runs_dry_at_s": dry if math.isfinite(dry) else None}


def seconds_of_picture(simulation: Simulation, quality: str) -> float | None:
    """Measure the time to draw the initial state on all cores [s]. Returns None if the picture shows no fluid."""
    scene, positions = simulation.scene, simulation.positions[: simulation.free_particles or None]
    scene = scene.model_copy(update={"picture": (scene.picture or Picture()).model_copy(update={"quality": quality})})
    colours = colours_of(scene, simulation.mass_fractions, simulation.particles)[: len(positions)]
    draws = painter(scene, positions, simulation.device)
    try:
        draws.image(positions, colours)  # compiles, and draws what does not change
        begun = time.perf_counter()
        draws.image(positions, colours)
        return time.perf_counter() - begun
    except ComputationError:
        return None


def estimated_bytes(simulation: Simulation, rollout: Rollout) -> tuple[float, float]:
    """Estimate the memory of a run, and of a run with its gradient and a checkpoint of every step [bytes]."""
    particles, real, solver = simulation.particles, simulation.precision.bytes, simulation.solver
    assert isinstance(solver, ParticleSolver)
    forward = sum(simulation_parts(particles, len(simulation.walls), solver.search.capacity, real).values())
    counts = rollout.diagnostics.get("iterations")  # a solver of one's own may have none
    iterations = 0 if counts is None else int(counts.max(initial=0))
    checkpoints = rollout.steps * sum(array.capacity for array in rollout.initial.arrays())
    return forward, forward + checkpoints + sum(gradient_parts(particles, iterations, real).values())


def _as_text(found: dict[str, Any], length: RunLength) -> str:
    sizes = found["fluid_size_m"], found["container_size_m"] or ()
    fluid, held = (" x ".join(f"{side:.3g}" for side in size) for size in sizes)
    masses, gravity = ", ".join(found["mass_in_words"]), point_in_words(found["gravity_m_s2"])
    layer = " in a layer of 1 m" if found["dimension"] == 2 else ""
    container = f", in a container of {held} m" if held else ""
    phases = ", ".join(f"{count} {name}" for name, count in found["particles_of_phase"].items())
    waiting = f", {found['particles_in_emitter']} of them in emitters" if found["particles_in_emitter"] else ""
    limits = {name: limit for name, limit in found["time_step_limits_s"].items() if limit is not None}
    least = min(limits.values(), default=math.inf)
    by_name = ", ".join(f"{name} {limit:.3g}" for name, limit in sorted(limits.items(), key=lambda item: item[1]))
    beyond = " (beyond it: the run may diverge)" if found["time_step_s"] > least * (1.0 + 1e-9) else ""
    chosen = found["time_step_chosen_by"]
    run, backward = (_bytes(found[f"{name}memory_bytes"]) for name in ("", "gradient_"))
    allowed = f"stable up to about {least:.3g} s{beyond}; limits: {by_name}" if limits else "nothing limits it"
    step = f"{found['time_step_s']:g} s; {allowed}"
    if chosen:
        step = f"chosen before each step: the first is {found['time_step_s']:.3g} s, by {chosen}; limits: {by_name}"
    stored = "unknown, as nobody knows what time so many chosen steps simulate; --time says it"
    if length.frames is not None:
        stored = f"{_bytes(length.trajectory)} on disk, {counted(length.frames, 'frame')}; --fps or --record-every says"
        stored += " how many"
    rows = [
        ("particles", f"{found['particles']} of fluid ({phases}{waiting}), {found['wall_particles']} of walls"),
        ("spacing", f"{found['spacing_m']:g} m, in {found['dimension']}-D"),
        # lengths and masses, in which a wrong unit is easy to see
        ("size", f"fluid in {fluid} m{container}; {masses}{layer}; gravity {gravity} m/s2"),
        ("time step", step),
        ("viscosity", found["viscosity"]),
        *(("emitter", _emitter(one, found["dimension"], length)) for one in found["emitters"]),
        ("memory", f"{run} for a run, {backward} for a gradient, beside Python and Warp themselves"),
        ("time", _time(found, length)),
        ("trajectory", stored),
        ("film", _film(length, found.get("picture_seconds"), found.get("quick_picture_seconds"))),
    ]
    courses = [f"{name} changes until {last:g} s" for name, last in found["scheduled_until_s"].items()]
    rows += [("schedule", f"{', '.join(courses)}, and is constant from then on")] if courses else []
    rows += [("search", " ".join(found["search"]))] if "search" in found else []
    rows += [("picture", found["picture"])] if "picture" in found else []
    return "\n".join([found["name"], *(f"{label:<12}{text}" for label, text in rows)])


def _emitter(found: dict[str, Any], dimension: int, length: RunLength) -> str:
    given, asked, dry = found["area"], found["area_asked"], found["runs_dry_at_s"]
    lasts = "never runs dry" if dry is None else f"has fluid for {dry:.4g} s"
    if found["fed_by"]:
        lasts = f"{' and '.join(found['fed_by'])} feed it"
    elif dry is not None and length.time is not None and dry < length.time * (1.0 - SAME):
        lasts = f"runs dry at {dry:.4g} s, before the end of the run at {length.time:g} s"
    said = f"{lasts}; fluid comes out of {found['name']} at {found['speed_m_s']:.3g} m/s"
    if abs(given - asked) > EXCESS * asked:
        unit = "m" if dimension == 2 else "m2"
        said += f", through {given:.3g} {unit} of cells, where an opening of {asked:.3g} {unit} was asked for"
    return said


def _time(found: dict[str, Any], length: RunLength) -> str:
    if "diverged" in found:
        return f"unknown. {found['diverged']}"
    slower = "later ones may take more pressure iterations"
    if found["particles_in_emitter"]:
        slower = "later ones take longer, as fluid comes out of emitters"
    read = f"with {counted(found['sensors'], 'sensor')}, " if found["sensors"] else ""
    motion = "" if length.time is None else f", {length.time:g} s of motion"
    about = "about " if length.is_about else ""
    guess = ", if fluid gets as fast as by a fall through the whole container" if length.is_about else ""
    return (
        f"{found['milliseconds_per_step']:.3g} ms a step on {found['device']} in {found['precision']}, {read}without "
        f"what is recorded (mean of the first {found['measured_steps']} steps; {slower}); "
        f"{about}{counted(length.steps, 'step')}{motion}{guess}: {_duration(found['expected_seconds'])}"
    )


def _film(length: RunLength, traced: float | None, quick: float | None) -> str:
    """``traced`` and ``quick`` are the drawing times of one picture [s] in two qualities."""
    if length.film is None:
        return "of unknown length; --time says it" if length.time is None else "none"
    if traced is None:
        return f"{length.film}; what it takes to draw it comes on top"
    times = [(quick, "as a quick look"), (traced, "with its light traced")] if quick else [(traced, "")]
    drawn = ", ".join(f"{_duration(len(length.film.frames) * each)} to draw {how}".strip() for each, how in times)
    first = " and ".join(f"{each:.2g} s" for each, _ in times)
    return f"{length.film}; {drawn}, {first} for the first state; splashes take up to twice as long"


def _duration(seconds: float) -> str:
    for size, unit in ((86400.0, "days"), (3600.0, "h"), (60.0, "min")):
        if seconds >= 2.0 * size:
            return f"about {seconds / size:.2g} {unit}"
    return f"about {seconds:.2g} s"


def _bytes(size: float | None) -> str:
    if size is None:
        return "unknown"
    return f"about {size / 1e9:.2g} GB" if size >= 1e9 else f"about {max(size / 1e6, 0.1):.2g} MB"


def check_scene(
    scene_file: Path,
    steps: int,
    parameters: Sequence[str],
    loss: str,
    perturbation: float,
    out: Path | None,
    overrides: list[str],
    device: str,
    as_json: bool,
    seed: int,
) -> str:
    if loss not in ("positions", "centre-of-mass", "image"):
        raise InputError(f"--loss is {shown(loss)}, but must be one of positions, centre-of-mass, image.")
    scene = load_scene(scene_file, overrides).lasting(steps=check_steps(steps))
    simulation = Simulation(scene, device, "float64")
    measure: Loss = FinalPositions(simulation.positions)  # of how far the fluid has moved from its initial state
    if loss == "centre-of-mass":
        measure = CentreOfMass(simulation.positions.mean(axis=0))
    elif loss == "image":
        renderer = simulation.renderer()
        measure = Image(renderer, renderer.render(simulation.initial))
    problem = Problem(simulation, steps, measure)
    if out is not None:
        make_folder(out)
    certificate = certify(problem, parameters, perturbation, seed)
    found = json.dumps(certificate.as_dict(), indent=2)
    text = found if as_json else f"Loss: {loss}.\n{certificate}"
    if out is not None:
        from cortado.pictures.run_pictures import gradient_check

        gradient_check(certificate, out / "certificate.png")
        write_atomically(out / "certificate.json", found.encode())
        text += "" if as_json else f"\nThe results are in {out.resolve()}"
    if not certificate.right:
        tell(text)
        raise ComputationError(f"The adjoint is wrong for: {', '.join(certificate.wrong)}.")
    return text
