"""Checks of the input of a run, and warnings after it."""

from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cortado.arrays import as_one_number, as_precise_numbers, is_whole
from cortado.calls import counted, point_in_words
from cortado.device.precision import Precision
from cortado.discretise.room import TOLERANCE, Room
from cortado.discretise.shapes import check_apart, check_crowding, nearest
from cortado.errors import InputError, OutOfRangeError, shown
from cortado.particles.state import State
from cortado.rollout.rollout import Rollout
from cortado.rollout.scene_parameters import DENSITY, Simulated
from cortado.rollout.step_bounds import Travel, moved_by
from cortado.scene.checks import NEAREST
from cortado.scene.discrete_scene import WHOLE
from cortado.scene.drain_tables import flow_name
from cortado.scene.emitter_table import emitted_name, path_name, waits
from cortado.scene.motions import displacement_name, position_name, scale_name, told
from cortado.scene.parameter_values import Arrays, Known
from cortado.scene.parameters import Changing, Range
from cortado.scene.restart import Clock, Origin, RestartState
from cortado.scene.scene import Scene
from cortado.scene.stability import broken_limits
from cortado.sph.viscous_solve import Solve


def check_sizes(values: Arrays, precision: Precision, known: Known) -> None:
    for name, value in values.items():
        size = np.abs(value)
        if size.max(initial=0.0) > precision.greatest:
            wanted = f"at most {precision.greatest:g} in {precision.name}"
            raise OutOfRangeError(f"parameter {name} has a value of size {size.max():g}, but must be {wanted}.")
        if known[name].range is Range.POSITIVE and size.min(initial=1.0) < 1.0 / precision.greatest:
            wanted = f"at least {1.0 / precision.greatest:g} in {precision.name}"
            raise OutOfRangeError(f"parameter {name} is {size.min():g}, but must be {wanted}.")


def check_places(values: Arrays, scene: Scene, free: int) -> None:
    """Check that emitters' openings and the first ``free`` particles are in the container."""
    spacing = scene.discretisation.spacing
    if "initial_positions" in values and scene.forces.pressure:
        positions = values["initial_positions"]
        for particle in outside(scene.room, positions[:free], spacing)[:1]:
            wrong = f"parameter initial_positions has particle {particle} at {point_in_words(positions[particle])} m"
            raise InputError(f"{wrong}, outside the container or in a solid.")
        room = np.prod(np.ptp(positions[:free], axis=0) + spacing) if free else np.inf
        if room < 0.5 * (needed := free * spacing**scene.dimension):
            unit = "m2" if scene.dimension == 2 else "m3"
            found = f"parameter initial_positions has all particles within {room:.3g} {unit}"
            raise InputError(f"{found}, but the fluid of these particles fills about {needed:.3g} {unit}.")
    for emitter in scene.emitter:
        name = path_name(emitter.name)
        if scene.solver.chooses and np.ndim(values.get(name, 0.0)) == 2:
            wanted = "one place if time steps are adaptive: move the emitter by its table path"
            why = "whose times do not depend on the steps"
            raise InputError(f"parameter {name} has a row for each step, but must be {wanted}, {why}.")
        if name in values:
            path, opening = np.atleast_2d(values[name]), emitter.opening(spacing) - emitter.outlet
            places = (path[:, None] + opening).reshape(-1, scene.dimension)
            for step in outside(scene.room, places, spacing)[:1] // len(opening):
                found = f"parameter {name} is at {point_in_words(path[step])} m in step {step + 1}"
                raise InputError(f"{found}, but the whole opening must be inside the container.")


def unstable_sentence(values: Arrays, scene: Scene, told: set[str]) -> str | None:
    """Return a warning about an exceeded limit of stability, or None. The function adds exceeded limits to ``told``."""
    if scene.solver.time_step == "auto":
        return None
    time_step = float(values.get("time_step", scene.solver.time_step))
    broken = [(name, limit) for name, limit in broken_limits(scene, values, time_step) if name not in told]
    if not broken:
        return None
    told.update(name for name, _ in broken)
    name, limit = broken[0]
    found = f"time_step is {time_step:g} s, but the limit of stability with these parameters is about {limit:.3g} s"
    return f"{found}, which comes from {name}."


def outside(room: Room, points: Any, spacing: float) -> np.ndarray:
    return np.flatnonzero(~room.contains(points, TOLERANCE * spacing))


