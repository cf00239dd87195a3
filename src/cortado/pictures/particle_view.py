"""An animation of particles as a part of an HTML page, which plays without a server or a network."""

from __future__ import annotations

import json
from base64 import b64encode
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cortado.discretise.shapes import Points, corners, in_space
from cortado.files.image_encoding import srgb_bytes
from cortado.pictures.painter import colours_of
from cortado.pictures.shown_solids import solid_outline
from cortado.pictures.stage import upright
from cortado.scene.scene import Scene
from cortado.scene.shape_tables import INDEX_OF_AXIS, CylinderContainer


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
    return Path(__file__).with_suffix(".css").read_text(encoding="utf-8")


def script() -> str:
    """The script must appear once in a page, after all animations."""
    return f"<script>\n{Path(__file__).with_suffix('.js').read_text(encoding='utf-8')}</script>"


def thinned(frames: int, particles: int, numbers: int, most_bytes: int = 2_200_000) -> tuple[NDArray[np.intp], int]:
    """Return frame numbers and a stride of particles, so that an animation needs at most ``most_bytes``. ``numbers``
    are the     bytes of one particle in one frame."""
    count = min(frames, 120, max(most_bytes // (numbers * particles), 24))  # 24 to 120 of them
    stride = max(-(-count * numbers * particles // most_bytes), 1)
    return np.unique(np.linspace(0, frames - 1, count).astype(int)), stride


def particle_view(
    clouds: Sequence[Cloud], times: ArrayLike, spacing: float, *, lines: ArrayLike = (), stride: int = 1
) -> str:
    """Return HTML that shows clouds of the same size side by side, with the y axis up. ``times`` (frames,) are in
    seconds,     and ``lines`` (k, 2, d) are end points [m]. The clouds contain every ``stride``-th particle of
    particles with the     distance ``spacing`` [m] at rest."""
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
    """Return HTML that shows runs of a scene side by side. ``runs`` maps names to states at ``times`` (frames,) [s]."""
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
