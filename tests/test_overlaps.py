"""Bodies of fluid may touch, but not start in each other, however their lattices lie."""

import numpy as np
import pytest

from cortado import Scene, SceneError

SPACING = 0.05


def scene(dimension, *boxes, lower=0.0, upper=2.0):
    """Boxes of fluid, each from a lower to an upper corner."""
    fluid = [{"shape": "box", "lower": low, "upper": high, "phase": "water"} for low, high in boxes]
    return Scene(
        name="boxes",
        dimension=dimension,
        discretisation={"spacing": SPACING},
        phase=[{"name": "water", "rest_density": 1000.0, "viscosity": 0.01}],
        fluid=fluid,
        container={"shape": "box", "lower": [lower] * dimension, "upper": [upper] * dimension},
        solver={"kind": "pcisph", "time_step": 0.001},
    )


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("offset", np.arange(5) / 5.0 + 0.1)
def test_a_box_within_another_is_refused(dimension, offset):
    """At any place of its particles between those of the other, and in either order."""
    low = 0.4 + offset * SPACING
    large, small = ([0.0] * dimension, [1.0] * dimension), ([low] * dimension, [low + 0.1] * dimension)
    for boxes in ((large, small), (small, large)):
        with pytest.raises(SceneError, match=r"fluid\[1\] is overlapping fluid\[0\] at"):
            scene(dimension, *boxes)


@pytest.mark.parametrize("dimension", [2, 3])
def test_a_box_half_in_another_is_refused(dimension):
    half = 0.5 * SPACING
    with pytest.raises(SceneError, match="overlapping"):
        scene(dimension, ([0.0] * dimension, [0.5] * dimension), ([0.3 + half] * dimension, [0.8 + half] * dimension))


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("gap", [0.0, -0.4, 0.3])
def test_a_box_may_stand_in_a_corner_of_others(dimension, gap):
    """Nearer than a lattice by some of a spacing, or further away; the floor and the walls are boxes of fluid."""
    side, at = 0.5, 0.5 + gap * SPACING
    floor = ([0.0] * dimension, [1.0, side, 1.0][:dimension])
    wall = ([0.0, side, 0.0][:dimension], [side, 1.0, 1.0][:dimension])
    boxes = [floor, wall]
    if dimension == 3:
        boxes.append(([side, side, 0.0], [1.0, 1.0, side]))
    scene(dimension, *boxes, ([at] * dimension, [at + 0.3] * dimension))