class FirstPositions:
    def __init__(self, simulation: Simulated):
        self._simulation, self._warned = simulation, False
        self._judged: dict[int, NDArray] = {}

    def check(self, values: Arrays, member: int) -> str | None:
        """Return a warning about particles that are too close together, or None."""
        if "initial_positions" not in values:
            return None
        simulation, positions = self._simulation, values["initial_positions"]
        spacing = simulation.scene.discretisation.spacing
        former = self._judged.get(member, simulation.positions)
        if np.abs(positions - former).max(initial=0.0) < 0.05 * spacing:
            return None
        lattice, period = simulation.lattice, simulation.scene.container.periods(simulation.dimension)
        check_apart("parameter initial_positions", positions, spacing, period)
        found, free = None, positions[: simulation.free_particles]
        if len(free) > 1 and simulation.scene.forces.pressure:
            of_lattice = simulation.smoothing, lattice.support, lattice.volume, spacing
            found = check_crowding("particles at initial_positions", free, *of_lattice, period)
            least = nearest(free).min() / spacing
            if found is None and least < NEAREST:
                wanted = f"at least {NEAREST:g} spacings"
                found = f"particles at initial_positions are only {least:.2g} spacings apart, but should be {wanted}."
        self._judged[member] = positions.copy()
        told, self._warned = self._warned, self._warned or found is not None
        return None if told else found


FURTHEST = 1.0
"""Greatest displacement of a solid in a time step [spacings]. A faster solid could pass over fluid."""
SCALES = (0.6, 1.5)
"""Smallest and greatest scale of a solid with wall particles. At other scales, fluid leaks through the solid."""


def path_sentence(scene: Scene, first: State, values: Arrays, run: Arrays, courses: dict[str, Changing]) -> str | None:
    """Return a sentence about the first invalid path or scale, or None. ``run`` has values of all steps."""
    spacing, furthest = scene.discretisation.spacing, FURTHEST * scene.discretisation.spacing * (1.0 + 1e-6)
    left = f"which is further than a spacing, {spacing:g} m: fluid may end up inside"
    if wrong := _stretched(scene, values):
        return wrong
    for what, moved in moved_by(scene, values, courses).items() if scene.solver.chooses else ():
        travel = Travel.of(scene, values, [moved])
        sizes = travel.at(travel.times + travel.least) - travel.lengths
        if (size := sizes.max()) > furthest:
            when = f"in {travel.least:.2g} s, the shortest step there is, at {travel.times[sizes.argmax()]:g} s"
            return f"{what} goes {size:.3g} m {when}, {left}. Slow the motion."
    for table in told(scene.solid):
        if scene.solver.chooses and displacement_name(table.name) in courses:
            continue
        position = position_name(table.name)
        begun = first.numpy(scene.dimension, only=[position])[position].reshape(-1, scene.dimension)[:1]
        places = np.concatenate([begun, run[position] + run[displacement_name(table.name)]])
        steps = np.linalg.norm(np.diff(places, axis=0), axis=1)  # in a batch those of the first scene
        if (size := steps.max(initial=0.0)) > furthest:
            found = f"the solid {table.name!r} goes {size:.3g} m in step {steps.argmax() + 1} of this run, {left}"
            later = f"a run that continues from a state needs {position} of the first run"
            return f"{found}. A displacement begins near 0, and {later}."
    return None


def _stretched(scene: Scene, values: Arrays) -> str | None:
    (least, most), periods = SCALES, scene.periods[1]
    for table in told(scene.solid):
        scale = float(values.get(scale_name(table.name), 1.0))
        if scale == 1.0:
            continue
        start = f"the solid {table.name!r} is {scale:.4g} times as large as in the scene"
        if not least <= scale <= most:
            return f"{start}, but the scale must be from {least:g} to {most:g}."
        size = float(np.ptp(table.shape_about()[0].extent(), axis=0).max())
        grown = 0.5 * size * (1.0 - scale if table.side == "inside" else scale - 1.0)
        if grown > FURTHEST * scene.discretisation.spacing and "initial_positions" not in values:
            return f"{start} and covers {grown:.3g} m, more than a spacing, of possible fluid: give initial_positions."
        lower, upper = table.solid().extent()
        if ((periods > 0.0) & (upper - lower > periods * (1.0 - WHOLE))).any():
            return f"{start}, so that the solid no longer fills a period of the container."
    return None


