"""The largest time step at which an explicit simulation of a scene is likely to be stable."""

from math import inf, sqrt
from typing import TYPE_CHECKING

import numpy as np

from cortado.shapes import Points

if TYPE_CHECKING:
    from cortado.scene import Scene


def stability_limit(scene: "Scene") -> float:
    """The smallest of three limits [s], infinite if nothing moves; h is the support radius.

    Courant: 0.4 h / v, where v is the largest initial speed and that of a free fall through the container, or through
    the extent of the fluid if there is none (Monaghan 1992); an emitter has its speed, and fluid falls from its outlet.
    Force: 0.25 sqrt(h / |g|) (Monaghan 1992). Viscosity: 0.06 h^2 rho / mu of the most viscous and the lightest phase
    in use, as they may meet: the least that a lattice bears of explicit steps with any kernel here (Wendland C4 in 3-D;
    the form is that of Morris et al. 1997, whose 0.125 is for an h of half the support).
    """
    support, emitter = scene.discretisation.support_radius, scene.emitter
    gravity = np.array(scene.forces.gravity)
    strength = float(np.linalg.norm(gravity))
    speed = max(float(np.linalg.norm(fluid.velocity)) for fluid in scene.fluid)
    if emitter is not None:
        speed = max(speed, emitter.speed(scene.discretisation.spacing))
    if strength > 0.0:
        lower, upper = _extent(scene)
        drop = float(np.abs(gravity) @ (upper - lower)) / strength
        speed += sqrt(2.0 * strength * drop)
    courant = 0.4 * support / speed if speed > 0.0 else inf
    force = 0.25 * sqrt(support / strength) if strength > 0.0 else inf
    return min(courant, force, _viscous_limit(scene))


def _viscous_limit(scene: "Scene") -> float:
    if scene.forces.viscosity == "none":
        return inf
    names = {fluid.phase for fluid in scene.fluid} | ({scene.emitter.phase} if scene.emitter else set())
    used = [phase for phase in scene.phase if phase.name in names]
    density, viscosity = min(phase.rest_density for phase in used), max(phase.viscosity for phase in used)
    return 0.06 * scene.discretisation.support_radius**2 * density / viscosity if viscosity > 0.0 else inf


def _extent(scene: "Scene") -> tuple[Points, Points]:
    """The box through which fluid may fall: lower and upper, each (d,) [m]."""
    lower, upper = _room(scene)
    if scene.emitter is None:
        return lower, upper
    return np.minimum(lower, scene.emitter.outlet), np.maximum(upper, scene.emitter.outlet)


def _room(scene: "Scene") -> tuple[Points, Points]:
    """The box around the container, or around the fluids if there is none: lower and upper, each (d,) [m]."""
    ends = scene.container.extent()
    if ends is not None:
        return ends
    lower, upper = np.swapaxes([fluid.extent(scene.discretisation.spacing) for fluid in scene.fluid], 0, 1)
    half = 0.5 * scene.discretisation.spacing
    return lower.min(axis=0) - half, upper.max(axis=0) + half
