"""The command ``cortado view``, which shows a recorded run or a running scene in the browser."""

import atexit
import gc
import time
from collections.abc import Callable, Mapping
from functools import cache, partial
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cortado.discretise.shapes import Points, in_space
from cortado.errors import CortadoError, InputError, unwarned
from cortado.files.image_encoding import to_srgb
from cortado.files.terminal import keeping, say
from cortado.losses.loss import ADJOINT_FIELDS
from cortado.pictures.film import is_out
from cortado.pictures.pages import container_outline, outline
from cortado.pictures.painter import colours_of
from cortado.pictures.shown_solids import ShownSolid, own_faces, own_lines, shown_solids
from cortado.pictures.stage import upright
from cortado.runs.frames import SolidMotions, posed, sized
from cortado.runs.particle_sums import square
from cortado.runs.run_folder import RunFolder
from cortado.runs.trajectory import Trajectory
from cortado.scene.emitter_table import path_name
from cortado.scene.restart import RestartState
from cortado.scene.scene import Scene, load_scene
from cortado.scene.stability import longest_step
from cortado.simulation import Simulation
from cortado.solvers.particles import ParticleSolver

UNITS = {"speed": "m/s", "density": "kg/m³", "pressure": "Pa", "vorticity": "1/s", "wall_force": "N"}
PALETTE = "viridis"
LINES = (130, 125, 118)
THIN: Any = {"thickness": 1.5, "thickness_units": "screen"}
Quantity = Callable[[], np.ndarray]
"""A function that returns a quantity (n,) of the particles, or raises a `CortadoError`."""