SAME = 1e-6
"""Relative tolerance for equal numbers, also after rounding to float32."""
MIXED = 0.02
"""Relative tolerance for the volumes of particles with several phases, and for the sums of their mass fractions."""


def origin_of(simulation: Simulated, rest_density: NDArray) -> Origin:
    scene, cut = simulation.scene, simulation.scene.discretisation
    return Origin(
        spacing=cut.spacing,
        support=cut.support,
        kernel=cut.kernel,
        periods=tuple(map(float, scene.periods[1])),
        waiting=tuple(len(emitter.sample(cut.spacing).upstream) for emitter in scene.emitter),
        rest_density=tuple(map(float, rest_density)),
        solver=simulation.carried_by,
    )


def one_for_each(state: RestartState | Sequence[RestartState] | None, batch: int | None) -> list[RestartState]:
    """Return a restart state for each scene, or an empty list for None."""
    if state is None:
        return []
    states = list(state) if isinstance(state, Sequence) and not isinstance(state, str) else [state]
    if len(states) != (batch or 1):
        raise InputError(f"state has {len(states)} states, but must have {batch or 1}, one for each scene.")
    for one in states:
        if not isinstance(one, RestartState):
            raise InputError(f"state is {shown(one)}, but must be a RestartState, such as trajectory.last_state.")
    return states


def check_directions(along: Mapping[str, NDArray], of_state: Collection[str]) -> None:
    if given := [name for name in of_state if name in along]:
        wanted = "but must be left out: give the directions of the state's fields"
        raise InputError(f"direction {given[0]} is given, {wanted}.")


def shapes_of_fields(simulation: Simulated, batch: int | None = None) -> dict[str, tuple[int, ...]]:
    """Return the shapes of a state's fields. A ``batch`` adds a first axis for the scenes."""
    sizes = len(simulation.positions), simulation.dimension, len(simulation.scene.phase)
    members = () if batch is None else (batch,)
    return {field.name: (*members, *field.shape(*sizes)) for field in simulation.initial.fields}


def check_state(state: RestartState, origin: Origin, simulation: Simulated) -> None:
    """Check a restart state. For a state in ``simulation.judged_states`` only the origin is compared."""
    if state.origin is not None and state in simulation.judged_states:
        _check_origin(state.origin, origin)
        return
    shapes = shapes_of_fields(simulation)
    if state.fields.keys() != shapes.keys():
        raise InputError(f"state has {', '.join(state.fields)}, but must have {', '.join(shapes)} in this scene.")
    fields = {name: as_precise_numbers(f"state {name}", state[name]) for name in shapes}
    for name, array in fields.items():
        if array.shape != shapes[name]:
            raise InputError(f"state {name} has shape {array.shape}, but must be {shapes[name]}.")
    check_clock(state.clock)
    if simulation.batch is not None and all(np.isnan(array).all() for array in fields.values()):
        return
    for name, array in fields.items():
        if not np.isfinite(array).all():
            raise InputError(f"state {name} has a value that is not finite, but all values must be finite.")
        if (size := np.abs(array).max(initial=0.0)) > simulation.precision.greatest:
            wanted = f"at most {simulation.precision.greatest:g} in {simulation.precision.name}"
            raise InputError(f"state {name} has a value of size {size:g}, but must be {wanted}.")
    scene, positions = simulation.scene, fields["positions"]
    if state.origin is None:
        _check_spacing(positions[: simulation.free_particles], simulation)
    else:
        _check_origin(state.origin, origin)
    fractions = fields["mass_fractions"]
    beyond = np.abs(fractions - 0.5).max(axis=1) > 1.0  # diffusion may leave fractions from -0.5 to 1.5
    bad = np.flatnonzero(beyond | (np.abs(fractions.sum(axis=1) - 1.0) > MIXED))
    if bad.size:
        wrong = f"state mass_fractions of particle {bad[0]} are {_listed(tuple(fractions[bad[0]].tolist()))}"
        raise InputError(f"{wrong}, but must be from 0 to 1 and add up to 1.")
    _check_densities(fields[DENSITY], fields["mass_fractions"], np.array(origin.rest_density))
    held = scene.forces.pressure and np.isinf(scene.container.region(scene.dimension).rim)
    drained, spacing = fields.get("drained", np.zeros(len(positions))), scene.discretisation.spacing
    in_fluid = (drained == 0.0) & ~waits(scene, fields, len(positions))
    free = np.flatnonzero(in_fluid[: simulation.free_particles])
    for particle in free[outside(scene.resting_room, positions[free], spacing)[:1]] if held else ():
        wrong = f"state positions has particle {particle} at {point_in_words(positions[particle])} m"
        raise InputError(f"{wrong}, outside the container of this scene or in a solid.")
    if scene.forces.pressure:
        check_apart("state positions", positions, origin.spacing, scene.periods)


