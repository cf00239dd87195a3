"""Differentiable rendering of particles, and the renderer for the table [render] of a scene."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
import warp as wp
from pydantic import AfterValidator, TypeAdapter

from cortado.arrays import as_numbers
from cortado.calls import counted, fixed, public
from cortado.device.modules import start_warp
from cortado.device.precision import Precision, precision_named
from cortado.device.threads import WARP
from cortado.discretise.smoothing import SmoothingKernel
from cortado.errors import InputError, shown
from cortado.particles.state import padded
from cortado.render.absorption import RayMarcher
from cortado.render.cameras import Perspective, TopView, View, ViewTangent, Volume, positive, vector
from cortado.render.colour_field import ColourField
from cortado.scene.appearance import Render
from cortado.scene.scene import Scene
from cortado.scene.tables import sentences


@dataclass(frozen=True)
class RenderAdjoint:
    """Derivatives of a function of the image. The next call of the renderer overwrites the Warp arrays."""

    positions: wp.array
    """Derivative with respect to positions, (n,) vectors [1 / m]."""
    fractions: wp.array
    """Derivative with respect to mass fractions, (n,) vectors with one component for each phase [-]."""
    colours: np.ndarray
    """Derivative with respect to the colours of the phases, (phases, 3) [-]."""
    translation: np.ndarray
    """Derivative with respect to the position of the camera, (3,) [1 / m]."""
    rotation: np.ndarray
    """Derivative with respect to a rotation vector of the camera about its position, (3,) [1 / rad]."""


@public
@fixed
class Renderer:
    """Renders a fixed number of particles in one view, on one device. Pictures are in linear RGB.

    Pictures are smooth functions of positions, fractions and colours, and piecewise smooth functions of the camera's
    pose. In a view along an axis, samples may lie on faces between cells of the colour field, where the derivative with
    respect to the pose is one-sided.
    """

    @WARP
    def __init__(
        self,
        view: View,
        lower: Sequence[float] | np.ndarray,
        upper: Sequence[float] | np.ndarray,
        *,
        smoothing: SmoothingKernel,
        support: float,
        volume: float,
        particles: int,
        phases: int,
        precision: Precision,
        device: Any,
        dimension: int = 3,
        cell: float | None = None,
        periods: Sequence[float] | np.ndarray | None = None,
        colours: np.ndarray | None = None,
    ):
        """Prepare a view of fluid between ``lower`` and ``upper`` (d,) [m], with a margin of the support radius.

        ``periods`` (d,) [m] are the lengths of the periodic box, 0 for an axis that is not periodic. Along a periodic
        axis, every periodic image between ``lower`` and ``upper`` is visible.

        ``volume`` is the volume of a particle [m^d]. ``cell`` is the node distance [m], by default half the ``support``
        radius. ``colours`` (phases, 3) are the default colours of the phases.
        """
        start_warp()
        for name, size in (("support", support), ("volume", volume), ("cell", 1.0 if cell is None else cell)):
            positive(name, size)
        cell = 0.5 * support if cell is None else cell
        for name, number in (("particles", particles), ("phases", phases)):
            if not isinstance(number, (int, np.integer)) or number < 1:
                raise InputError(f"{name} is {shown(number)}, but must be at least 1.")
        low, high = np.array(vector("lower", lower, dimension)), np.array(vector("upper", upper, dimension))
        if not (high >= low).all():
            raise InputError(f"upper is {shown(high.tolist())}, but must not be below lower, {shown(low.tolist())}.")
        turns = np.zeros(dimension) if periods is None else np.array(vector("periods", periods, dimension))
        if ((turns != 0.0) & (turns <= 2.0 * support)).any():
            wanted = f"0 or greater than two support radii, {2.0 * support:g} m"
            raise InputError(f"periods is {shown(turns.tolist())}, but must be {wanted}.")
        own_colours = None if colours is None else _of_shape("colours", colours, (phases, 3)).copy()
        own: dict[str, Any] = {"lower": tuple(low), "upper": tuple(high), "smoothing": smoothing, "support": support}
        own |= {"volume": volume, "particles": particles, "phases": phases, "device": wp.get_device(device).alias}
        self._settings = own | {"dimension": dimension, "cell": cell, "periods": tuple(turns), "colours": own_colours}
        self.view, self._precision, self._device = view, precision, wp.get_device(device)
        self._particles, self._phases, self._dimension, self._colours = particles, phases, dimension, own_colours
        self._field = ColourField(self._settings, precision, self._device)
        self._rays = RayMarcher(view, self._field.nodes, precision, self._device)
        self._rendered = False

    def __repr__(self) -> str:
        rows, columns, _ = self.shape
        view = type(self.view).__name__
        return f"Renderer({view}, {columns} x {rows} pixels, {counted(self._particles, 'particle')})"

    def __reduce__(self) -> tuple[Any, ...]:
        return _made_again, (self.view, self._settings, self._precision.name)

    @property
    def fingerprint(self) -> str:
        """Text that identifies the view and the grid of nodes, for checkpoints."""
        nodes = self._field.nodes
        return f"{self.view!r} {tuple(nodes.origin)} {nodes.cell} {tuple(nodes.shape)} {tuple(nodes.period)}"

    def in_precision(self, precision: Precision) -> "Renderer":
        """Return a renderer with the same view in the given precision."""
        return Renderer(self.view, **self._settings, precision=precision)

    def seen_by(self, view: View) -> "Renderer":
        """Return a renderer of the same particles with the given view."""
        return Renderer(view, **self._settings, precision=self._precision)

    @property
    def shape(self) -> tuple[int, int, int]:
        """Shape of a picture: rows, columns, 3."""
        columns, rows = self.view.camera.resolution
        return rows, columns, 3

    @property
    def precision(self) -> Precision:
        """Precision of the computation."""
        return self._precision

    @property
    def device(self) -> Any:
        """Device of the renderer."""
        return self._device

    @property
    def inputs(self) -> dict[str, tuple[int, ...]]:
        """Shapes of the arguments of `render`, by name."""
        n, phases = self._particles, self._phases
        return {"positions": (n, self._dimension), "fractions": (n, phases), "colours": (phases, 3)}

    @WARP
    def render(self, positions: Any, fractions: Any = None, colours: Any = None) -> np.ndarray:
        """Return the picture (rows, columns, 3) in float64, with row 0 at the top.

        Args:
            positions: positions (n, d) [m], a Warp array (n,) of vectors in the renderer's precision and on its device,
                or a frame. A frame, such as ``trajectory[-1]`` or ``problem.end(parameters)``, also contains mass
                fractions and perhaps colours.
            fractions: (n, phases) mass fractions [-], or a Warp array (n,) of vectors; not needed for a single phase.
            colours: (phases, 3) colours of the phases; by default the renderer's colours.

        Example: ``picture = renderer.render(trajectory[-1])``
        """
        if hasattr(positions, "positions"):
            frame, positions = positions, positions.positions
            fractions = frame.mass_fractions if fractions is None else fractions
            colours = getattr(frame, "colours", None) if colours is None else colours
        if fractions is None:
            if self._phases > 1:
                wanted = f"mass fractions ({self._particles}, {self._phases})"
                raise InputError(f"fractions is left out, but must be {wanted}, with {self._phases} phases.")
            fractions = np.ones((self._particles, 1))
        colours = self._colours if colours is None else colours
        if colours is None:
            raise InputError("colours is left out, but must be given, as the renderer has no default colours.")
        x = self._on_device("positions", positions, self._dimension, self._precision.vector)
        c = self._on_device("fractions", fractions, self._phases, self._precision.fractions(self._phases))
        colours = _of_shape("colours", colours, (self._phases, 3))
        self._field.gather(x, c, colours)
        self._rays.march(self._field.values)
        self._rendered = True
        return self._rays.image.numpy().astype(np.float64).reshape(self.shape)

    @WARP
    def tangent(
        self, positions: Any = None, fractions: Any = None, colours: Any = None, view: ViewTangent | None = None
    ) -> np.ndarray:
        """Return the derivative (rows, columns, 3) of the last picture along a direction. Tangents that are left out
        are 0.

        Args:
            positions: (n, d) [m], the direction of the positions.
            fractions: (n, phases) [-], the direction of the mass fractions.
            colours: (phases, 3) [-], the direction of the colours of the phases.
            view: the direction of the view.
        """
        self._require_picture("tangent")
        directions = {"positions": positions, "fractions": fractions, "colours": colours}
        x_dot, c_dot, colours_dot = (
            np.zeros(shape) if directions[name] is None else _of_shape(name, directions[name], shape)
            for name, shape in self.inputs.items()
        )
        x = self._on_device("positions", x_dot, self._dimension, self._precision.vector)
        c = self._on_device("fractions", c_dot, self._phases, self._precision.fractions(self._phases))
        field_dot = self._field.tangent(x, c, colours_dot)
        image_dot = self._rays.tangent(self._field.values, field_dot, ViewTangent() if view is None else view)
        return image_dot.numpy().astype(np.float64).reshape(self.shape)

    @WARP
    def adjoint(self, image_bar: np.ndarray) -> RenderAdjoint:
        """Return derivatives of a function of the last picture with respect to positions, mass fractions, colours and
        the camera's pose. ``image_bar`` (rows, columns, 3) is the derivative with respect to the picture."""
        self._require_picture("adjoint")
        image_bar = _of_shape("image_bar", image_bar, self.shape)
        field_bar, pose = self._rays.adjoint(image_bar.reshape(-1, 3), self._field.values)
        return RenderAdjoint(*self._field.adjoint(field_bar), pose[:3], pose[3:])

    @WARP
    def field(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the coverage (nx, ny, nz) and coverage times colour (nx, ny, nz, 3) at nodes, for the last picture."""
        found = self._field.values.numpy().astype(np.float64).transpose(2, 1, 0, 3)
        return found[..., 3].copy(), found[..., :3].copy()

    def nodes(self) -> np.ndarray:
        """Return the positions of the nodes (nx, ny, nz, 3) [m]."""
        nodes = self._field.nodes
        indices = np.moveaxis(np.indices(tuple(nodes.shape)), 0, -1)
        return np.array(nodes.origin, dtype=np.float64) + nodes.cell * indices

    def _require_picture(self, method: str) -> None:
        if not self._rendered:
            raise InputError(f"There is no picture to differentiate; call render before {method}.")

    def _on_device(self, name: str, values: Any, components: int, dtype: Any) -> wp.array:
        if not isinstance(values, wp.array):
            array = _of_shape(name, values, (self._particles, components))
            if not np.isfinite(array).all():
                raise InputError(f"{name} has a value that is not finite, but must be made of finite numbers.")
            return wp.array(padded(array) if name == "positions" else array, dtype=dtype, device=self._device)
        shape, device = (self._particles,), self._device
        if values.shape != shape or not wp.types.types_equal(values.dtype, dtype) or values.device != device:
            found = f"{values.dtype.__name__} of shape {values.shape} on {values.device}"
            raise InputError(f"{name} is {found}, but must be {dtype.__name__} of shape {shape} on {device}.")
        return values


def _made_again(view: View, settings: dict[str, Any], precision: str) -> Renderer:
    return Renderer(view, **settings, precision=precision_named(precision))


def _of_shape(name: str, values: Any, shape: tuple[int, ...]) -> np.ndarray:
    array = as_numbers(name, values)
    if array.shape != shape:
        raise InputError(f"{name} has shape {array.shape}, but must have {shape}.")
    return array


UP = {2: 2, 3: 1}
"""Index of the axis that points upwards, for each dimension. In 2-D the upward axis is perpendicular to the plane."""
FINENESS = {2: 0.5, 3: 1.0}
"""Ratio of node distance to particle spacing, by dimension. With coarser nodes, optimisers can get stuck."""
CLEARNESS = 8.0
"""Ratio of the scene's width to the default depth of visibility in a "volume" view."""
CAMERA = ("position", "look_at", "field_of_view", "extinction")


def scene_renderer(simulation: Any, extinction_factor: float = 1.0, **settings: Any) -> Renderer:
    """Make a renderer for a `cortado.Simulation` from the table [render] of its scene. The default view is from above.

    ``extinction_factor`` multiplies the extinction. ``settings`` replace keys of the table; see `Simulation.renderer`.
    """
    scene, dimension, x = simulation.scene, simulation.dimension, simulation.positions
    cut, ends = scene.discretisation, scene.container.extent()
    lower, upper = (x.min(axis=0), x.max(axis=0)) if ends is None else ends
    cell = cut.spacing * FINENESS[dimension]
    own: dict[str, Any] = {"smoothing": simulation.smoothing, "support": cut.support_radius, "dimension": dimension}
    own |= {"volume": simulation.lattice.cell, "particles": simulation.particles, "phases": len(scene.phase)}
    own |= {"precision": simulation.precision, "device": simulation.device, "cell": cell}
    own |= {"periods": scene.container.periods(dimension)[1]}
    own |= {"colours": np.array([phase.colour for phase in scene.phase])}
    given = {} if scene.render is None else scene.render.model_dump(exclude_unset=True)
    if isinstance(settings.get("view"), str) and settings["view"] != given.get("view"):
        given = {name: value for name, value in given.items() if name not in CAMERA}
    resolved = Annotated[Render, AfterValidator(lambda table: table.in_dimension(dimension))]
    with sentences(Scene):
        table = TypeAdapter(dict[str, resolved]).validate_python({"render": {**given, **settings}})["render"]
    resolution = (table.resolution[0], table.resolution[1])
    if table.view != "volume":
        opacity = TopView.opacity if table.extinction is None else table.extinction * cut.spacing
        # In 2-D the one layer of nodes is a cell thick, and has to be as opaque as a layer of particles.
        sizes: dict[str, Any] = {"spacing": cell if dimension == 2 else cut.spacing, "resolution": resolution}
        sizes |= {"up_axis": UP[dimension], "opacity": extinction_factor * opacity, "background": table.background}
        return Renderer(TopView(tuple(lower), tuple(upper), **sizes), lower, upper, **own)
    assert table.position is not None and table.look_at is not None and table.field_of_view is not None
    up = tuple(np.eye(3)[UP[dimension]])
    camera = Perspective(table.position, table.look_at, up, table.field_of_view, resolution=resolution)
    extinction = CLEARNESS / float(np.max(upper - lower)) if table.extinction is None else table.extinction
    return Renderer(Volume(camera, extinction_factor * extinction, table.background), lower, upper, **own)
