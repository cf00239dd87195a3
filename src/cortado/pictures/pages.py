"""HTML for objects in notebooks, report.html of run folders, and particle animations in notebooks and reports.

Reports and animations need neither a server nor a network.
"""

from __future__ import annotations

import json
import re
import shlex
from base64 import b64encode
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from html import escape
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cortado.discretise.room import WITHOUT_PERIODS
from cortado.discretise.shapes import Points, corners, in_space
from cortado.errors import CortadoError, InputError
from cortado.files.disk import write_atomically
from cortado.files.image_encoding import srgb_bytes
from cortado.losses import FinalPositions, Frames, Image, Snapshot
from cortado.pictures.painter import colours_of
from cortado.pictures.plots import images, loss_curve, particles, spacing_of
from cortado.pictures.shown_solids import solid_outline
from cortado.pictures.stage import upright
from cortado.problem import Problem
from cortado.runs.frames import Film
from cortado.runs.run_folder import RunFolder
from cortado.runs.trajectory import Trajectory
from cortado.scene.parameter_values import UNITS, Values
from cortado.scene.scene import Scene
from cortado.scene.shape_tables import INDEX_OF_AXIS, CylinderContainer
from cortado.simulation import Simulation


@dataclass(frozen=True)
class Cloud:
    """The particles of a run in all frames of an animation."""

    name: str
    positions: NDArray[Any]
    """Positions (frames, n, d) [m]."""
    speeds: NDArray[Any]
    """Speeds (frames, n) [m/s]."""
    colours: NDArray[Any] | None = None
    """Linear colours from 0 to 1, (n, 3) or (frames, n, 3)."""


def style() -> str:
    return Path(__file__).with_name("particle_view.css").read_text(encoding="utf-8")


def script() -> str:
    """Return the script of the animations, which a page must contain once, after all animations."""
    return f"<script>\n{Path(__file__).with_name('particle_view.js').read_text(encoding='utf-8')}</script>"