class Window:
    """A window in the browser, served by viser. In the window, the y axis points up."""

    def __init__(self, scene: Scene, port: int, units: Mapping[str, str]):
        """Open a window. ``units`` maps the names of particle quantities to their units."""
        try:
            import viser  # noqa: F401  for the sentence

            from cortado.cli.view_server import GuardedServer
        except ModuleNotFoundError:
            raise InputError("viser, which shows the view, is not installed: pip install viser.") from None
        self.scene = scene
        guarded = GuardedServer(port, f"Cortado: {scene.name}")
        self.server: Any = guarded.viser
        self.address, self.close = guarded.address, guarded.close
        """Address for a browser, with the token that gives access, and the function that closes the window."""
        self._turn = upright(np.asarray(scene.forces.gravity)) if scene.dimension == 3 else np.eye(2)
        self._units = units
        self._cloud: Any = None
        self._stale = False
        """True if the user has changed the colours since the last drawing."""
        self.server.scene.set_up_direction("+y")
        gui, first = self.server.gui, "phase" if len(scene.phase) > 1 else next(iter(units))  # one colour has no depth
        self.colour = gui.add_dropdown("Colour", ["phase", *units], initial_value=first)
        self.legend = gui.add_html("")
        self.colour.on_update(lambda _: setattr(self, "_stale", True))  # in a thread of viser's, which computes nothing
        lines = self._space(container_outline(scene))
        if len(lines):
            self.server.scene.add_line_segments("/container", lines, LINES, **THIN)
        self._solids = []
        for number, one in enumerate(shown_solids(scene)):
            name, pose = f"/solid_{number}", self._pose(one)
            self._solids.append(self.server.scene.add_frame(name, show_axes=False, position=pose[0], wxyz=pose[1]))
            self.server.scene.add_line_segments(f"{name}/edges", in_space(np.float32(own_lines(one))), LINES, **THIN)
            if scene.dimension == 3 and not one.is_tank:
                faces, colour = own_faces(one), tuple(to_srgb(one.colour[None, None])[0, 0].tolist())
                look = {"color": colour, "opacity": 1.0 - one.finish.transparency, "flat_shading": True}
                mesh = in_space(np.float32(faces.vertices)), faces.corners
                self.server.scene.add_mesh_simple(f"{name}/faces", *mesh, **look)

    def show(self, positions: Points, colours: Points, out: NDArray, quantities: Mapping[str, Quantity]) -> None:
        """Draw the particles in the mask ``out`` (n,), with linear ``colours`` (n, 3). Along a periodic axis particles
        are drawn within one period. The functions ``quantities`` return values (n,) for other colours."""
        self._drawn = np.where(out, np.arange(len(out)), np.argmax(out))  # hidden particles are drawn where one is
        self._points = self._space(self.scene.domain.wrapped(positions)[self._drawn])
        self._own_colours, self._quantities = to_srgb(colours[self._drawn][None])[0], quantities
        self._draw()

    def place_solids(self, scene: Scene) -> None:
        with self.server.atomic():
            for frame, solid in zip(self._solids, shown_solids(scene), strict=False):
                frame.position, frame.wxyz = self._pose(solid)

    def refresh(self) -> None:
        if self._stale:
            self._draw()

    def _draw(self) -> None:
        self._stale = False
        points, colours = self._points, self._colours()
        if self._cloud is None:
            size = 0.8 * self.scene.discretisation.spacing
            style = {"point_size": size, "point_shape": "circle", "precision": "float32"}
            self._cloud = self.server.scene.add_point_cloud("/particles", points, colours, **style)
            return
        with self.server.atomic():
            self._cloud.points, self._cloud.colors = points, colours

    def _colours(self) -> np.ndarray:
        from matplotlib import colormaps

        name = self.colour.value
        if name == "phase":
            self.legend.content = ""
            return self._own_colours
        try:
            values = np.asarray(self._quantities[name]())[self._drawn]
        except CortadoError as error:
            words = escape(str(error))
            self.legend.content = f'<p style="padding: 0 .8em .4em; margin: 0; font-size: .85em">{words}</p>'
            return self._own_colours
        least, greatest = float(values.min()), float(np.percentile(values, 99.5, method="higher"))
        self.legend.content = _scale(name, self._units[name], least, greatest, clips=values.max() > greatest)
        share = np.clip((values - least) / (greatest - least or 1.0), 0.0, 1.0)
        return (255.0 * colormaps[PALETTE](share)[:, :3]).astype(np.uint8)

    def _space(self, points: Points) -> np.ndarray:
        return np.asarray(in_space(np.asarray(points, np.float32) @ self._turn.T.astype(np.float32)))

    def _pose(self, solid: ShownSolid) -> tuple[np.ndarray, np.ndarray]:
        """Return the position of a solid (3,), and its rotation as a quaternion (w, x, y, z), (4,)."""
        from scipy.spatial.transform import Rotation

        turn = Rotation.from_matrix(square(self._turn @ solid.turn)).as_quat()
        return self._space(solid.position), np.roll(turn, 1)

    def look_at(self, positions: Points) -> None:
        """Point the camera at the container and the solids. Without both, point it at ``positions`` (n, d) [m]."""
        lines = self._space(outline(self.scene)).reshape(-1, 3)
        points = lines if len(lines) else self._space(positions)
        lower, upper = points.min(axis=0), points.max(axis=0)
        middle, radius = 0.5 * (lower + upper), 0.5 * float(np.linalg.norm(upper - lower))
        away = np.array([0.4, 0.35, 1.0]) if self.scene.dimension == 3 else np.array([0.0, 0.0, 1.0])
        camera = self.server.initial_camera
        camera.look_at = middle
        camera.position = middle + 1.7 * radius * away / np.linalg.norm(away)


def _scale(name: str, unit: str, least: float, greatest: float, clips: bool) -> str:
    from matplotlib import colormaps
    from matplotlib.colors import to_hex

    stops = ", ".join(to_hex(colormaps[PALETTE](share)) for share in np.linspace(0.0, 1.0, 9))
    ends = f"<span>{least:.4g}</span><span>{'≥ ' if clips else ''}{greatest:.4g}</span>"
    return (
        f'<div style="padding: 0 .8em .4em; font-size: .85em">{escape(name)} [{escape(unit)}]'
        f'<div style="height: .8em; border-radius: 3px; background: linear-gradient(90deg, {stops})"></div>'
        f'<div style="display: flex; justify-content: space-between">{ends}</div></div>'
    )


