"""``cortado describe``: what a scene will be before it is run: particles, limits of the time step, memory, time."""

import json
import math
import time
from collections import Counter
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from cortado.cli.commands.drawing_time import seconds_of_picture
from cortado.cli.commands.emitter_words import SAME, emitter_rows, of_emitter
from cortado.cli.commands.memory_use import estimated_bytes
from cortado.cli.commands.run_length import RunLength
from cortado.device.memory import step_parts
from cortado.errors import DivergedError, InputError
from cortado.files.output_files import sentences
from cortado.files.terminal import timed_note
from cortado.optimisation.inverse.in_words import task_in_words
from cortado.optimisation.inverse.task import load_task
from cortado.pictures.image_files import write_picture
from cortado.pictures.painter import colours_of, plan
from cortado.rollout.checkpoints import MEMORY_BUDGET
from cortado.rollout.rollout import Rollout
from cortado.rollout.scene_parameters import SceneParameters
from cortado.rollout.step_bounds import scheduled_bounds
from cortado.runs.recording import FrameChoice
from cortado.scene.scene import Scene, load_scene, vector
from cortado.scene.stability import chosen_limits, is_implicit, stability_limits, viscous_limit
from cortado.scene.toml import overrides_of, read_toml
from cortado.simulation import Simulation
from cortado.solvers.particles import ParticleSolver
from cortado.watching import Watch
from cortado.words import counted

MANY = 1_000_000
"""Particles: so many are announced before they are made, as that takes some seconds or minutes."""
FIRST, MOST, ENOUGH = 4, 100, 0.5
"""Steps that are timed: a few, or more if they are fast, until they take so many seconds together."""


@dataclass(frozen=True)
class MeasuredSpeed:
    """How long the first steps of a scene take, with what its sensors read after each."""

    steps: int
    """That were measured, after twice as many that were not."""
    seconds: float
    """Of one of them."""

    @classmethod
    def measured(cls, simulation: Simulation) -> "MeasuredSpeed":
        """Raises `DivergedError` of a scene that does not even bear these steps."""
        steps = FIRST
        while True:
            rollout = simulation.rollout(steps)
            watch = Watch(simulation, rollout).step if simulation.scene.sensor else None
            for _ in range(2):  # the first time compiles, the second captures graphs
                rollout.forward(watch, keep=False)
            begun = time.perf_counter()
            rollout.forward(watch, keep=False)
            wp.synchronize_device(simulation.device)
            seconds = (time.perf_counter() - begun) / steps
            if steps == MOST or steps * seconds > 0.5 * ENOUGH:
                return cls(steps, seconds)
            steps = min(math.ceil(ENOUGH / seconds), MOST)


def describe_scene(
    scene_file: Path,
    steps: int | None,
    time: float | None,
    frames: FrameChoice,
    overrides: list[str],
    device: str,
    precision: str,
    picture: Path | None,
    as_json: bool,
) -> str:
    """As text, or as JSON; a picture of the first state is written where one is asked for."""
    if picture is not None and picture.suffix.lower() != ".png":
        raise InputError(f"--picture is {str(picture)!r}, but must be the name of a PNG file, such as first.png.")
    of_search = overrides_of(overrides, ("problem", "optimise")) if "optimise" in read_toml(scene_file) else []
    scene = load_scene(scene_file, [one for one in overrides if one not in of_search]).lasting(time, steps)
    bodies = scene.fluid if scene.emitter is None else (*scene.fluid, scene.emitter)
    count = sum(body.count(scene.discretisation.spacing) for body in bodies)
    with timed_note(f"About {count:,.0f} particles are made") if count > MANY else nullcontext():
        simulation = Simulation(scene, device, precision)
    length = RunLength.of(simulation, steps, time, frames)
    found = _described(simulation, length)
    if length.film is not None:
        found["picture_seconds"] = seconds_of_picture(simulation)
    if "optimise" in read_toml(scene_file):
        found["search"] = task_in_words(load_task(scene_file, overrides))
    if picture is not None:
        with sentences(picture.parent):
            picture.parent.mkdir(parents=True, exist_ok=True)
        found["picture"] = str(_drawn(simulation, picture).absolute())
    return json.dumps(found, indent=2) if as_json else _as_text(found, length)


