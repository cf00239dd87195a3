"""Rewards and their derivatives for all scenes of a batch."""

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
from cortado.errors import InputError, shown
from cortado.losses.loss import Snapshot, SnapshotBatch, precision_of
from cortado.particles.state import State, padded, to_device
from cortado.scene.motions import AXES, position_name, turn_name


@dataclass(frozen=True, eq=False)
class StepEnd:
    """The states of all scenes after an environment step."""

    state: State
    """Fields of all particles (scenes * n,)."""
    goal: NDArray
    """Goals (scenes, g)."""
    step: NDArray
    """Number of the step in the episode of each scene (scenes,), counted from 1."""
    domain: Domain = WITHOUT_PERIODS

    @property
    def scenes(self) -> int:
        return len(self.step)

    @property
    def per(self) -> int:
        return len(self.state.positions) // self.scenes

    @property
    def period(self) -> dict[str, Any]:
        _, period, frequency = self.domain.vectors(precision_of(self.state).vector)
        return {"period": period, "frequency": frequency}


class Term(Protocol):
    """Protocol of a reward term. A term computes a number for each scene, and the derivative of the number."""

    def values(self, at: StepEnd) -> NDArray:
        """Return the value of the term for each scene (scenes,)."""

    def adjoint(self, at: StepEnd, factor: NDArray, bar: State) -> None:
        """Add ``factor`` (scenes,) times the derivative of the term to ``bar``, which is the adjoint of the states."""


Boxes = Callable[[NDArray], tuple[NDArray, NDArray]]
"""A function that maps goals (scenes, g) to lower and upper corners of boxes (scenes, boxes, d) [m]."""


@dataclass(frozen=True)
class OneBox:
    """A function that returns the same box [m] for every goal."""

    lower: tuple[float, ...]
    upper: tuple[float, ...]

    def __call__(self, goal: NDArray) -> tuple[NDArray, NDArray]:
        lower, upper = (np.tile(corner, (len(goal), 1, 1)) for corner in (self.lower, self.upper))
        return lower, upper


class OverParticles:
    """A reward term that sums the values of a kernel over particles. The adjoint kernel has the suffix ``_adjoint``."""

    kernel: str

    def __init__(self, *given: Any):
        self._given = given
        self._made: dict[Any, Any] = {}

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), self._given

    def values(self, at: StepEnd) -> NDArray:
        value = wp.empty(self._threads(at), dtype=wp.float64, device=at.state.positions.device)
        self._launch(self.kernel, at, value=value)
        count = value.size // at.scenes
        total = self._kept(count, at, lambda: sum_of(wp.float64, count, value.device, at.scenes))
        return total(value.flatten()).numpy() / self._over(at)

    def adjoint(self, at: StepEnd, factor: NDArray, bar: State, **others: wp.array) -> None:
        """Add ``factor`` times the derivative to ``bar``. ``others`` are further outputs of the kernel."""
        scaled = _reals(at, factor / self._over(at))
        self._launch(f"{self.kernel}_adjoint", at, factor=scaled, x_bar=bar.positions, **others)

    def _launch(self, name: str, at: StepEnd, **arguments: Any) -> None:
        x, kernels = at.state.positions, environment_kernels(precision_of(at.state))
        own = {"per": at.per, "x": x, **self._arguments(at)}
        launch(getattr(kernels, name), self._threads(at), x.device, **own, **arguments)

    def _threads(self, at: StepEnd) -> tuple[int, ...]:
        return (at.scenes * at.per,)

    def _over(self, at: StepEnd) -> float:
        return 1.0

    def _arguments(self, at: StepEnd) -> dict[str, Any]:
        raise NotImplementedError

    def _kept(self, key: Any, at: StepEnd, make: Callable[[], Any]) -> Any:
        """Return a cached object for each device, precision and number of scenes."""
        key = key, str(at.state.positions.device), at.state.positions.dtype, at.scenes
        if key not in self._made:
            self._made[key] = make()
        return self._made[key]


class Share(OverParticles):
    """A reward term: the fraction of the fluid in boxes. The fraction is the mean of 1 / (1 + e^2 / w^2) over
    particles, with the distance e from the nearest box and the ``width`` w."""

    kernel = "share"

    def __init__(self, boxes: Boxes, width: float, solid: str | None = None):
        """``width`` [m] is the width of the transition. The boxes move with ``solid``, which turns only about z."""
        super().__init__(boxes, width, solid)
        self._boxes, self._width, self._solid = boxes, width, solid

    def adjoint(self, at: StepEnd, factor: NDArray, bar: State, **others: wp.array) -> None:
        x = at.state.positions
        place_bar, turn_bar = wp.empty_like(x), wp.empty(len(x), dtype=precision_of(at.state).real, device=x.device)
        super().adjoint(at, factor, bar, place_bar=place_bar, turn_bar=turn_bar)
        if self._solid is not None:
            place, turn = (sum_of(bars.dtype, at.per, x.device, at.scenes)(bars) for bars in (place_bar, turn_bar))
            add(place, bar[position_name(self._solid)])
            of_turn = bar[turn_name(self._solid)]
            if of_turn.dtype is turn.dtype:
                add(turn, of_turn)
            else:
                _add(bar, turn_name(self._solid), turn.numpy()[:, None] * [0.0, 0.0, 1.0])

    def _over(self, at: StepEnd) -> float:
        return at.per

    def _arguments(self, at: StepEnd) -> dict[str, Any]:
        lower, upper = (_vectors(at, corners) for corners in self._boxes(at.goal))
        if self._solid is None:
            place, turn = _vectors(at, np.zeros((at.scenes, 3))), _reals(at, np.zeros(at.scenes))
        else:
            place, turn = at.state[position_name(self._solid)], at.state[turn_name(self._solid)]
            if turn.dtype is not precision_of(at.state).real:  # in 3-D
                turns = turn.numpy()
                if turns[:, :2].any():
                    found = f"{self._solid} is turned by {shown(turns[0].tolist())}"
                    raise InputError(f"{found}, but must turn about z alone.")
                turn = _reals(at, turns[:, 2])
        return {"width": self._width, "lower": lower, "upper": upper, **at.period, "place": place, "turn": turn}


