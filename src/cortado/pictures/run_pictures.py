"""Pictures, films and plots of a run."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from pydantic_core import PydanticCustomError

from cortado.arrays import whole_number
from cortado.device.modules import device_named, start_warp
from cortado.discretise.shapes import Points, corners
from cortado.errors import InputError, SceneError, shown
from cortado.files.disk import as_path
from cortado.files.image_encoding import ShadedPicture
from cortado.files.terminal import announce
from cortado.particles.state import Entry
from cortado.pictures.film import LEAST_PIXELS, Computed, Page, ShownRun, coloured_by, film, lacking
from cortado.pictures.image_files import write_picture
from cortado.pictures.pages import Figures
from cortado.pictures.painter import Scale, side_by_side
from cortado.pictures.plane import PlaneStage
from cortado.pictures.plots import DASHED, FAINT, INK, PALETTE, drawing, whole_numbers
from cortado.pictures.stage import Stage
from cortado.runs.frames import Film, common_rate, pace_of
from cortado.runs.sensor import MeasuredColumn, Readings
from cortado.runs.trajectory import Frame, Trajectory
from cortado.scene.appearance import CameraPath, Picture
from cortado.scene.parameters import NAMES, Axis
from cortado.scene.scene import Scene, as_scene
from cortado.scene.tables import field_name
from cortado.simulation import Simulation

SHEET = 3
Settings = Mapping[str, Any]
Given = Scene | str | Path | None
"""A scene, the path of its file, or None for the scene of the trajectory."""


def run_pictures(
    scene: Scene, trajectory: Trajectory, folder: Path, device: Any, values: NDArray | None = None
) -> Figures:
    """Return captions and paths of a run's pictures. The default quality of film and contact sheet is "quick"."""
    run, last, picture = ShownRun(scene, trajectory, values), len(trajectory) - 1, scene.picture or Picture()
    page, is_quick = run_page(run, device), picture.quality is None and scene.dimension == 3
    stills: Figures = []
    for k, name, words in ((0, "first", "at the start"), (last, "last", "at the end")):
        path = folder / f"{name}.png"
        write_picture(path, page.image(k))
        stills.append((f"The fluid {words}, t = {trajectory.times[k]:.4g} s.", path))
    if picture.film_frames == 0 or not last:
        return stills
    small = {"width": max(picture.width // SHEET, LEAST_PIXELS), "height": max(picture.height // SHEET, LEAST_PIXELS)}
    looks = [picture.for_films.model_copy(update=small), picture.for_films]
    scenes = [scene.model_copy(update={"picture": look}) for look in looks]
    parts, page = (run_page(replace(run, scene=one), device) for one in scenes)
    shown = np.linspace(0, last, min(SHEET * SHEET, last + 1)).round().astype(int).tolist()
    names = [f"{trajectory.times[k]:.3g} s" for k in shown]
    path = write_picture(folder / "sheet.png", side_by_side([parts.image(k) for k in shown], SHEET, names))
    stills.append(("The whole run, from the start to the end.", path))
    pace = pace_of(trajectory.due, picture, common_rate([trajectory.marks]))
    made = film(folder / "film.mp4", page, range(last + 1), pace)
    announce(f"{made}{f'; cortado picture {folder.parent} --film traces its light' if is_quick else ''}")
    return [(f"The run, {made.pace.in_words}.", made.path), *stills]


def run_page(run: ShownRun, device: Any) -> Page:
    if run.values is None:
        return Page([run.panel(run.stage, device, None)], fingerprint=run.fingerprint)
    scale = Scale.of((run.scene.picture or Picture()).colour, run.values, run.unit)
    stage, composed = _with_scale(run.stage, scale)
    return Page([run.panel(stage, device, scale)], lambda images: composed(images[0]), run.fingerprint)


def _with_scale(stage: PlaneStage | Stage, scale: Scale) -> tuple[PlaneStage | Stage, Callable[[Points], Points]]:
    """Return a stage with space for a colour scale, and a function that draws the colour scale into an image."""
    free = stage.picture.width - scale.columns(stage.picture.height)
    is_covered = stage.on_screen(corners(*stage.ends))[:, 0].max() > free
    if not is_covered or free < LEAST_PIXELS:
        return stage, scale.on
    return stage.framed(stage.ends, stage.picture.model_copy(update={"width": free})), scale.beside


def shown_run(
    trajectory: Trajectory, scene: Scene, settings: Settings, units: Any = None, simulation: Computed = None
) -> ShownRun:
    """Prepare a run for pictures. ``simulation`` computes the quantity of the colours if the run lacks the quantity."""
    if not len(trajectory):
        raise InputError("The trajectory has no frames, but a film needs at least one.")
    known = dict.fromkeys(trajectory.others, "") if units is None else units
    scene = shown_as(scene, settings, known)
    unit = known.get((scene.picture or Picture()).colour)
    return ShownRun(scene, trajectory, coloured_by(scene, trajectory, simulation), unit)


def film_of(run: ShownRun, path: str | Path, device: Any) -> Film:
    if missing := lacking(run.scene):
        raise InputError(missing)
    pace = pace_of(run.trajectory.due, run.scene.picture or Picture(), common_rate([run.trajectory.marks]))
    return film(Path(as_path("path", path)), run_page(run, device), range(len(run.trajectory)), pace)


def simulation_picture(simulation: Simulation, frame: Frame, settings: Settings) -> ShadedPicture:
    if not isinstance(frame, Frame):
        raise InputError(f"frame is {shown(frame)}, but must be one frame of a trajectory, such as trajectory[-1].")
    units = _units_of_fields(simulation)
    if (shown_as(simulation.scene, settings, units).picture or Picture()).colour == "age":
        advice = 'take trajectory.picture(k, colour="age")'
        raise InputError(f"The age of fluid cannot be computed from one frame: {advice}.")
    alone = Trajectory(
        times=np.array([frame.time]),
        steps=np.zeros(1, dtype=int),
        positions=frame.positions[None],
        velocities=frame.velocities[None],
        diagnostics={"converged": np.zeros(0, dtype=bool)},
        mass_fractions=None if frame.mass_fractions is None else frame.mass_fractions[None],
        others={name: values[None] for name, values in frame.others.items()},
        quantities={name: values[None] for name, values in frame.quantities.items()},
    )
    run = shown_run(alone, simulation.scene, settings, units)
    return ShadedPicture.of(run_page(run, simulation.device).image(0))


def simulation_film(simulation: Simulation, trajectory: Trajectory, path: str | Path, settings: Settings) -> Film:
    if not isinstance(trajectory, Trajectory):
        raise InputError(f"trajectory is {shown(trajectory)}, but must be a Trajectory from simulation.run.")
    units = _units_of_fields(simulation)
    run = shown_run(trajectory, simulation.scene, settings, units, lambda: simulation)
    return film_of(run, path, simulation.device)


def trajectory_picture(trajectory: Trajectory, k: int, scene: Given, device: str, settings: Settings) -> ShadedPicture:
    count = len(trajectory)
    if k not in range(-count, count):
        raise InputError(f"k is {shown(k)}, but must be the number of one of {count} frames, such as 0 or -1.")
    run = shown_run(trajectory, _scene_of(trajectory, scene), settings)
    return ShadedPicture.of(run_page(run, device_of(device)).image(k % count))


def trajectory_film(trajectory: Trajectory, path: str | Path, scene: Given, device: str, settings: Settings) -> Film:
    return film_of(shown_run(trajectory, _scene_of(trajectory, scene), settings), path, device_of(device))


def device_of(name: str) -> Any:
    start_warp()
    return device_named(name)


def _scene_of(trajectory: Trajectory, given: Given) -> Scene:
    found = trajectory.scene if given is None else as_scene(given)
    if found is None:
        raise InputError("The trajectory is from a file, which has no scene: give the scene, as scene=scene.")
    return found


def _units_of_fields(simulation: Simulation) -> dict[str, str]:
    drawn = (Entry.NUMBER, Entry.VECTOR)
    known = (field for field in simulation.initial.fields if field.entry in drawn and field.axis is Axis.PARTICLE)
    return {field.name: field.unit for field in known if field.name not in NAMES}


def shown_as(scene: Scene, settings: Settings, fields: Collection[str] = ()) -> Scene:
    """Return the scene with ``settings`` in its table [picture]. ``colour`` may name one of the recorded ``fields``.
    Raises `SceneError` for invalid settings."""
    given = {} if scene.picture is None else scene.picture.model_dump()
    wanted = {**given, **settings}
    if "lines" in settings:
        lines = whole_number("lines", wanted.pop("lines"), 64)
        wanted |= {"width": 2 * round(8.0 / 9.0 * lines), "height": lines}  # 16:9
    if isinstance(wanted.get("camera"), CameraPath):
        wanted |= {"camera": given.get("camera"), "camera_path": wanted["camera"].model_dump()}
    own = wanted.get("colour")
    is_field = isinstance(own, str) and own in fields
    try:
        table = Picture(**{**wanted, "colour": "phase"} if is_field else wanted)
        table = table.in_scene(scene.dimension, [one.name for one in scene.solid], ("picture",))
    except SceneError as problem:
        raise SceneError(None, f"picture.{problem.field}", *problem.args[2:]) from None
    except PydanticCustomError as problem:
        error = (problem.context or {})["error"]
        raise SceneError(None, field_name(error.path), error.found, error.wanted) from None
    return scene.model_copy(update={"picture": table.model_copy(update={"colour": own}) if is_field else table})


def density_errors(trajectory: Trajectory, path: str | Path, *, tolerance: float | None = None) -> Path:
    """Plot the density error [%] and the iterations of each solver loop. Mark steps that did not converge."""
    steps = np.arange(1, len(trajectory.converged) + 1)
    loops = {name: column for name, column in trajectory.diagnostics.items() if column.dtype.kind == "i"}
    errors = 100.0 * trajectory.density_errors
    failed = ~trajectory.converged
    with drawing(path, height=6.0) as figure:
        upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(2, 1))
        upper.plot(steps, errors, color=PALETTE[0], linewidth=1.4, label="density error")
        if failed.any():
            label = f"not converged ({failed.sum()} of {len(steps)} steps)"
            upper.plot(steps[failed], errors[failed], "o", color=PALETTE[6], markersize=3.5, label=label)
        if tolerance is not None:
            upper.axhline(100.0 * tolerance, **DASHED, color=FAINT, label="tolerance")
        upper.set_title("Density error and pressure iterations", pad=32)
        upper.set_ylabel("average density\nerror [%]")
        upper.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=3, borderaxespad=0.2)
        for number, (name, iterations) in enumerate(loops.items(), 1):
            style = {"color": PALETTE[number % len(PALETTE)], "label": name.replace("_", " ")}
            lower.step(steps, iterations, where="mid", linewidth=1.2, **style)
        if len(loops) > 1:
            lower.legend(loc="center left", bbox_to_anchor=(1.01, 0.5))
        lower.set(xlabel="step", ylabel="pressure\niterations", ylim=(0, None))
        whole_numbers(lower.xaxis)
        whole_numbers(lower.yaxis)
        figure.align_ylabels()
    return Path(path)


