"""Checks of names, sizes and bodies of fluid in a scene. A failed check raises a `field_error`."""

from itertools import product
from typing import Any

import numpy as np

from cortado.calls import point_in_words
from cortado.device.threads import sampling_parts, shortage
from cortado.discretise.mesh_files import read_mesh
from cortado.discretise.room import TOLERANCE
from cortado.discretise.shapes import Points, corners, grid
from cortado.discretise.smoothing import CUBIC_SPLINE
from cortado.errors import Words, shown
from cortado.scene.drain_tables import check_drains
from cortado.scene.emitter_table import EmitterTable, check_columns, check_fed
from cortado.scene.fluids import Fluid, FluidBody, PointsFluid
from cortado.scene.links import check_free_body, check_hinges, check_springs
from cortado.scene.model import MixtureTable, SceneTables
from cortado.scene.motions import free
from cortado.scene.parameters import BY_NAME
from cortado.scene.shape_tables import MeshShape, check_length
from cortado.scene.tables import MISSING, FieldPath, check_name, field_error, field_name, usable_file

DEEPEST = 0.25
"""Greatest initial overlap of a free body with a solid [spacings]."""
FINE, MOST = 0.5, 40
"""Distance between test points for overlaps [spacings], and greatest number of test points along an axis."""


def check_free_bodies(scene: SceneTables) -> None:
    bodies = free(scene.solid)
    if not bodies:
        return
    _check_solver(
        scene, f"as the solid {bodies[0].name!r} is free", ", and pressures that are not shared with it move it"
    )
    rubbed = next((body for body in bodies if body.sticks), None)
    if rubbed is not None and scene.forces.viscous_solve == "explicit":
        wanted = f'"implicit" or "automatic", as the solid {rubbed.name!r} is free and has no slip'
        raise field_error(("forces", "viscous_solve"), "explicit", wanted)
    spacing, lengths = scene.discretisation.spacing, scene.periods[1]
    for index, table in enumerate(scene.solid):
        if table.motion != "free":
            continue
        solid, step = table.solid(), FINE * spacing
        ends = zip(*solid.extent(), strict=True)
        lattice = grid([np.linspace(a, b, min(int((b - a) / step) + 2, MOST)) for a, b in ends])
        points = np.concatenate([solid.faces(step).vertices, lattice[solid.distance(lattice) < 0.0]])
        depths = [("the container", scene.region.distance(points))]
        for other in scene.solid:
            if other is not table:
                away = np.round((points - np.mean(other.solid().extent(), axis=0)) / np.where(lengths, lengths, np.inf))
                depths.append((f"the solid {other.name!r}", -other.solid().distance(points - lengths * away)))
        for name, depth in depths:
            if depth.max() > DEEPEST * spacing:
                place = point_in_words(points[depth.argmax()])
                wanted = f"at most a quarter of a spacing, {DEEPEST * spacing:g} m, in it"
                raise field_error(("solid", index), Words(f"{depth.max():g} m deep in {name} at {place}"), wanted)


def check_sheets(scene: SceneTables) -> None:
    name = next((table.name for table in scene.solid if table.is_sheet), None)
    if name is None:
        return
    why = f"as the solid {name!r} is a sheet"
    _check_solver(scene, why)
    if scene.periods[1].any():
        axis = int(np.argmax(scene.periods[1] > 0.0))
        raise field_error(("container", "periodic", axis), True, f"false, {why}, and sheets have no periodic images")
    for index, table in enumerate(scene.solid):
        if table.motion == "free":
            raise field_error(("solid", index, "motion"), "free", f'"fixed" or "path", {why}, through which bodies go')


def _check_solver(scene: SceneTables, why: str, and_why: str = "") -> None:
    if scene.solver.kind != "projection":
        raise field_error(("solver", "kind"), scene.solver.kind, f'"projection", {why}{and_why}')
    if not scene.forces.pressure:
        raise field_error(("forces", "pressure"), False, f"true, {why}")


NEAREST = 0.5
"""Smallest initial distance between particles [spacings]."""
OVERLAPPING = NEAREST * (1.0 - 1e-6)
DENSEST = 0.9
"""Greatest relative number density of one body of fluid at a particle of another body."""
SUPPORT, NEIGHBOURS = 2.0, 40
"""Support radius for number densities [spacings], and greatest number of neighbours in the sum."""


def check_distinct(path: FieldPath, fluid: Fluid, spacing: float) -> None:
    if not isinstance(fluid, PointsFluid) or fluid.count(spacing) < 2:
        return
    points = fluid.points()
    distinct, counts = np.unique(points, axis=0, return_counts=True)
    if len(distinct) < len(points):
        raise field_error(path, *_overlap("itself", distinct[np.argmax(counts)], spacing))
    from scipy.spatial import cKDTree

    distances = cKDTree(points).query(points, k=[2])[0].ravel()
    if distances.min() < OVERLAPPING * spacing:
        raise field_error(path, *_overlap("itself", points[np.argmin(distances)], spacing))


