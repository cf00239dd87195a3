"""Runs of the reference engine with their derivative with respect to the size of gravity, as in the report's Figures 4
to 7."""

from typing import Any

import numpy as np

from cortado.errors import InputError
from cortado.reference import History
from cortado.scene.scene import Scene
from experiments.sources import ReferenceTangent

COST = {"float32": 1, "float64": 1, "float80": 3, "float128": 60}
"""Approximate time of a step, relative to that in float64."""
LABEL = "|dx/dg|  [s²]"


def along_gravity(
    scene: Scene, steps: int, source: ReferenceTangent, gravity: float | None = None
) -> tuple[History, float]:
    """The tangents along the direction of gravity, and the distance between two unrelated states [m].

    ``gravity`` [m / s2] may replace the size of gravity. Unrelated states are the last one, and the last one with its
    particles permuted at random.
    """
    direction = np.array(scene.forces.gravity)
    size = float(np.linalg.norm(direction))
    if size == 0.0:
        raise InputError("forces.gravity of the scene is zero, but must have a direction.")
    direction /= size
    at = {"gravity": (size if gravity is None else gravity) * direction}
    history = source.run(scene, steps, at, {"gravity": direction})
    last = np.asarray(history.positions[-1])
    shuffled = np.random.default_rng(0).permutation(last)
    return history, float(np.linalg.norm(last - shuffled))


def row(history: History, distance: float, **keys: Any) -> dict[str, Any]:
    """Norms of all states, for a table."""
    assert history.position_norms is not None
    steps = np.arange(len(history.position_norms))
    return {**keys, "step": steps, "norm": history.position_norms, "distance": distance}
