"""What light meets within fluids: how strongly each phase of a scene scatters and absorbs it."""

import numpy as np

from cortado.discretise.shapes import Points
from cortado.scene.materials import LIQUIDS
from cortado.scene.picture import Picture
from cortado.scene.scene import Scene

TINT = 2.6
"""How much sooner light takes the colour of a fluid without a material than it is scattered."""
SPAN = 0.1
"""How thick fluid is that transparency is said of, in sizes of what is shown."""
LAYERS, LAYERS_OF_SPHERES = 3.0, 1e3
"""How often light is scattered within a spacing of what is opaque."""


def media_of(scene: Scene, size: float) -> tuple[Points, float]:
    """(phases, 2) scattering and absorption [1/m] where what is shown has a size [m], and the part of the light that
    goes through `SPAN` of it, the mean of all phases.

    They are those of materials, unless the picture has a transparency of its own or particles have other colours than
    those of phases. A layer of particles hides what is behind it where fluid without a material is opaque.
    """
    picture, spacing = scene.picture or Picture(), scene.discretisation.spacing
    by_phase, transparency = picture.colour == "phase", picture.transparency
    own = by_phase and transparency is None and picture.surface == "liquid"
    liquids = [LIQUIDS[phase.material] if own and phase.material else None for phase in scene.phase]
    if transparency is None:
        transparency = 0.0 if len(scene.phase) > 1 or not by_phase else 0.9
    plain = LAYERS / spacing
    if picture.surface == "spheres":
        plain = LAYERS_OF_SPHERES / spacing
    elif transparency > 0.0:
        plain = min(-np.log(transparency) / (SPAN * size), plain)
    media = [(one.scattering, one.absorption) if one else (plain, TINT * plain) for one in liquids]
    through = [
        float(np.exp(-SPAN * size * one.scattering) * np.mean(np.array(phase.colour) ** (SPAN * size * one.absorption)))
        if one
        else transparency
        for one, phase in zip(liquids, scene.phase, strict=True)
    ]
    return np.array(media), float(np.mean(through))
