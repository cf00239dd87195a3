"""The steps of a simulation as functions: from a state to a later one."""

from typing import cast

from cortado.arrays import check_steps
from cortado.device.threads import Turn, in_turn
from cortado.parameters.values import Arrays, Values
from cortado.stepper import Given, States, Steppable, Stepper

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

    def step(self, state: Given, parameters: Values | None = None, steps: int = 1) -> States:
        """The state after ``steps`` steps from ``state``, with the bits of ``run(steps, parameters, state=state)``; of
        a batch a tuple with one for each scene, with NaN in that of a scene that is lost.

        ``parameters`` are any of those of `Problem` but first values, which ``state`` has; one over time has a row for
        each of these steps. Nothing is recorded on the way. From the second call on with as many steps no array of the
        device is allocated, and no graph captured. Warns and raises as `Simulation.run` does.
        """
        return self.stepper(check_steps(steps)).advance(state, parameters)

    def vjp(self, state: Given, parameters: Values | None, state_bar: Values, steps: int = 1) -> tuple[Arrays, Arrays]:
        """The derivatives of `step` in reverse: from the adjoint of the state after the steps to those of ``state`` and
        of ``parameters``; see `Stepper.vjp`, which takes the steps once for several adjoints."""
        stepper = self.stepper(check_steps(steps))
        return stepper.vjp(stepper.step(state, parameters)[1], state_bar)

    def jvp(
        self,
        state: Given,
        parameters: Values | None,
        state_dot: Values,
        parameter_dots: Values | None = None,
        steps: int = 1,
    ) -> Arrays:
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