def check_overlaps(placed: list[tuple[FieldPath, FluidBody]], lengths: Points, spacing: float) -> None:
    """``lengths`` (d,) [m] are the lengths of the periodic box, and 0 along other axes."""
    paths, bodies = zip(*placed, strict=True)
    lower, upper = np.swapaxes([body.extent(spacing) for body in bodies], 0, 1)
    shifts = [np.array(s) * lengths for s in product(*[(0, -1, 1) if length else (0,) for length in lengths])]
    for second, shift in product(range(len(bodies)), shifts):
        last = second + 1 if shift.any() else second
        gaps = np.maximum(lower[:last] - upper[second] - shift, lower[second] + shift - upper[:last])
        for first in np.nonzero((gaps < OVERLAPPING * spacing).all(axis=1))[0]:
            place = _meeting(bodies[first], bodies[second], shift, spacing)
            if place is not None:
                raise field_error(paths[second], *_overlap(field_name(paths[first]), place, spacing))


def _meeting(first: FluidBody, second: FluidBody, shift: Points, spacing: float) -> Points | None:
    from scipy.spatial import cKDTree

    one = _near(first.particles(spacing), np.array(second.extent(spacing)) + shift, spacing)
    other = _near(second.particles(spacing) + shift, first.extent(spacing), spacing)
    if not len(one) or not len(other):
        return None
    distances = cKDTree(one).query(other)[0]
    if distances.min() < OVERLAPPING * spacing:
        return other[np.argmin(distances)]
    for points, body in ((other, one), (one, other)):
        tree = cKDTree(body)
        close = points[tree.query(points)[0] < spacing * (1.0 - 1e-6)]
        distances = tree.query(close, k=NEIGHBOURS, distance_upper_bound=SUPPORT * spacing)[0]
        weights = CUBIC_SPLINE.weight(distances, close.shape[1], SUPPORT * spacing)
        density = spacing ** close.shape[1] * weights.sum(axis=1)
        if density.max(initial=0.0) > DENSEST:
            return close[np.argmax(density)]
    return None


def _near(points: Points, extent: Any, spacing: float) -> Points:
    reach = SUPPORT * spacing
    return points[((points > extent[0] - reach) & (points < extent[1] + reach)).all(axis=1)]


def _overlap(other: str, place: Points, spacing: float) -> tuple[Words, str]:
    wanted = f"at least half a spacing, {NEAREST * spacing:g} m, from it everywhere"
    return Words(f"overlapping {other} at {point_in_words(place)}"), wanted


MOST_PARTICLES = 2e8
FURTHEST = 1e9
"""Greatest allowed distance of a scene from the origin [spacings]."""


def check_scene(scene: SceneTables) -> None:
    spacing = scene.discretisation.spacing
    if not (scene.fluid or scene.emitter):
        found = Words("empty") if "fluid" in scene.model_fields_set else MISSING
        raise field_error(("fluid",), found, "a list of at least one table, as there is no emitter")
    _check_phases(scene)
    _check_files_and_counts(scene)
    for path, body in _bodies(scene):
        if body.count(spacing) == 0.0:
            wanted = f"at least one spacing, {spacing:g} m, wide along every axis"
            raise field_error(path, Words("too thin to hold a particle"), wanted)
        if isinstance(body, EmitterTable) and body.length is not None and body.layers(spacing) == 0.0:
            wanted = f"greater than half a spacing, {0.5 * spacing:g} m, for the column to hold a layer of particles"
            raise field_error((*path, "length"), body.length, wanted)
        _check_near(path, body.extent(spacing), spacing)
    check_length(scene.container, spacing, scene.discretisation.support_radius)
    if (ends := scene.container.extent()) is not None:
        _check_near(("container",), ends, spacing)
    for index, solid in enumerate(scene.solid):
        _check_near(("solid", index), solid.body().extent(), spacing)
        least = solid.least_thickness * spacing
        if solid.side == "outside" and (thickness := solid.thinnest(spacing)) < least * (1.0 - 1e-6):
            found, of = Words(f"only {thickness:g} m thick"), "one spacing" if least == spacing else "half a spacing"
            wanted = f'at least {of}, {least:g} m, thick, or a solid of the shape "sheet"'
            raise field_error(("solid", index), found, wanted)
    check_hinges(scene.hinge, scene.solid, scene.dimension)
    check_springs(scene.spring, scene.hinge, scene.solid)
    check_free_bodies(scene)
    check_drains(scene)
    check_fed(scene)
    check_sheets(scene)
    check_columns(scene)
    for key in ("solid", "emitter", "drain", "spring", "hinge", "sensor"):
        for index, table in enumerate(getattr(scene, key)):
            if "/" in (table.name or ""):
                raise field_error((key, index, "name"), table.name, 'without "/"')
    _check_sensors(scene)
    for index, fluid in enumerate(scene.fluid):
        _check_inside(scene, index, fluid)
        if isinstance(fluid, PointsFluid):
            _check_outside_solids(scene, ("fluid", index), fluid.points())
        check_distinct(("fluid", index), fluid, spacing)
    for index, emitter in enumerate(scene.emitter):
        _check_outlet(scene, ("emitter", index), emitter)
    check_overlaps(_bodies(scene), scene.periods[1], spacing)
    _check_schedule(scene)


