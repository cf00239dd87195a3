"""Converts the named parameters of a scene to the NumPy arrays of a run, and back."""

from typing import Protocol
from weakref import WeakSet

import numpy as np
from numpy.typing import NDArray

from cortado.device.precision import Precision
from cortado.discretise.smoothing import SmoothingKernel
from cortado.errors import InputError
from cortado.particles.state import State, first_values
from cortado.scene.courses import Steady
from cortado.scene.discrete_scene import Lattice
from cortado.scene.parameter_values import (
    Arrays,
    Known,
    Tilt,
    reference_density,
    reference_density_adjoint,
    reference_density_tangent,
    scene_values,
)
from cortado.scene.parameters import Axis, Changing, Source
from cortado.scene.restart import Clock, RestartState
from cortado.solvers.build import ForceMaker
from cortado.solvers.solver import Solver

DENSITY = "reference_density"
COMPOSITION = ("mass_fractions", "rest_density")


class Simulated(Source, Protocol):
    initial: State
    known: Known
    forces: tuple[ForceMaker, ...]
    judged_states: WeakSet[RestartState]
    batch: int | None
    """Number of scenes in a batch, or None for a single scene."""
    solver: Solver
    precision: Precision
    smoothing: SmoothingKernel
    lattice: Lattice
    free_particles: int
    """Number of particles outside emitters, which come first in arrays."""

    @property
    def dimension(self) -> int: ...

    @property
    def carried_by(self) -> str | None:
        """Name of the solver if the solver adds fields to states, or None."""

    def substeps(
        self, time_step: NDArray, mobility: NDArray, interface_width: NDArray, rest_density: NDArray
    ) -> int: ...


