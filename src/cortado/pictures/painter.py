"""Draw scenes, texts, lines and colour scales on pictures, and draw scenes before a run."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cache, lru_cache
from math import ceil
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cortado.discretise.shapes import Points, corners
from cortado.files.image_encoding import from_srgb
from cortado.pictures.plane import PlanePainter, PlaneStage
from cortado.pictures.stage import Stage
from cortado.pictures.tracing.near_particles import mixed
from cortado.pictures.tracing.space import SpacePainter
from cortado.scene.appearance import Picture
from cortado.scene.courses import Knots
from cortado.scene.emitter_table import EmitterTable
from cortado.scene.motions import courses
from cortado.scene.parameters import QUANTITIES
from cortado.scene.scene import Scene

FINER = 3
Text = tuple[tuple[int, int], str, str]
"""A text on a picture: the position (column, row), the text, and Pillow's two-letter anchor."""
INK = from_srgb(np.array([43, 42, 40], dtype=np.uint8))
PALETTE = "viridis"
UNITS = {"age": "s", **{name: quantity.unit for name, quantity in QUANTITIES.items()}}
MOVING = np.array([0.75, 0.20, 0.02])


def painter(
    scene: Scene, positions: Points | Sequence[Points], device: Any = "cpu", poses: Iterable[Scene] = ()
) -> PlanePainter | SpacePainter:
    stage = stage_of(scene, positions, poses)
    return PlanePainter(stage) if isinstance(stage, PlaneStage) else SpacePainter(stage, device)


def stage_of(scene: Scene, positions: Points | Sequence[Points], poses: Iterable[Scene] = ()) -> PlaneStage | Stage:
    """Return a stage for positions (n, d) or (frames, n, d) [m]. Pictures have room for the solids of all ``poses``."""
    return (PlaneStage if scene.dimension == 2 else Stage).of(scene, positions, poses)


def colours_of(scene: Scene, mass_fractions: Points | None, particles: int, colours: Points | None = None) -> Points:
    """Mix linear colours (n, 3) of particles from phase ``colours`` (phases, 3), by default the scene's colours."""
    palette = np.array([phase.colour for phase in scene.phase]) if colours is None else np.asarray(colours)
    fractions = np.ones((particles, 1)) if mass_fractions is None else np.asarray(mass_fractions)
    return mixed(fractions, np.clip(palette, 0.0, 1.0))


