"""Estimates of the greatest stable time step of a scene."""

from collections.abc import Sequence
from math import inf, sqrt

import numpy as np

from cortado.discretise.shapes import Points
from cortado.discretise.smoothing import pairwise_rate, smoothing_kernel, stress_rate
from cortado.scene.drain_tables import flow_name, sink_limit
from cortado.scene.links import spring_limit
from cortado.scene.model import SceneTables
from cortado.scene.motions import free, greatest_speed, moving, position_name, rotation_name, scale_name, told
from cortado.scene.parameter_values import Arrays, Tilt
from cortado.scene.parameters import PARAMETERS
from cortado.scene.solids import SolidTable, solids_of
from cortado.scene.solvers import ProjectionSolver


def greatest_fall(scene: SceneTables, gravity: Points) -> float:
    """Return the greatest energy per mass [J/kg] of a fall inside the container, for gravity (k, d) [m/s2]."""
    lower, upper = _extent(scene)
    return float((np.abs(gravity) @ (upper - lower)).max())


def fall_to(scene: SceneTables, solid: SolidTable, gravity: Points, values: Arrays) -> float:
    """Return the greatest energy per mass [J/kg] of a fall to the lowest point of a solid, for gravity (k, d) [m/s2].

    The fall begins at the highest point of initial fluid, free bodies and emitters. If gravity changes or the solid
    moves, the result is `greatest_fall`.
    """
    whole = greatest_fall(scene, gravity)
    around = scene.periods[1] > 0.0
    stirred = greatest_speed(told(scene.solid), values) > 0.0 or any(one.surface_velocity for one in scene.solid)
    elsewhere = {name(one.name) for one in moving(scene.solid) for name in (position_name, rotation_name, scale_name)}
    if len(gravity) > 1 or (gravity[0] * around).any() or stirred or solid.motion == "free" or elsewhere & {*values}:
        return whole
    spacing, places = scene.discretisation.spacing, values.get("initial_positions")
    if places is not None and len(places):
        extents = [(places.min(axis=0), places.max(axis=0))]
    else:
        extents = [fluid.extent(spacing) for fluid in scene.fluid]
    boxes = [(lower - 0.5 * spacing, upper + 0.5 * spacing) for lower, upper in extents]
    boxes += [body.extent() for body in solids_of(tuple(free(scene.solid)))]
    openings = [emitter.opening(spacing) for emitter in scene.emitter]
    boxes += [(opening.min(axis=0), opening.max(axis=0)) for opening in openings]
    highest = min((np.minimum(*(gravity[0] * np.array(ends))).sum() for ends in boxes), default=-inf)
    foot = np.clip(solid.solid().extent(), *_extent(scene))
    return float(np.clip(np.maximum(*(gravity[0] * foot)).sum() - highest, 0.0, whole))


def _extent(scene: SceneTables) -> tuple[Points, Points]:
    outlets = [(np.array(emitter.outlet),) * 2 for emitter in scene.emitter]
    ends, spacing = scene.container.extent(), scene.discretisation.spacing
    if ends is not None:
        boxes = [ends]
    else:
        fluids = [fluid.extent(spacing) for fluid in scene.fluid]
        boxes = [(lower - 0.5 * spacing, upper + 0.5 * spacing) for lower, upper in fluids]
        boxes += [solid.extent() for solid in solids_of(scene.solid)]
    lower, upper = np.swapaxes([*boxes, *outlets], 0, 1)
    return lower.min(axis=0), upper.max(axis=0)


VISCOUS_RATES = {"stress": (stress_rate, 0.5), "pairwise": (pairwise_rate, 0.65)}
"""Function for the greatest viscous rate on a lattice, and safety factor, by form of the viscous force."""
DEPTH_FACTORS = {"cubic_spline": 1.8, "wendland_c2": 1.6, "wendland_c4": 1.2}
"""Factors of the time step limit for deep fluid, by smoothing kernel."""
RESTING, RUNNING = 0.63, 0.4
"""Factors of the time step limit for deep fluid with a coarse pressure grid. ``RESTING`` is for fluid that covers the
floor of its container, ``RUNNING`` for other fluid."""
SOLID_STEP = 0.2
"""Greatest motion of a solid in a time step [spacings]."""
FRICTION_STEP = 0.25
"""Greatest product of kinematic viscosity and time step beside no-slip free bodies [spacings²]."""
BESIDE, THROUGH = 0.4, 0.25
"""Greatest motion of fluid beside a solid in a time step: in spacings, and as a fraction of the solid's thickness."""


