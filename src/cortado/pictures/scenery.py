"""What rays meet: the surface of the fluid of one state, and the shadow on the floor, on the device that draws them."""

from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import warp as wp

from cortado.device.bands import BandLauncher
from cortado.discretise.shapes import Points
from cortado.pictures.device_surface import DeviceSurface
from cortado.pictures.environment import environment_of
from cortado.pictures.liquid import Level, liquid_level, liquid_surface
from cortado.pictures.particles import Particles
from cortado.pictures.shadow import FloorShadow
from cortado.pictures.stage import Stage
from cortado.pictures.steady import still_of
from cortado.pictures.surface import spheres
from cortado.pictures.wetting import particles_of, wetting
from cortado.scene.camera_paths import View
from cortado.scene.scene import Scene


class State(NamedTuple):
    """What a picture shows."""

    positions: Points
    """(n, d) of particles [m], in the scene's axes"""
    colours: Points
    """(n, 3) of particles, linear from 0 to 1"""
    pose: Scene | None = None
    """The scene with its solids where they are; where it has them if left out."""
    view: View | None = None
    """Where the camera is; home if left out."""
    fractions: Points | None = None
    """(n, phases) by mass, what particles are made of; with one phase left out"""


@dataclass(frozen=True)
class Scenery:
    """The fluid of one state, in the frame of the picture."""

    stage: Stage
    """With solids and the camera where they are."""
    environment: Any
    """`Environment`"""
    surface: DeviceSurface
    shadow: FloorShadow


def scenery(home: Stage, state: State, launch: BandLauncher, steady: Any = None) -> Scenery:
    """That of a state in 3-D; ``steady``: `Still` of the state that is drawn in the place of its own."""
    stage, s, particles, shadow = _placed(home, state, launch)
    if steady is None:
        shadow.of_fluid(particles)
        return Scenery(stage, s, _surface(stage, s, particles, launch), shadow)
    shadow.light = steady.light
    return Scenery(stage, s, _surface(stage, s, particles, launch, (steady.b, steady.blocks)), shadow)


def still(home: Stage, state: State, launch: BandLauncher) -> Any:
    """`Still` of a state in 3-D; None where its fluid is not drawn with a surface around it."""
    stage, s, particles, shadow = _placed(home, state, launch)
    if stage.picture.surface != "liquid" or not len(particles):
        return None
    shadow.of_fluid(particles)
    level, near = liquid_level(wetting(stage, s, particles, launch), stage.spacing, launch)
    return still_of(level, near, shadow.light, launch)


def _placed(home: Stage, state: State, launch: BandLauncher) -> tuple[Stage, Any, Particles, FloorShadow]:
    """The stage of a state, its `Environment`, its particles, and a floor without a shadow."""
    stage = home.at(state.pose, state.view)
    s, shadow = environment_of(stage), FloorShadow(stage, launch)
    s.shadow_corner, s.shadow_cell = wp.vec3(*shadow.corner), shadow.cell
    return stage, s, particles_of(stage, state.positions, state.colours, launch, state.fractions), shadow


def _surface(
    stage: Stage, s: Any, particles: Particles, launch: BandLauncher, level: Level | None = None
) -> DeviceSurface:
    if not len(particles):
        return _nothing(stage, launch.device)
    if stage.picture.surface == "liquid":
        found = liquid_surface(wetting(stage, s, particles, launch), stage.spacing, launch, level)
        softened = partial(found.softened, launch=launch)
        surface = DeviceSurface.of(found.points, found.triangles, found.normals, found.colours, softened)
        surface.lit.media = found.media
        return surface
    balls = spheres(particles.places.numpy(), particles.looks.numpy()[:, :3], stage.spacing)
    surface = DeviceSurface.on(launch.device, balls.points, balls.triangles, balls.normals, balls.colours)
    surface.lit.media.fill_(wp.vec2(*stage.media[0]))
    return surface


def _nothing(stage: Stage, device: Any) -> DeviceSurface:
    """A triangle that is too small and too far below the floor to be seen: meshes need one."""
    places = stage.lower - 1e3 * stage.size + 1e-6 * stage.size * np.eye(3)
    return DeviceSurface.on(device, places, np.arange(3), np.eye(3), np.eye(3))