def plan(scene: Scene, positions: Points, colours: Points, device: Any = "cpu") -> Points:
    """Draw a scene before a run, with spheres at ``positions`` (n, d) [m] of linear ``colours`` (n, 3)."""
    look = (scene.picture or Picture()).model_copy(update={"surface": "spheres", "colour": "phase"})
    scene, spacing = scene.model_copy(update={"picture": look}), scene.discretisation.spacing
    paths, poses = list[Points](), list[Scene]()
    for k, table in enumerate(scene.solid):
        shifts = courses(table)[0] if table.motion == "path" else None
        if isinstance(shifts, Knots):
            paths.append(table.middle() + shifts.seen)
            for place in paths[-1][:: max(len(shifts.seen) // 60, 1)].tolist():
                moved = table.model_copy(update={"position": tuple(place)})
                poses.append(scene.model_copy(update={"solid": (*scene.solid[:k], moved, *scene.solid[k + 1 :])}))
    paths += [emitter.path.knots.seen for emitter in scene.emitter if emitter.path is not None]
    for emitter in scene.emitter:
        opening = emitter.opening(spacing)
        paths += [opening] if scene.dimension == 2 else []
        paths.append(_arrow(scene, emitter, np.concatenate([positions, opening])))
        shown = opening if scene.dimension == 3 or not len(positions) else opening[:0]
        positions = np.concatenate([positions, shown])
        colours = np.concatenate([colours, np.tile(MOVING, (len(shown), 1))])
    draws = painter(scene, np.concatenate([positions, *paths]), device, poses)
    image, stage = draws.image(positions, colours), draws.stage
    ends = scene.container.extent() or (positions.min(axis=0) - 0.5 * spacing, positions.max(axis=0) + 0.5 * spacing)
    thin, edges = max(round(look.height / 240), 1), _edges(stage, *ends)
    image = lined(image, [stage.on_screen(path) for path in paths], MOVING, thin)
    image = lined(image, edges, INK, thin)
    return written(image, _sizes(stage, edges, *ends), max(round(0.030 * look.height), 10))


def _arrow(scene: Scene, emitter: EmitterTable, positions: Points) -> Points:
    start, direction = np.array(emitter.outlet), np.array(emitter.direction)
    size = np.ptp(scene.container.extent() or positions, axis=0).max()
    length = max(0.18 * float(size), emitter.width)
    tip = start + length * direction
    aside = np.eye(len(start))[int(np.abs(direction).argmin())]
    aside = aside - (aside @ direction) * direction
    barbs = [tip - 0.22 * length * (direction + sign * 0.5 * aside / np.linalg.norm(aside)) for sign in (1.0, -1.0)]
    return np.array([start, tip, barbs[0], tip, barbs[1]])


def _edges(stage: Any, lower: Points, upper: Points) -> list[Points]:
    box, found = corners(lower, upper), list[Points]()
    for axis in range(len(lower)):
        pairs = [np.array([a, b]) for a in box for b in box if a[axis] < b[axis] and np.delete(a == b, axis).all()]
        places = np.array([stage.on_screen(pair) for pair in pairs])
        sought = (0.0, 1.0) if axis != stage.up_axis else (-1.0, 0.0)  # below, and on the left
        found.append(places[int((places.mean(axis=1) @ sought).argmax())])
    return found


def _sizes(stage: Any, edges: list[Points], lower: Points, upper: Points) -> list[Text]:
    found, middle = list[Text](), stage.on_screen(0.5 * (lower + upper)[None])[0]
    for axis, edge in enumerate(edges):
        away = edge.mean(axis=0) - middle
        place = edge.mean(axis=0) + 0.035 * stage.picture.height * away / max(float(np.linalg.norm(away)), 1e-9)
        text, across = f"{'xyz'[axis]}: {upper[axis] - lower[axis]:.3g} m", abs(away[0]) > abs(away[1])
        anchor = ("lm" if away[0] > 0.0 else "rm") if across else "mm"
        found.append(((round(place[0]), round(place[1])), text, anchor))
    return found


def labelled(image: Points, text: str, below: str = "") -> Points:
    """Write ``text`` at the upper left of a picture (rows, columns, 3) and ``below`` at the lower left, in place."""
    rows, columns = image.shape[:2]
    size = max(round(0.042 * rows), 11)
    left, top = round(0.9 * size), round(0.7 * size)
    size = max(min(size, int(size * (columns - 2 * left) / max(length_of(text, size), 1.0))), 7)
    return written(image, [((left, top), text, "la"), ((left, rows - top), below, "ld")], size)


def written(image: Points, texts: Sequence[Text], size: int) -> Points:
    """Write texts on a linear picture (rows, columns, 3) in place, with letters of ``size`` pixels."""
    where, cover = _covered(image.shape[:2], tuple(texts), size)
    image[where] = image[where] * (1.0 - cover) + INK * cover
    return image


def length_of(text: str, size: int) -> float:
    """Return the width [pixels] of a text with letters of ``size`` pixels."""
    return float(_font(size).getlength(text))


@lru_cache(maxsize=32)
def _covered(shape: tuple[int, int], texts: tuple[Text, ...], size: int) -> tuple[tuple[slice, slice], Points]:
    """Return the region of a picture that contains the texts, and the opacity of the region's pixels."""
    from PIL import Image, ImageDraw

    mask = Image.new("L", shape[::-1])
    for place, text, anchor in texts:
        ImageDraw.Draw(mask).text(place, text, fill=255, font=_font(size), anchor=anchor)
    left, upper, right, lower = mask.getbbox() or (0, 0, 0, 0)
    where = slice(upper, lower), slice(left, right)
    return where, (np.asarray(mask)[where] / 255.0)[..., None]


def lined(image: Points, lines: Sequence[Points], colour: Points, width: int) -> Points:
    """Draw lines on a linear picture through points (k, 2), given by column and row. ``width`` is in pixels."""
    from PIL import Image, ImageDraw

    rows, columns = image.shape[:2]
    mask = Image.new("L", (FINER * columns, FINER * rows))
    for line in lines:
        points = [tuple(point) for point in (FINER * np.asarray(line)).tolist()]
        ImageDraw.Draw(mask).line(points, fill=255, width=FINER * width, joint="curve")
    cover = (np.asarray(mask.resize((columns, rows), Image.Resampling.BOX)) / 255.0)[..., None]
    return image * (1.0 - cover) + colour * cover


def side_by_side(images: Sequence[Points], across: int, names: Sequence[str] = ()) -> Points:
    """All pictures must have the same size."""
    rows, columns = images[0].shape[:2]
    down = -(-len(images) // across)
    page = np.ones((down * rows, across * columns, 3), images[0].dtype)
    for k, image in enumerate(images):
        row, column = divmod(k, across)
        panel = page[row * rows : (row + 1) * rows, column * columns : (column + 1) * columns]
        panel[:] = image
        if names:
            labelled(panel, names[k])
    page[[row * rows for row in range(1, down)]] = 1.0
    page[:, [column * columns for column in range(1, across)]] = 1.0
    return page


@cache
def _font(size: int) -> Any:
    import matplotlib
    from PIL import ImageFont

    return ImageFont.truetype(str(Path(matplotlib.get_data_path()) / "fonts/ttf/DejaVuSans.ttf"), size)


@dataclass(frozen=True)
class Scale:
    name: str
    unit: str
    least: float
    greatest: float

    @classmethod
    def of(cls, name: str, values: NDArray, unit: str | None = None) -> "Scale":
        """Fit a scale to ``values``. A quantity that is not in `UNITS` needs a ``unit``."""
        least, greatest = np.percentile(values, (0.5, 99.5))
        return cls(name, UNITS.get(name, "") if unit is None else unit, float(least), float(greatest))

    def colours(self, values: NDArray) -> Points:
        return _colours(np.clip((values - self.least) / (self.greatest - self.least or 1.0), 0.0, 1.0))

    def columns(self, rows: int) -> int:
        """Return the width of the scale in pixels."""
        size = max(round(0.026 * rows), 9)  # of letters
        return ceil(max(self._wide(size), *(length_of(text, size) for text in self._heads))) + size

    def beside(self, image: Points) -> Points:
        rows = image.shape[0]
        edge = np.pad(image[:, -1], ((reach := rows // 16, reach), (0, 0)), mode="edge")
        smooth = np.lib.stride_tricks.sliding_window_view(edge, 2 * reach + 1, axis=0).mean(axis=-1)
        return self.on(np.concatenate([image, np.repeat(smooth[:, None], self.columns(rows), axis=1)], axis=1))

    def on(self, image: Points) -> Points:
        """Draw the scale over the right edge of a picture (rows, columns, 3)."""
        rows, columns = image.shape[:2]
        size = max(round(0.026 * rows), 9)  # of letters
        top, bottom, right = round(0.34 * rows), round(0.70 * rows), columns - size // 2
        left = right - ceil(self._wide(size))
        found, bar = np.array(image), _colours(np.linspace(1.0, 0.0, bottom - top))
        found[top:bottom, left : left + size // 2] = bar[:, None]
        texts = [((right, top - 3 * size // (1 + k)), text, "rm") for k, text in enumerate(self._heads)]
        for number in self._ticks():
            row = bottom - 1 - round((number - self.least) / (self.greatest - self.least) * (bottom - top - 1))
            found[row, left + size // 2 : left + 3 * size // 4] = INK
            texts.append(((left + size, row), f"{number:.4g}", "lm"))
        return written(found, texts, size)

    @property
    def _heads(self) -> tuple[str, str]:
        return self.name.replace("_", " "), f"[{self.unit}]"

    def _wide(self, size: int) -> float:
        return size + max((length_of(f"{number:.4g}", size) for number in self._ticks()), default=0.0)

    def _ticks(self) -> list[float]:
        from matplotlib.ticker import MaxNLocator

        if not self.greatest > self.least:
            return []
        found = MaxNLocator(nbins=4, steps=[1, 2, 2.5, 5, 10]).tick_values(self.least, self.greatest)
        return [float(number) for number in found if self.least <= number <= self.greatest]


def _colours(shares: NDArray) -> Points:
    from matplotlib import colormaps

    palette = colormaps[PALETTE]
    numbers = np.minimum((palette.N * shares).astype(int), palette.N - 1)
    return from_srgb((255.0 * palette(np.arange(palette.N))[:, :3]).round().astype(np.uint8))[numbers]