def readings(found: Mapping[str, Readings], path: str | Path) -> Path:
    lines = dict[str, list[tuple[str, Readings, str]]]()
    for name, own in found.items():
        for column, unit in own.units.items():
            lines.setdefault(unit, []).append((f"{name} {column}".replace("_", " "), own, column))
    with _over_time(path, list(lines)) as panels:
        for panel, shown in zip(panels, lines.values(), strict=True):
            for k, (label, own, column) in enumerate(shown):
                panel.plot(own.times, own[column], color=PALETTE[k % len(PALETTE)], linewidth=1.3, label=label)
    return Path(path)


@contextmanager
def _over_time(path: str | Path, units: Sequence[str]) -> Iterator[Any]:
    with drawing(path, height=1.5 + 2.5 * len(units)) as figure:
        panels = figure.subplots(len(units), 1, sharex=True, squeeze=False)[:, 0]
        yield panels
        for panel, unit in zip(panels, units, strict=True):
            panel.set_ylabel(f"[{unit}]")
            panel.legend(loc="center left", bbox_to_anchor=(1.01, 0.5))
        panels[-1].set_xlabel("time [s]")


def beside_measured(found: Mapping[str, Readings], measured: Sequence[MeasuredColumn], path: str | Path) -> Path:
    with _over_time(path, [one.unit for one in measured]) as panels:
        for panel, one in zip(panels, measured, strict=True):
            name, _, column = one.name.rpartition(".")
            panel.plot(found[name].times, found[name][column], color=PALETTE[0], linewidth=1.3, label="simulated")
            panel.plot(one.times, one.values, "o", color=PALETTE[6], markersize=3.5, label="measured")
            error = f"apart by {one.errors['root_mean_square']:.3g} {one.unit} (root mean square)"
            panel.set_title(f"{name} {column}: {error}".replace("_", " "))
    return Path(path)


