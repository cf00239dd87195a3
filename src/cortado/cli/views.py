"""``cortado view``: show a recorded run in the browser, or run a scene and show it live.

Quantities that colour the particles are computed only when the user selects them.
"""

import atexit
import gc
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cache, partial
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from cortado.discretise.shapes import Points, in_space
from cortado.errors import CortadoError, InputError, unwarned
from cortado.files.image_encoding import to_srgb
from cortado.files.terminal import keeping, say
from cortado.losses.loss import ADJOINT_FIELDS
from cortado.pictures.film import drawn_for_each
from cortado.pictures.painter import colours_of
from cortado.pictures.particle_view import container_outline, outline
from cortado.pictures.shown_solids import ShownSolid, own_faces, own_lines, shown_solids, turn_in_space
from cortado.pictures.stage import upright
from cortado.rollout.rollout import Rollout
from cortado.runs.frames import posed, sized, solid_motions
from cortado.runs.run_folder import RunFolder
from cortado.runs.trajectory import Trajectory
from cortado.scene.emitter_table import EmitterTable, path_name
from cortado.scene.restart import RestartState
from cortado.scene.scene import Scene, load_scene
from cortado.scene.stability import longest_step
from cortado.simulation import Simulation
from cortado.solvers.particles import ParticleSolver

UNITS = {"speed": "m/s", "density": "kg/m³", "pressure": "Pa", "vorticity": "1/s", "wall_force": "N"}
"""Units of quantities that every state has."""
RADIUS = 0.4
"""Radius of a drawn particle, in spacings."""
DISTANCE = 1.7
"""Initial distance of the camera, in radii of the scene's contents."""
PALETTE = "viridis"
BRIGHTEST = 99.5
"""Percentile of the values at the upper end of the colour scale: single particles do not darken the rest."""
LINES = (130, 125, 118)
"""sRGB colour of the container and of solids."""
THIN: Any = {"thickness": 1.5, "thickness_units": "screen"}

Quantity = Callable[[], np.ndarray]
"""Computes a quantity of the shown particles; may raise a `CortadoError`."""


@dataclass(frozen=True)
class Shown:
    """The particles that a window shows at one time, with the quantities that can colour them."""

    positions: Points
    """(n, d) [m]"""
    colours: Points
    """(n, 3) the particles' own colours, linear."""
    quantities: Mapping[str, Quantity]
    """(n,) quantities by name."""


class Window:
    """A window in the browser, served by viser; y is up, whatever the axes of the scene."""

    def __init__(self, scene: Scene, port: int, units: Mapping[str, str]):
        """Open a window; ``units`` are those of the quantities that can colour particles, by name, besides "phase"."""
        try:
            import viser  # noqa: F401  for the sentence

            from cortado.cli.view_server import GuardedServer
        except ModuleNotFoundError:
            raise InputError("viser, which shows the view, is not installed: pip install viser.") from None
        self.scene = scene
        self._guarded = GuardedServer(port, f"Cortado: {scene.name}")
        self.server: Any = self._guarded.viser
        self._turn = upright(np.asarray(scene.forces.gravity)) if scene.dimension == 3 else np.eye(2)
        self._units = units
        self._cloud: Any = None
        self._shown: Shown | None = None
        self._stale = False
        """True if the user has changed what to show; `refresh` then draws again."""
        self.server.scene.set_up_direction("+y")
        gui, first = self.server.gui, "phase" if len(scene.phase) > 1 else next(iter(units))  # one colour has no depth
        self.colour = gui.add_dropdown("Colour", ["phase", *units], initial_value=first)
        self.legend = gui.add_html("")
        self.colour.on_update(lambda _: setattr(self, "_stale", True))  # in a thread of viser's, which computes nothing
        self._draw_container()
        self._solids = [self._draw_solid(f"/solid_{number}", one) for number, one in enumerate(shown_solids(scene))]

    @property
    def address(self) -> str:
        """Return the window's address for a browser, with the token that gives access."""
        return self._guarded.address

    def close(self) -> None:
        """Close the window and its server."""
        self._guarded.close()

    def show(self, shown: Shown) -> None:
        """Replace the drawn particles; along a periodic axis they are drawn within one period."""
        self._drawn = drawn_for_each(self.scene, shown.positions)
        self._shown = replace(shown, positions=self.scene.domain.wrapped(shown.positions))
        self._draw()

    def place_solids(self, scene: Scene) -> None:
        """Move the drawn solids to their poses in ``scene``, which otherwise equals the scene shown."""
        with self.server.atomic():
            for frame, solid in zip(self._solids, shown_solids(scene), strict=False):
                frame.position, frame.wxyz = self._space(solid.position), _quaternion(self._turn @ solid.turn)

    def refresh(self) -> None:
        """Draw again if the user has chosen other colours."""
        if self._stale and self._shown is not None:
            self._draw()

    def _draw(self) -> None:
        assert self._shown is not None
        self._stale = False
        points, colours = self._space(self._shown.positions[self._drawn]), self._colours(self._shown)
        if self._cloud is None:
            size = 2.0 * RADIUS * self.scene.discretisation.spacing
            style = {"point_size": size, "point_shape": "circle", "precision": "float32"}
            self._cloud = self.server.scene.add_point_cloud("/particles", points, colours, **style)
            return
        with self.server.atomic():
            self._cloud.points, self._cloud.colors = points, colours

    def _colours(self, shown: Shown) -> np.ndarray:
        """Return sRGB colours (n, 3); the legend shows their range, or why the quantity is not available."""
        from matplotlib import colormaps

        name, own = self.colour.value, to_srgb(shown.colours[None])[0][self._drawn]
        if name == "phase":
            self.legend.content = ""
            return own
        try:
            values = np.asarray(shown.quantities[name]())[self._drawn]
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
        """Draw the edges of a solid, and in 3-D its faces unless it is a tank; return viser's frame, which sets the
        solid's pose."""
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
        """Place the camera so that the container and solids fill the window, or without them the particles at
        ``positions`` (n, d) [m]."""
        lines = self._space(outline(self.scene)).reshape(-1, 3)
        points = lines if len(lines) else self._space(positions)
        lower, upper = points.min(axis=0), points.max(axis=0)
        middle, radius = 0.5 * (lower + upper), 0.5 * float(np.linalg.norm(upper - lower))
        away = np.array([0.4, 0.35, 1.0]) if self.scene.dimension == 3 else np.array([0.0, 0.0, 1.0])
        camera = self.server.initial_camera
        camera.look_at = middle
        camera.position = middle + DISTANCE * radius * away / np.linalg.norm(away)