def chosen_limits(scene: SceneTables, values: Arrays | None = None) -> dict[str, float]:
    """Return upper bounds of adaptive time steps [s] by name: `standing_limits` and the key ``greatest_time_step``.

    If gravity changes, `gravity_limits` bounds each time step separately.
    """
    own = {name: value for name, value in (values or {}).items() if name != "gravity"}
    found = standing_limits(scene, own, [solid for solid in scene.solid if solid.is_steady])
    if scene.schedule.leads_gravity:
        found |= {name: float(limits.max()) for name, limits in gravity_limits(scene, _gravity(scene)).items()}
    greatest = scene.solver.greatest_time_step
    if greatest is not None:
        return {**found, "greatest_time_step": greatest}
    return found if min(found.values()) < inf else standing_limits(scene, own, scene.solid)


def longest_step(scene: SceneTables) -> float:
    size = scene.solver.time_step
    return min(chosen_limits(scene).values()) if size == "auto" else size


def broken_limits(scene: SceneTables, values: Arrays, time_step: float) -> list[tuple[str, float]]:
    """Return the names and values [s] of the stability limits that ``time_step`` exceeds, smallest first."""
    limits = sorted(stability_limits(scene, values).items(), key=lambda item: item[1])
    return [(name, limit) for name, limit in limits if time_step > limit * (1.0 + 1e-9)]


def divergence_advice(scene: SceneTables, values: Arrays, time_step: float) -> str:
    if scene.solver.chooses:
        return "try a smaller solver.courant or solver.greatest_time_step, or more pressure iterations"
    broken = broken_limits(scene, values, time_step)
    if not broken:
        return f"try a smaller time step than {time_step:g} s, or more pressure iterations"
    name, limit = broken[0]
    return f"{name} limits the time step to about {limit:.2g} s, but it is {time_step:g} s: try one within the limit"


def stability_limits(scene: SceneTables, values: Arrays | None = None) -> dict[str, float]:
    """Return the stability limits of the time step [s] by name. A stability limit that does not apply is infinite. In
    the formulas h is the support radius, s the spacing and g gravity.

    Courant: 0.4 h / v (Monaghan 1992). The speed v is the larger of the initial speed and the speed after a free fall
    through the container. The speed v is at least the speed of emitted fluid.

    Solids: beside a solid, fluid moves at most 0.4 spacings in a time step, and at most a quarter of the solid's
    thickness.

    Force: 0.25 sqrt(h / |g|) (Monaghan 1992).

    Viscosity: a fraction of the longest stable explicit time step on a lattice; see `VISCOUS_RATES`.

    Depth: C s^(3/2) / (H sqrt(|g|)) for fluid of depth H, where the factor C is from `DEPTH_FACTORS`. With a coarse
    pressure grid, the limit of the time step is C s / sqrt(H |g|), where C is `RESTING` or `RUNNING`. In a tilted
    container, H is the depth in the lowest corner.

    Friction: 0.25 s^2 / nu for no-slip free bodies in fluid of kinematic viscosity nu.

    Moving solids move at most a fifth of a spacing in a time step, and fluid near a sink moves at most 0.4 spacings.
    The registry of parameters contains the limits of optional forces. Parameters in ``values`` replace the scene's
    parameters and schedule. If gravity changes during a run, the strongest gravity is used.
    """
    values = values or {}
    gravity, spacing = np.atleast_2d(values.get("gravity", _gravity(scene))), scene.discretisation.spacing
    if "initial_velocities" in values:
        first = float(np.linalg.norm(values["initial_velocities"], axis=1).max())
    else:
        first = max((fluid.greatest_speed(spacing) for fluid in scene.fluid), default=0.0)
    for emitter in scene.emitter:
        flow = float(np.max(values.get(flow_name(emitter.name), emitter.greatest)))
        first = max(first, flow / emitter.area(spacing))
    speed, found = first + sqrt(2.0 * greatest_fall(scene, gravity)), {"speed": inf}
    if speed > 0.0:
        found["speed"] = 0.4 * scene.discretisation.support_radius / speed
    for solid in scene.solid if speed > 0.0 else ():
        beside = first + sqrt(2.0 * fall_to(scene, solid, gravity, values))
        way = min(THROUGH * solid.thinnest(spacing), BESIDE * spacing) if solid.side == "outside" else inf
        found["solids"] = min(found.get("solids", inf), way / beside if beside > 0.0 else inf)
    return {**found, **standing_limits(scene, values, scene.solid)}


def standing_limits(scene: SceneTables, values: Arrays, solids: Sequence[SolidTable]) -> dict[str, float]:
    """Return the stability limits [s] that do not depend on the speed of the fluid."""
    viscous = inf if is_implicit(scene) else viscous_limit(scene, values)
    own = {**_other_limits(scene, values), "viscosity": viscous}
    if (fastest := greatest_speed(solids, values)) > 0.0:
        own["the speed of solids"] = SOLID_STEP * scene.discretisation.spacing / fastest
    if scene.spring or any(hinge.turned_by for hinge in scene.hinge):
        own["springs"] = spring_limit(scene, values)
    if any(body.sticks for body in free(scene.solid)) and (greatest := _kinematic(scene, values)) > 0.0:
        own["friction"] = FRICTION_STEP * scene.discretisation.spacing**2 / greatest
    if (longest := sink_limit(scene, values)) < inf:
        own["drains"] = longest
    return {name: own[name] for name in ("gravity", "depth", "viscosity", *own)}


