"""A scene on a device in a precision: the thing that runs."""

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
from cortado.solvers.build import (
    ForceMaker,
    SolverMaker,
    SolverSetting,
    built,
    called,
    check_own,
    checked_makers,
    checked_solver,
    first_capacity,
    forces_named,
    known_of,
    solver_named,
)
from cortado.solvers.solver import Solver
from cortado.sph.free_energy import FREE_ENERGIES, FreeEnergy, stable_substeps
from cortado.watching import Watch

WORTH = {"cpu": 16_000, "cuda": 1_000_000}
"""Number of particles of all scenes in one launch above which more are no faster, by kind of device."""


@public
@fixed
class Simulation(Stepping):
    """A scene made ready to run: particles sampled, masses calibrated, kernels chosen.

    Threads that use it take turns, and other processes can have it, pickled or by a fork: see `docs/processes.md`.

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
        forces: Sequence[ForceMaker] = (),
        solver: SolverMaker | None = None,
        lanes: int | None = None,
    ):
        """Prepare ``scene``: one, or the path of its file; ``device`` as Warp names it ("cpu", "cuda:0"), ``precision``
        "float32" or "float64"; ``free_energy`` replaces the one that the scene names. ``batch``: run so many of it in
        one launch, each with parameters of its own; see `docs/batches.md`. ``forces``: forces of one's own, such as
        `cortado.forces.Body`, which act besides the scene's; ``solver``: what makes a solver of one's own, instead of
        the one that the scene names; see `docs/own_parts.md`. ``lanes``: threads of a GPU that share a particle, by
        default as many as are fastest for a scene of this size that runs alone; see `docs/batches.md`."""
        scene, self.batch = as_scene(scene), None if batch is None else whole_number("batch", batch, 1)
        start_warp()
        if free_energy is not None and not isinstance(free_energy, FreeEnergy):
            wanted = "a FreeEnergy, of cortado.sph.free_energy"
            raise InputError(f"free_energy is {shown(free_energy)}, but must be {wanted}.")
        if free_energy is not None and len(scene.phase) == 1:
            raise InputError("free_energy is given, but must be left out, as the scene has only one phase.")
        self.scene = scene
        self._given = checked_makers(forces), None if solver is None else checked_solver(solver)
        self.forces = (*forces_named(scene), *self._given[0])
        """What makes the forces that are not Cortado's own: those of packages that the scene names, and those given."""
        self._maker = self._given[1] or solver_named(scene.solver)
        self.own_solver = None if self._given[1] is None and scene.solver.kind in OWN else self._maker
        """What makes the solver, if it is not Cortado's own."""
        self._called, self._lanes = called(scene.solver, self._given[1]), checked_lanes(lanes)
        self.known = known_of(self.forces, self._maker, scene)
        """Its parameters."""
        self.device = device_named(device)
        self.precision = precision_named(precision)
        discrete = discretise(scene)
        room = first_capacity(scene.discretisation.support, scene.dimension)
        counts = (self.batch or 1) * len(discrete.fluid.positions), len(discrete.walls.positions)
        parts = simulation_parts(*counts, room, self.precision.bytes)
        smaller = "" if self.batch is None else "a smaller batch, "
        require(parts, f"take {smaller}a larger spacing or a smaller container", self.device)
        check_distance(scene, discrete, self.precision)
        self.positions, self.velocities = discrete.fluid.positions, discrete.fluid.velocities
        """(n, d) first positions [m], and first velocities [m / s]."""
        self.mass_fractions = np.eye(len(scene.phase))[discrete.fluid.phase]
        """(n, phases) first mass fractions [-]."""
        self.particles = len(self.positions)
        check_own(self.known, self)
        self.free_energy = FREE_ENERGIES[scene.mixture.free_energy] if free_energy is None else free_energy
        self.smoothing = discrete.kernel
        self.walls, self.wall_solids = discrete.walls.positions, discrete.walls.solid
        """(b, d) wall particles [m], and (b,) the solid of each, as `wall_numbers` has them; -1 for the container."""
        self.lattice, self.masses = discrete.lattice, discrete.masses
        """Constants of the lattice of particles at rest; masses of the fluid at the start, given and asked for [kg]."""
        self.free_particles = discrete.fluid.emitted.start
        """How many particles, the first ones, do not wait in a nozzle."""
        own = (self.scene, discrete, self.free_energy, self.precision, self.device, self.batch, self.forces, self.known)
        self.solver: Solver = built(self._maker, SolverSetting(*own, self._called, self._lanes))
        self.initial = self.solver.new_state()
        """The first state on the device."""
        self.judged_states: WeakSet[RestartState] = WeakSet()
        """Those that need not be judged again, as nobody can change them."""
        first = SceneParameters(self, 0).first(self.parameters())
        self.initial.set(first if self.batch is None else {name: [a] * self.batch for name, a in first.items()})
        for array in (self.positions, self.velocities, self.mass_fractions, self.walls):
            array.setflags(write=False)
        check_sizes(self.parameters(), self.precision, self.known)

    @property
    def carried_by(self) -> str | None:
        """Name of the solver in sentences, if it adds fields of its own to states, from which no other solver goes on;
        else None."""
        return self._called if getattr(self.solver, "carried_fields", ()) else None

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle or copy the simulation as its constructor's arguments."""
        return _made_again, (self._made_of(self.precision.name, self.batch), self._points)

    def _made_of(self, precision: str, batch: int | None) -> tuple[Any, ...]:
        """Return the arguments to make a simulation of this scene, in a precision and for a batch."""
        energy = self.free_energy if len(self.scene.phase) > 1 else None
        return self.scene, self.device.alias, precision, energy, batch, *self._given, self._lanes

    def __repr__(self) -> str:
        sizes = f"{counted(self.particles, 'particle')}, {counted(len(self.scene.phase), 'phase')}"
        batch = "" if self.batch is None else f"batch of {self.batch}, "
        return f"Simulation({batch}{sizes}, {self.device.alias}, {self.precision.name})"

    def _repr_html_(self) -> str:
        """Return the repr, and a picture of the first particles."""
        page: str = on_top("simulation_page")(self)
        return page

    @property
    def _points(self) -> str:
        """Checksum of the first positions."""
        return sha256(self.positions.tobytes()).hexdigest()

    @property
    def turn(self) -> Turn:
        """Lock that a thread holds while it uses the simulation."""
        return self.solver.turn

    @in_turn
    def run(
        self,
        steps: int | None = None,
        controls: Mapping[str, Any] | None = None,
        record_every: int = 1,
        state: RestartState | Sequence[RestartState] | None = None,
        record: Sequence[str] = (),
        sensors: Mapping[str, Sensor] | None = None,
        time: float | None = None,
        observe: Callable[[int], object] | None = None,
    ) -> Trajectory:
        """Run from the scene's first state and return the frames, the first and the last state included; of a batch a
        `TrajectoryBatch`. A frame is kept every ``record_every`` steps. ``time`` [s], in the place of ``steps``: as
        many steps as it takes, the last of which ends then or later.

        ``controls={"gravity": (d,) or (steps, d)}`` [m / s2] replaces the scene's gravity, its schedule included; so
        does any other parameter of `Problem`. With ``state``, the ``last_state`` of an earlier trajectory of the same
        scene, the run goes on from there, with the same bits as if it had not stopped. A parameter over time then has a
        value for each of the steps to come, and a rest density that the earlier run was given is given again. A batch
        goes on from one state for each scene. ``record=["density"]`` keeps quantities of the particles with every
        frame: see `quantity`. ``sensors`` by name are read in every step, besides those of the scene: see
        `cortado.sensors`. ``observe`` is called with the number of each step, to show how far a run is. Warns when the
        pressure did not converge; raises `DivergedError` when a particle is lost, where a batch warns, and goes on
        without the scene.
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
        """Run a rollout forward and return its frames. ``record_every``, ``record``, ``sensors`` and ``observe`` are
        those of `run`, which warns and raises in the same way."""
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
        """Return the fields of a state that a trajectory records, as steps change them."""
        return state.numpy(self.dimension, self._changing)

    @property
    def _changing(self) -> list[str]:
        """Names of the fields of a state that steps change."""
        return [field.name for field in self.initial.fields if not field.is_constant]

    def numbers_in_frame(self, components: int) -> int:
        """Return the greatest number of numbers that `frame` records, for vectors with so many components."""
        sizes = self.particles, components, len(self.scene.phase)
        return sum(prod(field.shape(*sizes)) for field in self.initial.fields if not field.is_constant)

    def constants(self, rollout: Rollout) -> dict[str, np.ndarray]:
        """Return the fields of a rollout's states that no step changes."""
        names = [field.name for field in rollout.initial.fields if field.is_constant]
        return rollout.initial.numpy(self.dimension, only=names)

    @in_turn
    def rollout(
        self,
        steps: int | None = None,
        controls: Mapping[str, Any] | None = None,
        state: RestartState | Sequence[RestartState] | None = None,
        time: float | None = None,
    ) -> Rollout:
        """Return a rollout that is ready to go forward from the scene's first state, or from ``state``, by so many
        ``steps`` or for a ``time`` [s], with ``controls`` as of `run`."""
        rollout = Rollout(self.solver, steps_of_run(self, steps, time, {} if controls is None else controls))
        self._begin(rollout, controls, state, time)
        return rollout

    def _begin(
        self,
        rollout: Rollout,
        controls: Mapping[str, Any] | None,
        state: RestartState | Sequence[RestartState] | None,
        time: float | None,
    ) -> None:
        """Give a rollout its first state and parameters, and its end where that is a time."""
        space, given = ParameterSpace(self, rollout.steps), {} if controls is None else controls
        values = space.checked(given)
        states = one_for_each(state, self.batch)
        space.check_restarts(states, values)
        space.begin(rollout, values, states=states)
        end_after(rollout, time)

    def quantity(
        self,
        name: str,
        of: RestartState | Sequence[RestartState] | Trajectory | None = None,
        controls: Mapping[str, Any] | None = None,
    ) -> np.ndarray:
        """Return a quantity of the particles: "density" [kg / m3], "pressure" [Pa], "speed" [m / s], "vorticity" [1 /
        s], "wall_force" [N]; see `docs/sensors.md`. Or a field of the state, such as one that a part of one's own
        keeps, or the load on a solid, such as "rotor.load".

        Args:
            name: of the quantity.
            of: a state of this simulation, of a batch one for each scene; or a trajectory, of which it is found for
                every frame; the scene's first state if left out.
            controls: as of `run`; the pressure is that of the step that begins at the state, which they act in. Of a
                trajectory they are those of its run.

        Returns:
            (n,) or (n, k), of a trajectory (frames, n, ...), float64, in the scene's order, of a field its shape, of a
            load (k,).

        Raises:
            InputError: another name, or a state that is none of this simulation's.
        """
        check_readable(name, "quantity", self.initial.names)
        if not isinstance(of, Trajectory):
            return self._quantity(name, of, controls)
        given = {key: value for key, value in (controls or {}).items() if key not in self.known.state}
        return np.array(
            [self._quantity(name, of[: k + 1].last_state, _controls_at(given, of, k)) for k in range(len(of))]
        )

    @in_turn
    def _quantity(self, name: str, state: Any, controls: Mapping[str, Any] | None) -> np.ndarray:
        rollout = self.rollout(1, controls, state)
        if name in rollout.initial.names:
            return rollout.initial.numpy(self.dimension, only=[name])[name].astype(np.float64)
        return Moment.of(rollout, 0, rollout.initial, self.evaluator).value(name)

    @in_turn
    def evaluator(self) -> QuantityEvaluator:
        """Return the evaluator of quantities of states on the device, made once."""
        made: QuantityEvaluator | None = self.__dict__.get("_evaluator")
        if made is None:
            spacing, support = self.scene.discretisation.spacing, self.lattice.support
            factor = circulation_factor(self.smoothing, spacing, support, self.dimension)
            made = self.__dict__["_evaluator"] = QuantityEvaluator(self.solver, self.scene, factor)
        return made

    def renderer(self, **settings: Any) -> Renderer:
        """Return the renderer that takes pictures of the simulation, ``renderer.render(trajectory[k])``, and
        differentiates them: as the table ``[render]`` of its scene says, or from above, in 2-D as the plane is.

        ``settings`` replace keys of that table: ``resolution=(320, 240)``, or ``view="volume", position=(1, 1, 2),
        look_at=(0.2, 0.2, 0.2)``. `losses.Image` takes the renderer. Raises `SceneError` for settings that do not fit.
        """
        return scene_renderer(self, **settings)

    def picture(self, frame: Frame, **settings: Any) -> ShadedPicture:
        """Return a shaded picture of a frame, (rows, columns, 3), linear from 0 to 1, as the table ``[picture]`` of the
        scene says; ``settings`` replace keys of it: ``width=640, height=360``, as those of `film` do.

        Raises:
            SceneError: settings that do not fit.
            InputError: what ``colour`` names was not recorded in the frame, or is the age, which one frame does not
                tell.

        Example: ``cortado.pictures.write_picture("last.png", simulation.picture(trajectory[-1]))``
        """
        image: ShadedPicture = on_top("simulation_picture")(self, frame, settings)
        return image

    def film(self, trajectory: Trajectory, path: str | Path, **settings: Any) -> Film:
        """Write a film of a ``trajectory`` to a ``path`` on the simulation's device; for ``settings`` see
        `Trajectory.film`. It also computes the quantity of ``colour`` that was not recorded, such as the pressure."""
        film: Film = on_top("simulation_film")(self, trajectory, path, settings)
        return film

    @property
    def dimension(self) -> int:
        """Number of space dimensions, 2 or 3."""
        return self.scene.dimension

    @unwarned()
    def batch_of(self, size: int) -> "Simulation":
        """Return a simulation of ``size`` copies of this scene in one launch."""
        return Simulation(*self._made_of(self.precision.name, size))

    @unwarned()
    def in_precision(self, precision: str) -> "Simulation":
        """Return a single simulation of this scene, on the same device, in a precision."""
        return Simulation(*self._made_of(precision, None))

    def replaced(self, *overrides: str) -> "Simulation":
        """Return a simulation of this scene with the ``overrides`` of `Scene.replaced`, on the same device."""
        _, *others = self._made_of(self.precision.name, self.batch)
        return Simulation(self.scene.replaced(*overrides), *others)

    def room(self, steps: int, checkpoints: float) -> int:
        """Return the number of runs of ``steps`` steps that are worth one launch, and fit half of the free memory, with
        at most ``checkpoints`` bytes of kept states in all."""
        neighbours, real = first_capacity(self.scene.discretisation.support, self.dimension), self.precision.bytes
        own = sum(simulation_parts(self.particles, 0, neighbours, real).values())
        states = real * self.numbers_in_frame(3) * 2 * max(isqrt(steps), 1)
        fitting = within(np.inf, self.device) // own
        kept = checkpoints // states if checkpoints else fitting
        return int(max(min(WORTH["cpu" if self.device.is_cpu else "cuda"] // self.particles, fitting, kept), 1))

    def parameters(self) -> dict[str, np.ndarray]:
        """Return every parameter of `Problem` as the scene and forces have it, without the changes of its schedule."""
        return scene_values(self, self.known)

    def substeps(
        self, time_step: np.ndarray, mobility: np.ndarray, interface_width: np.ndarray, rest_density: np.ndarray
    ) -> int:
        """Return the number of explicit diffusion substeps per ``time_step`` [s] that is stable with a ``mobility``
        [m2/s], an ``interface_width`` [m] and a ``rest_density`` (phases,) [kg/m3]; raises `InputError` where there
        would be more than `cortado.sph.free_energy.MOST_SUBSTEPS`."""
        if len(self.scene.phase) == 1:
            return 0
        numbers = (float(time_step), float(mobility), float(interface_width), rest_density)
        return stable_substeps(self.scene, self.free_energy, *numbers)


def _controls_at(given: dict[str, Any], trajectory: Trajectory, frame: int) -> dict[str, Any]:
    """Return the controls of the step after a frame of the run that they were given to."""
    step = int(trajectory.steps[frame] - trajectory.steps[0])
    rows = {name: value for name, value in given.items() if name in OVER_TIME and np.ndim(value) == 2}
    return given | {name: value[min(step, len(value) - 1)] for name, value in rows.items()}


@unwarned()
def _made_again(made_of: tuple[Any, ...], points: str) -> Simulation:
    """Make a simulation from pickled arguments; raises `InputError` unless first positions have an equal checksum."""
    simulation = Simulation(*made_of)
    if simulation._points != points:
        raise InputError(
            "The first positions of a simulation are others than when it was pickled, but must be the same: the file "
            "of points that its scene names has changed. Restore it, or make the simulation anew."
        )
    return simulation
