"""What rewards are made of: terms, numbers of a state each with its derivative; and the reward of a step, and the same
as a loss of the state after it. All are computed for all scenes at once, and sums over particles stay on the
device."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import warp as wp
from numpy.typing import NDArray

from cortado.device.launching import launch
from cortado.device.reduction import add, sum_of
from cortado.device.threads import WARP
from cortado.discretise.room import WITHOUT_PERIODS, Domain
from cortado.discretise.shapes import apart
from cortado.environments.kernels import environment_kernels
from cortado.losses.loss import Snapshot, SnapshotBatch, precision_of
from cortado.particles.state import State, padded, to_device
from cortado.scene.motions import AXES, position_name, turn_name


@dataclass(frozen=True, eq=False)
class StepEnd:
    """The states of all scenes after a step of the environment."""

    state: State
    """(scenes n,)"""
    goal: NDArray
    """(scenes, g) what each scene is to reach."""
    step: NDArray
    """(scenes,) which step of its episode it is, counted from 1."""
    domain: Domain = WITHOUT_PERIODS
    """Along which axes the scene repeats."""

    @property
    def scenes(self) -> int:
        """How many there are."""
        return len(self.step)

    @property
    def per(self) -> int:
        """Particles of a scene."""
        return len(self.state.positions) // self.scenes

    @property
    def period(self) -> dict[str, Any]:
        """``period`` and ``frequency``, as kernels take them."""
        _, period, frequency = self.domain.vectors(precision_of(self.state).vector)
        return {"period": period, "frequency": frequency}


class Term(Protocol):
    """A part of a reward."""

    def values(self, at: StepEnd) -> NDArray:
        """(scenes,)"""

    def adjoint(self, at: StepEnd, factor: NDArray, bar: State) -> None:
        """Add the derivative times ``factor`` (scenes,) to an adjoint of the states."""


Boxes = Callable[[NDArray], tuple[NDArray, NDArray]]
"""From goals (scenes, g) to lower and upper corners (scenes, boxes, d) [m]."""


@dataclass(frozen=True)
class OneBox:
    """The same box, whatever the goal."""

    lower: tuple[float, ...]
    """[m]"""
    upper: tuple[float, ...]
    """[m]"""

    def __call__(self, goal: NDArray) -> tuple[NDArray, NDArray]:
        lower, upper = (np.tile(corner, (len(goal), 1, 1)) for corner in (self.lower, self.upper))
        return lower, upper


class OverParticles:
    """A term that is a sum over particles, of a kernel whose derivative has its name and ``_adjoint``."""

    kernel: str

    def __init__(self, *given: Any):
        """``given``: what it is made from."""
        self._given = given
        self._made: dict[Any, Any] = {}
        """Sums, and arrays on devices."""

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickled and copied as what it is made from."""
        return type(self), self._given

    def values(self, at: StepEnd) -> NDArray:
        value = wp.empty(self._threads(at), dtype=wp.float64, device=at.state.positions.device)
        self._launch(self.kernel, at, value=value)
        count = value.size // at.scenes
        total = self._kept(count, at, lambda: sum_of(wp.float64, count, value.device, at.scenes))
        return total(value.flatten()).numpy() / self._over(at)

    def adjoint(self, at: StepEnd, factor: NDArray, bar: State, **others: wp.array) -> None:
        """``others``: what the kernel of the derivative writes besides ``x_bar``."""
        scaled = _reals(at, factor / self._over(at))
        self._launch(f"{self.kernel}_adjoint", at, factor=scaled, x_bar=bar.positions, **others)

    def _launch(self, name: str, at: StepEnd, **arguments: Any) -> None:
        x, kernels = at.state.positions, environment_kernels(precision_of(at.state))
        own = {"per": at.per, "x": x, **self._arguments(at)}
        launch(getattr(kernels, name), self._threads(at), x.device, **own, **arguments)

    def _threads(self, at: StepEnd) -> tuple[int, ...]:
        """One for each particle, unless said otherwise."""
        return (at.scenes * at.per,)

    def _over(self, at: StepEnd) -> float:
        """What the sum is divided by."""
        return 1.0

    def _arguments(self, at: StepEnd) -> dict[str, Any]:
        """The arguments that the forward and the adjoint kernel share."""
        raise NotImplementedError

    def _kept(self, key: Any, at: StepEnd, make: Callable[[], Any]) -> Any:
        """What is made once for a device, a precision and a number of scenes."""
        key = key, str(at.state.positions.device), at.state.positions.dtype, at.scenes
        if key not in self._made:
            self._made[key] = make()
        return self._made[key]


