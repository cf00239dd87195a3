"""A window in the browser with particles, the container around them, and what they are coloured by."""

from collections.abc import Callable, Mapping
from contextlib import redirect_stdout
from io import StringIO
from typing import Any

import numpy as np

from cortado.errors import InputError
from cortado.io.srgb import to_srgb
from cortado.lattice.shapes import Points
from cortado.scene.scene import Scene
from cortado.shading.scene_view import outline
from cortado.shading.stage import upright

RADIUS = 0.4
"""Of a particle that is drawn, in spacings."""
DISTANCE = 2.0
"""Of the camera at the start, in radii of what is shown."""
PALETTE = "cividis"

Quantity = Callable[[], np.ndarray]
"""(n,) of the particles that are shown, computed when it is asked for."""


class Window:
    """A page of viser's; y is up, whatever the axes of the scene."""

    def __init__(self, scene: Scene, port: int, units: Mapping[str, str]):
        """``units``: of the quantities that colours may show, by their names; "phase" is there without."""
        try:
            import viser
        except ImportError:
            raise InputError("viser is not installed, which shows it: pip install 'cortado-sph[view]'.") from None
        self.scene = scene
        with redirect_stdout(StringIO()):  # it draws a box
            self.server: Any = viser.ViserServer("127.0.0.1", port, f"Cortado: {scene.name}", verbose=False)
        self._turn = upright(np.asarray(scene.forces.gravity)) if scene.dimension == 3 else np.eye(2)
        self._units = units
        self._cloud: Any = None
        self._shown: tuple[Points, Points, Mapping[str, Quantity]] | None = None
        self.server.scene.set_up_direction("+y")
        first = "phase" if len(scene.phase) > 1 else next(iter(units))  # one colour would show no depth
        self.colour = self.server.gui.add_dropdown("Colour", ["phase", *units], initial_value=first)
        self.legend = self.server.gui.add_markdown("")
        self.colour.on_update(lambda _: self._draw())
        self._frame_container()

    @property
    def address(self) -> str:
        """Where a browser finds it."""
        return f"http://127.0.0.1:{self.server.get_port()}"

    def close(self) -> None:
        """Nobody can see it from now on."""
        with redirect_stdout(StringIO()):
            self.server.stop()

    def show(self, positions: Points, colours: Points, quantities: Mapping[str, Quantity]) -> None:
        """Particles at positions (n, d) [m] with linear colours (n, 3), or coloured by one of the quantities."""
        self._shown = positions, colours, quantities
        self._draw()

    def _draw(self) -> None:
        if self._shown is None:
            return
        positions, own, quantities = self._shown
        points, colours = self._space(positions), self._colours(own, quantities)
        if self._cloud is None:
            size = 2.0 * RADIUS * self.scene.discretisation.spacing
            style = {"point_size": size, "point_shape": "circle", "precision": "float32"}
            self._cloud = self.server.scene.add_point_cloud("/particles", points, colours, **style)
            return
        with self.server.atomic():
            self._cloud.points, self._cloud.colors = points, colours

    def _colours(self, own: Points, quantities: Mapping[str, Quantity]) -> np.ndarray:
        """(n, 3) sRGB; the legend says from where to where they go."""
        from matplotlib import colormaps

        name = self.colour.value
        if name not in quantities:
            self.legend.content = ""
            return to_srgb(own[None])[0]
        values = np.asarray(quantities[name](), dtype=float)
        least, greatest = float(values.min()), float(values.max())
        self.legend.content = f"{name}: {least:.4g} (dark) to {greatest:.4g} {self._units[name]} (bright)"
        share = (values - least) / (greatest - least or 1.0)
        return (255.0 * colormaps[PALETTE](share)[:, :3]).astype(np.uint8)

    def _space(self, points: Points) -> np.ndarray:
        """(..., 3) float32, of points (..., d), with y up."""
        turned = np.asarray(points, dtype=np.float32) @ self._turn.T.astype(np.float32)
        return np.pad(turned, [(0, 0)] * (turned.ndim - 1) + [(0, 3 - turned.shape[-1])])

    def _frame_container(self) -> None:
        lines = self._space(outline(self.scene))
        if len(lines):
            style = {"thickness": 1.5, "thickness_units": "screen"}
            self.server.scene.add_line_segments("/container", lines, (130, 125, 118), **style)

    def look_at(self, positions: Points) -> None:
        """Put the camera where the container, or else the particles (n, d) [m], fill the window."""
        lines = self._space(outline(self.scene)).reshape(-1, 3)
        points = lines if len(lines) else self._space(positions)
        lower, upper = points.min(axis=0), points.max(axis=0)
        middle, radius = 0.5 * (lower + upper), 0.5 * float(np.linalg.norm(upper - lower))
        away = np.array([0.4, 0.35, 1.0]) if self.scene.dimension == 3 else np.array([0.0, 0.0, 1.0])
        camera = self.server.initial_camera
        camera.look_at = middle
        camera.position = middle + DISTANCE * radius * away / np.linalg.norm(away)
