"""Warnings about keys without effect and about inaccurate physics."""

from collections.abc import Iterator
from itertools import product
from typing import Any

import numpy as np

from cortado.calls import point_in_words
from cortado.discretise.room import Room
from cortado.discretise.solid_walls import surface_feet
from cortado.scene.appearance import Keyframes
from cortado.scene.courses import Steady
from cortado.scene.fluids import PointsFluid
from cortado.scene.model import Carreau, SceneTables, Thinning, Yielding
from cortado.scene.motions import courses, told
from cortado.scene.shape_tables import BoxContainer
from cortado.scene.solids import SolidTable, thick
from cortado.scene.solvers import what_suits
from cortado.scene.stability import fluid_lengths
from cortado.scene.tables import FieldPath, Table, field_error, field_name

OF_DIFFUSION = ("free_energy", "strength", "mobility_form", "interface_width")
OF_ITERATIONS = (
    *("minimum_iterations", "maximum_iterations", "density_tolerance", "maximum_density_tolerance"),
    *("iterations", "tolerance", "repairs", "velocities_follow"),
)
OF_SPACE = ("surface", "field_of_view", "transparency", "floor")


def given(table: Table, *names: str) -> Iterator[str]:
    """Yield the keys in ``names`` that have a value other than the default in the table."""
    for name in names:
        field = type(table).model_fields.get(name)
        if field is not None and getattr(table, name) != field.default:
            yield name


def check_idle(scene: SceneTables) -> None:
    for path, table, names, reason in _idle(scene):
        for name in given(table, *names):
            raise field_error((*path, name), getattr(table, name), f"left out, as {reason}")


def idle_sentences(scene: SceneTables) -> Iterator[str]:
    for path, table, names, reason in _turned_off(scene):
        for name in given(table, *names):
            yield f"{field_name((*path, name))} changes nothing, as {reason}."


Idle = tuple[FieldPath, Table, tuple[str, ...], str]
"""Path of a table, the table itself, the names of keys without effect, and the reason."""


def _idle(scene: SceneTables) -> Iterator[Idle]:
    forces, mixture = scene.forces, scene.mixture
    if mixture.mobility == 0.0 and "mobility" not in mixture.model_fields_set:
        yield ("mixture",), mixture, OF_DIFFUSION, "there is no mobility, without which nothing diffuses"
    if forces.viscosity != "stress":
        yield ("forces",), forces, ("viscous_solve",), f'viscosity is "{forces.viscosity}", and not "stress"'
    if np.all(getattr(scene.container, "periodic", False)):
        walls = ("slip", "material", "colour")
        yield ("container",), scene.container, walls, "it has no walls where all axes are periodic"
    if scene.dimension == 2:
        tables: list[tuple[FieldPath, Table]] = [(("phase", index), phase) for index, phase in enumerate(scene.phase)]
        for place, table in [*tables, (("container",), scene.container)]:
            if "colour" in table.model_fields_set and getattr(table, "colour", None) is not None:
                yield place, table, ("material",), "colour is given, which is all that a plane shows of it"
    picture, path = scene.picture, ("picture",)
    if picture is None:
        return
    if scene.dimension == 2:
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
    spacing = scene.discretisation.spacing
    for index, emitter in enumerate(scene.emitter):
        if emitter.length is not None and emitter.layers(spacing) * spacing < emitter.length - spacing:
            yield ("emitter", index), emitter, ("length",), "the volume is less than so long a column has"
    for index, solid in enumerate(scene.solid):
        names = tuple(name for name in ("centre", "base") if any(getattr(solid, name, ())))
        if not np.allclose(solid.centroid(), solid.shape_about()[1]):
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


def creep_sentence(scene: SceneTables) -> str | None:
    phase, law = scene.phase[0], scene.phase[0].rheology
    if not isinstance(law, Yielding) or law.yield_stress == 0.0 or not scene.fluid:
        return None
    lengths, pull = fluid_lengths(scene), np.abs(scene.forces.gravity)
    depth = lengths[pull.argmax()] if pull.any() else lengths.max()
    growth = law.numbers(phase.viscosity)["regularisation"]
    return (
        f"where {phase.name} does not yield, below {law.yield_stress:g} Pa, it creeps, at up to "
        f"{depth / growth:.2g} m/s: its depth, {depth:g} m, over rheology.regularisation, "
        f"{growth:g} s; a longer one makes it slower."
    )