def _bodies(scene: SceneTables) -> list[tuple[FieldPath, FluidBody]]:
    fluids: list[tuple[FieldPath, FluidBody]] = [(("fluid", index), fluid) for index, fluid in enumerate(scene.fluid)]
    return [*fluids, *((("emitter", index), emitter) for index, emitter in enumerate(scene.emitter))]


def _check_phases(scene: SceneTables) -> None:
    names = [phase.name for phase in scene.phase]
    for index, name in enumerate(names):
        if name in names[:index]:
            raise field_error(("phase", index, "name"), name, f"different from that of phase[{names.index(name)}]")
    for path, body in _bodies(scene):
        check_name((*path, "phase"), body.phase, names, "a phase")
    for index, phase in enumerate(scene.phase):
        if phase.rheology is not None and len(names) > 1:
            wanted = "left out where there are several phases"
            raise field_error(("phase", index, "rheology"), phase.rheology.kind, wanted)
    if scene.phase[0].rheology is not None and scene.forces.viscosity != "stress":
        raise field_error(("forces", "viscosity"), scene.forces.viscosity, '"stress", as the phase has a rheology')
    if scene.forces.viscosity == "pairwise" and scene.solver.kind != "pcisph":
        wanted = '"stress" or "none", as the solver is not "pcisph"'
        raise field_error(("forces", "viscosity"), "pairwise", wanted)
    if len(names) == 1 and scene.mixture != MixtureTable():
        raise field_error(("mixture",), Words("given"), "left out, as the scene has only one phase")


def _check_sensors(scene: SceneTables) -> None:
    names, springs = ([one.name for one in tables] for tables in (scene.solid, scene.spring))
    moving = [solid.name for solid in scene.solid if solid.moves]
    for index, sensor in enumerate(scene.sensor):
        path = "sensor", index
        if sensor.kind == "solid_load":
            check_name((*path, "solid"), sensor.solid, names, "a solid", "of a scene with solids")
            if sensor.axes == "body" and sensor.solid not in moving:
                raise field_error((*path, "axes"), sensor.axes, '"world", as the solid is at rest')
        elif sensor.kind == "spring_force":
            check_name((*path, "spring"), sensor.spring, springs, "a spring", "of a scene with springs")
        elif sensor.kind == "body_motion":
            check_free_body((*path, "solid"), sensor.solid, scene.solid)
        elif sensor.kind != "flow_rate":
            if sensor.on is not None:
                check_name((*path, "on"), sensor.on, moving, "a solid that moves", "left out, as no solid moves")
            if sensor.kind != "pressure_probe" and sensor.axes == "body" and sensor.on is None:
                raise field_error((*path, "axes"), sensor.axes, '"world", as the sensor is on no solid')


def _check_files_and_counts(scene: SceneTables) -> None:
    spacing, support = scene.discretisation.spacing, scene.discretisation.support_radius
    for name, tables, reach in (("solid", scene.solid, support), ("fluid", scene.fluid, None)):
        for index, table in enumerate(tables):
            if isinstance(table, MeshShape):
                with usable_file((name, index, "file"), table.file, "a file of a mesh"):
                    read_mesh(table.file, table.scale, spacing, reach, scene.container.extent())
    for index, fluid in enumerate(scene.fluid):
        if isinstance(fluid, PointsFluid):
            with usable_file(("fluid", index, "file"), fluid.file, "a file of positions"):
                fluid.points()
    particles = sum(body.count(spacing) for _, body in _bodies(scene))
    walls = scene.container.wall_count(spacing) + sum(solid.wall_count(spacing) for solid in scene.solid)
    for count, what in ((particles, "particles of fluid"), (walls, "wall particles")):
        if count > MOST_PARTICLES:
            wanted = f"so large that there are at most {MOST_PARTICLES:.0e} {what}, not about {count:.1e}"
            raise field_error(("discretisation", "spacing"), spacing, wanted)
    if lack := shortage(sampling_parts(particles, walls)):
        wanted = f"larger, or the fluid and the container smaller: the scene needs {lack}"
        raise field_error(("discretisation", "spacing"), spacing, wanted)


