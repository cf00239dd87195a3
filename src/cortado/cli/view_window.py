"""A window in the browser: particles, the container, and what particles are coloured by.

What particles may be coloured by is computed when it is asked for.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from html import escape
from typing import Any

import numpy as np

from cortado.discretise.shapes import Points, in_space
from cortado.errors import CortadoError, InputError
from cortado.files.image_encoding import to_srgb
from cortado.losses.loss import ADJOINT_FIELDS
from cortado.pictures.particle_view import container_outline, outline
from cortado.pictures.shown_solids import ShownSolid, own_faces, own_lines, shown_solids, turn_in_space
from cortado.pictures.stage import upright
from cortado.rollout.rollout import Rollout
from cortado.scene.restart import RestartState
from cortado.scene.scene import Scene
from cortado.simulation import Simulation
from cortado.solvers.particles import ParticleSolver

UNITS = {"speed": "m/s", "density": "kg/m³", "pressure": "Pa", "vorticity": "1/s", "wall_force": "N"}
"""Units of the quantities that every state has."""
RADIUS = 0.4
"""Radius of a particle that is drawn, in spacings."""
DISTANCE = 1.7
"""Distance of the camera at the start, in radii of the contents."""
PALETTE = "cividis"
BRIGHTEST = 99.5
"""Percentile at the upper end of the colours, so that a few particles do not darken all the others."""
LINES = (130, 125, 118)
"""sRGB colour of the container and of solids."""
THIN: Any = {"thickness": 1.5, "thickness_units": "screen"}

Quantity = Callable[[], np.ndarray]
"""Something of the particles that are shown, computed when it is asked for; may raise a `CortadoError`."""


@dataclass(frozen=True)
class Shown:
    """The particles that a window shows at a moment, with the quantities that may colour them."""

    positions: Points
    """(n, d) [m]"""
    colours: Points
    """(n, 3) their own, linear."""
    quantities: Mapping[str, Quantity]
    """(n,) by name."""


class Window:
    """A window in the browser, a page of viser's; y is up, whatever the axes of the scene."""

    def __init__(self, scene: Scene, port: int, units: Mapping[str, str]):
        """Open a window with ``units`` of the quantities that colours may show, by name, besides "phase"."""
        try:
            import viser  # noqa: F401  for the sentence

            from cortado.cli.view_server import GuardedServer
        except ModuleNotFoundError:
            raise InputError("viser is not installed, which shows it: pip install viser.") from None
        self.scene = scene
        self._guarded = GuardedServer(port, f"Cortado: {scene.name}")
        self.server: Any = self._guarded.viser
        self._turn = upright(np.asarray(scene.forces.gravity)) if scene.dimension == 3 else np.eye(2)
        self._units = units
        self._cloud: Any = None
        self._shown: Shown | None = None
        self._stale = False
        """Whether the user wants to see something else of what is shown; `refresh` draws it."""
        self.server.scene.set_up_direction("+y")
        gui, first = self.server.gui, "phase" if len(scene.phase) > 1 else next(iter(units))  # one colour has no depth
        self.colour = gui.add_dropdown("Colour", ["phase", *units], initial_value=first)
        self.legend = gui.add_html("")
        self.colour.on_update(lambda _: setattr(self, "_stale", True))  # in a thread of viser's, which computes nothing
        self._draw_container()
        self._solids = [self._draw_solid(f"/solid_{number}", one) for number, one in enumerate(shown_solids(scene))]

    @property
    def address(self) -> str:
        """Return the address at which a browser finds it, with the token that lets it in."""
        return self._guarded.address

    def close(self) -> None:
        """Close the window: nobody can see it from now on."""
        self._guarded.close()

    def show(self, shown: Shown) -> None:
        """Draw particles instead of those before, along a periodic axis within the period."""
        domain = self.scene.domain
        self._shown = replace(shown, positions=domain.wrapped(shown.positions))
        self._draw()

    def place_solids(self, scene: Scene) -> None:
        """Show the solids where a scene has them, which is otherwise unchanged."""
        with self.server.atomic():
            for frame, solid in zip(self._solids, shown_solids(scene), strict=False):
                frame.position, frame.wxyz = self._space(solid.position), _quaternion(self._turn @ solid.turn)

    def refresh(self) -> None:
        """Draw again where the user has chosen other colours."""
        if self._stale and self._shown is not None:
            self._draw()

    def _draw(self) -> None:
        assert self._shown is not None
        self._stale = False
        points, colours = self._space(self._shown.positions), self._colours(self._shown)
        if self._cloud is None:
            size = 2.0 * RADIUS * self.scene.discretisation.spacing
            style = {"point_size": size, "point_shape": "circle", "precision": "float32"}
            self._cloud = self.server.scene.add_point_cloud("/particles", points, colours, **style)
            return
        with self.server.atomic():
            self._cloud.points, self._cloud.colors = points, colours

    def _colours(self, shown: Shown) -> np.ndarray:
        """Return sRGB colours (n, 3); the legend says their range, or why there are none."""
        from matplotlib import colormaps

        name, own = self.colour.value, to_srgb(shown.colours[None])[0]
        if name == "phase":
            self.legend.content = ""
            return own
        try:
            values = np.asarray(shown.quantities[name]())
        except CortadoError as error:
            self.legend.content = in_words(str(error))
            return own
        least, greatest = float(values.min()), float(np.percentile(values, BRIGHTEST, method="higher"))
        self.legend.content = _scale(name, self._units[name], least, greatest, clips=values.max() > greatest)
        share = np.clip((values - least) / (greatest - least or 1.0), 0.0, 1.0)
        return (255.0 * colormaps[PALETTE](share)[:, :3]).astype(np.uint8)

    def _space(self, points: Points) -> np.ndarray:
        """Return points (..., d) as (..., 3) float32, with y up."""
        return np.asarray(in_space(np.asarray(points, np.float32) @ self._turn.T.astype(np.float32)))

    def _draw_container(self) -> None:
        lines = self._space(container_outline(self.scene))
        if len(lines):
            self.server.scene.add_line_segments("/container", lines, LINES, **THIN)

    def _draw_solid(self, name: str, solid: ShownSolid) -> Any:
        """Draw the edges of a solid, and in 3-D its faces unless it is a tank; return the frame that has its pose."""
        pose = {"position": self._space(solid.position), "wxyz": _quaternion(self._turn @ solid.turn)}
        frame = self.server.scene.add_frame(name, show_axes=False, **pose)
        self.server.scene.add_line_segments(f"{name}/edges", in_space(np.float32(own_lines(solid))), LINES, **THIN)
        if self.scene.dimension == 3 and not solid.is_tank:
            faces, colour = own_faces(solid), tuple(to_srgb(solid.colour[None, None])[0, 0].tolist())
            look = {"color": colour, "opacity": 1.0 - solid.transparency, "flat_shading": True}
            self.server.scene.add_mesh_simple(
                f"{name}/faces", in_space(np.float32(faces.vertices)), faces.corners, **look
            )
        return frame

    def look_at(self, positions: Points) -> None:
        """Put the camera where the container and solids, or else the particles (n, d) [m], fill the window."""
        lines = self._space(outline(self.scene)).reshape(-1, 3)
        points = lines if len(lines) else self._space(positions)
        lower, upper = points.min(axis=0), points.max(axis=0)
        middle, radius = 0.5 * (lower + upper), 0.5 * float(np.linalg.norm(upper - lower))
        away = np.array([0.4, 0.35, 1.0]) if self.scene.dimension == 3 else np.array([0.0, 0.0, 1.0])
        camera = self.server.initial_camera
        camera.look_at = middle
        camera.position = middle + DISTANCE * radius * away / np.linalg.norm(away)


