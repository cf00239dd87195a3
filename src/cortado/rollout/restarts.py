"""Whether a state is one of a simulation: what it belongs to, its numbers, and its clock."""

from collections.abc import Collection, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from cortado.arrays import as_one_number, as_precise_numbers, is_whole
from cortado.device.precision import Precision
from cortado.discretise.pairs import check_apart, nearest
from cortado.errors import InputError, shown
from cortado.rollout.parameter_checks import outside, place_in_words
from cortado.rollout.scene_parameters import DENSITY, Simulated
from cortado.scene.model import resting_room
from cortado.scene.restart import Clock, Origin, RestartState

SAME = 1e-6
"""Relative: two numbers that differ by less are the same, as one of them may have been rounded to float32."""
MIXED = 0.02
"""The same of the volume of particles among which phases have diffused, and of fractions that do not quite add up
to 1."""
BEYOND = 0.5
"""How far fractions may be below 0 or above 1: diffusion leaves them a little outside."""
CLOSE, FAR = 0.7, 1.4
"""In spacings: the distance from a particle to the nearest other one is greater than the first for half of them, and
less than the second for a part of them."""
CROWDED = 0.1
"""This part."""


def origin_of(simulation: Simulated, rest_density: NDArray) -> Origin:
    """Of the particles of a run with these rest densities (phases,) [kg/m3]."""
    scene, cut = simulation.scene, simulation.scene.discretisation
    return Origin(
        spacing=cut.spacing,
        support=cut.support,
        kernel=cut.kernel,
        periods=tuple(map(float, scene.container.periods(scene.dimension)[1])),
        waiting=len(simulation.positions) - simulation.free_particles,
        rest_density=tuple(map(float, rest_density)),
        solver=simulation.carried_by,
    )


def one_for_each(state: RestartState | Sequence[RestartState] | None, batch: int | None) -> list[RestartState]:
    """The states to go on from, one for each scene; none for the scenes' own. Raises `InputError` for another number of
    them, and for anything else."""
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
    """Raises `InputError` where directions have parameters that are ``of_state``, which a state has instead."""
    if given := [name for name in of_state if name in along]:
        wanted = "but must be left out: give it among those of the state's fields"
        raise InputError(f"direction {given[0]} is given, {wanted}.")


def check_state(
    state: RestartState, shapes: Mapping[str, tuple[int, ...]], origin: Origin, simulation: Simulated
) -> None:
    """A state to go on from is one of the simulation, whose fields have these shapes, and of these particles; raises
    `InputError`. One that was judged before can only be of other rest densities, and that of a scene of a batch that
    was lost has no numbers to judge."""
    if state.origin is not None and state in simulation.judged_states:
        _check_origin(state.origin, origin)
        return
    if state.fields.keys() != shapes.keys():
        raise InputError(f"state has {', '.join(state.fields)}, but must have {', '.join(shapes)} in this scene.")
    fields = {name: _shaped(name, state[name], wanted) for name, wanted in shapes.items()}
    check_clock(state.clock)
    if simulation.batch is not None and all(np.isnan(array).all() for array in fields.values()):
        return
    for name, array in fields.items():
        _check_numbers(name, array, simulation.precision)
    scene, positions = simulation.scene, fields["positions"]
    if state.origin is None:
        _check_spacing(positions[: simulation.free_particles], simulation)
    else:
        _check_origin(state.origin, origin)
    _check_fractions(fields["mass_fractions"])
    _check_densities(fields[DENSITY], fields["mass_fractions"], np.array(origin.rest_density))
    held = scene.forces.pressure and np.isinf(scene.container.region(scene.dimension).rim)
    free, spacing = positions[: simulation.free_particles], scene.discretisation.spacing
    for particle in outside(resting_room(scene), free, spacing)[:1] if held else ():  # solids that move are elsewhere
        place = place_in_words(positions[particle])
        raise InputError(
            f"state positions has particle {particle} at {place}, outside the container of this scene or in a solid."
        )
    if scene.forces.pressure:
        check_apart("state positions", positions, origin.spacing, scene.container.periods(scene.dimension))


def _shaped(name: str, value: object, shape: tuple[int, ...]) -> NDArray:
    array = as_precise_numbers(f"state {name}", value)
    if array.shape != shape:
        raise InputError(f"state {name} has shape {array.shape}, but must be {shape}.")
    return array


def _check_numbers(name: str, array: NDArray, precision: Precision) -> None:
    if not np.isfinite(array).all():
        raise InputError(f"state {name} has a value that is not finite, but must be numbers.")
    if (size := np.abs(array).max(initial=0.0)) > precision.greatest:
        wanted = f"at most {precision.greatest:g} in {precision.name}"
        raise InputError(f"state {name} has a value of size {size:g}, but must be {wanted}.")