def quantities_of(
    velocities: np.ndarray, simulation: Callable[[], Simulation], state: RestartState, controls: Mapping[str, Any]
) -> dict[str, Quantity]:
    """Return functions of particle quantities by name. ``velocities`` has the shape (n, d) [m/s]."""

    def density() -> np.ndarray:
        rollout = simulation().rollout(1, controls, state)
        if not isinstance(rollout.solver, ParticleSolver):
            raise InputError("The solver of this scene has no densities of particles to show.")
        return rollout.solver.densities(rollout.initial, rollout.parameters)

    def quantity(name: str) -> np.ndarray:
        return sizes_of(simulation().quantity(name, state, controls))

    others = {name: partial(quantity, name) for name in ("pressure", "vorticity", "wall_force")}
    return {"speed": partial(sizes_of, velocities), "density": density, **others}


def own_fields(fields: Mapping[str, np.ndarray], particles: int) -> dict[str, Quantity]:
    shown = {name: a for name, a in fields.items() if a.ndim in (1, 2) and len(a) == particles}
    return {name: partial(sizes_of, array) for name, array in shown.items() if name not in ADJOINT_FIELDS}


def sizes_of(values: np.ndarray) -> np.ndarray:
    """Return numbers (n,) unchanged, or the lengths of vectors (n, k)."""
    return values if values.ndim == 1 else np.linalg.norm(values, axis=-1)


class RecordedView:
    def __init__(self, scene: Scene, trajectory: Trajectory, simulation: Callable[[], Simulation], port: int):
        self.scene, self.trajectory, self._simulation = scene, trajectory, simulation
        own = own_fields(trajectory[0].others, trajectory.particles)
        large = sized(scene, SolidMotions.of(trajectory.others, scene.dimension))
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
        now = time.monotonic()
        passed, self._former = now - self._former, now
        last = len(self.trajectory) - 1
        if self.playing.value and last:
            length = max(float(self.trajectory.times[-1] - self.trajectory.times[0]), 4.0)
            self._moment = (self._moment + passed * self.pace.value * last / length) % (last + 1)
            self.slider.value = min(int(self._moment), last)
        if self.slider.value != self._frame:
            if not self.playing.value:
                self._moment = float(self.slider.value)
            self.show(self.slider.value)
        self.window.refresh()
        time.sleep(1.0 / 30.0)

    def show(self, k: int) -> None:
        frame, self._frame, particles = self.trajectory[k], k, self.trajectory.particles
        self._time.content = f"t = {frame.time:.4g} s"
        colours = colours_of(self.scene, frame.mass_fractions, particles)
        quantities = quantities_of(frame.velocities, self._simulation, self.trajectory[: k + 1].last_state, {})
        quantities |= own_fields(frame.others, particles)
        quantities |= {name: partial(sizes_of, values) for name, values in frame.quantities.items()}
        motions = SolidMotions.of(self.trajectory.others, self.scene.dimension)
        self.window.place_solids(posed(self.scene, motions, k))
        self.window.show(frame.positions, colours, is_out(self.scene, frame.others, particles), quantities)