def thinned(frames: int, particles: int, numbers: int, most_bytes: int = 2_200_000) -> tuple[NDArray[np.intp], int]:
    """Return frame numbers, and k for every k-th particle, for an animation of at most ``most_bytes``. ``numbers`` is
    the number of bytes per particle and frame."""
    count = min(frames, 120, max(most_bytes // (numbers * particles), 24))  # 24 to 120 of them
    stride = max(-(-count * numbers * particles // most_bytes), 1)
    return np.unique(np.linspace(0, frames - 1, count).astype(int)), stride


def particle_view(
    clouds: Sequence[Cloud], times: ArrayLike, spacing: float, *, lines: ArrayLike = (), stride: int = 1
) -> str:
    """Return HTML that shows clouds of the same size side by side, with the y axis up. ``times`` (frames,) are in
    seconds. ``lines`` (k, 2, d) [m] are end points of lines. The clouds contain every ``stride``-th particle. Particles
    at rest have the distance ``spacing`` [m] from each other."""
    times, (_, particles, dimension) = np.asarray(times, dtype=float), clouds[0].positions.shape
    ends = np.asarray(lines, dtype=float).reshape(-1, 2, dimension)
    shown = np.concatenate([array.reshape(-1, dimension) for array in (*(cloud.positions for cloud in clouds), ends)])
    lower, upper = np.nanmin(shown, axis=0).astype(float), np.nanmax(shown, axis=0).astype(float)
    middle, half = 0.5 * (lower + upper), np.maximum(0.5 * (upper - lower), 0.5 * spacing)
    fastest = max(float(np.nanmax(cloud.speeds, initial=0.0)) for cloud in clouds) or 1.0
    plain = np.tile((0.1, 0.3, 0.8), (particles, 1))
    drawn = [
        {
            "name": cloud.name,
            "still": cloud.colours is None or np.ndim(cloud.colours) == 2,
            "positions": _base64(np.round((cloud.positions - middle) / half * 32767).astype("<i2")),
            "speeds": _base64(np.round(cloud.speeds / fastest * 255).astype(np.uint8)),
            "colours": _base64(srgb_bytes(plain if cloud.colours is None else cloud.colours)),
        }
        for cloud in clouds
    ]
    data = {
        "dimension": dimension,
        "particles": particles,
        "times": [float(f"{t:.6g}") for t in times],
        "seconds": float(np.clip(len(times) / 20.0, 3.0, 12.0)),
        "half": _space(half),
        "radius": 0.56 * spacing * stride ** (1.0 / dimension),
        "lines": _space(ends - middle),
        "clouds": drawn,
    }
    text = json.dumps(data, separators=(",", ":")).replace("<", "\\u003c")
    names = "".join(f'<span class="name">{escape(cloud.name)}</span>' for cloud in clouds) if len(clouds) > 1 else ""
    hint = "Drag to turn it. " if dimension == 3 else ""
    left_out = f" One particle in {stride} is shown." if stride > 1 else ""
    choices = ["phase", "speed"] if any(cloud.colours is not None for cloud in clouds) else ["speed"]
    options = "".join(f'<option value="{word}">{word}</option>' for word in choices)
    what = escape(" and ".join(cloud.name for cloud in clouds))
    last, still = len(times) - 1, "" if len(times) > 1 else " hidden"
    return f"""<div class="particle-view">
<div class="stage">{names}
<canvas tabindex="0" role="img" aria-label="Particles in motion: {what}"></canvas></div>
<div class="controls">
<button data-play{still}>Play</button>
<input type="range" min="0" max="{last}" step="any" value="0" aria-label="Time"{still}><output>0 s</output>
<label>colour <select>{options}</select></label>
<button data-farther aria-label="Farther">&minus;</button><button data-closer aria-label="Closer">+</button>
<button data-reset>Reset</button>
</div>
<p>{hint}Speeds go from 0 (blue) to {fastest:.3g} m/s (yellow).{left_out}</p>
<script type="application/json">{text}</script>
</div>"""


def _space(vectors: NDArray[Any]) -> Any:
    padded = in_space(vectors)
    return np.array([float(f"{number:.6g}") for number in padded.ravel()]).reshape(padded.shape).tolist()


def _base64(array: NDArray[Any]) -> str:
    return b64encode(np.ascontiguousarray(array).tobytes()).decode()


def scene_view(scene: Scene, runs: Mapping[str, Iterable[Any]], times: ArrayLike) -> str:
    """Return HTML that shows runs side by side. ``runs`` maps names of runs to states at ``times`` (frames,) [s]."""
    turn = upright(np.asarray(scene.forces.gravity)) if scene.dimension == 3 else np.eye(2)
    states, times = {name: list(of_run) for name, of_run in runs.items()}, np.asarray(times)
    particles = len(next(iter(states.values()))[0].positions)
    numbers = len(states) * (2 * scene.dimension + 1 + 3 * (len(scene.phase) > 1))
    chosen, stride = thinned(len(times), particles, numbers)
    clouds = []
    for name, of_run in states.items():
        shown = [of_run[k] for k in chosen]
        positions = scene.domain.wrapped(np.stack([state.positions[::stride] for state in shown])) @ turn.T
        speeds = np.stack([np.linalg.norm(state.velocities[::stride], axis=1) for state in shown])
        fractions = [None if state.mass_fractions is None else state.mass_fractions[::stride] for state in shown]
        each = [colours_of(scene, one, positions.shape[1]) for one in (fractions if len(scene.phase) > 1 else [None])]
        clouds.append(Cloud(name, positions, speeds, np.stack(each) if len(scene.phase) > 1 else each[0]))
    still = tuple(table for table in scene.solid if table.motion == "fixed")
    lines = outline(scene.model_copy(update={"solid": still})) @ turn.T
    return particle_view(clouds, times[chosen], scene.discretisation.spacing, lines=lines, stride=stride)


def outline(scene: Scene) -> Points:
    """Return the outlines of the container and the solids of a scene as line segments (k, 2, d) [m]."""
    return np.concatenate([container_outline(scene), solid_outline(scene)])


def container_outline(scene: Scene) -> Points:
    """Return the outline of the container of a scene as line segments (k, 2, d) [m]. Without a container, k is 0."""
    container, ends = scene.container, scene.container.extent()
    if ends is None:
        return np.zeros((0, 2, scene.dimension))
    if not isinstance(container, CylinderContainer):
        places = corners(*ends)
        pairs = [(a, b) for a in range(len(places)) for b in range(a) if np.count_nonzero(places[a] != places[b]) == 1]
        return places[np.array(pairs)]
    angles = np.linspace(0.0, 2.0 * np.pi, 48, endpoint=False)
    axis = INDEX_OF_AXIS[container.axis]
    circle = np.insert(container.radius * np.stack([np.cos(angles), np.sin(angles)], axis=1), axis, 0.0, axis=1)
    low = circle + np.asarray(container.base)
    high = low + container.height * np.eye(3)[axis]
    rims = [np.stack([rim, np.roll(rim, -1, axis=0)], axis=1) for rim in (low, high)]
    return np.concatenate([*rims, np.stack([low, high], axis=1)[:: len(angles) // 4]])


Figures = list[tuple[str, str | Path]]
"""Caption and path of each picture or video."""
_KINDS = {
    **{".png": "image/png", ".jpg": "image/jpeg", ".svg": "image/svg+xml", ".gif": "image/gif"},
    **{".webp": "image/webp", ".mp4": "video/mp4", ".webm": "video/webm"},
}
WIDE = ' style="width: 100%"'
AGAIN, LATER = "<h2>How to run it again</h2>", "<h2>Drawn later</h2>"
MOST_NUMBERS = 6
"""Greatest number of values that the table shows for a parameter."""


@dataclass(frozen=True)
class Section:
    """A section of a report, in which empty parts are left out."""

    title: str
    words: Sequence[object] = ()
    failures: Sequence[object] = ()
    figures: Sequence[tuple[str, str | Path]] = ()
    """Caption and path of each figure, which is a png, jpg, svg, gif, webp, mp4 or webm file."""
    view: str = ""
    head: Sequence[str] = ()
    rows: Sequence[Sequence[object]] = ()
    """Rows of a table. The first cell of a row is the row's name."""


def write_report(folder: RunFolder, title: str, sections: Sequence[Section]) -> Path:
    """Write a report. Raises `InputError` if a picture cannot be embedded or the page cannot be written."""
    again = "<p>The command is not known.</p>"
    with suppress(OSError, ValueError, KeyError):
        noted = json.loads(folder.environment.read_text(encoding="utf-8"))
        commands = [noted["command"], *(session["command"] for session in noted["resumed"])]
        lines, place = escape("\n".join(map(shlex.join, commands))), escape(str(folder.path))
        again = f"<pre>{lines}</pre>\n<p>With --overwrite, a new run replaces this run. The folder of the run is "
        again += f"{place}. Its file scene.json contains the scene with all replaced values.</p>"
    parts = "\n".join(_section(section) for section in sections)
    player = script() if any(section.view for section in sections) else ""
    look = f"{Path(__file__).with_name('report.css').read_text(encoding='utf-8')}\n{style()}"
    page = f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{escape(title)}</title>
<style>
{look}</style>
</head>
<body>
<h1>{escape(title)}</h1>
{parts}
{AGAIN}
{again}
{_details("Scene", folder.scene)}
{_details("Where it ran", folder.environment)}
{player}
</body>
</html>
"""
    write_atomically(folder.report, page.encode(errors="backslashreplace"))  # names of files may not be UTF-8
    return folder.report


def add_to_report(folder: RunFolder, caption: str, path: Path) -> None:
    """Add a figure to the report of a run. Do nothing if the run has no report."""
    page = folder.report.read_text(encoding="utf-8") if folder.report.exists() else ""
    before, again, after = page.partition(AGAIN)
    if again:
        mark = f"<!-- {escape(path.name)} -->"
        before = re.sub(f"{re.escape(mark)}.*\n", "", before) if LATER in before else f"{before}{LATER}\n"
        page = f"{before}{mark}{_figure(caption, path)}\n{again}{after}"
        write_atomically(folder.report, page.encode(errors="backslashreplace"))


def written(value: Any) -> str:
    array = np.asarray(value)
    if array.dtype.kind not in "fiub":
        return str(value)
    if array.ndim == 0:
        return _number(value)
    if array.size > 12:
        shape = " × ".join(map(str, array.shape))
        return f"{shape} numbers from {_number(np.nanmin(array))} to {_number(np.nanmax(array))}, in result.json"
    rows = array.reshape(-1, array.shape[-1]) if array.size else array.reshape(0, 1)
    return "; ".join(f"({', '.join(_number(number) for number in row)})" for row in rows)


def _number(value: Any) -> str:
    return f"{value}" if isinstance(value, int | np.integer | bool | np.bool_) else f"{float(value):.6g}"


def _section(section: Section) -> str:
    parts = [f"<p>{escape(str(paragraph))}</p>" for paragraph in section.words]
    parts += [f'<p class="failed">{escape(str(paragraph))}</p>' for paragraph in section.failures]
    parts += [_figure(caption, Path(path)) for caption, path in section.figures]
    parts += [section.view] if section.view else []
    if section.rows:
        head = "".join(f'<th scope="col">{escape(word)}</th>' for word in section.head)
        lines = ['<div class="wide"><table>', f"<tr>{head}</tr>" if head else ""]
        for first, *rest in section.rows:
            cells = "".join(f"<td>{escape(written(entry))}</td>" for entry in rest)
            lines.append(f'<tr><th scope="row">{escape(str(first))}</th>{cells}</tr>')
        parts.append("\n".join([*lines, "</table></div>"]))
    return "\n".join([f"<h2>{escape(section.title)}</h2>", *parts]) if parts else ""


def _figure(caption: str, path: Path) -> str:
    return f"<figure>{_shown(path, caption)}<figcaption>{escape(caption)}</figcaption></figure>"


def _shown(path: Path, words: str, look: str = "") -> str:
    kind = _KINDS.get(path.suffix.lower())
    if kind is None:
        raise InputError(f"{path} cannot be shown; a report can contain {', '.join(_KINDS)}.")
    try:
        content = b64encode(path.read_bytes()).decode()
    except OSError as problem:
        raise InputError(f"The picture {path} cannot be read: {problem}.") from problem
    source = f'src="data:{kind};base64,{content}"{look}'
    if kind.startswith("video"):
        return f'<video controls loop muted playsinline aria-label="{escape(words)}" {source}></video>'
    return f'<img alt="{escape(words)}" {source}>'


def _details(label: str, path: Path) -> str:
    if not path.exists():
        return ""
    text = path.read_text(encoding="utf-8")
    with suppress(ValueError):  # what is not JSON is shown as it stands
        text = json.dumps(json.loads(text), indent=2, ensure_ascii=False)
    return f"<details><summary>{escape(label)}</summary><pre>{escape(text)}</pre></details>"


def simulation_page(simulation: Simulation) -> str:
    first, scene = simulation.positions[: simulation.free_particles or None], simulation.scene
    look: Any = {"container": scene.container.extent(), "lines": [solid_outline(scene)]}
    return as_words(simulation) + picture(simulation, lambda path: particles([first], ["t = 0 s"], path, **look))


def trajectory_page(run: Trajectory) -> str:
    if not len(run):
        return f"<pre>{escape(repr(run))}</pre>"
    domain = WITHOUT_PERIODS if run.scene is None else run.scene.container.domain(run.dimension)
    shown = [run[k] for k in sorted({0, len(run) // 2, len(run) - 1})]
    titles = [f"t = {frame.time:.4g} s" for frame in shown]
    speeds = [np.linalg.norm(frame.velocities, axis=1) for frame in shown]
    sets, label = [domain.wrapped(frame.positions) for frame in shown], "speed [m/s]"
    chosen, stride = thinned(len(run), run.particles, 2 * run.dimension + 1, 1_000_000)  # bytes
    thin = [array[chosen, ::stride] for array in (run.positions, run.velocities)]
    cloud = Cloud("run", domain.wrapped(thin[0]), np.linalg.norm(thin[1], axis=2))
    view = particle_view([cloud], run.times[chosen], spacing_of(run.positions[0], 1.0), stride=stride)
    drawn = picture(run, lambda path: particles(sets, titles, path, colours=speeds, colour_label=label))
    page = f"<!DOCTYPE html><meta charset='utf-8'><style>{style()}</style>{view}{script()}"
    frame = f'<iframe srcdoc="{escape(page)}" style="width: 100%; height: 600px; border: 0"></iframe>'
    return as_words(run) + frame + f"<details><summary>As a picture</summary>{drawn}</details>"


def film_page(film: Film) -> str:
    return as_words(film) + _shown(film.path, repr(film), WIDE)


def result_page(found: object, message: str, problem: Any, start: Values, best: Values, losses: Any) -> str:
    if hasattr(problem, "coordinates"):
        problem, (start, best) = problem.problem, [problem.parameters(u) for u in (start, best)]
    is_ours = isinstance(problem, Problem) and problem.simulation.batch is None
    units = {name: (is_ours and UNITS.get(name, "")) or "-" for name in best}
    rows = [(name.replace("_", " "), units[name], *map(_written, (start[name], best[name]))) for name in best]
    head = ("parameter", "unit", "first guess", "found")
    parts = [table(head, rows), picture(found, lambda path: loss_curve(losses, path))]
    if is_ours:
        with suppress(CortadoError):  # the first guess may be a run that diverges
            parts.insert(0, picture(found, lambda path: _draw_ends(problem, [start, best], path)))
    return as_words(found) + f"<p>{escape(message)}</p>" + "".join(parts)


def _draw_ends(problem: Problem, points: Sequence[Mapping[str, Any]], path: Path) -> None:
    # the user's problem keeps its last evaluation
    own = Problem(problem.simulation, problem.steps, problem.loss, state=problem.state)
    step, loss = max(own.loss.losses.items()) if isinstance(own.loss, Frames) else (own.steps, own.loss)
    ends: list[Snapshot] = [own.states(point, [step])[step] for point in points]
    titles = [f"first guess, after {step} steps", "found"]
    if isinstance(loss, Image):
        images([*map(loss.image, ends), loss.target], [*titles, "target"], path)
        return
    sets = [end.positions for end in ends]
    if isinstance(loss, FinalPositions):
        sets, titles = [*sets, loss.target], [*titles, "target"]
    scene = problem.simulation.scene
    particles(sets, titles, path, container=scene.container.extent(), lines=[solid_outline(scene)] * len(sets))


def _written(value: Any) -> str:
    numbers = np.ravel(value)
    if len(numbers) > MOST_NUMBERS:
        return f"{np.shape(value)} numbers, {numbers.min():.4g} to {numbers.max():.4g}"
    return ", ".join(f"{number:.4g}" for number in numbers)


def as_words(found: object) -> str:
    return f"<p>{escape(repr(found))}</p>"


def picture(found: object, draw: Callable[[Path], Any]) -> str:
    """Return HTML of a drawn picture, or an empty text if a drawing package is missing."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "picture.png"
        try:
            draw(path)
        except ImportError:
            return ""
        return _shown(path, repr(found), WIDE)


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    lines = [
        "".join(f'<{kind} style="text-align: left; padding: 0 1em .2em 0">{escape(cell)}</{kind}>' for cell in cells)
        for kind, cells in (("th", head), *(("td", row) for row in rows))
    ]
    return f"<table>{''.join(f'<tr>{line}</tr>' for line in lines)}</table>"