def _quaternion(turn: Points) -> np.ndarray:
    """Return the quaternion w, x, y and z (4,) of a rotation matrix (d, d)."""
    from scipy.spatial.transform import Rotation

    return np.roll(Rotation.from_matrix(turn_in_space(turn)).as_quat(), 1)


def _scale(name: str, unit: str, least: float, greatest: float, clips: bool) -> str:
    """Return HTML of a bar with the colours, and the numbers at its ends."""
    from matplotlib import colormaps
    from matplotlib.colors import to_hex

    stops = ", ".join(to_hex(colormaps[PALETTE](share)) for share in np.linspace(0.0, 1.0, 9))
    ends = f"<span>{least:.4g}</span><span>{'≥ ' if clips else ''}{greatest:.4g}</span>"
    return (
        f'<div style="padding: 0 .8em .4em; font-size: .85em">{escape(name)} [{escape(unit)}]'
        f'<div style="height: .8em; border-radius: 3px; background: linear-gradient(90deg, {stops})"></div>'
        f'<div style="display: flex; justify-content: space-between">{ends}</div></div>'
    )


def in_words(words: str) -> str:
    """Return HTML of plain words."""
    return f'<p style="padding: 0 .8em .4em; margin: 0; font-size: .85em">{escape(words)}</p>'


def quantities_of(
    velocities: np.ndarray, simulation: Callable[[], Simulation], state: RestartState, controls: Mapping[str, Any]
) -> dict[str, Quantity]:
    """Return by name the quantities of particles with velocities (n, d) [m/s] in a state, under ``controls`` as of
    `Simulation.run`. All but the speed raise `InputError` where the solver does not know them."""
    return {
        "speed": lambda: np.linalg.norm(velocities, axis=1),
        "density": lambda: densities(simulation().rollout(1, controls, state)),
        "pressure": lambda: simulation().quantity("pressure", state, controls),
        "vorticity": lambda: sizes_of(simulation().quantity("vorticity", state, controls)),
        "wall_force": lambda: sizes_of(simulation().quantity("wall_force", state, controls)),
    }


def own_fields(fields: Mapping[str, np.ndarray], particles: int) -> dict[str, Quantity]:
    """Return by name a state's further fields, such as ones that parts keep, that have a number or a vector for each
    particle."""
    own = {name: array for name, array in fields.items() if name not in ADJOINT_FIELDS and array.ndim in (1, 2)}
    return {name: partial(sizes_of, array) for name, array in own.items() if len(array) == particles}


def sizes_of(values: np.ndarray) -> np.ndarray:
    """Return numbers (n,) as they are, or the lengths of vectors (n, k)."""
    return values if values.ndim == 1 else np.linalg.norm(values, axis=-1)


def densities(rollout: Rollout) -> np.ndarray:
    """Return the densities (n,) of the first state of a rollout [kg/m3]."""
    solver = rollout.solver
    if not isinstance(solver, ParticleSolver):
        raise InputError("The solver of this scene has no densities of particles to show.")
    return solver.densities(rollout.initial, rollout.parameters)