if TYPE_CHECKING:
    from cortado.certificate import Certificate
    from cortado.certificate.horizon import Alignment, Horizon


def gradient_check(certificate: Certificate, path: str | Path) -> Path:
    with drawing(path, 12.0, 8.4) as figure:
        (differences, growth), (horizon, estimators) = figure.subplots(2, 2)
        _differences(differences, certificate)
        _growth(growth, certificate)
        _horizon(horizon, min(certificate.horizons, key=lambda one: one.measured, default=None))
        _estimators(estimators, certificate.alignment)
        verdict = f"The adjoint is {'right' if certificate.right else 'WRONG'}"
        figure.suptitle(f"{verdict}; {certificate.particles} particles, {certificate.steps} steps", weight="bold")
    return Path(path)


def _differences(axes: Any, certificate: Certificate) -> None:
    c = certificate.consistency
    if not len(c.steps):
        _empty(axes, f"reverse and forward mode differ by {c.disagreement:.1e}")
        return
    steps, misses = c.steps, c.misses
    shown = sorted({*np.linspace(0, len(c.sample_steps) - 1, 4).round().astype(int)})
    for colour, k in zip(PALETTE, shown, strict=False):
        axes.loglog(steps, np.maximum(misses[:, k], 1e-16), "o-", color=colour, label=str(c.sample_steps[k]))
    axes.axhline(max(c.disagreement, 1e-16), **DASHED, color=FAINT)
    axes.text(steps[-1], max(c.disagreement, 1e-16), "reverse mode", color=FAINT, va="bottom")
    axes.set(title="Central differences against forward mode", xlabel="step of the difference")
    axes.set_ylabel("relative distance")
    axes.legend(title="after step", loc="best", ncols=2, fontsize=9)


