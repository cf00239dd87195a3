"""Parameters by name: what a user writes, checked, and the way to the arrays of a rollout and back.

n counts fluid particles in the order in which the scene lists them, d is the scene's dimension.
"""

import warnings
from collections.abc import Iterable, Mapping
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from cortado.device.fields import Entry, first_values
from cortado.device.precision import Precision
from cortado.device.state import Parameters, State
from cortado.device.threads import WARP
from cortado.errors import CortadoWarning, InputError, shown
from cortado.parameters.checks import check_places, check_sizes, check_state, unstable_sentence
from cortado.parameters.reference_density import (
    reference_density,
    reference_density_adjoint,
    reference_density_tangent,
)
from cortado.parameters.registry import BY_NAME, Role, Source, names
from cortado.parameters.tilt import Tilt
from cortado.parameters.values import OVER_TIME, Arrays, Values, check_known, checked_value, scene_values
from cortado.restart import Clock, RestartState
from cortado.rollout import Rollout

RUN, STATE = names(Role.RUN), names(Role.STATE)
DENSITY = "reference_density"
"""The field of a state that the first mass fractions and the rest densities decide."""
DIFFUSION = ("time_step", "mobility", "interface_width", "rest_density")
"""Parameters that explicit steps of diffusion have to follow."""


class Simulated(Source, Protocol):
    """A simulation as its parameters see it."""

    state: State
    """The first, on the device."""

    @property
    def dimension(self) -> int:
        """2 or 3."""

    @property
    def precision(self) -> Precision:
        """Of the device's arrays."""

    @property
    def free_particles(self) -> int:
        """How many particles, the first ones, do not wait in an emitter."""

    def substeps(self, time_step: NDArray, mobility: NDArray, interface_width: NDArray, rest_density: NDArray) -> int:
        """Explicit steps of diffusion within a time step that are stable with these parameters."""


