"""The class `Watch`, which records quantities and reads sensors during a run."""

from collections.abc import Callable, Iterable, Mapping
from functools import cache, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cortado.arrays import require_names, require_table
from cortado.errors import DivergedError, InputError
from cortado.losses.loss import Snapshot, SnapshotBatch
from cortado.particles.state import State
from cortado.rollout.rollout import Observer, Rollout
from cortado.runs.probes import SENSORS, sensors_of, warn_of_places
from cortado.runs.quantity_values import Moment, QuantityEvaluator
from cortado.runs.recording import StepReader, Waiting
from cortado.runs.sensor import Readings, Sensor, SensorLog, value_of
from cortado.scene.parameter_values import Arrays
from cortado.scene.parameters import QUANTITIES, check_quantity


class Watch:
    def __init__(
        self, simulation: Any, rollout: Rollout, record: Iterable[str] = (), sensors: Mapping[str, Sensor] | None = None
    ):
        if sensors is not None:
            require_table("sensors", sensors, "{'probe': cortado.sensors.PressureProbe([0.1, 0.1])}")

        @cache
        def evaluator() -> QuantityEvaluator:
            own, batch = simulation, simulation.batch
            made = own.in_precision(own.precision.name) if batch is None else own.batch_of(batch)
            found: QuantityEvaluator = made.evaluator()
            return found

        known = sensors_of(simulation.scene) | dict(sensors or {})
        warn_of_places(simulation, known)
        names = require_names("record", record)
        self.names = tuple(dict.fromkeys(check_quantity(name, "record") for name in names))
        if self.names:
            evaluator()
        self.logs = [SensorLog(known, simulation.dimension) for _ in range(simulation.batch or 1)]
        self._rollout, self._simulation, self._evaluator = rollout, simulation, evaluator
        self._on_host = {name: one for name, one in known.items() if type(one) not in SENSORS.values()}
        if self._on_host and simulation.batch is not None:
            name, own = next(iter(self._on_host.items()))
            wanted = "a sensor of a batch must be of a class in cortado.sensors; or run the scenes one by one"
            raise InputError(f"sensor {name!r} is a {type(own).__name__}, but {wanted}.")
        summed: Any = {name: one for name, one in known.items() if name not in self._on_host}
        self._reader = StepReader(simulation.evaluator(), rollout, summed, self.logs) if summed else None
        self._quantities = set[str](() if self._reader is None else self._reader.quantities)
        self._colours = np.array([phase.colour for phase in simulation.scene.phase])
        self._waiting: Any = None

    def run(
        self, is_frame: Callable[[int], bool], record: Observer, observe: Callable[[int], object] | None = None
    ) -> State:
        """Run the rollout and return its last state. An error or an interrupt does not lose earlier states."""

        def look(step: int, state: State) -> None:
            if is_frame(step):
                record(step, state)
            self.read(step, state)

        def keep(step: int, state: State) -> None:
            if self._on_host or is_frame(step):
                self._waiting.keep(step, state)
            if observe is not None:
                observe(step)

        self._waiting = Waiting(look, self._rollout.initial, self._rollout.copies)
        try:
            return self._rollout.forward(keep, keep=False, meanwhile=self.look, reader=self._reader)
        finally:
            self.look()

    def look(self) -> None:
        if self._waiting is not None:
            self._waiting.look()
        if self._reader is not None:
            self._reader.look()

    def frame(self, step: int, state: State) -> Arrays:
        """Return the recorded quantities after ``step`` steps. The values are NaN if the next step loses a particle."""
        if not self.names:
            return {}
        found, real = dict[str, NDArray](), self._rollout.solver.discretisation.precision.numpy
        moment = Moment.of(self._rollout, step, state, self._evaluator)
        for name in self.names:
            try:
                found[name] = moment.value(name).astype(real)
            except DivergedError:  # which the run itself raises
                sizes = QUANTITIES[name].shape(len(state.positions), self._simulation.dimension)
                found[name] = np.full(sizes, np.nan, dtype=real)
        return found

    def read(self, step: int, state: State) -> None:
        if self._on_host:
            at: Any = self._snapshot(step, state, self._evaluator)
            for name, sensor in self._on_host.items():
                self.logs[0].read(name, step, partial(value_of, sensor, at))

    def end(self, state: State) -> None:
        if self._reader is None:
            return
        step = self._rollout.taken
        at = self._snapshot(step, state, self._simulation.evaluator)
        for member, log in enumerate(self.logs):
            own = at if isinstance(at, Snapshot) else at[member]
            for name, sensor in self._reader.sensors.items() if member not in self._rollout.lost else ():
                log.read(name, step, partial(value_of, sensor, own))

    def _snapshot(self, step: int, state: State, evaluator: Callable[[], QuantityEvaluator]) -> Any:
        moment = Moment.of(self._rollout, step, state, evaluator, self._quantities)
        d, batch = self._simulation.dimension, self._simulation.batch
        if batch is None:
            return Snapshot(state, d, self._colours, moment)
        return SnapshotBatch(state, d, np.array([self._colours] * batch), moment)

    def readings(self, member: int = 0) -> dict[str, Readings]:
        clock, steps = self._rollout.clocks[member], np.arange(self._rollout.steps + 1)
        return self.logs[member].readings(clock.times(steps, float(self._rollout.time_steps[member])))
