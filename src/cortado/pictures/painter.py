"""Who draws a scene, in 2-D or in 3-D; and a scene before it is run, with paths and sizes."""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from cortado.discretise.shapes import Points, corners
from cortado.pictures.labels import INK, Text, lined, written
from cortado.pictures.plane import PlanePainter, PlaneStage
from cortado.pictures.stage import Stage
from cortado.pictures.tracing.near_particles import mixed
from cortado.pictures.tracing.space import SpacePainter
from cortado.scene.appearance import Picture
from cortado.scene.scene import Scene


def painter(
    scene: Scene, positions: Points | Sequence[Points], device: Any = "cpu", poses: Iterable[Scene] = ()
) -> PlanePainter | SpacePainter:
    """The painter of a scene; arguments as of `stage_of`, and the ``device`` of the rays."""
    return painter_on(stage_of(scene, positions, poses), device)


def painter_on(stage: PlaneStage | Stage, device: Any = "cpu") -> PlanePainter | SpacePainter:
    """The painter of what is on a stage; ``device``: that of the rays."""
    return PlanePainter(stage) if isinstance(stage, PlaneStage) else SpacePainter(stage, device)


def stage_of(scene: Scene, positions: Points | Sequence[Points], poses: Iterable[Scene] = ()) -> PlaneStage | Stage:
    """What is around the fluid of a scene, which will be at positions (n, d) or (frames, n, d)
    [m]; ``poses``: the same scene
    with its solids where they will be, for them to be in the picture, too."""
    return (PlaneStage if scene.dimension == 2 else Stage).of(scene, positions, poses)


def colours_of(scene: Scene, mass_fractions: Points | None, particles: int, colours: Points | None = None) -> Points:
    """(n, 3) the colour of each particle: of what it is made of, in the scene's colours or in others (phases, 3)."""
    palette = np.array([phase.colour for phase in scene.phase]) if colours is None else np.asarray(colours)
    fractions = np.ones((particles, 1)) if mass_fractions is None else np.asarray(mass_fractions)
    return mixed(fractions, np.clip(palette, 0.0, 1.0))


MOVING = np.array([0.75, 0.20, 0.02])
"""Linear colour of paths and of what comes out of an emitter."""
ARROW = 0.18
"""How long an arrow is, in sizes of what is shown, and its head, in lengths of it."""
HEAD = 0.22


def plan(scene: Scene, positions: Points, colours: Points, device: Any = "cpu") -> Points:
    """A picture (rows, columns, 3), linear: particles at positions (n, d) [m] with colours (n, 3) as spheres, the
    opening of an emitter with an arrow, paths of solids and of the opening, and along each axis a line that is as long
    as the whole, and says how long."""
    look = (scene.picture or Picture()).model_copy(update={"surface": "spheres", "colour": "phase"})
    scene = scene.model_copy(update={"picture": look})
    spacing, paths = scene.discretisation.spacing, _paths(scene)
    if scene.emitter is not None:
        opening = scene.emitter.opening(spacing)
        paths += [opening] if scene.dimension == 2 else []
        paths.append(_arrow(scene, np.concatenate([positions, opening])))
        shown = opening if scene.dimension == 3 or not len(positions) else opening[:0]
        positions = np.concatenate([positions, shown])
        colours = np.concatenate([colours, np.tile(MOVING, (len(shown), 1))])
    draws = painter(scene, np.concatenate([positions, *paths]), device, _poses(scene))
    image, stage = draws.image(positions, colours), draws.stage
    ends = scene.container.extent() or (positions.min(axis=0) - 0.5 * spacing, positions.max(axis=0) + 0.5 * spacing)
    thin = max(round(look.height / 240), 1)
    edges = _edges(stage, *ends)
    image = lined(image, [stage.on_screen(path) for path in paths], MOVING, thin)
    image = lined(image, edges, INK, thin)
    return written(image, _sizes(stage, edges, *ends), max(round(0.030 * look.height), 10))


def _paths(scene: Scene) -> list[Points]:
    """(k, d) [m] those of solids' middles, and that of an emitter's opening."""
    found = [np.array(table.positions) for table in scene.solid if table.positions is not None]
    course = scene.schedule.courses.get("nozzle_path")
    return found if course is None else [*found, np.array(course.values, dtype=np.float64)]


def _poses(scene: Scene) -> list[Scene]:
    """The scene with each of its solids along its path."""
    found = []
    for k, table in enumerate(scene.solid):
        for place in table.positions or ():
            moved = (*scene.solid[:k], table.model_copy(update={"position": place}), *scene.solid[k + 1 :])
            found.append(scene.model_copy(update={"solid": moved}))
    return found


def _arrow(scene: Scene, positions: Points) -> Points:
    """(5, d) [m] a line and its head, in one stroke, out of the opening of an emitter; at least as long as the opening
    is wide. Without a container what is shown is at positions (n, d) [m]."""
    assert scene.emitter is not None
    start, direction = np.array(scene.emitter.outlet), np.array(scene.emitter.direction)
    size = np.ptp(scene.container.extent() or positions, axis=0).max()
    length = max(ARROW * float(size), 2.0 * scene.emitter.radius)
    tip = start + length * direction
    aside = np.eye(len(start))[int(np.abs(direction).argmin())]
    aside = aside - (aside @ direction) * direction
    barbs = [tip - HEAD * length * (direction + sign * 0.5 * aside / np.linalg.norm(aside)) for sign in (1.0, -1.0)]
    return np.array([start, tip, barbs[0], tip, barbs[1]])


def _edges(stage: Any, lower: Points, upper: Points) -> list[Points]:
    """(2, 2) on the screen, along each axis: the ends of that edge of the box which is outermost on the screen."""
    box, found = corners(lower, upper), list[Points]()
    for axis in range(len(lower)):
        pairs = [np.array([a, b]) for a in box for b in box if a[axis] < b[axis] and np.delete(a == b, axis).all()]
        places = np.array([stage.on_screen(pair) for pair in pairs])
        sought = (0.0, 1.0) if axis != stage.up_axis else (-1.0, 0.0)  # below, and on the left
        found.append(places[int((places.mean(axis=1) @ sought).argmax())])
    return found


def _sizes(stage: Any, edges: list[Points], lower: Points, upper: Points) -> list[Text]:
    """How long the box is along each axis, beside its edges."""
    found, middle = list[Text](), stage.on_screen(0.5 * (lower + upper)[None])[0]
    for axis, edge in enumerate(edges):
        away = edge.mean(axis=0) - middle
        place = edge.mean(axis=0) + 0.035 * stage.picture.height * away / max(float(np.linalg.norm(away)), 1e-9)
        text, across = f"{'xyz'[axis]}: {upper[axis] - lower[axis]:.3g} m", abs(away[0]) > abs(away[1])
        anchor = ("lm" if away[0] > 0.0 else "rm") if across else "mm"
        found.append(((round(place[0]), round(place[1])), text, anchor))
    return found