class Share(OverParticles):
    """The share of the fluid that is in some boxes, each particle counted by 1 / (1 + e^2 / w^2), where e is the
    distance of its nearest image to the nearest box: 1 within, a half at the distance w, so that there is a gradient
    everywhere."""

    kernel = "share"

    def __init__(self, boxes: Boxes, width: float, solid: str | None = None):
        """``width`` w [m]; ``solid``: on whose middle boxes are placed, and with which they turn, in the plane."""
        super().__init__(boxes, width, solid)
        self._boxes, self._width, self._solid = boxes, width, solid

    def adjoint(self, at: StepEnd, factor: NDArray, bar: State, **others: wp.array) -> None:
        x = at.state.positions
        place_bar, turn_bar = wp.empty_like(x), wp.empty(len(x), dtype=precision_of(at.state).real, device=x.device)
        super().adjoint(at, factor, bar, place_bar=place_bar, turn_bar=turn_bar)
        if self._solid is not None:
            for name, bars in ((position_name(self._solid), place_bar), (turn_name(self._solid), turn_bar)):
                add(sum_of(bars.dtype, at.per, x.device, at.scenes)(bars), bar[name])

    def _over(self, at: StepEnd) -> float:
        return at.per

    def _arguments(self, at: StepEnd) -> dict[str, Any]:
        lower, upper = (_vectors(at, corners) for corners in self._boxes(at.goal))
        if self._solid is None:
            fixed = _vectors(at, np.zeros((at.scenes, 3))), _reals(at, np.zeros(at.scenes))
        else:
            fixed = at.state[position_name(self._solid)], at.state[turn_name(self._solid)]
        found = {"width": self._width, "lower": lower, "upper": upper, **at.period}
        return {**found, "place": fixed[0], "turn": fixed[1]}


class Spread(OverParticles):
    """The mean distance of all pairs of some particles, component by component, |dx| + |dy|, over ``everywhere``;
    along a periodic axis to the nearest image."""

    kernel = "apart"

    def __init__(self, chosen: NDArray, everywhere: float):
        """``chosen`` (m,) numbers of particles; ``everywhere`` [m]."""
        super().__init__(chosen, everywhere)
        self._chosen, self._pairs = chosen, len(chosen) ** 2 * everywhere

    def _threads(self, at: StepEnd) -> tuple[int, ...]:
        return at.scenes, len(self._chosen)

    def _over(self, at: StepEnd) -> float:
        return self._pairs

    def _arguments(self, at: StepEnd) -> dict[str, Any]:
        device = at.state.positions.device
        chosen = self._kept("chosen", at, lambda: wp.array(self._chosen, dtype=wp.int32, device=device))
        return {**at.period, "chosen": chosen}


class Missed(OverParticles):
    """The squared distances of particles to targets that change from step to step, each times a weight, added up.

    Targets go on beyond the end of a period, as positions do: a lap too many is a distance.
    """

    kernel = "missed"

    def __init__(self, targets: NDArray, weights: NDArray):
        """``targets`` (steps, n, d) [m], those of step k, counted from 1, at k - 1; ``weights`` (steps, n)."""
        super().__init__(targets, weights)
        self._targets, self._weights = targets, weights

    def _arguments(self, at: StepEnd) -> dict[str, Any]:
        target, weight = self._kept("targets", at, lambda: (_vectors(at, self._targets), _reals(at, self._weights)))
        steps = np.clip(at.step, 1, len(self._targets)) - 1
        step = wp.array(steps, dtype=wp.int32, device=at.state.positions.device)
        return {"step": step, "target": target, "weight": weight}


@dataclass(frozen=True)
class Distance:
    """|x - x*| [m]: how far the middle of a solid is from its goal along the first axis."""

    solid: str

    def values(self, at: StepEnd) -> NDArray:
        return np.abs(_miss(at, self.solid))

    def adjoint(self, at: StepEnd, factor: NDArray, bar: State) -> None:
        _add(bar, position_name(self.solid), factor[:, None] * np.sign(_miss(at, self.solid))[:, None] * [1.0, 0.0])