def gravity_limits(scene: SceneTables, gravity: Points) -> dict[str, Points]:
    """Return the stability limits (k,) [s] that depend on gravity (k, d) [m/s2]."""
    cut, acts, depth = scene.discretisation, gravity.any(axis=1), np.full(len(gravity), inf)
    with np.errstate(divide="ignore"):
        force = 0.25 * np.sqrt(cut.support_radius / np.linalg.norm(gravity, axis=1))
    if not scene.forces.pressure or not acts.any() or not scene.fluid:
        return {"gravity": force, "depth": depth}
    pulls, lengths, ends = np.abs(gravity[acts]), fluid_lengths(scene), scene.container.extent()
    along, axes = pulls * lengths, pulls.argmax(axis=1)
    upright = np.take_along_axis(along, axes[:, None], axis=1)[:, 0]
    roots = np.sqrt(np.linalg.norm(pulls, axis=1))
    depths = 0.5 * (upright + along.sum(axis=1)) / roots  # times sqrt(|g|)
    if isinstance(scene.solver, ProjectionSolver):
        covers_floor = np.zeros(len(axes), dtype=bool)
        if ends is not None:
            gaps = ends[1] - ends[0] - lengths > cut.spacing
            covers_floor = gaps.sum() == gaps[axes]
        depth[acts] = np.where(covers_floor, RESTING, RUNNING) * cut.spacing / np.sqrt(depths * roots)
    else:
        depth[acts] = DEPTH_FACTORS[cut.kernel] * 0.5 * cut.support * cut.spacing**1.5 / depths
    return {"gravity": force, "depth": depth}


def _other_limits(scene: SceneTables, values: Arrays) -> dict[str, float]:
    gravity = np.atleast_2d(values.get("gravity", _gravity(scene)))
    of_gravity = {name: float(limits.min()) for name, limits in gravity_limits(scene, gravity).items()}
    optional = [p for p in PARAMETERS if p.is_optional and p.present(scene)]
    return {**of_gravity, **{p.name.replace("_", " "): p.longest_step(scene, values) for p in optional}}


def is_implicit(scene: SceneTables, values: Arrays | None = None) -> bool:
    values = values or {}
    if scene.forces.viscosity != "stress" or scene.forces.viscous_solve == "explicit":
        return False
    if scene.forces.viscous_solve == "implicit" or any(body.sticks for body in free(scene.solid)):
        return True
    size = values.get("time_step", scene.solver.time_step)
    longest = min(_other_limits(scene, values).values()) if isinstance(size, str) else float(size)
    return longest > viscous_limit(scene, values)


def _gravity(scene: SceneTables) -> Points:
    courses = scene.schedule.courses
    if "tilt" in courses:
        return Tilt(scene.forces.gravity).gravity(courses["tilt"].seen)
    return courses["gravity"].seen if "gravity" in courses else np.array(scene.forces.gravity)


def viscous_limit(scene: SceneTables, values: Arrays) -> float:
    kinematic = _kinematic(scene, values)
    if kinematic <= 0.0:
        return inf
    rate, part = VISCOUS_RATES[scene.forces.viscosity]
    cut = scene.discretisation
    greatest = rate(smoothing_kernel(cut.kernel), cut.spacing, cut.support_radius, scene.dimension)
    return part * 2.0 / (kinematic * greatest)


def _kinematic(scene: SceneTables, values: Arrays) -> float:
    """Return the greatest viscosity of the phases divided by their smallest density [m2/s]; 0 without viscosity."""
    if scene.forces.viscosity == "none":
        return 0.0
    names = {body.phase for body in (*scene.fluid, *scene.emitter)}
    used = [k for k, phase in enumerate(scene.phase) if phase.name in names]
    densities = np.atleast_1d(values.get("rest_density", [phase.rest_density for phase in scene.phase]))
    viscosities = np.atleast_1d(values.get("viscosity", [phase.viscosity for phase in scene.phase]))
    laws = [(scene.phase[k].rheology, float(viscosities[k])) for k in used]
    thickest = [eta if law is None else float(law.thickest(eta)) for law, eta in laws]
    return max(thickest) / float(densities[used].min())


def fluid_lengths(scene: SceneTables) -> Points:
    """Return the length of the initial fluid along each axis (d,) [m], without empty gaps."""
    spacing = scene.discretisation.spacing
    extents = np.array([fluid.extent(spacing) for fluid in scene.fluid])
    found = np.zeros(scene.dimension)
    for axis in range(scene.dimension):
        ends, reached = extents[:, :, axis], -inf
        for lower, upper in ends[np.argsort(ends[:, 0])] + [-0.5 * spacing, 0.5 * spacing]:
            found[axis] += max(upper - max(lower, reached), 0.0)
            reached = max(reached, upper)
    return found
