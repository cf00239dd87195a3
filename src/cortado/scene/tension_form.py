"""The form of surface tension of a scene."""

from typing import Any


def tension_form(scene: Any) -> str:
    """ "curvature" or "pairwise"; it follows from the solver if the scene leaves it open."""
    form = str(scene.forces.surface_tension_form)
    if form != "automatic":
        return form
    return "curvature" if scene.solver.kind == "projection" else "pairwise"