def check_clock(clock: Clock) -> None:
    if not isinstance(clock, Clock):
        raise InputError(f"state clock is {shown(clock)}, but must be a Clock, such as trajectory.last_state.clock.")
    if not is_whole(clock.steps) or clock.steps < 0:
        raise InputError(f"state clock has {shown(clock.steps)} steps, but must have a whole number of at least 0.")
    if not 0.0 <= as_one_number("state clock time", clock.time) < np.inf:
        raise InputError(f"state clock is at {shown(clock.time)} s, but must be at a finite time of at least 0 s.")
    if not 0.0 <= as_one_number("state clock time_step", clock.time_step) < np.inf:
        raise InputError(f"state clock has a step of {shown(clock.time_step)} s, but must have a finite step, or 0.")


def _check_origin(found: Origin, wanted: Origin) -> None:
    for name, words in WORDS.items() if found != wanted else ():
        one, other = getattr(found, name), getattr(wanted, name)
        if one is None:
            continue
        is_same = one == other
        if not (is_same or isinstance(one, str) or isinstance(other, str)):
            is_same = np.shape(one) == np.shape(other) and np.allclose(one, other, rtol=SAME, atol=0.0)
        if not is_same:
            own, needed = words.format(_listed(one)), words.format(_listed(other))
            why = f"as this simulation has{ADVICE.get(name, '')}"
            raise InputError(f"state is of a run with {own}, but must be of a run with {needed}, {why}.")


WORDS = {
    "spacing": "a spacing of {} m",
    "support": "a support of {} spacings",
    "kernel": "the kernel {}",
    "periods": "periods of {} m",
    "waiting": "{} particles in emitters",
    "rest_density": "a rest density of {} kg/m3",
    "solver": "the additional state fields of {}",
}
ADVICE = {"rest_density": "; give the rest density of the first run again"}


def _listed(value: object) -> str:
    if isinstance(value, tuple):
        return ", ".join(map(_listed, value))
    return f"{value:g}" if isinstance(value, float) else str(value)


def _check_densities(found: NDArray, fractions: NDArray, rest_density: NDArray) -> None:
    if (found <= 0.0).any():
        raise InputError("state reference_density must be greater than 0.")
    volumes = found * (fractions / rest_density).sum(axis=1)
    room = MIXED if len(rest_density) > 1 else 10.0 * SAME
    measured = np.array([volumes.mean()]) if len(rest_density) > 1 else volumes
    between = (found > rest_density.min() * (1.0 - MIXED)) & (found < rest_density.max() * (1.0 + MIXED))
    if (np.abs(measured - 1.0) > room).any() or not (between.all() or len(rest_density) == 1):
        lowest, highest = found.min(), found.max()
        values = f"{lowest:g}" if lowest == highest else f"from {lowest:g} to {highest:g}"
        wanted = f"the density of fluid with a rest density of {_listed(tuple(rest_density))} kg/m3, as this run has"
        raise InputError(f"state reference_density is {values} kg/m3, but must be {wanted}{ADVICE['rest_density']}.")


def _check_spacing(positions: NDArray, simulation: Simulated) -> None:
    if len(positions) < 2 or not simulation.scene.forces.pressure:
        return
    spacing = simulation.scene.discretisation.spacing
    found, first = (nearest(x) / spacing for x in (positions, simulation.positions[: len(positions)]))
    usual, least = float(np.median(found)), float(np.quantile(found, 0.1))
    if usual < 0.7 or least > 1.4 * max(float(np.quantile(first, 0.1)), 1.0):
        found = f"state positions has a typical distance of {usual:.2g} spacings of {spacing:g} m between neighbours"
        raise InputError(f"{found}, but must have about one spacing: the state is of a run with another spacing.")


TORN = 0.015
"""Divergence of the velocity times the time step, above which a step counts towards a warning."""