def _check_near(path: FieldPath, ends: Any, spacing: float) -> None:
    if (furthest := np.abs(ends).max()) > FURTHEST * spacing:
        found = Words(f"{furthest:g} m from the origin")
        raise field_error(path, found, f"within {FURTHEST:g} spacings of {spacing:g} m")


def _check_inside(scene: SceneTables, index: int, fluid: Fluid) -> None:
    spacing = scene.discretisation.spacing
    tolerance, (lower, upper) = 1e-6 * spacing, fluid.extent(spacing)
    if scene.container.contains(corners(lower, upper), tolerance).all():
        return
    region, place = scene.container.region(scene.dimension), 0.5 * (lower + upper)
    for ends, beyond in ((lower, region.lower - lower), (upper, upper - region.upper)):
        axis = int(np.argmax(beyond))
        if beyond[axis] > tolerance:
            place[axis] = ends[axis]
            break
    else:
        particles = fluid.particles(spacing)
        outside = ~scene.container.contains(particles, tolerance)
        if not outside.any():
            return
        place = particles[outside][0]
    found = Words(f"partly outside, for example at {point_in_words(place)}")
    raise field_error(("fluid", index), found, "inside the container")


def _check_outside_solids(scene: SceneTables, path: FieldPath, points: Points) -> None:
    within = scene.room.from_solids(points) < -TOLERANCE * scene.discretisation.spacing
    if within.any():
        found = Words(f"partly in a solid, for example at {point_in_words(points[within][0])}")
        raise field_error(path, found, "outside of solids")


def _check_outlet(scene: SceneTables, path: FieldPath, emitter: EmitterTable) -> None:
    spacing, lengths = scene.discretisation.spacing, scene.periods[1]
    tolerance, outlet, opening = 1e-6 * spacing, np.array(emitter.outlet), emitter.opening(spacing)
    if not scene.container.contains(outlet[None], tolerance).all():
        raise field_error((*path, "outlet"), emitter.outlet, "inside the container")
    outside = ~scene.container.contains(opening, tolerance)
    _check_outside_solids(scene, path, np.concatenate([opening, emitter.particles(spacing)]))
    if outside.any():
        wanted = f"so small that the opening is inside the container, also at {point_in_words(opening[outside][0])}"
        size = "radius" if emitter.sides is None else "sides"
        raise field_error((*path, size), getattr(emitter, size), wanted)
    ahead = outlet + np.where(lengths > 0.0, 0.0, spacing * np.array(emitter.direction))
    if not scene.container.contains(ahead[None], tolerance).all():
        raise field_error((*path, "direction"), emitter.direction, "into the container, where the outlet is")
    if (lengths > 0.0).all() and emitter.supply(spacing) > emitter.layers(spacing):
        wanted = "left out, as no axis is without a period, along which a reserve could be put aside"
        raise field_error((*path, "volume"), emitter.volume, wanted)
    for index, place in enumerate(() if emitter.path is None else emitter.path.knots.seen):
        key = (*path, "path", "values", index)
        if index == 0 and np.abs(place - outlet).max() > tolerance:
            wanted = f"{field_name((*path, 'outlet'))}, {shown(emitter.outlet)}, where the opening is at the start"
            raise field_error(key, place.tolist(), wanted)
        if not scene.region.contains(place + opening - outlet, tolerance).all():
            raise field_error(key, place.tolist(), "where all of the opening is inside the container")
    ends, (lower, upper) = scene.container.extent(), emitter.extent(spacing)
    if ends is None:
        return
    out = (lengths > 0.0) & ((lower < ends[0] - tolerance) | (upper > ends[1] + tolerance))
    if out.any():
        found = Words(f"partly outside along axis {int(np.argmax(out))}, which is periodic")
        raise field_error(path, found, "inside the container along that axis")


def _check_schedule(scene: SceneTables) -> None:
    courses = scene.schedule.courses
    for name in courses:
        if not BY_NAME[name].present(scene):
            raise field_error(("schedule", name), Words("given"), f"left out, as the scene {BY_NAME[name].absent}")
    if "gravity" in courses and "tilt" in courses:
        raise field_error(("schedule", "gravity"), Words("given"), "left out, as the tilt says where gravity points")
    if "gravity" in courses:
        usual = type(scene.forces).model_fields["gravity"].default[: scene.dimension]
        first = tuple(courses["gravity"].values[0].tolist())
        if scene.forces.gravity not in (usual, first):
            wanted = f"left out, or {shown(first)}, with which schedule.gravity begins, as that acts in its place"
            raise field_error(("forces", "gravity"), scene.forces.gravity, wanted)
