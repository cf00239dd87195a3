"""What can be read of a simulation's states: quantities of its particles."""

from collections.abc import Mapping, Sequence
from typing import Any, Protocol, cast

import numpy as np
from numpy.typing import NDArray

from cortado.device.threads import Turn, in_turn
from cortado.discretise.calibration import circulation_factor
from cortado.rollout.rollout import Rollout
from cortado.rollout.stepper import Steppable
from cortado.runs.quantities.evaluator import QuantityEvaluator
from cortado.runs.quantities.moment import Moment
from cortado.runs.trajectory import Trajectory
from cortado.scene.parameters.values import OVER_TIME
from cortado.scene.quantities import check_readable
from cortado.scene.restart import RestartState


class Measured(Steppable, Protocol):
    """A simulation as its quantities see it."""

    @property
    def walls(self) -> NDArray:
        """(b, d) wall particles [m]"""

    def rollout(self, steps: int, controls: Mapping[str, Any] | None, state: Any) -> Rollout:
        """A rollout that is ready to go forward."""

    def in_precision(self, precision: str) -> Any:
        """A single one of the same scene in a precision."""

    def batch_of(self, size: int) -> Any:
        """The same scene so many times in one launch."""


class Measuring:
    """What a simulation can say of states."""

    @property
    def turn(self) -> Turn:
        """What a thread holds that uses the simulation."""
        raise NotImplementedError

    @in_turn
    def evaluator(self) -> QuantityEvaluator:
        """What computes quantities of states on the device, made once."""
        made = self.__dict__.get("_evaluator")
        if made is None:
            own = cast(Measured, self)
            scene, lattice = own.scene, own.lattice
            factor = circulation_factor(own.smoothing, scene.discretisation.spacing, lattice.support, scene.dimension)
            made = self.__dict__["_evaluator"] = QuantityEvaluator(own.solver, scene, factor)
        return made

    def quantity(
        self,
        name: str,
        of: RestartState | Sequence[RestartState] | Trajectory | None = None,
        controls: Mapping[str, Any] | None = None,
    ) -> NDArray:
        """A quantity of the particles: "density" [kg / m3], "pressure" [Pa], "speed" [m / s], "vorticity" [1 / s],
        "wall_force" [N]; see `docs/sensors.md`. Or a field of the state, such as one that a part of one's own keeps, or
        the load on a solid, such as "rotor.load".

        Args:
            name: of the quantity.
            of: a state of this simulation, of a batch one for each scene; or a trajectory, of which it is found for
                every frame; the scene's first state if left out.
            controls: as of `run`; the pressure is that of the step that begins at the state, which they act in. Of a
                trajectory they are those of its run.

        Returns:
            (n,) or (n, k), of a trajectory (frames, n, ...), float64, in the scene's order, of a field its shape, of a
            load (k,).

        Raises:
            InputError: another name, or a state that is none of this simulation's.
        """
        check_readable(name, "quantity", cast(Measured, self).initial.names)
        if not isinstance(of, Trajectory):
            return self._quantity(name, of, controls)
        first = cast(Measured, self).known.state
        given = {name: value for name, value in (controls or {}).items() if name not in first}
        frames = [self._quantity(name, of[: k + 1].last_state, _at(given, of, k)) for k in range(len(of))]
        return np.array(frames)

    @in_turn
    def _quantity(self, name: str, state: Any, controls: Mapping[str, Any] | None) -> NDArray:
        own = cast(Measured, self)
        rollout = own.rollout(1, controls, state)
        if name in rollout.initial.names:
            return rollout.initial.numpy(own.dimension, only=[name])[name].astype(np.float64)
        return Moment.of(rollout, 0, rollout.initial, self.evaluator).value(name)


def _at(given: dict[str, Any], trajectory: Trajectory, frame: int) -> dict[str, Any]:
    """The controls of the step after a frame of the run that they were given to."""
    step = int(trajectory.steps[frame] - trajectory.steps[0])
    rows = {name: value for name, value in given.items() if name in OVER_TIME and np.ndim(value) == 2}
    return given | {name: value[min(step, len(value) - 1)] for name, value in rows.items()}
