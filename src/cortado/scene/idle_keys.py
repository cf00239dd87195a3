"""Keys that change nothing beside what the rest of a scene says, so that none is ignored in silence.

One that belongs to a choice that was not made is refused; one that a number of 0 turns off is warned of.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np

from cortado.scene.camera_paths import Keyframes
from cortado.scene.fields import FieldPath, field_error
from cortado.scene.fluids import PointsFluid
from cortado.scene.model import SceneTables
from cortado.scene.picture import Picture
from cortado.scene.rheology import Carreau, Thinning, Yielding
from cortado.scene.sentences import field_name
from cortado.scene.solvers import what_suits
from cortado.scene.tables import Table

OF_DIFFUSION = ("free_energy", "strength", "mobility_form", "interface_width")
OF_ITERATIONS = (
    *("minimum_iterations", "maximum_iterations", "density_tolerance", "maximum_density_tolerance"),
    *("iterations", "tolerance", "repairs", "velocities_follow"),
)
OF_SPACE = ("surface", "field_of_view", "transparency", "floor")


def given(table: Table, *names: str) -> Iterator[str]:
    """Those of some fields of a table that are there, with other values than their defaults."""
    for name in names:
        field = type(table).model_fields.get(name)
        if field is not None and getattr(table, name) != field.default:
            yield name


def check_idle(scene: SceneTables) -> None:
    """Raises a `field_error` for the first key that belongs to a choice that was not made."""
    for path, table, names, reason in _idle(scene):
        for name in given(table, *names):
            raise field_error((*path, name), getattr(table, name), f"left out, as {reason}")


def idle_sentences(scene: SceneTables) -> Iterator[str]:
    """What to say of keys that a number of 0 turns off."""
    for path, table, names, reason in _turned_off(scene):
        for name in given(table, *names):
            yield f"{field_name((*path, name))} changes nothing, as {reason}."


Idle = tuple[FieldPath, Table, tuple[str, ...], str]
"""A table by its path, those of its keys that change nothing, and why."""


def _idle(scene: SceneTables) -> Iterator[Idle]:
    forces, mixture = scene.forces, scene.mixture
    if mixture.mobility == 0.0 and "mobility" not in mixture.model_fields_set:
        yield ("mixture",), mixture, OF_DIFFUSION, "there is no mobility, without which nothing diffuses"
    if forces.viscosity != "stress":
        yield ("forces",), forces, ("viscous_solve",), f'viscosity is "{forces.viscosity}", and not "stress"'
    if np.all(getattr(scene.container, "periodic", False)):
        names = ("slip", "material", "colour")
        yield ("container",), scene.container, names, "it has no walls where all axes are periodic"
    if scene.dimension == 2:
        tables: list[tuple[FieldPath, Table]] = [(("phase", index), phase) for index, phase in enumerate(scene.phase)]
        for path, table in [*tables, (("container",), scene.container)]:
            if "colour" in table.model_fields_set and getattr(table, "colour", None) is not None:
                yield path, table, ("material",), "colour is given, which is all that a plane shows of it"
    if scene.picture is not None:
        yield from _idle_in_picture(scene.picture, scene.dimension)


def _idle_in_picture(picture: Picture, dimension: int) -> Iterator[Idle]:
    path = ("picture",)
    if dimension == 2:
        yield path, picture, OF_SPACE, "the scene has 2 dimensions"
        if picture.background is not None:
            yield path, picture, ("light",), "background is given, which is all that a plane shows of it"
    if picture.surface == "spheres":
        yield path, picture, ("transparency",), 'surface is "spheres", which are not clear'
    if picture.film_frames == 0:
        yield path, picture, ("film_speed",), "film_frames is 0, and there is no film"
    if isinstance(picture.camera_path, Keyframes):
        names = ("camera",) if picture.camera_path.look_at is None else ("camera", "look_at")
        yield path, picture, names, "camera_path has keyframes"


def _turned_off(scene: SceneTables) -> Iterator[Idle]:
    forces, mixture = scene.forces, scene.mixture
    thick = any(phase.viscosity > 0.0 or phase.rheology for phase in scene.phase)
    if mixture.mobility == 0.0:
        yield ("mixture",), mixture, OF_DIFFUSION, "mobility is 0 and nothing diffuses"
    if forces.viscosity == "none" or not thick:
        tables: list[tuple[FieldPath, Any]] = [(("container",), scene.container)]
        tables += [(("solid", index), solid) for index, solid in enumerate(scene.solid)]
        for path, table in tables:
            yield path, table, ("slip",), "no viscous force acts"
    if not forces.pressure:
        yield ("solver",), scene.solver, OF_ITERATIONS, "forces.pressure is false"
    cut = scene.discretisation
    suited = ("discretisation", {"jitter": cut.jitter}) in what_suits(scene.solver, scene.container)
    if all(isinstance(fluid, PointsFluid) for fluid in scene.fluid) and not suited:
        yield ("discretisation",), cut, ("jitter",), "points of files and an emitter's particles stay where they are"
    emitter, spacing = scene.emitter, scene.discretisation.spacing
    if (
        emitter is not None
        and emitter.length is not None
        and emitter.layers(spacing) * spacing < emitter.length - spacing
    ):
        yield ("emitter",), emitter, ("length",), "duration is over before so much is out"
    for index, solid in enumerate(scene.solid):
        names = tuple(name for name in ("centre", "base") if any(getattr(solid, name, ())))
        if not np.allclose(solid.middle(), solid.shape_about()[1]):
            yield ("solid", index), solid, names, "position says where its middle is"
    for index, phase in enumerate(scene.phase):
        path, law = ("phase", index, "rheology"), phase.rheology
        if isinstance(law, Yielding) and law.yield_stress == 0.0:
            yield path, law, ("regularisation",), "yield_stress is 0"
        if isinstance(law, Thinning) and law.flow_index == 1.0:
            yield path, law, ("least_shear_rate",), "flow_index is 1"
        if isinstance(law, Carreau) and (law.flow_index == 1.0 or law.relaxation_time == 0.0):
            why = "flow_index is 1" if law.flow_index == 1.0 else "relaxation_time is 0"
            yield path, law, ("infinite_viscosity", "relaxation_time"), f"{why} and the viscosity is that at rest"