class LiveView:
    def __init__(self, simulation: Simulation, port: int):
        scene, self.simulation = simulation.scene, simulation
        self.steps = max(round(0.01 / longest_step(scene)), 1)  # s of motion between pictures
        own = own_fields(simulation.initial.numpy(simulation.dimension), simulation.particles)
        units = {field.name: field.unit for field in simulation.initial.fields if field.name in own}
        self.window = Window(scene, port, {**UNITS, **units})
        gui = self.window.server.gui
        self.running = gui.add_checkbox("Run", True)
        gui.add_button("Begin again").on_click(lambda _: setattr(self, "_wish_to_begin", True))
        self._told = gui.add_markdown("")
        most = np.full(scene.dimension, 2.0 * (float(np.linalg.norm(scene.forces.gravity)) or 9.81))
        self.gravity = self._sliders("Gravity", "m/s²", scene.forces.gravity, (-most, most))
        self.nozzles = dict[str, list[Any]]()
        for emitter in scene.emitter:  # whose nozzle stays above the container
            outlet, ends, half = np.array(emitter.outlet), scene.container.extent(), 0.5 * emitter.width
            reach = outlet + np.array([[-20.0], [20.0]]) * half
            if ends is not None:
                inner = np.array([[1.0], [-1.0]]) * half + np.array(ends)
                reach = np.stack([np.minimum(inner[0], outlet), np.maximum(inner[1], outlet)])
                axis = int(np.abs(emitter.direction).argmax())
                reach[:, axis] = outlet[axis] + np.array([-0.5, 0.5]) * half
            self.nozzles[emitter.name] = self._sliders(emitter.name.capitalize(), "m", outlet, reach)
        self._wish_to_begin = False
        self.window.look_at(simulation.positions)
        self._begin()

    def tick(self) -> None:
        if self._wish_to_begin:
            self._begin()
        begun, pause = time.monotonic(), 1.0 / 40.0  # s from one picture to the next at least
        if not self.running.value:
            self.window.refresh()
            time.sleep(pause)
            return
        try:
            with unwarned():  # there would be one for each picture
                found = self.simulation.run(self.steps, self._controls(), self.steps, self._state)
        except CortadoError as error:
            self.running.value = False
            self._told.content = f"{error} Begin again."
            return
        self._show(found.last_state)
        time.sleep(max(pause - (time.monotonic() - begun), 0.0))

    def _begin(self) -> None:
        self._wish_to_begin = False
        scene = self.simulation.scene
        self._outlets = {emitter.name: np.array(emitter.outlet) for emitter in scene.emitter}
        moved = [(self.nozzles[name], outlet) for name, outlet in self._outlets.items()]
        for sliders, values in ((self.gravity, scene.forces.gravity), *moved):
            for slider, value in zip(sliders, values, strict=False):
                slider.value = float(value)
        first = self.simulation.rollout(1)
        self._show(RestartState({**self.simulation.frame(first.initial), **self.simulation.constants(first)}))

    def _show(self, state: RestartState) -> None:
        self._state = state
        self._told.content = f"t = {state.clock.time:.4g} s"
        particles = self.simulation.particles
        colours = colours_of(self.simulation.scene, state.fields.get("mass_fractions"), particles)
        controls = {"gravity": np.array([slider.value for slider in self.gravity])}
        controls |= {path_name(name): outlet for name, outlet in self._outlets.items()}
        quantities = quantities_of(state["velocities"], lambda: self.simulation, state, controls)
        quantities |= own_fields(state.fields, particles)
        scene, fields = self.simulation.scene, {name: np.asarray(field)[None] for name, field in state.fields.items()}
        self.window.place_solids(posed(scene, SolidMotions.of(fields, scene.dimension), 0))
        self.window.show(state["positions"], colours, is_out(scene, state.fields, particles), quantities)

    def _controls(self) -> dict[str, np.ndarray]:
        """Return the parameters of the next steps: gravity, and the path of each nozzle. A nozzle moves in a straight
        line to the position that the sliders show."""
        controls = {"gravity": np.array([slider.value for slider in self.gravity])}
        share = np.arange(1, self.steps + 1)[:, None] / self.steps
        for name, sliders in self.nozzles.items():
            wished = np.array([slider.value for slider in sliders])
            controls[path_name(name)] = self._outlets[name] + share * (wished - self._outlets[name])
            self._outlets[name] = wished
        return controls

    def _sliders(self, title: str, unit: str, values: Any, ends: Any) -> list[Any]:
        found = []
        for axis, value, *ends_of_axis in zip("xyz", values, *ends, strict=False):
            least, greatest = map(float, ends_of_axis)
            step, label = float(f"{(greatest - least) / 200.0:.1g}"), f"{title} {axis} [{unit}]"
            found.append(self.window.server.gui.add_slider(label, least, greatest, step, float(value)))
        return found


def view(path: Path, overrides: list[str], device: str, precision: str | None, port: int) -> str:
    shown = opened(path, overrides, device, precision, port)
    say(f"{shown.window.address} shows it; Ctrl-C ends it.")
    atexit.register(gc.freeze)  # the garbage collection at exit would take as long as the rest
    try:
        with keeping(lambda: ""):
            while True:
                shown.tick()
    except KeyboardInterrupt:
        return ""
    finally:
        shown.window.close()


def opened(path: Path, overrides: list[str], device: str, precision: str | None, port: int) -> LiveView | RecordedView:
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
    return RecordedView(scene, Trajectory.load(folder.trajectory), cache(lambda: Simulation(scene, device)), port)
