"""The class `Simulation`: a scene prepared to run on a device in a floating-point precision."""

from collections.abc import Callable, Mapping, Sequence
from hashlib import sha256
from math import isqrt, prod
from os import PathLike
from pathlib import Path
from typing import Any
from weakref import WeakSet

import numpy as np

from cortado.arrays import whole_number
from cortado.calls import counted, fixed, public
from cortado.device.modules import device_named, start_warp
from cortado.device.precision import checked_lanes, precision_named
from cortado.device.threads import WARP, Turn, frame_parts, in_turn, require, simulation_parts, within
from cortado.discretise.smoothing import circulation_factor
from cortado.errors import InputError, shown, unwarned, warn
from cortado.files.image_encoding import ShadedPicture
from cortado.lazy import on_top
from cortado.particles.state import State
from cortado.render.renderer import Renderer, scene_renderer
from cortado.rollout.outcome import trouble
from cortado.rollout.parameter_space import ParameterSpace, end_after, steps_of_run
from cortado.rollout.rollout import Rollout
from cortado.rollout.run_checks import check_sizes, one_for_each
from cortado.rollout.scene_parameters import SceneParameters
from cortado.rollout.step_bounds import expected_frames
from cortado.rollout.stepper import Stepping
from cortado.runs.frames import Film
from cortado.runs.quantity_values import Moment, QuantityEvaluator
from cortado.runs.recording import Table, recorded
from cortado.runs.sensor import Sensor
from cortado.runs.trajectory import Frame, Trajectory
from cortado.scene.discrete_scene import check_distance, discretise
from cortado.scene.parameter_values import OVER_TIME, scene_values
from cortado.scene.parameters import check_readable
from cortado.scene.restart import RestartState
from cortado.scene.scene import Scene, as_scene
from cortado.scene.solvers import OWN
from cortado.solvers import build
from cortado.solvers.solver import Solver
from cortado.sph.free_energy import FREE_ENERGIES, FreeEnergy, stable_substeps
from cortado.watching import Watch

WORTH = {"cpu": 16_000, "cuda": 1_000_000}
Controls = Mapping[str, Any] | None
Start = RestartState | Sequence[RestartState]
"""A state to begin from, or one for each scene of a batch."""