@dataclass(frozen=True)
class Pose:
    """(x - x*)^2 / l^2 + 2 (1 - cos angle) of a free body in the plane: how far it is from its goal along the first
    axis, and how far from level."""

    solid: str
    length: float
    """l [m]"""

    def values(self, at: StepEnd) -> NDArray:
        turned = sum(_numbers(at.state, name)[:, axis] for axis, name in self._axes)
        return (_miss(at, self.solid) / self.length) ** 2 - turned

    def adjoint(self, at: StepEnd, factor: NDArray, bar: State) -> None:
        slopes = (2.0 / self.length**2 * factor * _miss(at, self.solid))[:, None]
        _add(bar, position_name(self.solid), slopes * [1.0, 0.0])
        for axis, name in self._axes:
            _add(bar, name, -factor[:, None] * np.eye(2)[axis])

    @property
    def _axes(self) -> list[tuple[int, str]]:
        """Fields of how far the ends of its axes have moved, of which these components are cos angle - 1."""
        return [(axis, f"{self.solid}.{name}") for axis, name in enumerate(AXES[:2])]


@dataclass(frozen=True)
class Reward:
    """A constant, and terms times their weights."""

    terms: tuple[tuple[float, Term], ...]
    constant: float = 0.0
    domain: Domain = WITHOUT_PERIODS
    """Along which axes the scene repeats."""

    def at(self, state: State, goal: NDArray, step: NDArray) -> StepEnd:
        """What it is a function of: the states of all scenes, with ``goal`` and ``step`` as of `StepEnd`."""
        return StepEnd(state, goal, step, self.domain)

    @WARP
    def values(self, at: StepEnd) -> NDArray:
        """(scenes,)"""
        found = np.full(at.scenes, self.constant)
        for weight, term in self.terms:
            found += weight * term.values(at)
        return found

    @WARP
    def adjoint(self, at: StepEnd, factor: float) -> State:
        """The derivative of the reward with respect to the state, times ``factor``."""
        bar, each = at.state.like(), np.full(at.scenes, factor)
        for weight, term in self.terms:
            term.adjoint(at, weight * each, bar)
        return bar


@dataclass(frozen=True)
class MinusReward:
    """The loss of one step: minus its reward."""

    reward: Reward
    goal: NDArray
    """(scenes, g), or (1, g) for all of them"""
    step: int
    """Which step of the episode it is, counted from 1."""

    @property
    def fingerprint(self) -> str:
        """Tells one step from another, for checkpoints."""
        return f"{[(weight, type(term).__name__) for weight, term in self.reward.terms]} {self.goal} {self.step}"

    def value(self, end: Snapshot) -> float:
        return -float(self.reward.values(self._at(end))[0])

    def value_and_adjoint(self, end: Snapshot) -> tuple[float, State]:
        return self.value(end), self.reward.adjoint(self._at(end), -1.0)

    def values(self, end: SnapshotBatch) -> NDArray:
        """See `losses.batch.BatchedLoss`."""
        return -self.reward.values(self._at(end))

    def values_and_adjoint(self, end: SnapshotBatch) -> tuple[NDArray, State]:
        """See `losses.batch.BatchedLoss`."""
        return self.values(end), self.reward.adjoint(self._at(end), -1.0)

    def _at(self, end: Any) -> StepEnd:
        scenes = end.state.batch or 1
        goal = np.broadcast_to(self.goal, (scenes, self.goal.shape[1]))
        return self.reward.at(end.state, goal, np.full(scenes, self.step))


def _miss(at: StepEnd, solid: str) -> NDArray:
    """(scenes,) from the goal to the middle of a solid along the first axis, the shorter way around a period [m]."""
    return apart(_numbers(at.state, position_name(solid))[:, :1] - at.goal[:, :1], at.domain.lengths[:1])[:, 0]


def _reals(at: StepEnd, values: NDArray) -> wp.array:
    return wp.array(values, dtype=precision_of(at.state).real, device=at.state.positions.device)


def _vectors(at: StepEnd, values: NDArray) -> wp.array:
    """A Warp array of vectors with three components, from numbers (..., d)."""
    return to_device(values.reshape(-1, values.shape[-1]), precision_of(at.state), at.state.positions.device).reshape(
        values.shape[:-1]
    )


def _numbers(state: State, name: str) -> NDArray:
    """A field with an entry for each scene, in float64."""
    return state[name].numpy().astype(np.float64)


def _add(bar: State, name: str, values: NDArray) -> None:
    """Vectors (scenes, d) to a field with one for each scene."""
    field = bar[name]
    add(wp.array(padded(values), dtype=field.dtype, device=field.device), field)