def check_clock(clock: Clock) -> None:
    """A clock is one of a state; raises `InputError`."""
    if not isinstance(clock, Clock):
        raise InputError(f"state clock is {shown(clock)}, but must be a Clock, such as that of trajectory.last_state.")
    if not is_whole(clock.steps) or clock.steps < 0:
        raise InputError(f"state clock has {shown(clock.steps)} steps, but must have a whole number of at least 0.")
    if not 0.0 <= as_one_number("state clock time", clock.time) < np.inf:
        raise InputError(f"state clock is at {shown(clock.time)} s, but must be at a finite time of at least 0 s.")
    if not 0.0 <= as_one_number("state clock time_step", clock.time_step) < np.inf:
        raise InputError(f"state clock has a step of {shown(clock.time_step)} s, but must have a finite one, or 0.")


def _check_origin(found: Origin, wanted: Origin) -> None:
    """Both are of the same particles."""
    for name, words in WORDS.items() if found != wanted else ():
        one, other = getattr(found, name), getattr(wanted, name)
        if one is not None and not _is_same(one, other):
            raise InputError(
                f"state is of a run with {words.format(_listed(one))}, but must be of one with "
                f"{words.format(_listed(other))}, as this simulation has{ADVICE.get(name, '')}."
            )


WORDS = {
    "spacing": "a spacing of {} m",
    "support": "a support of {} spacings",
    "kernel": "the kernel {}",
    "periods": "periods of {} m",
    "waiting": "{} particles in the emitter",
    "rest_density": "a rest density of {} kg/m3",
    "solver": "what {} carries from step to step",
}
"""What each field of an `Origin` is called."""
ADVICE = {"rest_density": "; a rest density that a run was given is to be given again where it goes on"}


def _is_same(one: object, other: object) -> bool:
    if isinstance(one, str) or isinstance(other, str):
        return one == other
    some, others = (np.asarray(value, dtype=np.float64) for value in (one, other))
    return some.shape == others.shape and np.allclose(some, others, rtol=SAME, atol=0.0)


def _listed(value: object) -> str:
    if isinstance(value, tuple):
        return ", ".join(map(_listed, value))
    return f"{value:g}" if isinstance(value, float) else str(value)


def _check_fractions(fractions: NDArray) -> None:
    """The mass fractions (n, phases) of each particle are shares of one whole."""
    beyond = np.abs(fractions - 0.5).max(axis=1) > 0.5 + BEYOND
    bad = np.flatnonzero(beyond | (np.abs(fractions.sum(axis=1) - 1.0) > MIXED))
    if bad.size:
        found = f"state mass_fractions of particle {bad[0]} are {_listed(tuple(fractions[bad[0]].tolist()))}"
        raise InputError(f"{found}, but must be from 0 to 1 and add up to 1.")


def _check_densities(found: NDArray, fractions: NDArray, rest_density: NDArray) -> None:
    """The masses (n,) of particles over their volume at rest are those of fluid of these rest densities. With one phase
    that is so of each particle, as it was at the start; phases that diffuse keep the volume of all of them."""
    if (found <= 0.0).any():
        raise InputError("state reference_density must be greater than 0.")
    volumes = found * (fractions / rest_density).sum(axis=1)
    room = MIXED if len(rest_density) > 1 else 10.0 * SAME
    measured = np.array([volumes.mean()]) if len(rest_density) > 1 else volumes
    between = (found > rest_density.min() * (1.0 - MIXED)) & (found < rest_density.max() * (1.0 + MIXED))
    if (np.abs(measured - 1.0) > room).any() or not (between.all() or len(rest_density) == 1):
        lowest, highest = found.min(), found.max()
        values = f"{lowest:g}" if lowest == highest else f"from {lowest:g} to {highest:g}"
        raise InputError(
            f"state reference_density is {values} kg/m3, but must be that of fluid with a rest density of "
            f"{_listed(tuple(rest_density))} kg/m3, as this run has{ADVICE['rest_density']}."
        )


def _check_spacing(positions: NDArray, simulation: Simulated) -> None:
    """The particles (n, d) of a state that does not say what it is of are about as far apart as those of the scene:
    most of them no nearer, and some, which have others around them, no further."""
    if len(positions) < 2 or not simulation.scene.forces.pressure:
        return
    spacing = simulation.scene.discretisation.spacing
    found, first = (nearest(x) / spacing for x in (positions, simulation.positions[: len(positions)]))
    usual, least = float(np.median(found)), float(np.quantile(found, CROWDED))
    if usual < CLOSE or least > FAR * max(float(np.quantile(first, CROWDED)), 1.0):
        raise InputError(
            f"state positions are usually {usual:.2g} spacings of {spacing:g} m from the nearest other particle, but "
            "must be about one: the state is of a run with another spacing."
        )