class ParameterSpace:
    """The parameters of one simulation over a number of steps."""

    def __init__(self, simulation: Simulated, steps: int):
        self._simulation, self._steps = simulation, steps
        self._phases = len(simulation.scene.phase)
        absent = {name: np.zeros(self.shapes(name)[0]) for name in RUN}
        self._scene: Arrays = absent | scene_values(simulation)
        self._warned = False

    def shapes(self, name: str) -> list[tuple[int, ...]]:
        """The shapes that a parameter may have; () is a number."""
        return BY_NAME[name].shapes(self._steps, self._phases, self._simulation.positions.shape)

    def checked(self, values: Values, what: str = "parameter") -> Arrays:
        """Values as float64 arrays; raises `InputError` in a sentence. A ``what`` of "direction" may be negative."""
        if not isinstance(values, Mapping):
            raise InputError(f"{what}s are {shown(values)}, but must be a table of values by name.")
        if "tilt" in values and "gravity" in values:
            raise InputError(f"{what} gravity is given, but must be left out, as the tilt says where it points.")
        found = {name: self._checked(name, value, what) for name, value in values.items()}
        if what != "direction":
            self._check(found)
        return found

    def colours(self, values: Arrays) -> np.ndarray:
        """(phases, 3) the colours of the phases."""
        return values.get("colours", self._scene["colours"])

    @WARP
    def begin(
        self, rollout: Rollout, values: Arrays, varied: Iterable[str] = (), state: RestartState | None = None
    ) -> None:
        """Give a rollout its first state and its parameters: ``values``, and the scene's for what is not among them.

        ``varied`` are parameters that a derivative is wanted for: with the mobility among them there is a substep of
        diffusion even where it is 0. ``state`` replaces the scene's first state.
        """
        simulation, parameters, values = self._simulation, rollout.parameters, self._upright(values)
        rollout.evaluation += 1
        rollout.clock = Clock() if state is None else state.clock
        rollout.initial.assign(simulation.state)
        if state is None:
            rollout.initial.set(first_values(simulation.state.fields, values))
            rollout.initial.set({DENSITY: self._reference_density(values)})
        else:
            rollout.initial.set(state.fields)
        chosen = {name: values.get(name, self._scene[name]) for name in RUN}
        rollout.time_step = float(chosen["time_step"])
        parameters.set(chosen)
        needed = simulation.substeps(**{name: chosen[name] for name in DIFFUSION})
        rollout.substeps = max(needed, 1) if "mobility" in varied and self._phases > 1 else needed

    def check_restart(self, state: RestartState, values: Arrays) -> None:
        """Whether a state is one of this simulation, and ``values`` go with it; raises `InputError`."""
        for name in (*STATE, "rest_density"):
            if name in values:
                raise InputError(f"parameter {name} is given, but must be left out with a state, which has its own.")
        simulation = self._simulation
        shapes = {
            field.name: field.shape(len(simulation.positions), simulation.dimension, self._phases)
            for field in simulation.state.fields
        }
        check_state(state, shapes, simulation.scene, simulation.free_particles)

    @WARP
    def direction(self, rollout: Rollout, values: Arrays, along: Arrays) -> tuple[State, Parameters]:
        """A direction by name as tangents of the first state and of the parameters, at ``values``."""
        dot, parameters = rollout.solver.new_state(), rollout.solver.new_parameters(self._steps)
        if "tilt" in along:
            if "gravity" in values:
                raise InputError("direction tilt is given, but must be left out, as gravity is given in its place.")
            angles = values.get("tilt", np.zeros(self._simulation.dimension - 1))
            along = {**along, "gravity": self._tilt.tangent(angles, along["tilt"])}
        along = {name: along.get(name, np.zeros_like(value)) for name, value in self._scene.items()}
        dot.set(first_values(dot.fields, along))
        fractions_dot, density_dot = along["mass_fractions"], np.atleast_1d(along["rest_density"])
        dot.set({DENSITY: reference_density_tangent(*self._composition(values), fractions_dot, density_dot)})
        parameters.set({name: along[name] for name in RUN})
        return dot, parameters

    def gradient(self, values: Arrays, state: State, parameters: Parameters) -> Arrays:
        """Adjoints of the first state and of the parameters, for the names and in the shapes of ``values``."""
        dimension = self._simulation.dimension
        found: Arrays = {name: parameters[name].numpy().copy() for name in RUN if name in values}
        for field in state.fields:
            if field.first in values:
                bar = state[field.name].numpy()
                if field.first in found:
                    found[field.first][0] += bar[0]
                else:
                    found[field.first] = bar[:, :dimension] if field.entry is Entry.VECTOR else bar
        found = {name: bar.astype(np.float64) for name, bar in found.items()}
        if "tilt" in values:
            gravity = parameters["gravity"].numpy()[:, :dimension].astype(np.float64)
            found["tilt"] = self._tilt.adjoint(values["tilt"], gravity)
        for name in OVER_TIME:
            if name in values:
                table = found[name][:, :dimension]
                found[name] = table if values[name].ndim == 2 else table.sum(axis=0)
        if not values.keys().isdisjoint(("mass_fractions", "rest_density")):
            bar = state[DENSITY].numpy().astype(np.float64)
            bars = reference_density_adjoint(*self._composition(values), bar)
            for name, own_bar in zip(("mass_fractions", "rest_density"), bars, strict=True):
                if name in found:
                    found[name] = found[name] + own_bar
        return {name: found[name].reshape(values[name].shape) for name in values if name in found}

    def _check(self, values: Arrays) -> None:
        """Whether they make sense for the scene; a time step beyond the limit of stability is warned of once."""
        simulation = self._simulation
        check_sizes(values, simulation.precision)
        if self._steps == 0:
            return
        check_places(values, simulation.scene, self._simulation.free_particles)
        sentence = unstable_sentence(self._upright(values), simulation.scene) if values and not self._warned else None
        if sentence is not None:
            self._warned = True
            warnings.warn(sentence, CortadoWarning, stacklevel=4)

    @property
    def _tilt(self) -> Tilt:
        return Tilt(self._simulation.scene.forces.gravity)

    def _upright(self, values: Arrays) -> Arrays:
        """The values, with gravity in the place of a tilt."""
        return {**values, "gravity": self._tilt.gravity(values["tilt"])} if "tilt" in values else values

    def _reference_density(self, values: Arrays) -> np.ndarray:
        """(n,) of the particles [kg/m3]; fractions a little below 0, left by diffusion, may make one negative."""
        fractions, density = self._composition(values)
        with np.errstate(divide="ignore"):
            found = reference_density(fractions, density)
        bad = np.flatnonzero(~(np.isfinite(found) & (found > 0.0)))
        if bad.size:
            raise InputError(
                f"mass_fractions of particle {bad[0]} are {fractions[bad[0]].tolist()}, but must be such that its "
                "volume, the sum of the fractions over the rest densities of the phases, is greater than 0."
            )
        return found

    def _composition(self, values: Arrays) -> tuple[np.ndarray, np.ndarray]:
        fractions, density = (values.get(name, self._scene[name]) for name in ("mass_fractions", "rest_density"))
        return fractions, np.atleast_1d(density)

    def _checked(self, name: str, value: Any, what: str) -> np.ndarray:
        check_known(name, self._simulation.scene, what)
        return checked_value(name, value, self.shapes(name), what)
