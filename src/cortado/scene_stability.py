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
    the extent of the fluid if there is none (Monaghan 1992). Force: 0.25 sqrt(h / |g|) (Monaghan 1992). Viscosity:
    0.06 h^2 rho / mu, the least that a lattice bears of explicit steps with any kernel here (Wendland C4 in 3-D; the
    form is that of Morris et al. 1997, whose 0.125 is for an h of half the support).
    """
    support = scene.discretisation.support_radius
    gravity = np.array(scene.forces.gravity)
    strength = float(np.linalg.norm(gravity))
    speed = max(float(np.linalg.norm(fluid.velocity)) for fluid in scene.fluid)
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
    support, used = scene.discretisation.support_radius, {fluid.phase for fluid in scene.fluid}
    limits = [
        0.06 * support**2 * phase.rest_density / phase.viscosity
        for phase in scene.phase
        if phase.name in used and phase.viscosity > 0.0
    ]
    return min(limits, default=inf)


def _extent(scene: "Scene") -> tuple[Points, Points]:
    """The box around the container, or around the fluid if there is none: lower and upper, each (d,) [m]."""
    ends = scene.container.extent()
    if ends is not None:
        return ends
    lower, upper = np.swapaxes([fluid.extent(scene.discretisation.spacing) for fluid in scene.fluid], 0, 1)
    half = 0.5 * scene.discretisation.spacing
    return lower.min(axis=0) - half, upper.max(axis=0) + half
