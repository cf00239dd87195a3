"""Where a forward run begins that an earlier process has computed a part of."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from cortado.errors import InputError
from cortado.particles.state import State
from cortado.rollout.step_sizes import StepSizes


@dataclass(frozen=True)
class Progress:
    """How far an earlier process came with the same first state, parameters and steps of a single scene. The rest of
    the run has the same bits as if that process had not stopped."""

    step: int = 0
    """Steps that it took."""
    state: State | None = None
    """The state after them; None of the first one."""
    diagnostics: Mapping[str, np.ndarray] = field(default_factory=dict)
    """(step,) by name, what was noted of these steps."""

    def begin(self, initial: State, sizes: StepSizes, keep: bool) -> tuple[State, int, bool]:
        """The state to go on from, its number, and whether the run ends with it. Raises `InputError` where states shall
        be kept for a backward pass, as those before are not known."""
        if self.state is None:
            return initial, 0, False
        if keep:
            raise InputError("keep is True, but must be False in a run that goes on from the middle.")
        return self.state, self.step, sizes.go_on(self.step, self.state, self.diagnostics.get("time_steps"))

    def whole(self, found: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """What was noted of all steps, given what the present process has noted, whose first steps mean nothing."""
        if self.state is None:
            return dict(found)
        n = self.step
        return {name: np.concatenate([self.diagnostics[name][:n], column[n:]]) for name, column in found.items()}
