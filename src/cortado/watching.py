"""Looking at a run's states while it runs: quantities of recorded frames, and sensors in every step."""

from collections.abc import Iterable, Mapping
from functools import cache
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from cortado.arrays import require_table
from cortado.errors import InputError
from cortado.losses.loss import Snapshot
from cortado.particles.state import State
from cortado.rollout.rollout import Rollout
from cortado.rollout.stepper import Steppable
from cortado.runs.probes import sensors_of, warn_of_places
from cortado.runs.quantity_values import Moment, QuantityEvaluator, Recorder
from cortado.runs.sensor import Readings, Sensor, SensorLog
from cortado.scene.parameter_values import Arrays


class Watched(Steppable, Protocol):
    """Protocol of a simulation as `Watch` needs it."""

    @property
    def walls(self) -> NDArray:
        """Positions (b, d) of wall particles [m]."""

    def rollout(self, steps: int, controls: Mapping[str, Any] | None, state: Any) -> Rollout:
        """Return a rollout that is ready to go forward."""

    def in_precision(self, precision: str) -> Any:
        """Return a single simulation of this scene in a precision."""

    def batch_of(self, size: int) -> Any:
        """Return a simulation of ``size`` copies of this scene in one launch."""


class Watch:
    """An observer of one rollout that computes quantities and reads sensors, with the arrays of another solver of the
    scene, as the rollout's own are at work."""

    def __init__(
        self,
        simulation: Watched,
        rollout: Rollout,
        record: Iterable[str] = (),
        sensors: Mapping[str, Sensor] | None = None,
    ):
        """Prepare to record quantities, and to read ``sensors`` besides those of the scene, which a batch does not
        read. Raises `InputError` for unknown quantities, and for sensors of a batch."""
        if sensors is not None:
            require_table("sensors", sensors, "{'probe': cortado.sensors.PressureProbe([0.1, 0.1])}")
        if sensors and simulation.batch is not None:
            raise InputError("sensors is given, but must be left out, as a batch reads none: read one scene's.")

        @cache
        def evaluator() -> QuantityEvaluator:
            own, batch = simulation, simulation.batch
            return (own.in_precision(own.precision.name) if batch is None else own.batch_of(batch)).evaluator()

        of_scene = sensors_of(simulation.scene) if simulation.batch is None else {}
        warn_of_places(simulation, of_scene | dict(sensors or {}))
        self._recorder = Recorder(rollout, record, evaluator, simulation.dimension)
        self._log = SensorLog(of_scene | dict(sensors or {}), simulation.dimension)
        self._rollout, self._dimension, self._evaluator = rollout, simulation.dimension, evaluator
        self._quantities = set[str]()
        """Those that sensors read of a state."""
        self._colours = np.array([phase.colour for phase in simulation.scene.phase])
        self.names = self._recorder.names
        """Of the quantities that are recorded."""

    def frame(self, step: int, state: State) -> Arrays:
        """Return the recorded quantities of a state after so many steps, by name."""
        return self._recorder(step, state)

    @property
    def reads(self) -> bool:
        """True if there is a sensor, which reads every state."""
        return bool(self._log.sensors)

    def step(self, step: int, state: State) -> None:
        """Make the sensors read a state after so many steps; it is called for every state in its turn."""
        if self.reads:
            moment = Moment.of(self._rollout, step, state, self._evaluator, self._quantities)
            self._log.read(Snapshot(state, self._dimension, self._colours, moment))

    def known(self, readings: Mapping[str, Readings]) -> float:
        """Return the last step of which an earlier process has left all readings; infinite without sensors."""
        return self._log.known(readings)

    def go_on(self, steps: int, readings: Mapping[str, Readings]) -> None:
        """Take over sensor readings by an earlier process of the first states, up to that after ``steps`` steps."""
        self._log.go_on(steps, readings)

    def readings(self) -> dict[str, Readings]:
        """Return the readings of the sensors, by their names."""
        clock, steps = self._rollout.clocks[0], np.arange(self._rollout.steps + 1)
        return self._log.readings(clock.times(steps, float(self._rollout.time_steps[0])))