def _quaternion(turn: Points) -> np.ndarray:
    """Convert a rotation matrix (d, d) to a quaternion (w, x, y, z), (4,)."""
    from scipy.spatial.transform import Rotation

    return np.roll(Rotation.from_matrix(turn_in_space(turn)).as_quat(), 1)


def _scale(name: str, unit: str, least: float, greatest: float, clips: bool) -> str:
    """Return HTML of a colour bar with the numbers at its ends."""
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
    """Return plain text as HTML."""
    return f'<p style="padding: 0 .8em .4em; margin: 0; font-size: .85em">{escape(words)}</p>'


def quantities_of(
    velocities: np.ndarray, simulation: Callable[[], Simulation], state: RestartState, controls: Mapping[str, Any]
) -> dict[str, Quantity]:
    """Return by name functions for quantities of particles with velocities (n, d) [m/s] in a state, under ``controls``
    as in `Simulation.run`. All except the speed raise `InputError` if the solver cannot compute them."""
    return {
        "speed": lambda: np.linalg.norm(velocities, axis=1),
        "density": lambda: densities(simulation().rollout(1, controls, state)),
        "pressure": lambda: simulation().quantity("pressure", state, controls),
        "vorticity": lambda: sizes_of(simulation().quantity("vorticity", state, controls)),
        "wall_force": lambda: sizes_of(simulation().quantity("wall_force", state, controls)),
    }


def own_fields(fields: Mapping[str, np.ndarray], particles: int) -> dict[str, Quantity]:
    """Return by name further fields of a state (such as a part's own) that have a number or a vector per particle."""
    own = {name: array for name, array in fields.items() if name not in ADJOINT_FIELDS and array.ndim in (1, 2)}
    return {name: partial(sizes_of, array) for name, array in own.items() if len(array) == particles}


def sizes_of(values: np.ndarray) -> np.ndarray:
    """Return numbers (n,) unchanged, and of vectors (n, k) their lengths."""
    return values if values.ndim == 1 else np.linalg.norm(values, axis=-1)


def densities(rollout: Rollout) -> np.ndarray:
    """Return the densities (n,) of the first state of a rollout [kg/m3]."""
    solver = rollout.solver
    if not isinstance(solver, ParticleSolver):
        raise InputError("The solver of this scene has no densities of particles to show.")
    return solver.densities(rollout.initial, rollout.parameters)


STRIDE = 1.0 / 100.0
"""Simulated time [s] between two pictures, approximately."""
SHORTEST_PAUSE = 1.0 / 40.0
"""Shortest real time [s] from one picture to the next, so that the motion of the fluid can be followed."""
LEAN = 2.0
"""Ends of the gravity sliders, relative to the size of the scene's gravity."""
AXES = "xyz"
SHORTEST_PLAY = 4.0
"""Time [s] that a run takes to play at speed 1, unless its simulated time is longer."""


