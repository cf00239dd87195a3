"""Is a gradient right? Reverse mode against forward mode against central differences, along random directions."""

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from cortado.policies import Policy
from cortado.problem import Problem

STEPS = tuple(10.0**-k for k in range(2, 10))
"""Steps of the central differences, in units of a parameter's scale."""
AGREEMENT = 1e-8
"""How near reverse and forward mode must be, relative, in float64; both are exact to round-off."""
PLATEAU = 1e-3
"""Two neighbouring differences this near to each other, relative, are believed; and so near must the adjoint be."""
ROUND_OFF = 1e-13
"""Derivatives along a direction below so much of the loss are taken as 0."""
DIFFERENCE_ROUND_OFF = 0.01
"""Round-off of a central difference of step h is taken as this part of the floor, over h: 1e-15 of the loss."""


@dataclass(frozen=True)
class Comparison:
    """One parameter: the loss's derivative along one direction, three times."""

    parameter: str
    adjoint: float
    tangent: float
    differences: tuple[float, ...]
    """Central differences at `STEPS`."""
    floor: float
    """Derivatives below it are 0 up to round-off."""

    @property
    def disagreement(self) -> float:
        """Relative distance of reverse and forward mode."""
        return self._distance(self.adjoint, self.tangent)

    @property
    def best_difference(self) -> float:
        """Relative distance of the adjoint and the central difference that is nearest to it."""
        return min(self._distance(self.adjoint, difference) for difference in self.differences)

    @property
    def plateau(self) -> float | None:
        """The central difference where two neighbouring steps agree best; None where none agree (chaos, round-off)."""
        number = self._plateau
        return None if number is None else self.differences[number]

    @property
    def right(self) -> bool:
        """Whether nothing speaks against the adjoint: neither forward mode nor a difference that is to be believed,
        to `PLATEAU` or its own round-off."""
        number = self._plateau
        if number is None or not self.disagreement < AGREEMENT:
            return bool(self.disagreement < AGREEMENT)
        believed, round_off = self.differences[number], DIFFERENCE_ROUND_OFF * self.floor / STEPS[number]
        return bool(self._distance(self.adjoint, believed) < PLATEAU or abs(self.adjoint - believed) < round_off)

    @property
    def _plateau(self) -> int | None:
        distances = [self._distance(a, b) for a, b in zip(self.differences, self.differences[1:], strict=False)]
        number = int(np.argmin(distances))
        return number if distances[number] < PLATEAU else None

    def _distance(self, a: float, b: float) -> float:
        """Relative; 0 where both numbers are below the floor."""
        if not (np.isfinite(a) and np.isfinite(b)):
            return float("inf")
        size = max(abs(a), abs(b))
        return abs(a - b) / size if size > self.floor else 0.0


@dataclass(frozen=True)
class Certificate:
    """The comparisons of one problem."""

    steps: int
    particles: int
    loss: float
    comparisons: tuple[Comparison, ...]

    @property
    def right(self) -> bool:
        """Whether every adjoint is right."""
        return all(comparison.right for comparison in self.comparisons)

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        rows = [
            {
                **asdict(c),
                "disagreement": c.disagreement,
                "best_difference": c.best_difference,
                "right": c.right,
            }
            for c in self.comparisons
        ]
        return {**asdict(self), "difference_steps": STEPS, "comparisons": rows, "right": self.right}


def certify(problem: Problem, seed: int = 0, policy: Policy | None = None) -> Certificate:
    """Compare the derivatives of a problem's loss with respect to every parameter, at the scene's own values.

    A viscosity of 0 is taken as 0.01 Pa s, so that there is something to compare.

    Each parameter is moved along a random direction of the size of its scale: gravity by a tenth of its size,
    positions by a tenth of a spacing, velocities by 0.1 m / s, numbers by a tenth of their value.
    """
    random = np.random.default_rng(seed)
    compared = []
    loss = 0.0
    for name, point, scale in _points(problem):
        direction = scale * random.standard_normal(point.shape) if point.ndim else np.asarray(scale)
        parameter = name.removesuffix(" over time")
        loss, gradient = problem.value_and_gradient({parameter: point}, policy)
        tangent = problem.tangent({parameter: point}, {parameter: direction})
        differences = tuple(
            (problem.value({parameter: point + h * direction}) - problem.value({parameter: point - h * direction}))
            / (2.0 * h)
            for h in STEPS
        )
        compared.append(
            Comparison(
                name, float((gradient[parameter] * direction).sum()), tangent, differences, ROUND_OFF * abs(loss)
            )
        )
    return Certificate(problem.steps, problem.simulation.particles, loss, tuple(compared))


def _points(problem: Problem) -> list[tuple[str, np.ndarray, Any]]:
    values = problem.simulation.parameters()
    gravity = values["gravity"]
    size = float(np.linalg.norm(gravity)) or 1.0
    viscosity = np.where(values["viscosity"] > 0.0, values["viscosity"], 0.01)
    points = [
        ("gravity", gravity, 0.1 * size),
        *([("gravity over time", np.tile(gravity, (problem.steps, 1)), 0.1 * size)] if problem.steps > 0 else []),
        ("initial_positions", values["initial_positions"], 0.1 * problem.simulation.scene.discretisation.spacing),
        ("initial_velocities", values["initial_velocities"], 0.1),
        ("viscosity", viscosity, 0.1 * viscosity),
    ]
    relative = ["rest_density", "time_step"]
    if len(problem.simulation.scene.phase) > 1:
        points.append(("mass_fractions", values["mass_fractions"], 0.01))
        relative += ["mobility", "interface_width"] if values["mobility"] > 0.0 else []
    return points + [(name, values[name], 0.1 * values[name]) for name in relative]