def trouble(rollout: Rollout, scene: Scene) -> Iterator[str]:
    if rollout.is_calm({"divergence": TORN, Solve.name: Solve.most - 1}) and not scene.solver.chooses:
        return
    noted = rollout.diagnostics
    converged = noted["converged"]
    if not converged.all():
        yield not_converged_sentence(converged, scene)
    if torn := divergence_sentence(noted, scene):
        yield torn
    solves = noted.get(Solve.name, np.zeros(0))
    if missed := np.count_nonzero(solves >= Solve.most):
        found = (
            f"the viscosity did not converge in {missed} of {solves.size} steps, in which the solve took {Solve.most}"
        )
        yield f"{found} iterations: try a smaller time step."
    last, end = rollout.clocks[0].after(rollout.taken, 0.0), rollout.step_sizes.end
    if not rollout.lost and last.time < end < np.inf:
        found = f"the run ended at {last.time:.4g} s, before the requested time, as steps became as short as"
        yield f"{found} {last.time_step:.2g} s: continue from the last state, or try a larger spacing."
    if scene.solver.chooses and (dry := dry_sentence(scene, rollout)):
        yield dry
    if rollout.lost:
        lost, batch = rollout.lost, rollout.solver.layout.members
        first = min(lost, key=lambda b: lost[b].step)
        yield f"{len(lost)} of {counted(batch, 'scene')} of the batch were lost. First scene {first}: {lost[first]}"


def not_converged_sentence(converged: np.ndarray, scene: Scene) -> str:
    advice = "try a smaller time step, more iterations or a larger tolerance."
    spacing = scene.discretisation.spacing
    for index, emitter in enumerate(scene.emitter):
        if not scene.container.contains(emitter.particles(spacing), -0.25 * spacing).all():
            why = f"a part of the column in emitter[{index}] is outside the container, whose walls press on the column"
            advice = f"{why}. Shorten emitter[{index}].length, or make the container larger."
    return f"the pressure did not converge in {np.count_nonzero(~converged)} of {converged.size} steps: {advice}"


def divergence_sentence(diagnostics: Mapping[str, np.ndarray], scene: Scene) -> str | None:
    found = diagnostics.get("divergence", np.zeros(0))
    if not (found > TORN).any():
        return None
    torn = np.nan_to_num(found, nan=0.0, posinf=0.0)  # lost scenes are not finite
    if scene.solver.kind != "projection" or np.count_nonzero(torn > TORN) <= 0.05 * torn.size:
        return None
    step, *member = np.unravel_index(torn.argmax(), torn.shape)
    where = f"step {step + 1}" + "".join(f" of scene {b}" for b in member)
    many = f"more than {TORN:g} in {np.count_nonzero(torn > TORN)} of {torn.size} steps"
    advice = "try a smaller time step, more solver.iterations or a solver.tolerance"
    return f"the projection left a divergence times time step of {torn.max():.2g} in {where}, and {many}: {advice}."


def dry_sentence(scene: Scene, rollout: Rollout) -> str | None:
    """Return a warning about the first emitter that runs out of fluid before the end, or None."""
    spacing, clock = scene.discretisation.spacing, rollout.clocks[0]
    taken = rollout.taken if scene.solver.chooses else rollout.steps
    times = clock.times(np.arange(taken + 1), float(rollout.time_steps.max()))
    for index, emitter in enumerate(scene.emitter):
        flow = np.max(rollout.parameters[flow_name(emitter.name)].numpy(), axis=0)[:taken]
        begun = float(np.max(rollout.initial[emitted_name(emitter.name)].numpy()))
        lengths = begun + np.cumsum(np.append(0.0, flow * np.diff(times))) / emitter.area(spacing)
        supply, end = emitter.supply(spacing) * spacing, times[-1]
        if emitter.fed_by or lengths[-1] * (1.0 - 1e-6) <= supply:
            continue
        advice = f"scene.lasting({end:.4g}) has more fluid in reserve, as has a scene with emitter[{index}].volume"
        if emitter.volume is not None or scene.lasting(end) is scene:
            advice = f"a larger emitter[{index}].{'length' if emitter.volume is None else 'volume'} gives more fluid"
        dry = np.interp(supply, lengths, times)
        return f"{emitter.name} runs dry at {dry:.4g} s of a run to {end:.4g} s, as all its fluid is out: {advice}."
    return None