def viscosity_sentence(scene: SceneTables, where: str) -> str | None:
    """Return a warning that begins with the text ``where``, or None if viscosity is accurate."""
    if scene.forces.viscosity != "pairwise":
        return None
    fault = "with which fluid is 0.6 to 1.4 times as viscous as asked for, by the direction of the shear"
    return f'{where} and forces.viscosity is "pairwise", {fault}: viscosity = "stress" has it within 1 %.'


THROUGH = 1.5
"""Recommended length of a moving solid beyond a container wall that the solid crosses [spacings]."""
FACING = 0.9
"""A face counts as perpendicular to an axis if the axis component of its unit normal is greater than this number."""


def standing_sentences(scene: SceneTables) -> Iterator[str]:
    """Yield warnings about moving solids that end at a flat wall of the container."""
    box = scene.container
    if not isinstance(box, BoxContainer):
        return
    spacing, ends = scene.discretisation.spacing, box.extent()
    for table in thick(told(scene.solid)):
        axes = [axis for axis in range(scene.dimension) if not box.periodic[axis] and _stays(table, axis, spacing)]
        if table.side == "inside" or not axes:
            continue
        feet, away = surface_feet(table.solid(), spacing)
        for axis, upper in product(axes, (False, True)):
            sign = 1.0 if upper else -1.0
            through = sign * (feet[:, axis] - ends[upper][axis])
            on_it = (sign * away[:, axis] > FACING) & (through > -0.5 * spacing) & (through < 0.75 * spacing)
            if np.count_nonzero(on_it) > 2:
                yield (
                    f"the solid {table.name!r} moves along the wall of the container at {'xyz'[axis]} = "
                    f"{ends[upper][axis]:g} m and ends on it, which stirs fluid in the corner between them: let it "
                    f"reach through the wall by {THROUGH * spacing:.3g} m or more."
                )


def _stays(table: SolidTable, axis: int, spacing: float) -> bool:
    shifts, turns = courses(table)
    if turns.greatest() > 0.0:
        return False
    if isinstance(shifts, Steady):
        return bool(shifts.rate[axis] == 0.0)
    return bool(np.ptp(shifts.seen[:, axis]) < 0.5 * spacing)


ONE_LAYER, TWO_LAYERS = 1.1, 1.5
"""Smallest thickness of a leak-proof solid, for one and for two layers of wall particles [spacings]."""
DEPTHS = np.arange(1, 9) / 8.0
"""Depths at which the thickness of a solid is tested, as fractions of the smallest allowed thickness."""
MARGIN = 1e-3
"""Tolerance of the thickness, as a fraction of the smallest allowed thickness."""
SHARE = 0.01
"""Fraction of a solid's surface that may be above too thin walls without a warning."""


def thin_sentences(scene: SceneTables) -> Iterator[str]:
    cut = scene.discretisation
    spacing, least = cut.spacing, (ONE_LAYER if cut.support <= 2.0 else TWO_LAYERS) * cut.spacing
    for table in thick(scene.solid) if scene.forces.pressure else ():
        solid, resting = table.solid(), scene.resting_room
        room = Room(resting.region, (solid,), resting.periods) if table.moves else resting
        feet, away = surface_feet(solid, spacing)
        feet, away = (part[room.contains(feet + MARGIN * least * away, 0.0)] for part in (feet, away))
        depths = (1.0 - MARGIN) * least * DEPTHS
        thin = np.any([room.contains(feet - depth * away, -MARGIN * depth) for depth in depths], axis=0)
        if np.count_nonzero(thin) > SHARE * len(thin):
            place = point_in_words(feet[thin][0].round(4))
            yield (
                f"the solid {table.name!r} is thinner than {least:.3g} m, {least / spacing:g} times the spacing, at "
                f"{np.mean(thin):.0%} of its surface, for example at {place}: fluid that presses on it may go "
                "through. Make it thicker, or the spacing smaller."
            )