def _growth(axes: Any, certificate: Certificate) -> None:
    steps = np.arange(certificate.steps + 1)
    there = certificate.norms > 0.0
    axes.semilogy(steps[there], certificate.norms[there], color=PALETTE[0])
    if there.any():
        logs = np.log(certificate.norms[there])
        line = logs.mean() - certificate.growth * (steps[there] - steps[there].mean())
        axes.semilogy(steps[there], np.exp(line), **DASHED, color=PALETTE[6])
    axes.set(title=f"The adjoint grows by e^({certificate.growth:.3g}) a step, backwards", xlabel="step")
    axes.set_ylabel("norm of the adjoint of a state")


def _horizon(axes: Any, horizon: Horizon | None) -> None:
    if horizon is None:
        _empty(axes, "no horizon of a wrong adjoint")
        return
    for values, label, colour in ((horizon.exact, "exact", 6), (horizon.difference, "of a meaningful perturbation", 0)):
        there, style = np.abs(values) > 0.0, {"markersize": 3.5, "color": PALETTE[colour], "label": label}
        axes.semilogy(horizon.sample_steps[there], np.abs(values)[there], "o-", **style)
    for step, label, shade in ((horizon.measured, "measured", INK), (horizon.predicted, "predicted", FAINT)):
        if step is not None:
            axes.axvline(step, **DASHED, color=shade, label=f"{label} horizon: {step}")
    axes.set(title=f"Derivative of the loss along {horizon.parameter}", xlabel="step at which the run ends")
    axes.set_ylabel("size")
    axes.legend(loc="lower right", fontsize=9, frameon=True, framealpha=1.0, edgecolor="none")


def _estimators(axes: Any, alignment: Alignment | None) -> None:
    if alignment is None:
        _empty(axes, "no smoothed gradient to compare with")
        return
    for k, judged in enumerate(alignment.estimators):
        axes.barh(-k, judged.cosine, color=PALETTE[k], height=0.42)
        words = f"{judged.estimator}: {judged.cosine:.2f}, size x {judged.size:.2g}"
        axes.text(-1.0, -k + 0.25, words, va="bottom", bbox={"facecolor": "white", "edgecolor": "none", "pad": 1.0})
    axes.axvline(0.0, color=FAINT, linewidth=1.0)
    axes.set(title="Gradients against the smoothed one", xlabel="cosine", xlim=(-1.02, 1.02), yticks=[])
    axes.set_ylim(0.6 - len(alignment.estimators), 0.6)


def _empty(axes: Any, words: str) -> None:
    axes.set_axis_off()
    axes.text(0.5, 0.5, words, ha="center", color=FAINT, transform=axes.transAxes)