def _described(simulation: Simulation, length: RunLength) -> dict[str, Any]:
    scene = simulation.scene
    of_phase = Counter(np.argmax(simulation.mass_fractions, axis=1).tolist())
    (size, limits, chosen_by), ends = _time_step(simulation), scene.container.extent()
    masses = simulation.masses
    found: dict[str, Any] = {
        "name": scene.name,
        "dimension": scene.dimension,
        "particles": simulation.particles,
        "particles_of_phase": {phase.name: of_phase[k] for k, phase in enumerate(scene.phase)},
        "particles_in_emitter": simulation.particles - simulation.free_particles,
        **of_emitter(scene),
        "wall_particles": len(simulation.walls),
        "fluid_size_m": _fluid_size(simulation),
        "container_size_m": None if ends is None else (ends[1] - ends[0]).tolist(),
        "mass_of_phase_kg": masses.given,
        "mass_asked_of_phase_kg": masses.asked,
        "mass_in_words": [masses.off.get(name, f"{mass:.3g} kg of {name}") for name, mass in masses.given.items()],
        "gravity_m_s2": list(scene.forces.gravity),
        "spacing_m": scene.discretisation.spacing,
        "time_step_s": size,
        "time_step_chosen_by": chosen_by,
        "time_step_limits_s": {name: limit if math.isfinite(limit) else None for name, limit in limits.items()},
        "viscosity": _viscosity(scene),
        "scheduled_until_s": {name: course.times[-1] for name, course in scene.schedule.courses.items()},
        "device": str(simulation.device),
        "precision": simulation.precision.name,
    }
    steps = length.steps
    return {**found, **length.for_machines(), **_memory(simulation, steps), **_expected(simulation, steps)}


def _fluid_size(simulation: Simulation) -> list[float]:
    """(d,) [m] with what waits in line in an emitter, and without its reserve."""
    emitter, spacing = simulation.scene.emitter, simulation.scene.discretisation.spacing
    shown = simulation.free_particles + (0 if emitter is None else len(emitter.particles(spacing)))
    return (np.ptp(simulation.positions[:shown], axis=0) + spacing).tolist()


def _time_step(simulation: Simulation) -> tuple[float, dict[str, float], str | None]:
    """The time step [s], its limits by what they are of [s], and by which of them it is chosen: the first step then;
    None of one that is fixed."""
    scene = simulation.scene
    if scene.solver.time_step != "auto":
        return scene.solver.time_step, stability_limits(scene), None
    first = simulation.rollout(1).step_sizes.of_step(0)
    assert first is not None
    size, limits = float(first[0]), chosen_limits(scene)
    scheduled = scheduled_bounds(scene, {}, SceneParameters(simulation, 1))
    limits |= {name: bound.longest(0.0) for name, bound in scheduled.items()}
    if size < min(limits.values()) * (1.0 - SAME):
        limits["speed"] = size
    return size, limits, min(limits, key=lambda name: limits[name])


def _viscosity(scene: Scene) -> str:
    """Which form the viscous force has, and why it acts at the start or at the end of a step."""
    form, limit = scene.forces.viscosity, viscous_limit(scene, {})
    if form != "stress" or not math.isfinite(limit):
        return str(form)
    when = "implicit, at the end of a step" if is_implicit(scene) else "explicit, at the start of a step"
    return f"stress, {when}; an explicit one bears steps of {limit:.3g} s"


def _expected(simulation: Simulation, steps: int) -> dict[str, Any]:
    """How long so many steps will take; of a scene that does not bear the first ones, what happened."""
    try:
        speed = MeasuredSpeed.measured(simulation)
    except DivergedError as error:
        return {"diverged": str(error)}
    return {
        "milliseconds_per_step": 1e3 * speed.seconds,
        "measured_steps": speed.steps,
        "expected_seconds": steps * speed.seconds,
        "sensors": len(simulation.scene.sensor),
    }


def _memory(simulation: Simulation, steps: int) -> dict[str, float | None]:
    """[bytes] of a run, and of a gradient."""
    real = simulation.precision.bytes
    if not isinstance(simulation.solver, ParticleSolver):
        return {"memory_bytes": None, "gradient_memory_bytes": None}
    rollout = Rollout(simulation.solver, 1)
    forward, backward = estimated_bytes(simulation, rollout)
    own = sum(step_parts(steps, real).values())
    checkpoints = min(steps * sum(array.capacity for array in rollout.initial.arrays()), MEMORY_BUDGET)
    return {"memory_bytes": forward + own, "gradient_memory_bytes": backward + own + checkpoints}


def _drawn(simulation: Simulation, path: Path) -> Path:
    """The scene with its fluid where it is at the start, in the colours of its phases."""
    free = slice(simulation.free_particles)
    colours = colours_of(simulation.scene, simulation.mass_fractions, simulation.particles)
    return write_picture(path, plan(simulation.scene, simulation.positions[free], colours[free], simulation.device))


