"""The pictures that a scene asks for."""

from typing import Annotated, Any, Protocol

import numpy as np
from pydantic import AfterValidator, TypeAdapter

from cortado.device.precision import Precision
from cortado.discretise.smoothing import SmoothingKernel
from cortado.render.cameras import Perspective
from cortado.render.renderer import Renderer
from cortado.render.views import TopView, View, Volume
from cortado.scene.appearance import Render
from cortado.scene.discrete_scene import Lattice
from cortado.scene.scene import Scene
from cortado.scene.tables import sentences

UP = {2: 2, 3: 1}
"""Axis that points upwards, by dimension; in 2-D the one perpendicular to the plane."""
FINENESS = {2: 0.5, 3: 1.0}
"""Node distance over particle spacing, by dimension. On coarser nodes a particle's picture depends on where it lies
between them, which catches single particles; in 2-D finer nodes cost next to nothing."""
CLEARNESS = 8.0
"""Width of the scene over the depth to which one sees into a volume, unless the scene sets it."""
CAMERA = ("position", "look_at", "field_of_view", "extinction")
"""Keys of the table [render] that belong to one view."""


class Pictured(Protocol):
    """Protocol of a `cortado.Simulation` as its renderer needs it."""

    scene: Scene
    positions: np.ndarray
    particles: int
    precision: Precision
    device: Any
    smoothing: SmoothingKernel
    lattice: Lattice

    @property
    def dimension(self) -> int:
        """Number of space dimensions, 2 or 3."""


def scene_renderer(simulation: Pictured, extinction_factor: float = 1.0, **settings: Any) -> Renderer:
    """Make a renderer for the particles of a simulation, after its scene's table [render], or from above.

    The extinction is multiplied by ``extinction_factor``. ``settings`` replace keys of the table; see
    `Simulation.renderer`.
    """
    scene = simulation.scene
    ends, x = scene.container.extent(), simulation.positions
    lower, upper = (x.min(axis=0), x.max(axis=0)) if ends is None else ends
    dimension = simulation.dimension
    cell = scene.discretisation.spacing * FINENESS[dimension]
    table = _table(scene, settings)
    return Renderer(
        _view(table, lower, upper, scene.discretisation.spacing, cell, extinction_factor),
        lower,
        upper,
        smoothing=simulation.smoothing,
        support=scene.discretisation.support_radius,
        volume=simulation.lattice.cell,
        particles=simulation.particles,
        phases=len(scene.phase),
        precision=simulation.precision,
        device=simulation.device,
        dimension=dimension,
        cell=cell,
        periods=scene.container.periods(dimension)[1],
        colours=np.array([phase.colour for phase in scene.phase]),
    )


def _table(scene: Scene, settings: dict[str, Any]) -> Render:
    """Return a scene's table [render] with some keys replaced; a camera stays with its view."""
    given = {} if scene.render is None else scene.render.model_dump(exclude_unset=True)
    view = settings.get("view")
    if isinstance(view, str) and view != given.get("view"):
        given = {name: value for name, value in given.items() if name not in CAMERA}
    resolved = Annotated[Render, AfterValidator(lambda table: table.in_dimension(scene.dimension))]
    with sentences(Scene):
        return TypeAdapter(dict[str, resolved]).validate_python({"render": {**given, **settings}})["render"]


def _view(
    table: Render, lower: np.ndarray, upper: np.ndarray, spacing: float, cell: float, extinction_factor: float
) -> View:
    dimension = len(lower)
    options: dict[str, Any] = {"background": table.background}
    resolution = (table.resolution[0], table.resolution[1])
    if table.view != "volume":
        opacity = TopView.opacity if table.extinction is None else table.extinction * spacing
        # In 2-D the one layer of nodes is a cell thick, and has to be as opaque as a layer of particles.
        thickness = cell if dimension == 2 else spacing
        up_axis, options["opacity"] = UP[dimension], extinction_factor * opacity
        return TopView(tuple(lower), tuple(upper), thickness, resolution, up_axis, **options)
    assert table.position is not None and table.look_at is not None and table.field_of_view is not None
    up = tuple(np.eye(3)[UP[dimension]])
    camera = Perspective(table.position, table.look_at, up, table.field_of_view, resolution=resolution)
    extinction = CLEARNESS / float(np.max(upper - lower)) if table.extinction is None else table.extinction
    return Volume(camera, extinction_factor * extinction, **options)
