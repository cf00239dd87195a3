"""A scene made ready for the reference engine."""

import os
from collections.abc import Callable, Mapping
from dataclasses import astuple, dataclass
from typing import Any

import numpy as np

from cortado.device.threads import usable_cores
from cortado.discretise.room import TOLERANCE
from cortado.errors import DivergedError, InputError, shown
from cortado.scene.discrete_scene import discretise
from cortado.scene.parameter_values import checked_value
from cortado.scene.parameters import BY_NAME
from cortado.scene.scene import Scene, as_scene
from cortado.scene.solvers import ProjectionSolver
from cortado.scene.stability import divergence_advice
from cortado_reference.digits import Digits
from cortado_reference.engine import extension, precisions
from cortado_reference.histories import Gradient, History
from cortado_reference.losses import Loss
from cortado_reference.scenes import check_scene, engine_scene

METHODS = (
    "analytic",
    "dual",
    "complex_step",
    "finite_difference",
    "as_printed",
    "as_printed_right_viscosity",
    "as_printed_predicted_density",
)
"""Ways to a tangent; see `Simulation.tangent`."""
PARAMETERS = ("gravity", "initial_positions", "initial_velocities", "viscosity")
LEAST_PARALLEL = {"float128": 30}
"""Particles for which another thread is worth its while, 1000 where not said: in float128 every operation is slow."""
Observer = Callable[[int], None]


@dataclass(frozen=True)
class Terms:
    """Which parts of the derivative of a step of PCISPH count, where all are the exact one; the step itself is never
    changed."""

    viscosity: bool = True
    """The viscous force's derivative (report eq. 14, put right)."""
    pressure: bool = True
    """The pressure force's derivative (eq. 13, put right)."""
    hessian: bool = True
    """Of the pressure force's derivative the term with the kernel's Hessian: the report's term 1."""
    density: bool = True
    """Of the pressure force's derivative the term with the derivative of p / n^2: the report's term 2."""