class RecordedView:
    """A view that shows the frames of a run."""

    def __init__(
        self,
        scene: Scene,
        trajectory: Trajectory,
        simulation: Callable[[], Simulation],
        port: int,
    ):
        """Open a view; ``simulation`` is called to make the scene's simulation once a quantity has to be computed."""
        self.scene, self.trajectory, self._simulation = scene, trajectory, simulation
        own = own_fields(trajectory[0].others, trajectory.particles)
        large = sized(scene, solid_motions(scene, trajectory.others))
        self.window = Window(large, port, {**UNITS, **dict.fromkeys(own, "")})
        gui, last = self.window.server.gui, len(trajectory) - 1
        self.playing = gui.add_checkbox("Play", last > 0)
        self.slider = gui.add_slider("Frame", 0, max(last, 1), 1, 0, disabled=not last)
        self.pace = gui.add_slider("Pace", 0.1, 4.0, 0.1, 1.0)
        self._time = gui.add_markdown("")
        self._moment, self._former = 0.0, time.monotonic()
        self.window.look_at(trajectory.positions[0])
        self.show(0)

    def tick(self) -> None:
        """Show the frame that is due at the present time."""
        now = time.monotonic()
        passed, self._former = now - self._former, now
        last = len(self.trajectory) - 1
        if self.playing.value and last:
            length = max(float(self.trajectory.times[-1] - self.trajectory.times[0]), SHORTEST_PLAY)
            self._moment = (self._moment + passed * self.pace.value * last / length) % (last + 1)
            self.slider.value = min(int(self._moment), last)
        if self.slider.value != self._frame:
            if not self.playing.value:
                self._moment = float(self.slider.value)
            self.show(self.slider.value)
        self.window.refresh()
        time.sleep(1.0 / 30.0)

    def show(self, k: int) -> None:
        """Show frame k."""
        frame, self._frame = self.trajectory[k], k
        self._time.content = f"t = {frame.time:.4g} s"
        colours = colours_of(self.scene, frame.mass_fractions, self.trajectory.particles)
        quantities = quantities_of(frame.velocities, self._simulation, self.trajectory[: k + 1].last_state, {})
        quantities |= own_fields(frame.others, self.trajectory.particles)
        recorded = {name: sizes_of(values) for name, values in frame.quantities.items()}
        quantities |= {name: partial(np.asarray, values) for name, values in recorded.items()}
        self.window.place_solids(posed(self.scene, solid_motions(self.scene, self.trajectory.others), k))
        self.window.show(Shown(frame.positions, colours, quantities))


