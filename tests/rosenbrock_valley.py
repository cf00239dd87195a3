"""A problem of two numbers whose minimum is known, and a search for it."""

import numpy as np

from cortado.optimisation.optimise import Result, optimise


class Interrupted(Exception):
    """Stands for whatever ends a process."""


class Rosenbrock:
    """(1 - a)^2 + 100 (b - a^2)^2 of two scalars, with its minimum 0 at (1, 1); counts its evaluations."""

    def __init__(self, fail_at: int = -1) -> None:
        self.evaluations = 0
        self.fail_at = fail_at

    def value_and_gradient(self, parameters, gradient=None):
        if self.evaluations == self.fail_at:
            raise Interrupted
        self.evaluations += 1
        a, b = float(parameters["a"]), float(parameters["b"])
        loss = (1.0 - a) ** 2 + 100.0 * (b - a**2) ** 2
        slope_a = -2.0 * (1.0 - a) - 400.0 * a * (b - a**2)
        return loss, {"a": np.asarray(slope_a), "b": np.asarray(200.0 * (b - a**2))}


def rosenbrock(optimiser, iterations=30, problem=None, **options) -> Result:
    return optimise(problem or Rosenbrock(), {"a": -1.2, "b": 1.0}, optimiser, iterations, **options)
