"""The steps of a simulation as functions: from a state to a later one."""

from typing import Any, cast, overload

from cortado.arrays import check_steps
from cortado.device.threads import Turn, in_turn
from cortado.rollout.device_states import DeviceState
from cortado.rollout.host_states import Given, States
from cortado.rollout.stepper import Steppable, Stepper
from cortado.scene.parameter_values import Arrays, Values

KEPT = 4
"""Numbers of steps whose arrays and graphs a simulation keeps for the next call."""


class Stepping:
    """What a simulation can do with states."""

    @property
    def turn(self) -> Turn:
        """What a thread holds that uses the simulation."""
        raise NotImplementedError

    def state(self, parameters: Values | None = None) -> States:
        """The state before the first step, whole: what `step` and ``Simulation.run(state=...)`` go on from; of a batch
        a tuple with one for each scene.

        ``parameters`` are any of those of `Problem` that a first state depends on, such as ``initial_velocities``.
        Raises `InputError` for those that do not fit.
        """
        return self.stepper(0).first(parameters)

    def on_device(
        self, state: Given | DeviceState = None, fields: Values | None = None, parameters: Values | None = None
    ) -> DeviceState:
        """A state, the first one if left out, in arrays on the device, which other programs take by DLPack: steps from
        it give states on the device, and nothing of them passes through the host.

        ``fields`` are arrays that speak DLPack and replace fields of the state, in the precision of the simulation and
        on its device: vectors (n, 3), fractions (n, phases), numbers (n,), in a batch (batch, n, ...). Such a state is
        judged as one from a file is, which reads it on the host, once. ``parameters`` are those of the run that the
        state is of. Raises `InputError` for what does not fit.
        """
        return self.stepper(0).on_device(state, fields or {}, parameters)

    def on_host(self, state: DeviceState) -> States:
        """A state on the device as NumPy arrays: what files and other processes take, and ``Simulation.run``. Raises
        `InputError` for a state of another simulation."""
        return self.stepper(0).on_host(state)

    @overload
    def step(self, state: Given, parameters: Values | None = None, steps: int = 1) -> States: ...

    @overload
    def step(self, state: DeviceState, parameters: Values | None = None, steps: int = 1) -> DeviceState: ...

    def step(self, state: Any, parameters: Values | None = None, steps: int = 1) -> Any:
        """The state after ``steps`` steps from ``state``, with the bits of ``run(steps, parameters, state=state)``; of
        a batch a tuple with one for each scene, with NaN in that of a scene that is lost.

        ``parameters`` are any of those of `Problem` but first values, which ``state`` has; one over time has a row for
        each of these steps. Nothing is recorded on the way. From a `DeviceState` it gives another one. From the
        second call on with as many steps no array of the device is allocated but those of a `DeviceState`, and no graph
        is captured. Warns and raises as `Simulation.run` does.
        """
        return self.stepper(check_steps(steps)).advance(state, parameters)

    def vjp(
        self, state: Given | DeviceState, parameters: Values | None, state_bar: Values, steps: int = 1
    ) -> tuple[dict[str, Any], Arrays]:
        """The derivatives of `step` in reverse: from the adjoint of the state after the steps to those of ``state`` and
        of ``parameters``; see `Stepper.vjp`, which takes the steps once for several adjoints."""
        stepper = self.stepper(check_steps(steps))
        return stepper.vjp(stepper.step(state, parameters)[1], state_bar)

    def jvp(
        self,
        state: Given | DeviceState,
        parameters: Values | None,
        state_dot: Values,
        parameter_dots: Values | None = None,
        steps: int = 1,
    ) -> dict[str, Any]:
        """The derivative of `step` along tangents of ``state`` and of any parameters, as the tangent of the state after
        the steps; see `Stepper.jvp`."""
        stepper = self.stepper(check_steps(steps))
        residual = stepper.step(state, parameters, along=parameter_dots or ())[1]
        return stepper.jvp(residual, state_dot, parameter_dots)

    @in_turn
    def stepper(self, steps: int) -> Stepper:
        """The `Stepper` of so many steps; those of the last few numbers of steps are kept."""
        steppers: dict[int, Stepper] = self.__dict__.setdefault("_steppers", {})
        found = steppers.pop(steps, None) or Stepper(cast(Steppable, self), check_steps(steps, least=0))
        steppers[steps] = found  # the last one
        while len(steppers) > KEPT:
            steppers.pop(next(iter(steppers)))
        return found
