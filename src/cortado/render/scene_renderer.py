"""The pictures that a scene asks for."""

from typing import Any

import numpy as np

from cortado.render.cameras import Perspective
from cortado.render.renderer import Renderer
from cortado.render.views import TopView, View, Volume
from cortado.scene_render import Render
from cortado.simulation import Simulation

UP = {2: 2, 3: 1}
"""The axis that points upwards, by dimension; in 2-D the one that the plane lacks."""
FINENESS = {2: 0.5, 3: 1.0}
"""Node distance over particle spacing, by dimension. On coarser nodes a particle's picture depends on where it lies
between them, which catches single particles; in 2-D finer nodes cost next to nothing."""
CLEARNESS = 8.0
"""A volume is seen into as far as the scene is wide over this, unless the scene says more."""


def scene_renderer(simulation: Simulation, share: float = 1.0) -> Renderer:
    """A renderer for the particles of a simulation, as the table [render] of its scene wants it, or from above; with
    that share of the extinction."""
    scene = simulation.scene
    lower, upper = _extent(simulation)
    dimension = simulation.dimension
    cell = scene.discretisation.spacing * FINENESS[dimension]
    table = scene.render if scene.render is not None else Render().in_dimension(dimension)
    return Renderer(
        _view(table, lower, upper, scene.discretisation.spacing, cell, share),
        lower,
        upper,
        smoothing=simulation.smoothing,
        support=scene.discretisation.support_radius,
        volume=simulation.solver.lattice.volume,
        particles=simulation.particles,
        phases=len(scene.phase),
        precision=simulation.precision,
        device=simulation.device,
        dimension=dimension,
        cell=cell,
        periods=scene.container.periods(dimension)[1],
    )


def _view(table: Render, lower: np.ndarray, upper: np.ndarray, spacing: float, cell: float, share: float) -> View:
    dimension = len(lower)
    options: dict[str, Any] = {"background": table.background}
    resolution = (table.resolution[0], table.resolution[1])
    if table.view != "volume":
        opacity = TopView.opacity if table.extinction is None else table.extinction * spacing
        # In 2-D the one layer of nodes is a cell thick, and has to be as opaque as a layer of particles.
        thickness = cell if dimension == 2 else spacing
        up_axis, options["opacity"] = UP[dimension], share * opacity
        return TopView(tuple(lower), tuple(upper), thickness, resolution, up_axis, **options)
    assert table.position is not None and table.look_at is not None and table.field_of_view is not None
    up = tuple(np.eye(3)[UP[dimension]])
    camera = Perspective(table.position, table.look_at, up, table.field_of_view, resolution=resolution)
    extinction = CLEARNESS / float(np.max(upper - lower)) if table.extinction is None else table.extinction
    return Volume(camera, share * extinction, **options)


def _extent(simulation: Simulation) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper corner (d,) of the container, or of the fluid's first positions [m]."""
    ends = simulation.scene.container.extent()
    x = simulation.positions
    return (x.min(axis=0), x.max(axis=0)) if ends is None else ends