class LiveView:
    """A view that runs a scene live, a few steps for each picture."""

    def __init__(self, simulation: Simulation, port: int):
        scene, self.simulation = simulation.scene, simulation
        self.steps = max(round(STRIDE / longest_step(scene)), 1)
        """Number of steps between two pictures."""
        own = own_fields(simulation.initial.numpy(simulation.dimension), simulation.particles)
        units = {field.name: field.unit for field in simulation.initial.fields if field.name in own}
        self.window = Window(scene, port, {**UNITS, **units})
        gui = self.window.server.gui
        self.running = gui.add_checkbox("Run", True)
        reset = gui.add_button("Begin again")
        self._told = gui.add_markdown("")
        self.gravity = self._sliders("Gravity", "m/s²", scene.forces.gravity, self._most_gravity())
        self.nozzles = {
            emitter.name: self._sliders(emitter.name.capitalize(), "m", emitter.outlet, self._reach(emitter))
            for emitter in scene.emitter
        }
        self._wish_to_begin = False
        reset.on_click(lambda _: setattr(self, "_wish_to_begin", True))
        self.window.look_at(simulation.positions)
        self._begin()

    def tick(self) -> None:
        """Take a few steps with gravity and nozzles as set by the sliders; no steps while the view is paused."""
        if self._wish_to_begin:
            self._begin()
        if not self.running.value:
            self.window.refresh()
            time.sleep(SHORTEST_PAUSE)
            return
        begun = time.monotonic()
        try:
            with unwarned():  # there would be one for each picture
                found = self.simulation.run(self.steps, self._controls(), self.steps, self._state)
        except CortadoError as error:
            self.running.value = False
            self._told.content = f"{error} Begin again."
            return
        self._show(found.last_state)
        time.sleep(max(SHORTEST_PAUSE - (time.monotonic() - begun), 0.0))

    def _begin(self) -> None:
        """Show the first state, and set the sliders to the scene's values."""
        self._wish_to_begin = False
        scene = self.simulation.scene
        self._outlets = {emitter.name: np.array(emitter.outlet) for emitter in scene.emitter}
        moved = [(self.nozzles[name], outlet) for name, outlet in self._outlets.items()]
        for sliders, values in ((self.gravity, scene.forces.gravity), *moved):
            for slider, value in zip(sliders, values, strict=False):
                slider.value = float(value)
        first = self.simulation.rollout(1)
        frame = {**self.simulation.frame(first.initial), **self.simulation.constants(first)}
        self._show(RestartState(frame))

    def _show(self, state: RestartState) -> None:
        self._state = state
        self._told.content = f"t = {state.clock.time:.4g} s"
        colours = colours_of(self.simulation.scene, state.fields.get("mass_fractions"), self.simulation.particles)
        controls = {"gravity": self._gravity()}
        controls |= {path_name(name): outlet for name, outlet in self._outlets.items()}
        quantities = quantities_of(state["velocities"], lambda: self.simulation, state, controls)
        quantities |= own_fields(state.fields, self.simulation.particles)
        scene, fields = self.simulation.scene, {name: np.asarray(field)[None] for name, field in state.fields.items()}
        self.window.place_solids(posed(scene, solid_motions(scene, fields), 0))
        self.window.show(Shown(state["positions"], colours, quantities))

    def _gravity(self) -> np.ndarray:
        """Return gravity (d,) from the sliders."""
        return np.array([slider.value for slider in self.gravity])

    def _controls(self) -> dict[str, np.ndarray]:
        """Return the controls of the next steps: gravity, and each nozzle's path from its present to its wanted
        place."""
        controls = {"gravity": self._gravity()}
        share = np.arange(1, self.steps + 1)[:, None] / self.steps
        for name, sliders in self.nozzles.items():
            wished = np.array([slider.value for slider in sliders])
            controls[path_name(name)] = self._outlets[name] + share * (wished - self._outlets[name])
            self._outlets[name] = wished
        return controls

    def _sliders(self, title: str, unit: str, values: Any, ends: Any) -> list[Any]:
        """Make a slider for each component of ``values``, between ``ends`` (2, d)."""
        gui, found = self.window.server.gui, []
        for axis, value, least, greatest in zip(AXES, values, *ends, strict=False):
            step = float(f"{(greatest - least) / 200.0:.1g}")
            slider = gui.add_slider(f"{title} {axis} [{unit}]", float(least), float(greatest), step, float(value))
            found.append(slider)
        return found

    def _most_gravity(self) -> np.ndarray:
        gravity = np.array(self.simulation.scene.forces.gravity)
        most = LEAN * (float(np.linalg.norm(gravity)) or 9.81) * np.ones(len(gravity))
        return np.stack([-most, most])

    def _reach(self, emitter: EmitterTable) -> np.ndarray:
        """Return the ends of the nozzle's range: above the container, at the nozzle's present height."""
        outlet, ends, half = np.array(emitter.outlet), self.simulation.scene.container.extent(), 0.5 * emitter.width
        if ends is None:
            return outlet + np.array([[-20.0], [20.0]]) * half
        inner = np.array([[1.0], [-1.0]]) * half + np.array(ends)
        reach = np.stack([np.minimum(inner[0], outlet), np.maximum(inner[1], outlet)])
        axis = int(np.abs(emitter.direction).argmax())
        reach[:, axis] = outlet[axis] + np.array([-0.5, 0.5]) * half
        return reach


def view(path: Path, overrides: list[str], device: str, precision: str | None, port: int) -> str:
    """Show a run folder, or run and show a scene, until Ctrl-C."""
    shown = opened(path, overrides, device, precision, port)
    say(f"{shown.window.address} shows it; Ctrl-C ends it.")
    atexit.register(gc.freeze)  # Python would look through all that is there once more, which takes as long as the rest
    try:
        with keeping(lambda: ""):
            while True:
                shown.tick()
    except KeyboardInterrupt:
        return ""
    finally:
        shown.window.close()


def opened(path: Path, overrides: list[str], device: str, precision: str | None, port: int) -> LiveView | RecordedView:
    """Open the view of a run folder, or of a scene file."""
    if not path.exists():
        raise InputError(f"{path} does not exist, but must be the folder of a run, or the file of a scene.")
    if not path.is_dir():
        return LiveView(Simulation(load_scene(path, overrides), device, precision or "float32"), port)
    for option, value in (("set", overrides), ("precision", precision)):
        if value:
            raise InputError(f"--{option} is given, but must be left out, as the run has been computed already.")
    folder = RunFolder.open(path)
    if not folder.trajectory.exists():
        raise InputError(f"{path} has no trajectory, but must be the folder of `cortado run`, or a scene file.")
    folder.require_files()
    scene = folder.read_scene()
    simulation = cache(lambda: Simulation(scene, device))
    return RecordedView(scene, Trajectory.load(folder.trajectory), simulation, port)