def _as_text(found: dict[str, Any], length: RunLength) -> str:
    phases = ", ".join(f"{count} {name}" for name, count in found["particles_of_phase"].items())
    waiting = f", {found['particles_in_emitter']} of them in the emitter" if found["particles_in_emitter"] else ""
    limits = {name: limit for name, limit in found["time_step_limits_s"].items() if limit is not None}
    least = min(limits.values(), default=math.inf)
    by_name = ", ".join(f"{name} {limit:.3g}" for name, limit in sorted(limits.items(), key=lambda item: item[1]))
    beyond = " (beyond it: the run may diverge)" if found["time_step_s"] > least * (1.0 + 1e-9) else ""
    chosen = found["time_step_chosen_by"]
    allowed = f"stable up to about {least:.3g} s{beyond}; limits: {by_name}" if limits else "nothing limits it"
    rows = [
        ("particles", f"{found['particles']} of fluid ({phases}{waiting}), {found['wall_particles']} of walls"),
        ("spacing", f"{found['spacing_m']:g} m, in {found['dimension']}-D"),
        ("size", _size(found)),
        (
            "time step",
            f"chosen before each step: the first is {found['time_step_s']:.3g} s, by {chosen}; limits: {by_name}"
            if chosen
            else f"{found['time_step_s']:g} s; {allowed}",
        ),
        ("viscosity", found["viscosity"]),
        *emitter_rows(found, length),
        (
            "memory",
            f"{_bytes(found['memory_bytes'])} for a run, {_bytes(found['gradient_memory_bytes'])} for a gradient, "
            "beside Python and Warp themselves",
        ),
        ("time", _time(found, length)),
        ("trajectory", _trajectory(length)),
        ("film", _film(length, found.get("picture_seconds"))),
    ]
    courses = [f"{name} changes until {last:g} s" for name, last in found["scheduled_until_s"].items()]
    rows += [("schedule", f"{', '.join(courses)}, and is constant from then on")] if courses else []
    rows += [("search", " ".join(found["search"]))] if "search" in found else []
    rows += [("picture", found["picture"])] if "picture" in found else []
    return "\n".join([found["name"], *(f"{label:<12}{text}" for label, text in rows)])


def _size(found: dict[str, Any]) -> str:
    """Lengths and masses, by which one sees a wrong unit."""
    fluid, held = (
        " x ".join(f"{length:.3g}" for length in found[key] or ()) for key in ("fluid_size_m", "container_size_m")
    )
    masses = ", ".join(found["mass_in_words"])
    layer = " in a layer of 1 m" if found["dimension"] == 2 else ""
    container = f", in a container of {held} m" if held else ""
    gravity = vector(found["gravity_m_s2"])
    return f"fluid in {fluid} m{container}; {masses}{layer}; gravity {gravity} m/s2"


def _time(found: dict[str, Any], length: RunLength) -> str:
    if "diverged" in found:
        return f"unknown. {found['diverged']}"
    slower = "later ones may take more pressure iterations"
    if found["particles_in_emitter"]:
        slower = "later ones take longer, as fluid comes out of the emitter"
    read = f"with {counted(found['sensors'], 'sensor')}, " if found["sensors"] else ""
    return (
        f"{found['milliseconds_per_step']:.3g} ms a step on {found['device']} in {found['precision']}, {read}without "
        f"what is recorded (mean of the first {found['measured_steps']} steps; {slower}); "
        f"{length.in_words}: {_duration(found['expected_seconds'])}"
    )


def _trajectory(length: RunLength) -> str:
    """What is recorded, on disk."""
    if length.frames is None:
        return "unknown, as nobody knows what time so many chosen steps simulate; --time says it"
    return (
        f"{_bytes(length.trajectory)} on disk, {counted(length.frames, 'frame')}; --fps or --record-every says how many"
    )


def _film(length: RunLength, seconds: float | None) -> str:
    """What the film of the run shows, how long it is, and how long it takes to draw, if a picture takes so many
    seconds."""
    if length.film is not None and seconds is not None:
        drawn = _duration(len(length.film.frames) * seconds)
        return f"{length.film}; {drawn} to draw, {seconds:.2g} s for the first state; splashes take up to twice as long"
    if length.film is not None:
        return f"{length.film}; what it takes to draw it comes on top"
    return "of unknown length; --time says it" if length.time is None else "none"


def _duration(seconds: float) -> str:
    """About how long, in the unit that one would say."""
    for size, unit in ((86400.0, "days"), (3600.0, "h"), (60.0, "min")):
        if seconds >= 2.0 * size:
            return f"about {seconds / size:.2g} {unit}"
    return f"about {seconds:.2g} s"


def _bytes(size: float | None) -> str:
    if size is None:
        return "unknown"
    return f"about {size / 1e9:.2g} GB" if size >= 1e9 else f"about {max(size / 1e6, 0.1):.2g} MB"