class Simulation:
    """A scene of one phase in C++, in any precision; the same step as `cortado.Simulation`, in independent code.

    Parameters, in and out, by name: ``gravity`` (d,) or (steps, d) [m / s2], ``initial_positions`` [m] and
    ``initial_velocities`` [m / s], (n, d) each, and ``viscosity`` [Pa s], a number. Arrays, or `Digits` where float64
    is not enough. Every method takes an ``observe`` that is called with the number of every step.
    """

    def __init__(self, scene: Scene | str | os.PathLike[str], precision: str = "float64", threads: int | None = None):
        """``scene``: one, or the path of its file; ``precision``: one of `cortado.reference.precisions`; ``threads``:
        all cores unless said, or one where there are too few particles. The bits of the results do not depend on them.
        """
        scene = as_scene(scene)
        check_scene(scene)
        if precision not in precisions():
            raise InputError(f"precision is {shown(precision)}, but must be one of {', '.join(precisions())}.")
        self.scene, self.precision = scene, precision
        discrete = discretise(scene)
        self.positions = discrete.fluid.positions
        """(n, d) first positions [m]."""
        self.velocities = discrete.fluid.velocities
        """(n, d) first velocities [m / s]."""
        self._region = scene.container.region(scene.dimension).opened(discrete.periods)
        if threads is None:
            least = LEAST_PARALLEL.get(precision, 1000)
            threads = min(usable_cores(), 1 + len(self.positions) // least)
        self.threads = _positive("threads", threads)
        self._engine = extension().make_engine(precision, engine_scene(scene, discrete), self.threads)

    def run(
        self,
        steps: int,
        controls: Mapping[str, Any] | None = None,
        record_every: int = 1,
        observe: Observer | None = None,
    ) -> History:
        """Run from the scene's first state; ``controls`` replace its parameters. Raises `DivergedError` when a
        particle is lost."""
        at = self._parameters(controls or {}, steps, "parameter")
        raw = self._engine.run(at, steps, _positive("record_every", record_every), observe)
        return self._history(raw, controls or {})

    def tangent(
        self,
        parameters: Mapping[str, Any],
        directions: Mapping[str, Any],
        steps: int,
        method: str = "analytic",
        terms: Terms | None = None,
        difference: float = 1e-6,
        record_every: int = 1,
        observe: Observer | None = None,
    ) -> History:
        """The derivative of every state along ``directions``, at ``parameters`` (the scene's where not given), by

        - "analytic": the step's derivative, by hand, with a choice of its ``terms``;
        - "dual": the step on numbers a + b u with u^2 = 0;
        - "complex_step": with u^2 = -1, and b far below round-off;
        - "finite_difference": central, of the step ``difference`` (in directions); states are those of the run ahead;
        - "as_printed": the report's eqs. 12 to 14 as they stand, wrong: no pressure from before and no clamp in (12),
          one density for two in (13), gamma = 2 (d + 2 mu) before (14). Only with PCISPH and pairwise viscosity;
        - "as_printed_right_viscosity": the same with gamma = 2 (d + 2) mu;
        - "as_printed_predicted_density": and (12) with the predicted density, as Algorithm 2's text has it.
        """
        if method not in METHODS:
            raise InputError(f"method is {shown(method)}, but must be one of {', '.join(METHODS)}.")
        if terms is not None and method != "analytic":
            raise InputError(
                f"terms are given, but must be left out with the method {method!r}: only analytic has them."
            )
        self._check_terms(terms)
        form = self.scene.forces.viscosity
        if method.startswith("as_printed") and isinstance(self.scene.solver, ProjectionSolver):
            raise InputError("method is as printed, which must not be used with the projection: it is of PCISPH.")
        if method.startswith("as_printed") and form == "stress":
            raise InputError(
                "method is as printed, which must not be used with the stress viscosity: (14) is pairwise."
            )
        if method.startswith("as_printed") and "viscosity" in directions:
            raise InputError("directions has viscosity, but must not as printed: (14) has no such derivative.")
        if not (np.isfinite(difference) and difference > 0.0):
            raise InputError(f"difference is {shown(difference)}, but must be greater than 0.")
        at, along = self._parameters(parameters, steps), self._parameters(directions, steps, "direction")
        every = _positive("record_every", record_every)
        chosen = extension().Terms(*astuple(terms or Terms()))
        raw = self._engine.tangent(at, along, steps, every, method, chosen, difference, observe)
        return self._history(raw, parameters)

    def gradient(
        self,
        parameters: Mapping[str, Any],
        steps: int,
        loss: Loss,
        terms: Terms | None = None,
        record_every: int = 1,
        observe: Observer | None = None,
    ) -> Gradient:
        """The loss of the last state and its derivatives with respect to every one of ``parameters``, in reverse.

        ``observe`` is called with the number of every step on the way forward, then on the way back.
        """
        self._check_terms(terms)
        shape, values = self.positions.shape, []

        def adjoint(*raw: Any) -> tuple[Any, Any]:
            state = [Digits(numbers.high, numbers.low).reshape(shape) for numbers in raw]
            values.append(loss.value(*state))
            bars = [Digits.of(bar) for bar in loss.adjoint(*state)]
            for bar, what in zip(bars, ("positions", "velocities"), strict=True):
                if bar.shape != shape:
                    raise InputError(f"the loss's adjoint of {what} has shape {bar.shape}, but must be {shape}.")
            return _numbers(bars[0]), _numbers(bars[1])

        at = self._parameters(parameters, steps)
        chosen = extension().Terms(*astuple(terms or Terms()))
        every = _positive("record_every", record_every)
        raw = self._engine.gradient(at, steps, every, chosen, adjoint, observe)
        history = self._history(raw.history, parameters)
        found = {}
        for name in parameters:
            bar = getattr(raw.bar, name.removeprefix("initial_"))
            digits = Digits(bar.high, bar.low)
            given = np.shape(parameters[name])
            if name == "gravity" and len(given) == 1:
                digits = _total(digits.reshape((steps, *given)))
            found[name] = digits.reshape(given)
        return Gradient(values[0], found, history)

    def _parameters(self, values: Mapping[str, Any], steps: int, what: str = "parameter") -> Any:
        steps = _positive("steps", steps)
        given = {name: self._checked(name, value, steps, what) for name, value in values.items()}
        if what == "direction":
            rest: dict[str, Any] = dict.fromkeys(PARAMETERS, 0.0)
        else:
            scene = self.scene
            rest = {"gravity": scene.forces.gravity, "viscosity": scene.phase[0].viscosity}
            rest |= {"initial_positions": self.positions, "initial_velocities": self.velocities}
        n, d = self.positions.shape
        shapes = {"gravity": (steps, d), "viscosity": (1,)}
        chosen = [
            _broadcast(given.get(name, Digits.of(rest[name])), shapes.get(name, (n, d)))
            for name in ("initial_positions", "initial_velocities", "gravity", "viscosity")
        ]
        return extension().Parameters(*map(_numbers, chosen))

    def _check_terms(self, terms: Terms | None) -> None:
        if terms not in (None, Terms()) and isinstance(self.scene.solver, ProjectionSolver):
            raise InputError("terms leave a part out, which they must not with the projection: only PCISPH has parts.")

    def _checked(self, name: str, value: Any, steps: int, what: str) -> Digits:
        if name not in PARAMETERS:
            raise InputError(
                f"{what} {name!r} is unknown to the reference engine, but must be one of {', '.join(PARAMETERS)}."
            )
        shapes = BY_NAME[name].shapes(steps, 1, self.positions.shape)
        high = checked_value(name, value.high if isinstance(value, Digits) else value, shapes, what)
        return Digits(high, value.low) if isinstance(value, Digits) else Digits.of(high)

    def _history(self, raw: Any, parameters: Mapping[str, Any]) -> History:
        """What a run with these parameters recorded; raises `DivergedError` if a particle was lost."""
        time_step = self.scene.solver.fixed_time_step("the reference engine")
        history = None if raw.bad_step >= 0 else History.of(raw, self.positions.shape, time_step)
        lost = self._lost(history) if history else (raw.bad_step + 1, raw.bad_particle, "was lost", 0)
        if lost:
            values = {name: _float64(value) for name, value in parameters.items()}
            step, particle, where, others = lost
            raise DivergedError(step, particle, divergence_advice(self.scene, values, time_step), where, others)
        assert history is not None
        return history

    def _lost(self, history: History) -> tuple[int, int, str, int] | None:
        """The first recorded step after which a particle is beyond the walls, the particle, what became of it, and how
        many more are."""
        if not self.scene.forces.pressure:
            return None
        region, tolerance = self._region, TOLERANCE * self.scene.discretisation.spacing
        frames = history.positions.high
        for step, before, after in zip(history.steps[1:], frames, frames[1:], strict=False):
            lost = np.flatnonzero(region.escaped(before, after, tolerance))
            if lost.size:
                return int(step), int(lost[0]), "left the container", lost.size - 1
        return None


def _float64(value: Any) -> np.ndarray:
    return np.asarray(value.high if isinstance(value, Digits) else value, dtype=np.float64)


def _numbers(digits: Digits) -> Any:
    return extension().Numbers(np.ascontiguousarray(digits.high).ravel(), np.ascontiguousarray(digits.low).ravel())


def _broadcast(digits: Digits, shape: tuple[int, ...]) -> Digits:
    return Digits(np.broadcast_to(digits.high, shape), np.broadcast_to(digits.low, shape))


def _total(digits: Digits) -> Digits:
    """The sum over the first axis, without losing digits."""
    high, low = np.zeros(digits.shape[1:]), np.zeros(digits.shape[1:])
    for term in range(len(digits)):
        total = high + digits.high[term]
        part = total - high
        low += (high - (total - part)) + (digits.high[term] - part) + digits.low[term]
        high = total
    total = high + low
    return Digits(total, low - (total - high))


def _positive(name: str, value: Any) -> int:
    if not (isinstance(value, (int, np.integer)) and value >= 1):
        raise InputError(f"{name} is {shown(value)}, but must be a whole number of at least 1.")
    return int(value)