class Spread(OverParticles):
    """A reward term: the mean distance ``|dx| + |dy|`` of pairs of chosen particles, divided by the reference distance
    ``everywhere``. Distances are between nearest periodic images."""

    kernel = "apart"

    def __init__(self, chosen: NDArray, everywhere: float):
        """Set the indices ``chosen`` (m,) of the particles and the length ``everywhere`` [m]."""
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
    """A reward term: the weighted sum of squared distances of particles from the targets of the current step."""

    kernel = "missed"

    def __init__(self, targets: NDArray, weights: NDArray):
        """Set ``targets`` (steps, n, d) [m] and ``weights`` (steps, n). Index 0 belongs to step 1."""
        super().__init__(targets, weights)
        self._targets, self._weights = targets, weights

    def _arguments(self, at: StepEnd) -> dict[str, Any]:
        target, weight = self._kept("targets", at, lambda: (_vectors(at, self._targets), _reals(at, self._weights)))
        steps = np.clip(at.step, 1, len(self._targets)) - 1
        step = wp.array(steps, dtype=wp.int32, device=at.state.positions.device)
        return {"step": step, "target": target, "weight": weight}


@dataclass(frozen=True)
class Miss:
    """A reward term: the absolute difference between the value of another term and the first component of the goal."""

    term: Term

    def values(self, at: StepEnd) -> NDArray:
        return np.abs(self.term.values(at) - at.goal[:, 0])

    def adjoint(self, at: StepEnd, factor: NDArray, bar: State) -> None:
        self.term.adjoint(at, factor * np.sign(self.term.values(at) - at.goal[:, 0]), bar)


@dataclass(frozen=True)
class Distance:
    """A reward term: the distance between the centre of a solid and the goal along the first axis [m]."""

    solid: str

    def values(self, at: StepEnd) -> NDArray:
        return np.abs(_miss(at, self.solid))

    def adjoint(self, at: StepEnd, factor: NDArray, bar: State) -> None:
        _add(bar, position_name(self.solid), factor[:, None] * np.sign(_miss(at, self.solid))[:, None] * [1.0, 0.0])


@dataclass(frozen=True)
class Pose:
    """A reward term of a free body in the plane. The value is (x - x*)^2 / l^2 + 2 (1 - cos angle), with the position x
    and the goal x* along the first axis, the length l, and the angle of the body."""

    solid: str
    length: float

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
        return [(axis, f"{self.solid}.{name}") for axis, name in enumerate(AXES[:2])]


@dataclass(frozen=True)
class Reward:
    """The reward of a step, as a constant plus weighted terms."""

    terms: tuple[tuple[float, Term], ...]
    constant: float = 0.0
    domain: Domain = WITHOUT_PERIODS

    @WARP
    def values(self, at: StepEnd) -> NDArray:
        """Return the reward of each scene (scenes,)."""
        found = np.full(at.scenes, self.constant)
        for weight, term in self.terms:
            found += weight * term.values(at)
        return found

    @WARP
    def adjoint(self, at: StepEnd, factor: float) -> State:
        """Return ``factor`` times the derivative of the reward with respect to the state."""
        bar, each = at.state.like(), np.full(at.scenes, factor)
        for weight, term in self.terms:
            term.adjoint(at, weight * each, bar)
        return bar


@dataclass(frozen=True)
class MinusReward:
    reward: Reward
    goal: NDArray
    step: int

    @property
    def fingerprint(self) -> str:
        return f"{[(weight, type(term).__name__) for weight, term in self.reward.terms]} {self.goal} {self.step}"

    def value(self, end: Snapshot) -> float:
        return -float(self.reward.values(self._at(end))[0])

    def value_and_adjoint(self, end: Snapshot) -> tuple[float, State]:
        return self.value(end), self.reward.adjoint(self._at(end), -1.0)

    def values(self, end: SnapshotBatch) -> NDArray:
        return -self.reward.values(self._at(end))

    def values_and_adjoint(self, end: SnapshotBatch) -> tuple[NDArray, State]:
        return self.values(end), self.reward.adjoint(self._at(end), -1.0)

    def _at(self, end: Any) -> StepEnd:
        scenes = end.state.batch or 1
        goal = np.broadcast_to(self.goal, (scenes, self.goal.shape[1]))
        return StepEnd(end.state, goal, np.full(scenes, self.step), self.reward.domain)


def _miss(at: StepEnd, solid: str) -> NDArray:
    """Return the distance of a solid's nearest periodic image from the goal along the first axis (scenes,) [m]."""
    return apart(_numbers(at.state, position_name(solid))[:, :1] - at.goal[:, :1], at.domain.lengths[:1])[:, 0]


def _reals(at: StepEnd, values: NDArray) -> wp.array:
    return wp.array(values, dtype=precision_of(at.state).real, device=at.state.positions.device)


def _vectors(at: StepEnd, values: NDArray) -> wp.array:
    flat, device = values.reshape(-1, values.shape[-1]), at.state.positions.device
    return to_device(flat, precision_of(at.state), device).reshape(values.shape[:-1])


def _numbers(state: State, name: str) -> NDArray:
    return state[name].numpy().astype(np.float64)


def _add(bar: State, name: str, values: NDArray) -> None:
    field = bar[name]
    add(wp.array(padded(values), dtype=field.dtype, device=field.device), field)
