"""The form of surface tension of a scene."""

from typing import Any

LEAST_SUPPORT = {"curvature": 2.5, "pairwise": 1.8}
"""By the form, in spacings: below, drops fall apart in pairs, and curvatures are too noisy."""


def tension_form(scene: Any) -> str:
    """ "curvature" or "pairwise". If the scene leaves it open, it is by curvature where the solver pulls and particles
    see far enough."""
    form = str(scene.forces.surface_tension_form)
    if form != "automatic":
        return form
    far = scene.discretisation.support >= LEAST_SUPPORT["curvature"]
    return "curvature" if far and scene.solver.kind == "projection" else "pairwise"