class SceneParameters:
    """Converts the parameters of a scene to the arrays of a run, with tangents and adjoints."""

    def __init__(self, simulation: Simulated, steps: int):
        self._simulation, self._steps, self._known = simulation, steps, simulation.known
        self._scheduled, self._shapes = simulation.scene.schedule.courses, dict[str, list[tuple[int, ...]]]()
        absent = {name: np.zeros(self.shapes(name)[0]) for name in self._known.run}
        self.values: Arrays = absent | scene_values(simulation, self._known)

    def shapes(self, name: str) -> list[tuple[int, ...]]:
        if name not in self._shapes:
            simulation = self._simulation
            sizes = self._steps, len(simulation.scene.phase), simulation.positions.shape
            self._shapes[name] = self._known[name].shapes(*sizes)
        return self._shapes[name]

    def upright(self, values: Arrays) -> Arrays:
        return {**values, "gravity": self._tilt.gravity(values["tilt"])} if "tilt" in values else values

    def courses(self, values: Arrays) -> dict[str, Changing]:
        """Return the scheduled parameters that are not in ``values``, as functions of time."""
        replaced = {"gravity", "tilt"} if not values.keys().isdisjoint(("gravity", "tilt")) else set()
        courses = {**self._scheduled, **self._known.courses}
        found = {name: course for name, course in courses.items() if name not in values and name not in replaced}
        return found | {name: Steady(values[rate]) for rate, name in self._rates(values).items()}

    def _rates(self, values: Arrays) -> dict[str, str]:
        known = self._known
        return {name: known.views[name] for name in values if name in known.views and known[known.views[name]].grows}

    def _times(self, name: str, values: Arrays, clock: Clock | None = None) -> NDArray:
        return (clock or Clock()).times(self._moments(name), float(values.get("time_step", self.values["time_step"])))

    def _moments(self, name: str) -> NDArray:
        """Return the times (steps,) for the values of a scheduled parameter, in units of time steps."""
        return np.arange(max(self._steps, 1)) + self._known[name].moment

    def _scheduled_rates(self, values: Arrays, clock: Clock | None, of_clock: bool = False) -> Arrays:
        """Return the derivatives (steps, ...) of scheduled parameters by the time step or, with ``of_clock``, by the
        time."""
        found = {}
        for name, course in self.courses(values).items():
            times, moments = self._times(name, values, clock), self._moments(name)
            slopes = np.ones_like(moments) if of_clock else moments
            rates = course.rates(times) * (slopes[:, None] if self._known[name].rank else slopes)
            if name == "tilt":
                found["gravity"] = self._tilt.tangent(course.at(times), rates)
            else:
                found[name] = rates
        return found

    def scheduled(self, values: Arrays, clock: Clock | None = None) -> Arrays:
        """Return scheduled parameters (steps, ...) that are not in ``values``, with tilt as gravity."""
        rows = {name: course.at(self._times(name, values, clock)) for name, course in self.courses(values).items()}
        return {name: value for name, value in self.upright(rows).items() if name in self._known.run}

    def scheduled_at(self, values: Arrays, time: float, size: float) -> Arrays:
        """Return the scheduled parameters for a time step of length ``size`` [s] at ``time`` [s]."""
        courses = self.courses(values)
        rows = {name: course.at(np.array([time + self._known[name].moment * size])) for name, course in courses.items()}
        return {name: value[0] for name, value in self.upright(rows).items() if name in self._known.run}

    def run(self, values: Arrays) -> Arrays:
        """Return parameters over time (steps, ...) and parameters of phases (phases,)."""
        known = self._known
        found = {name: values.get(name, self.values[name]) for name in known.run}
        for name, value in found.items():
            if known[name].axis is Axis.STEP:
                row = value.shape[value.ndim - known[name].rank :]
                found[name] = np.broadcast_to(value, (max(self._steps, 1), *row))
            elif known[name].axis is Axis.PHASE:
                found[name] = np.atleast_1d(value)
        return found

    def first(self, values: Arrays) -> Arrays:
        """Return the fields of the first state that depend on ``values``."""
        fields = first_values(self._simulation.initial.fields, values)
        if values.keys().isdisjoint(COMPOSITION):
            return fields
        fractions, density = self._composition(values)
        with np.errstate(divide="ignore"):
            found = reference_density(fractions, density)
        bad = np.flatnonzero(~(np.isfinite(found) & (found > 0.0)))
        if bad.size:
            said = f"mass_fractions of particle {bad[0]} are {fractions[bad[0]].tolist()}"
            volume = "the sum of fractions divided by rest densities"
            raise InputError(f"{said}, but {volume} must be greater than 0.")
        return {**fields, DENSITY: found}

    def direction(
        self, values: Arrays, along: Arrays, clock: Clock | None = None, time_dot: float = 0.0
    ) -> tuple[Arrays, Arrays]:
        """Return tangents of the first state and of all steps. ``time_dot`` is the clock's tangent."""
        for view, replaced in self._known.views.items():
            for name, other in ((view, replaced), (replaced, view)):
                if name in along and other in values:
                    why = f"as {other} is given in its place"
                    raise InputError(f"direction {name} is given, but must be left out, {why}.")
        if "tilt" in along:
            if "tilt" not in values and self._simulation.scene.schedule.leads_gravity:
                why = "as the scene's schedule sets the direction of gravity: give tilt among the parameters, too"
                raise InputError(f"direction tilt is given, but must be left out, {why}.")
            angles = values.get("tilt", np.zeros(self._simulation.dimension - 1))
            along = {**along, "gravity": self._tilt.tangent(angles, along["tilt"])}
        rates = self._scheduled_rates(values, clock) if "time_step" in along else {}
        later = self._scheduled_rates(values, clock, of_clock=True) if time_dot else {}
        grown = {
            name: Steady(along[rate]).at(self._times(name, values, clock)) for rate, name in self._rates(along).items()
        }
        along = {name: along.get(name, np.zeros_like(value)) for name, value in self.values.items()}
        along |= {name: along[name] + rows for name, rows in grown.items()}
        fractions_dot, density_dot = along["mass_fractions"], np.atleast_1d(along["rest_density"])
        density = reference_density_tangent(*self._composition(values), fractions_dot, density_dot)
        first = {**first_values(self._simulation.initial.fields, along), DENSITY: density}
        moved = {name: along[name] + along["time_step"] * rate for name, rate in rates.items()}
        moved |= {name: moved.get(name, along[name]) + time_dot * rate for name, rate in later.items()}
        return first, self.run({**along, **moved})

    def changing(self, values: Arrays) -> set[str]:
        return {"gravity" if name == "tilt" else name for name in self.courses(values)}

    def time_adjoint(self, values: Arrays, run: Arrays, clock: Clock) -> float:
        """Return the adjoint of the clock's time, given the adjoints ``run`` of all steps."""
        rates = self._scheduled_rates(values, clock, of_clock=True)
        return sum((float((run[name] * rate).sum()) for name, rate in rates.items()), 0.0)

    def gradient(self, values: Arrays, first: Arrays, run: Arrays, clock: Clock | None = None) -> Arrays:
        """Return the gradient from the adjoints of the ``first`` state and of the ``run``'s parameters."""
        found = {name: run[name].copy() for name in self._known.run if name in values and name in run}
        for field in self._simulation.initial.fields:
            if field.first in values and field.name in first:
                if self._known[field.first].axis is Axis.STEP:  # the first row is the first value of the field
                    found[field.first][0] += first[field.name][0]
                else:
                    own = values[field.first].shape
                    found[field.first] = found.get(field.first, 0.0) + first[field.name].reshape(own)
        if "tilt" in values:
            found["tilt"] = self._tilt.adjoint(values["tilt"], run["gravity"])
        for rate, name in self._rates(values).items():
            found[rate] = np.tensordot(self._times(name, values, clock), run[name], axes=1)
        if "time_step" in values:
            later = sum(float((run[name] * rate).sum()) for name, rate in self._scheduled_rates(values, clock).items())
            found["time_step"] = found["time_step"] + later
        for name in self._known.over_time:
            if name in found and values[name].ndim == self._known[name].rank:
                found[name] = found[name].sum(axis=0)
        if DENSITY in first and not values.keys().isdisjoint(COMPOSITION):
            bars = reference_density_adjoint(*self._composition(values), first[DENSITY])
            for name, own_bar in zip(COMPOSITION, bars, strict=True):
                if name in found:
                    found[name] = found[name] + own_bar
        return {name: found[name].reshape(values[name].shape) for name in values if name in found}

    @property
    def _tilt(self) -> Tilt:
        return Tilt(self._simulation.scene.forces.gravity)

    def _composition(self, values: Arrays) -> tuple[np.ndarray, np.ndarray]:
        fractions, density = (values.get(name, self.values[name]) for name in COMPOSITION)
        return fractions, np.atleast_1d(density)
