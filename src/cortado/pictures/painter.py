"""Who draws a scene: a ray tracer in 3-D, a painter of the plane in 2-D."""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from cortado.discretise.shapes import Points
from cortado.pictures.particles import mixed
from cortado.pictures.plane import PlanePainter
from cortado.pictures.plane_stage import PlaneStage
from cortado.pictures.space import SpacePainter
from cortado.pictures.stage import Stage
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
