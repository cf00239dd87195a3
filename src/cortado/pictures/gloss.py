"""Bodies in the plane under a lamp."""

import numpy as np

from cortado.discretise.shapes import Points

LIGHT = (-0.45, 0.70, 0.55)
"""Towards the lamp: to the right, up, towards the viewer."""


def glossy(cover: Points, colour: Points, width: float, gleaming: float = 0.55) -> Points:
    """(rows, columns, 3) the light of a body that covers a part of each pixel (rows, columns).

    The body looks as if it were thicker in the middle than at its edge.

    Args:
        cover: (rows, columns), from 0 to 1.
        colour: linear, (rows, columns, 3) or (3,).
        width: of the edge, in pixels.
        gleaming: how bright the image of the lamp is in it.
    """
    from scipy.ndimage import gaussian_filter

    height = gaussian_filter(cover, width)
    height = height * height * (3.0 - 2.0 * height)
    down, right = np.gradient(height)
    steep = 1.9 * width
    normal = np.stack([-steep * right, steep * down, np.ones_like(right)], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    lamp = np.asarray(LIGHT) / np.linalg.norm(LIGHT)
    half = lamp + (0.0, 0.0, 1.0)
    half /= np.linalg.norm(half)
    diffuse = 0.62 + 0.38 * np.clip(normal @ lamp, 0.0, 1.0) / lamp[2]
    gleam = np.clip(normal @ half, 0.0, 1.0) ** 60 - half[2] ** 60
    deep = 0.80 + 0.20 * height
    return colour * (np.minimum(diffuse, 1.12) * deep)[..., None] + gleaming * np.clip(gleam, 0.0, 1.0)[..., None]
