"""The class `Simulation`: a scene prepared to run on one device in one precision."""

from collections.abc import Callable, Mapping, Sequence
from hashlib import sha256
from math import isqrt, prod
from os import PathLike
from pathlib import Path
from typing import Any
from weakref import WeakSet

import numpy as np

from cortado.arrays import as_one_number, whole_number
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
from cortado.rollout.parameter_space import ParameterSpace, end_after, steps_of_run
from cortado.rollout.rollout import Rollout
from cortado.rollout.run_checks import check_sizes, one_for_each, trouble
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
"""A state to start from, or a sequence with one state for each scene of a batch."""


@public
@fixed
class Simulation(Stepping):
    """A scene prepared to run.

    One thread at a time may use a simulation. A simulation can be pickled and used after a fork; see
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
        """Prepare ``scene``, which is a `Scene` or the path of its file.

        Args:
            device: "cpu" or "cuda:0", as in Warp.
            precision: "float32" or "float64".
            free_energy: replaces the free energy of the scene.
            batch: number of copies of the scene that are computed together. Each copy has separate parameters.
            forces: user-defined forces, such as `cortado.forces.Body`, in addition to the forces of the scene.
            solver: maker of a user-defined solver that replaces the scene's solver; see `docs/own_parts.md`.
            lanes: GPU threads per particle. The default is the fastest number for one scene of this size; see
                `docs/batches.md`.
        """
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
        """Makers of user-defined forces and of forces of installed packages."""
        self._maker = self._given[1] or build.solver_named(scene.solver)
        self.own_solver = None if self._given[1] is None and scene.solver.kind in OWN else self._maker
        self._called, self._lanes = build.called(scene.solver, self._given[1]), checked_lanes(lanes)
        self.known = build.known_of(self.forces, self._maker, scene)
        self.device, self.precision = device_named(device), precision_named(precision)
        discrete = discretise(scene)
        room = build.first_capacity(scene.discretisation.support, scene.dimension)
        counts = (self.batch or 1) * len(discrete.fluid.positions), len(discrete.walls.positions)
        parts = simulation_parts(*counts, room, self.precision.bytes)
        smaller = "" if self.batch is None else "a smaller batch, "
        require(parts, f"take {smaller}a larger spacing or a smaller container", self.device)
        check_distance(scene, discrete, self.precision)
        self.positions, self.velocities = discrete.fluid.positions, discrete.fluid.velocities
        """Initial positions (n, d) [m] and velocities (n, d) [m/s]."""
        self.mass_fractions = np.eye(len(scene.phase))[discrete.fluid.phase]
        """Initial mass fractions (n, phases) [-]."""
        self.particles = len(self.positions)
        build.check_own(self.known, self)
        self.free_energy = FREE_ENERGIES[scene.mixture.free_energy] if free_energy is None else free_energy
        self.smoothing = discrete.kernel
        self.walls, self.wall_solids = discrete.walls.positions, discrete.walls.solid
        """Positions (b, d) [m] of wall particles, and solids (b,) from `wall_numbers`, or -1 for the container."""
        self.lattice, self.masses = discrete.lattice, discrete.masses
        """Constants of the rest lattice, and the actual and the prescribed masses [kg] of the fluid."""
        self.free_particles = discrete.fluid.emitted.start
        """Number of particles that do not start in an emitter. Arrays end with the particles of emitters."""
        own = (self.scene, discrete, self.free_energy, self.precision, self.device, self.batch, self.forces, self.known)
        self.solver: Solver = build.built(self._maker, build.SolverSetting(*own, self._called, self._lanes))
        self.initial = self.solver.new_state()
        self.judged_states: WeakSet[RestartState] = WeakSet()
        first = SceneParameters(self, 0).first(self.parameters())
        self.initial.set(first if self.batch is None else {name: [a] * self.batch for name, a in first.items()})
        for array in (self.positions, self.velocities, self.mass_fractions, self.walls):
            array.setflags(write=False)
        check_sizes(self.parameters(), self.precision, self.known)

    @property
    def carried_by(self) -> str | None:
        """Name of the solver if its states have additional fields, which no other solver can read, else None."""
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
        """Run from the initial state of the scene and return a trajectory. The frames of the trajectory are the first
        state, every ``record_every``-th state and the last state. A batch returns a `TrajectoryBatch`.

        Args:
            steps: number of steps.
            controls: parameters by name, such as ``{"gravity": [0.0, -5.0]}``, (d,) or (steps, d) [m/s2]. Controls
                replace the values of the scene and its schedule. All parameters of `Problem` are possible.
            record_every: number of steps between frames.
            state: the ``last_state`` of an earlier trajectory, or a sequence with one state for each scene of a
                batch. The run continues exactly (bit for bit). Time-dependent parameters then need a value for each
                further step. A rest density that was given to the earlier run must be given again.
            record: names of particle quantities that are stored with every frame, such as ``["density"]``; see
                `quantity`.
            sensors: sensors by name, in addition to the scene's sensors. All sensors are read in every step; see
                `cortado.sensors`.
            observe: a function that is called with the number of each step, to show progress.
            time: duration [s] in place of ``steps``. The run ends with the first step that reaches this time.

        `run` warns if the pressure did not converge. A lost particle causes a `DivergedError`, or in a batch a warning.
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
        """Run a ``rollout`` forward and return its frames. The arguments ``record_every``, ``record``, ``sensors`` and
        ``observe`` are as in `run`, with the same warnings and errors."""
        record_every = whole_number("record_every", record_every, 1)
        numbers = 2 * (self.batch or 1) * self.numbers_in_frame(self.dimension)
        expected = expected_frames(rollout, record_every)
        require(frame_parts(expected, numbers, self.precision.bytes), "take a larger record_every or fewer steps")
        watch = Watch(self, rollout, record, sensors)
        steps, frames = list[int](), Table(expected)
        changing = [field.name for field in self.initial.fields if not field.is_constant]

        def record_frame(step: int, state: State) -> None:
            steps.append(step)
            frames.add({**state.views(self.dimension, changing), **watch.frame(step, state)})

        record_frame(0, rollout.initial)
        watch.read(0, rollout.initial)
        last = watch.run(lambda step: step % record_every == 0 or rollout.is_last(step), record_frame, observe)
        for sentence in trouble(rollout, self.scene):
            warn(sentence)
        fields, constants = frames.arrays(), self.constants(rollout)
        own = {name: fields.pop(name) for name in watch.names}
        watch.end(last)
        found: Any = recorded(rollout, self.scene, np.array(steps), fields, constants, own, watch.readings)
        return found

    def frame(self, state: State) -> dict[str, np.ndarray]:
        """Return the fields of a ``state`` that change from step to step."""
        return state.numpy(self.dimension, [field.name for field in self.initial.fields if not field.is_constant])

    def numbers_in_frame(self, components: int) -> int:
        """Return the count of numbers in a `frame` whose vectors have ``components`` components."""
        sizes = self.particles, components, len(self.scene.phase)
        return sum(prod(field.shape(*sizes)) for field in self.initial.fields if not field.is_constant)

    def constants(self, rollout: Rollout) -> dict[str, np.ndarray]:
        """Return the fields that are equal in all states of a ``rollout``."""
        names = [field.name for field in rollout.initial.fields if field.is_constant]
        return rollout.initial.numpy(self.dimension, only=names)

    @in_turn
    def rollout(
        self, steps: int | None = None, controls: Controls = None, state: Start | None = None, time: float | None = None
    ) -> Rollout:
        """Return a rollout of ``steps`` steps, or of a ``time`` [s], from ``state``, with ``controls`` as in `run`."""
        rollout = Rollout(self.solver, steps_of_run(self, steps, time, {} if controls is None else controls))
        self._begin(rollout, controls, state, time)
        return rollout

    def _begin(self, rollout: Rollout, controls: Controls, state: Start | None, time: float | None) -> None:
        space, given = ParameterSpace(self, rollout.steps), {} if controls is None else controls
        values, states = space.checked(given), one_for_each(state, self.batch)
        space.check_restarts(states, values)
        space.begin(rollout, values, states=states)
        end_after(rollout, time)

    def quantity(self, name: str, of: Start | Trajectory | None = None, controls: Controls = None) -> np.ndarray:
        """Return a quantity of the particles: "density" [kg/m3], "pressure" [Pa], "speed" [m/s], "vorticity" [1/s] or
        "wall_force" [N]; see `docs/sensors.md`. The name can also be a field of the state, or the load on a solid, such
        as "rotor.load".

        Args:
            name: name of the quantity.
            of: a state of this simulation, a sequence with one state for each scene of a batch, or a trajectory. The
                default is the initial state of the scene.
            controls: parameters of the step that starts at the state, as in `run`, or controls of the trajectory's run.

        Returns:
            float64 (n,) or (n, k) in the order of the scene, for a trajectory (frames, n, ...). A load has the shape
            (k,).

        Raises:
            InputError: the name is unknown, or the state does not belong to this simulation.
        """
        check_readable(name, "quantity", self.initial.names)
        if not isinstance(of, Trajectory):
            return self._quantity(name, of, controls)
        given = {key: value for key, value in (controls or {}).items() if key not in self.known.state}
        rows = {key: value for key, value in given.items() if key in OVER_TIME and np.ndim(value) == 2}
        found = []
        for k, step in enumerate((of.steps - of.steps[:1]).tolist()):
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
        """Return the object that computes quantities of states on the device."""
        made: QuantityEvaluator | None = self.__dict__.get("_evaluator")
        if made is None:
            spacing, support = self.scene.discretisation.spacing, self.lattice.support
            factor = circulation_factor(self.smoothing, spacing, support, self.dimension)
            made = self.__dict__["_evaluator"] = QuantityEvaluator(self.solver, self.scene, factor)
        return made

    def renderer(self, **settings: Any) -> Renderer:
        """Return a differentiable renderer of this simulation: ``renderer.render(trajectory[k])`` returns a picture.
        The scene's table ``[render]`` sets the view. The default camera looks down in 3-D, and at the plane in 2-D.

        ``settings`` replace keys of ``[render]``, such as ``resolution=(320, 240)`` or ``view="volume", position=(1, 1,
        2), look_at=(0.2, 0.2, 0.2)``. `losses.Image` needs a renderer. Raises `SceneError` for invalid settings.
        """
        return scene_renderer(self, **settings)

    def picture(self, frame: Frame, **settings: Any) -> ShadedPicture:
        """Return a shaded picture of a frame, (rows, columns, 3), with linear values from 0 to 1. The scene's table
        ``[picture]`` contains the settings. ``settings`` such as ``width=640, height=360`` replace keys of this table.

        Raises:
            SceneError: settings are invalid.
            InputError: the frame does not contain the quantity of ``colour``. For the colour "age", use
                `Trajectory.picture`.

        Example: ``cortado.pictures.write_picture("last.png", simulation.picture(trajectory[-1]))``
        """
        return on_top("simulation_picture")(self, frame, settings)

    def film(self, trajectory: Trajectory, path: str | Path, **settings: Any) -> Film:
        """Render a film of a ``trajectory`` on the device of the simulation and write it to ``path``. For ``settings``
        see `Trajectory.film`. If the run did not record the quantity of ``colour``, the film computes it."""
        return on_top("simulation_film")(self, trajectory, path, settings)

    @property
    def dimension(self) -> int:
        return self.scene.dimension

    @unwarned()
    def batch_of(self, size: int) -> "Simulation":
        """Return a simulation of ``size`` copies of this scene that are computed together."""
        return Simulation(*self._made_of(self.precision.name, size))

    @unwarned()
    def in_precision(self, precision: str) -> "Simulation":
        """Return a simulation of a single copy of this scene in a new ``precision``, on the same device."""
        return Simulation(*self._made_of(precision, None))

    def replaced(self, *overrides: str) -> "Simulation":
        """Return a simulation of this scene with the ``overrides`` of `Scene.replaced`, on the same device."""
        _, *others = self._made_of(self.precision.name, self.batch)
        return Simulation(self.scene.replaced(*overrides), *others)

    def room(self, steps: int, checkpoints: float) -> int:
        """Return the number of runs of ``steps`` steps to compute together, within half of the free memory.
        ``checkpoints`` is the greatest total size of stored states [byte]."""
        steps, most = whole_number("steps", steps, 0), as_one_number("checkpoints", checkpoints)
        neighbours, real = build.first_capacity(self.scene.discretisation.support, self.dimension), self.precision.bytes
        own = sum(simulation_parts(self.particles, 0, neighbours, real).values())
        states = real * self.numbers_in_frame(3) * 2 * max(isqrt(steps), 1)
        fitting = within(np.inf, self.device) // own
        kept = most // states if most else fitting
        return int(max(min(WORTH["cpu" if self.device.is_cpu else "cuda"] // self.particles, fitting, kept), 1))

    def parameters(self) -> dict[str, np.ndarray]:
        """Return the values of all parameters of `Problem` in the scene and its forces, without the schedule."""
        return scene_values(self, self.known)

    def substeps(
        self, time_step: np.ndarray, mobility: np.ndarray, interface_width: np.ndarray, rest_density: np.ndarray
    ) -> int:
        """Return the smallest stable number of explicit diffusion substeps per ``time_step`` [s].

        ``mobility`` is in m2/s, ``interface_width`` in m, and ``rest_density`` (phases,) in kg/m3. Raises `InputError`
        for more substeps than `cortado.sph.free_energy.MOST_SUBSTEPS`.
        """
        if len(self.scene.phase) == 1:
            return 0
        numbers = (float(time_step), float(mobility), float(interface_width), rest_density)
        return stable_substeps(self.scene, self.free_energy, *numbers)


@unwarned()
def _made_again(made_of: tuple[Any, ...], points: str) -> Simulation:
    simulation = Simulation(*made_of)
    if simulation._points != points:
        found = "The initial positions differ from the pickled simulation's positions"
        why = "as the file of points in the scene has changed"
        raise InputError(f"{found}, {why}: restore the file, or make a new simulation.")
    return simulation