@public
@fixed
class Simulation(Stepping):
    """A scene made ready to run: particles sampled, masses calibrated, kernels chosen.

    Only one thread at a time uses a simulation. A simulation can be pickled and used after a fork; see
    `docs/processes.md`.

    Example::

        simulation = cortado.Simulation("dam.toml", device="cpu", precision="float64")
        trajectory = simulation.run(steps=100, record_every=10)
        state = simulation.step(simulation.state(), {"gravity": [0.0, -9.81]}, steps=5)
    """

    @WARP
    def __init__(
        self,
        scene: Scene | str | PathLike[str],
        device: str = "cpu",
        precision: str = "float32",
        free_energy: FreeEnergy | None = None,
        batch: int | None = None,
        forces: Sequence[build.ForceMaker] = (),
        solver: build.SolverMaker | None = None,
        lanes: int | None = None,
    ):
        """Prepare ``scene``, a `Scene` or the path of its file. ``device``: "cpu" or "cuda:0", as in Warp.
        ``precision``: "float32" or "float64". ``free_energy`` replaces the scene's. ``batch``: number of copies in one
        launch, each with its parameters. ``forces``: user-defined forces, such as `cortado.forces.Body`, added to the
        scene's. ``solver``: a function that makes a user-defined solver, which replaces the scene's; see
        `docs/own_parts.md`. ``lanes``: GPU threads per particle, by default the fastest number for one scene of this
        size; see `docs/batches.md`."""
        scene, self.batch = as_scene(scene), None if batch is None else whole_number("batch", batch, 1)
        start_warp()
        if free_energy is not None and not isinstance(free_energy, FreeEnergy):
            wanted = "a FreeEnergy, of cortado.sph.free_energy"
            raise InputError(f"free_energy is {shown(free_energy)}, but must be {wanted}.")
        if free_energy is not None and len(scene.phase) == 1:
            raise InputError("free_energy is given, but must be left out, as the scene has only one phase.")
        self.scene = scene
        self._given = build.checked_makers(forces), None if solver is None else build.checked_solver(solver)
        self.forces = (*build.forces_named(scene), *self._given[0])
        """Makers of the forces that are not part of Cortado: of packages named in the scene, and user-defined ones."""
        self._maker = self._given[1] or build.solver_named(scene.solver)
        self.own_solver = None if self._given[1] is None and scene.solver.kind in OWN else self._maker
        """Maker of a solver that is not one of Cortado's, or None."""
        self._called, self._lanes = build.called(scene.solver, self._given[1]), checked_lanes(lanes)
        self.known = build.known_of(self.forces, self._maker, scene)
        self.device = device_named(device)
        self.precision = precision_named(precision)
        discrete = discretise(scene)
        room = build.first_capacity(scene.discretisation.support, scene.dimension)
        counts = (self.batch or 1) * len(discrete.fluid.positions), len(discrete.walls.positions)
        parts = simulation_parts(*counts, room, self.precision.bytes)
        smaller = "" if self.batch is None else "a smaller batch, "
        require(parts, f"take {smaller}a larger spacing or a smaller container", self.device)
        check_distance(scene, discrete, self.precision)
        self.positions, self.velocities = discrete.fluid.positions, discrete.fluid.velocities
        """First positions (n, d) [m] and first velocities (n, d) [m/s]."""
        self.mass_fractions = np.eye(len(scene.phase))[discrete.fluid.phase]
        """First mass fractions (n, phases) [-]."""
        self.particles = len(self.positions)
        build.check_own(self.known, self)
        self.free_energy = FREE_ENERGIES[scene.mixture.free_energy] if free_energy is None else free_energy
        self.smoothing = discrete.kernel
        self.walls, self.wall_solids = discrete.walls.positions, discrete.walls.solid
        """Positions of wall particles (b, d) [m], and the numbers of their solids (b,) as in `wall_numbers`; -1 for the
        container."""
        self.lattice, self.masses = discrete.lattice, discrete.masses
        """Constants of the rest lattice; masses of the fluid at the start [kg], and those that the scene describes."""
        self.free_particles = discrete.fluid.emitted.start
        """Number of particles outside nozzles at the start, which come first in arrays."""
        own = (self.scene, discrete, self.free_energy, self.precision, self.device, self.batch, self.forces, self.known)
        self.solver: Solver = build.built(self._maker, build.SolverSetting(*own, self._called, self._lanes))
        self.initial = self.solver.new_state()
        self.judged_states: WeakSet[RestartState] = WeakSet()
        """States that were checked once and cannot change."""
        first = SceneParameters(self, 0).first(self.parameters())
        self.initial.set(first if self.batch is None else {name: [a] * self.batch for name, a in first.items()})
        for array in (self.positions, self.velocities, self.mass_fractions, self.walls):
            array.setflags(write=False)
        check_sizes(self.parameters(), self.precision, self.known)

    @property
    def carried_by(self) -> str | None:
        """Name of a solver that adds fields to states, so that no other solver can continue from them; else None."""
        return self._called if getattr(self.solver, "carried_fields", ()) else None

    def __reduce__(self) -> tuple[Any, ...]:
        return _made_again, (self._made_of(self.precision.name, self.batch), self._points)

    def _made_of(self, precision: str, batch: int | None) -> tuple[Any, ...]:
        energy = self.free_energy if len(self.scene.phase) > 1 else None
        return self.scene, self.device.alias, precision, energy, batch, *self._given, self._lanes

    def __repr__(self) -> str:
        sizes = f"{counted(self.particles, 'particle')}, {counted(len(self.scene.phase), 'phase')}"
        batch = "" if self.batch is None else f"batch of {self.batch}, "
        return f"Simulation({batch}{sizes}, {self.device.alias}, {self.precision.name})"

    def _repr_html_(self) -> str:
        return on_top("simulation_page")(self)

    @property
    def _points(self) -> str:
        return sha256(self.positions.tobytes()).hexdigest()

    @property
    def turn(self) -> Turn:
        return self.solver.turn

    @in_turn
    def run(
        self,
        steps: int | None = None,
        controls: Controls = None,
        record_every: int = 1,
        state: Start | None = None,
        record: Sequence[str] = (),
        sensors: Mapping[str, Sensor] | None = None,
        time: float | None = None,
        observe: Callable[[int], object] | None = None,
    ) -> Trajectory:
        """Run from the scene's first state and return the frames: the first state, every ``record_every``-th and the
        last. A batch returns a `TrajectoryBatch`. ``time`` [s], instead of ``steps``, runs until the first step that
        ends at this time or later.

        ``controls={"gravity": (d,) or (steps, d)}`` [m/s2] replaces the scene's gravity and its schedule; any other
        parameter of `Problem` can be given as well. ``state``, the ``last_state`` of an earlier trajectory (one for
        each scene of a batch), continues that run bit for bit. Parameters over time then have a value for each
        remaining step, and a rest density given to the earlier run must be given again. ``record=["density"]`` stores
        particle quantities with every frame: see `quantity`. ``sensors``, by name, are read in every step besides the
        scene's: see `cortado.sensors`. ``observe`` is called with the number of each step, to show progress. Warns if
        the pressure did not converge. If a particle is lost, a single run raises `DivergedError`; a batch warns and
        continues without that scene.
        """
        own, number = self.__dict__, steps_of_run(self, steps, time, {} if controls is None else controls)
        rollout = own.pop("_idle", None)  # not to be had by a run within this one
        if rollout is None or rollout.room < number:
            rollout = Rollout(self.solver, 1 << (number - 1).bit_length())
        try:
            rollout.steps = number
            self._begin(rollout, controls, state, time)
            return self.collect(rollout, record_every, record, sensors, observe)
        finally:
            own["_idle"] = rollout

    @in_turn
    def collect(
        self,
        rollout: Rollout,
        record_every: int = 1,
        record: Sequence[str] = (),
        sensors: Mapping[str, Sensor] | None = None,
        observe: Callable[[int], object] | None = None,
    ) -> Trajectory:
        """Run a ``rollout`` forward and return its frames. ``record_every``, ``record``, ``sensors``, ``observe``,
        warnings and errors are as in `run`."""
        record_every = whole_number("record_every", record_every, 1)
        numbers = 2 * (self.batch or 1) * self.numbers_in_frame(self.dimension)
        expected = expected_frames(rollout, record_every)
        parts = frame_parts(expected, numbers, self.precision.bytes)
        require(parts, "take a larger record_every or fewer steps")
        watch = Watch(self, rollout, record, sensors)
        steps, frames = list[int](), Table(expected)

        def record_frame(step: int, state: State) -> None:
            steps.append(step)
            frames.add({**state.views(self.dimension, self._changing), **watch.frame(step, state)})

        record_frame(0, rollout.initial)
        watch.first()
        last = watch.run(lambda step: step % record_every == 0 or rollout.is_last(step), record_frame, observe)
        for sentence in trouble(rollout, self.scene):
            warn(sentence)
        fields, constants = frames.arrays(), self.constants(rollout)
        own = {name: fields.pop(name) for name in watch.names}
        watch.end(last)
        found: Any = recorded(rollout, self.scene, np.array(steps), fields, constants, own, watch.readings)
        return found

    def frame(self, state: State) -> dict[str, np.ndarray]:
        """Return the fields of a ``state`` that steps change."""
        return state.numpy(self.dimension, self._changing)

    @property
    def _changing(self) -> list[str]:
        return [field.name for field in self.initial.fields if not field.is_constant]

    def numbers_in_frame(self, components: int) -> int:
        """Return the greatest number of numbers in a `frame`, for vectors with so many ``components``."""
        sizes = self.particles, components, len(self.scene.phase)
        return sum(prod(field.shape(*sizes)) for field in self.initial.fields if not field.is_constant)

    def constants(self, rollout: Rollout) -> dict[str, np.ndarray]:
        """Return the fields of the states of a ``rollout`` that no step changes."""
        names = [field.name for field in rollout.initial.fields if field.is_constant]
        return rollout.initial.numpy(self.dimension, only=names)

    @in_turn
    def rollout(
        self, steps: int | None = None, controls: Controls = None, state: Start | None = None, time: float | None = None
    ) -> Rollout:
        """Return a rollout ready to run forward from the scene's first state, or from ``state``, over ``steps`` steps
        or a ``time`` [s]; ``controls`` are as in `run`."""
        rollout = Rollout(self.solver, steps_of_run(self, steps, time, {} if controls is None else controls))
        self._begin(rollout, controls, state, time)
        return rollout

    def _begin(self, rollout: Rollout, controls: Controls, state: Start | None, time: float | None) -> None:
        space, given = ParameterSpace(self, rollout.steps), {} if controls is None else controls
        values = space.checked(given)
        states = one_for_each(state, self.batch)
        space.check_restarts(states, values)
        space.begin(rollout, values, states=states)
        end_after(rollout, time)

    def quantity(self, name: str, of: Start | Trajectory | None = None, controls: Controls = None) -> np.ndarray:
        """Return a quantity of the particles: "density" [kg/m3], "pressure" [Pa], "speed" [m/s], "vorticity" [1/s],
        "wall_force" [N]; see `docs/sensors.md`. Fields of the state work too, such as one of a user-defined solver, and
        the load on a solid, such as "rotor.load".

        Args:
            name: name of the quantity.
            of: a state of this simulation (of a batch, one for each scene), or a trajectory, which is evaluated frame
                by frame; by default the scene's first state.
            controls: as in `run`, for the step that begins at the state, in which the pressure is computed. For a
                trajectory, give the controls of its run.

        Returns:
            float64 (n,) or (n, k) in the scene's order, for a trajectory (frames, n, ...). A field has its shape, and
            a load (k,).

        Raises:
            InputError: the name is unknown, or the state is not one of this simulation.
        """
        check_readable(name, "quantity", self.initial.names)
        if not isinstance(of, Trajectory):
            return self._quantity(name, of, controls)
        given = {key: value for key, value in (controls or {}).items() if key not in self.known.state}
        rows = {key: value for key, value in given.items() if key in OVER_TIME and np.ndim(value) == 2}
        found = []
        for k, step in enumerate((of.steps - of.steps[0]).tolist()):
            now = {key: value[min(step, len(value) - 1)] for key, value in rows.items()}
            found.append(self._quantity(name, of[: k + 1].last_state, given | now))
        return np.array(found)

    @in_turn
    def _quantity(self, name: str, state: Any, controls: Controls) -> np.ndarray:
        rollout = self.rollout(1, controls, state)
        if name in rollout.initial.names:
            return rollout.initial.numpy(self.dimension, only=[name])[name].astype(np.float64)
        return Moment.of(rollout, 0, rollout.initial, self.evaluator).value(name)

    @in_turn
    def evaluator(self) -> QuantityEvaluator:
        """Return the object that computes quantities of states on the device, which is made once."""
        made: QuantityEvaluator | None = self.__dict__.get("_evaluator")
        if made is None:
            spacing, support = self.scene.discretisation.spacing, self.lattice.support
            factor = circulation_factor(self.smoothing, spacing, support, self.dimension)
            made = self.__dict__["_evaluator"] = QuantityEvaluator(self.solver, self.scene, factor)
        return made

    def renderer(self, **settings: Any) -> Renderer:
        """Return a differentiable renderer of this simulation: ``renderer.render(trajectory[k])`` returns a picture.
        The scene's table ``[render]`` sets the view; by default the camera looks from above, and in 2-D at the plane.

        ``settings`` replace keys of that table: ``resolution=(320, 240)``, or ``view="volume", position=(1, 1, 2),
        look_at=(0.2, 0.2, 0.2)``. `losses.Image` takes the renderer. Raises `SceneError` for settings that do not fit.
        """
        return scene_renderer(self, **settings)

    def picture(self, frame: Frame, **settings: Any) -> ShadedPicture:
        """Return a shaded picture of a frame, (rows, columns, 3), linear from 0 to 1, with the settings of the scene's
        table ``[picture]``. ``settings`` replace keys of this table, as in `film`: ``width=640, height=360``.

        Raises:
            SceneError: the settings do not fit. InputError: the quantity that ``colour`` names is not recorded in the
            frame, or is the age, which needs more than one frame.

        Example: ``cortado.pictures.write_picture("last.png", simulation.picture(trajectory[-1]))``
        """
        return on_top("simulation_picture")(self, frame, settings)

    def film(self, trajectory: Trajectory, path: str | Path, **settings: Any) -> Film:
        """Render a film of a ``trajectory`` on the simulation's device and write it to ``path``; for ``settings`` see
        `Trajectory.film`. If the quantity of ``colour``, such as the pressure, was not recorded, it is computed."""
        return on_top("simulation_film")(self, trajectory, path, settings)

    @property
    def dimension(self) -> int:
        return self.scene.dimension

    @unwarned()
    def batch_of(self, size: int) -> "Simulation":
        """Return a simulation of ``size`` copies of this scene in one launch."""
        return Simulation(*self._made_of(self.precision.name, size))

    @unwarned()
    def in_precision(self, precision: str) -> "Simulation":
        """Return a single simulation of this scene, on the same device, in a ``precision``."""
        return Simulation(*self._made_of(precision, None))

    def replaced(self, *overrides: str) -> "Simulation":
        """Return a simulation of this scene with the ``overrides`` of `Scene.replaced`, on the same device."""
        _, *others = self._made_of(self.precision.name, self.batch)
        return Simulation(self.scene.replaced(*overrides), *others)

    def room(self, steps: int, checkpoints: float) -> int:
        """Return how many runs of ``steps`` steps one launch should compute: they fit half of the free memory, with at
        most ``checkpoints`` bytes of stored states in total."""
        neighbours, real = build.first_capacity(self.scene.discretisation.support, self.dimension), self.precision.bytes
        own = sum(simulation_parts(self.particles, 0, neighbours, real).values())
        states = real * self.numbers_in_frame(3) * 2 * max(isqrt(steps), 1)
        fitting = within(np.inf, self.device) // own
        kept = checkpoints // states if checkpoints else fitting
        return int(max(min(WORTH["cpu" if self.device.is_cpu else "cuda"] // self.particles, fitting, kept), 1))

    def parameters(self) -> dict[str, np.ndarray]:
        """Return the value of every parameter of `Problem` in the scene and its forces, without the scene's
        schedule."""
        return scene_values(self, self.known)

    def substeps(
        self, time_step: np.ndarray, mobility: np.ndarray, interface_width: np.ndarray, rest_density: np.ndarray
    ) -> int:
        """Return the number of explicit diffusion substeps per ``time_step`` [s] that is stable with a ``mobility``
        [m2/s], an ``interface_width`` [m] and a ``rest_density`` (phases,) [kg/m3]; raises `InputError` for more than
        `cortado.sph.free_energy.MOST_SUBSTEPS`."""
        if len(self.scene.phase) == 1:
            return 0
        numbers = (float(time_step), float(mobility), float(interface_width), rest_density)
        return stable_substeps(self.scene, self.free_energy, *numbers)


@unwarned()
def _made_again(made_of: tuple[Any, ...], points: str) -> Simulation:
    simulation = Simulation(*made_of)
    if simulation._points != points:
        raise InputError(
            "The first positions of a simulation are others than when it was pickled, but must be the same: the file "
            "of points that its scene names has changed. Restore it, or make the simulation anew."
        )
    return simulation
