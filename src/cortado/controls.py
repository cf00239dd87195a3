"""Parameters by name: what a user writes, checked, and the way to the arrays of a rollout and back.

n counts fluid particles in the order in which the scene lists them, d is the scene's dimension.
"""

import warnings
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import numpy as np

from cortado.errors import CortadoWarning, InputError
from cortado.masses import masses as masses_of
from cortado.masses import masses_adjoint, masses_tangent
from cortado.parameter_checks import check_places, check_sizes, check_state, unstable_sentence
from cortado.parameter_values import (
    MATERIALS,
    NAMES,
    NUMBERS,
    OF_EMITTER,
    OVER_TIME,
    STATES,
    TABLES,
    Arrays,
    Values,
    checked_parameter,
    parameter_shapes,
)
from cortado.particles import Parameters, State
from cortado.restart import Elapsed, RestartState
from cortado.rollout import Rollout
from cortado.threads import WARP
from cortado.tilt import Tilt

if TYPE_CHECKING:
    from cortado.simulation import Simulation


class Controls:
    """The parameters of one simulation over a number of steps."""

    def __init__(self, simulation: "Simulation", steps: int):
        self._simulation, self._steps = simulation, steps
        self._phases = len(simulation.scene.phase)
        no_emitter = {"nozzle_path": np.zeros(simulation.dimension), "flow_rate": np.zeros(())}
        self._scene: Arrays = no_emitter | simulation.parameters()
        self._warned = False

    def shapes(self, name: str) -> list[tuple[int, ...]]:
        """The shapes that a parameter may have; () is a number."""
        return parameter_shapes(name, self._steps, self._phases, self._simulation.positions.shape)

    def checked(self, values: Values, what: str = "parameter") -> Arrays:
        """Values as float64 arrays; raises `InputError` in a sentence. A ``what`` of "direction" may be negative."""
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
        rollout.elapsed = Elapsed() if state is None else state.elapsed
        if state is not None:
            fractions = self._scene["mass_fractions"] if state.mass_fractions is None else state.mass_fractions
            rollout.initial.set(state.positions, state.velocities, fractions)
        elif values.keys().isdisjoint(STATES):
            rollout.initial.assign(simulation.state)
        else:
            rollout.initial.set(*(values.get(name, self._scene[name]) for name in STATES))
        chosen = {name: values.get(name, self._scene[name]) for name in (*MATERIALS, *NUMBERS)}
        rollout.time_step, rollout.flow_rate = float(chosen["time_step"]), float(chosen["flow_rate"])
        parameters.set_tables(**{name: values.get(name, self._scene[name]) for name in TABLES})
        masses = self._masses(values) if state is None else state.constants.reference_density
        parameters.set_constants(**chosen, masses=masses)
        diffusion = ("time_step", "mobility", "interface_width", "rest_density")
        needed = simulation.substeps(**{name: chosen[name] for name in diffusion})
        rollout.substeps = max(needed, 1) if "mobility" in varied and self._phases > 1 else needed

    def check_restart(self, state: RestartState, values: Arrays) -> None:
        """Whether a state is one of this simulation, and ``values`` go with it; raises `InputError`."""
        for name in (*STATES, "rest_density"):
            if name in values:
                raise InputError(f"control {name} is given, but must be left out with a state, which has its own.")
        check_state(state, self._simulation.scene, self._simulation.positions.shape, self._free)
        if self._simulation.scene.emitter is not None:
            for name in ("time_step", "flow_rate"):
                before, now = getattr(state.constants, name), float(values.get(name, self._scene[name]))
                if now != before:
                    wanted = f"{before} with this state, whose nozzle ran with that"
                    raise InputError(f"{name} is {now:g}, but must be {wanted}.")

    @WARP
    def direction(self, rollout: Rollout, values: Arrays, along: Arrays) -> tuple[State, Parameters]:
        """A direction by name as tangents of the first state and of the parameters, at ``values``."""
        dot, parameters = rollout.solver.new_state(), rollout.solver.new_parameters(self._steps)
        if "tilt" in along:
            if "gravity" in values:
                raise InputError("direction tilt is given, but must be left out, as gravity is given in its place.")
            angles = values.get("tilt", np.zeros(self._simulation.dimension - 1))
            along = {**along, "gravity": self._tilt.tangent(angles, along["tilt"])}
        zeros = {name: np.zeros_like(self._scene[name]) for name in self._scene}
        dot.set(*(along.get(name, zeros[name]) for name in STATES))
        parameters.set_tables(**{name: along.get(name, zeros[name]) for name in TABLES})
        composition = [along.get(name, zeros[name]) for name in ("mass_fractions", "rest_density")]
        parameters.set_constants(
            **{name: along.get(name, zeros[name]) for name in (*MATERIALS, *NUMBERS)},
            masses=masses_tangent(*self._composition(values), *map(np.atleast_1d, composition)),
        )
        return dot, parameters

    def gradient(self, values: Arrays, state: State, parameters: Parameters) -> Arrays:
        """Adjoints of the first state and of the parameters, for the names and in the shapes of ``values``."""
        found: Arrays = {}
        if not values.keys().isdisjoint(STATES):
            arrays = state.numpy(self._simulation.dimension)
            found |= {name: array.astype(np.float64) for name, array in zip(STATES, arrays, strict=True)}
        for name in (*TABLES, *MATERIALS, *NUMBERS):
            if name in values:
                found[name] = getattr(parameters, name).numpy().astype(np.float64)
        if "tilt" in values:
            gravity = parameters.gravity.numpy()[:, : self._simulation.dimension].astype(np.float64)
            found["tilt"] = self._tilt.adjoint(values["tilt"], gravity)
        for name in OVER_TIME:
            if name in values:
                table = found[name][:, : self._simulation.dimension]
                found[name] = table if values[name].ndim == 2 else table.sum(axis=0)
        if not values.keys().isdisjoint(("mass_fractions", "rest_density")):
            bars = masses_adjoint(*self._composition(values), parameters.masses.numpy().astype(np.float64))
            for name, bar in zip(("mass_fractions", "rest_density"), bars, strict=True):
                if name in found:
                    found[name] = found[name] + bar
        return {name: found[name].reshape(values[name].shape) for name in values if name in found}

    def _check(self, values: Arrays) -> None:
        """Whether they make sense for the scene; a time step beyond the limit of stability is warned of once."""
        simulation = self._simulation
        check_sizes(values, simulation.precision)
        if self._steps == 0:
            return
        check_places(values, simulation.scene, self._free)
        sentence = unstable_sentence(self._upright(values), simulation.scene) if values and not self._warned else None
        if sentence is not None:
            self._warned = True
            warnings.warn(sentence, CortadoWarning, stacklevel=4)

    @property
    def _free(self) -> int:
        """How many particles, the first ones, do not wait in the nozzle."""
        emitter = self._simulation.solver.emitter
        return emitter.nozzle.first if emitter else self._simulation.particles

    @property
    def _tilt(self) -> Tilt:
        return Tilt(self._simulation.scene.forces.gravity)

    def _upright(self, values: Arrays) -> Arrays:
        """The values, with gravity in the place of a tilt."""
        return {**values, "gravity": self._tilt.gravity(values["tilt"])} if "tilt" in values else values

    def _masses(self, values: Arrays) -> np.ndarray:
        """(n,) of the particles; fractions a little below 0, as diffusion leaves them, may still make one negative."""
        fractions, density = self._composition(values)
        with np.errstate(divide="ignore"):
            found = masses_of(fractions, density)
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
        if name not in NAMES:
            raise InputError(f"{what} {name!r} is unknown, but must be one of {', '.join(NAMES)}.")
        if name in OF_EMITTER and self._simulation.scene.emitter is None:
            raise InputError(f"{what} {name} is given, but must be left out, as the scene has no emitter.")
        if name == "tilt" and not np.any(self._scene["gravity"]):
            raise InputError(f"{what} tilt is given, but must be left out, as the scene has no gravity to lean.")
        return checked_parameter(name, value, self.shapes(name), what)
