"""What PCISPH notes of every step: iterations and density errors."""

import numpy as np
import warp as wp
from numpy.typing import NDArray

from cortado.device.precision import Precision
from cortado.solvers.pcisph.parts import PressureSolve
from cortado.solvers.solver import Counts


class IterationLog:
    """See `StepLog`."""

    def __init__(self, steps: int, solve: PressureSolve | None, precision: Precision, device: object):
        self.iterations = wp.zeros(max(steps, 1), dtype=wp.int32, device=device)
        """(steps,) on the device."""
        self.errors = wp.zeros(max(steps, 1), dtype=precision.pair, device=device)
        """(steps,) average and greatest compression, on the device."""
        self._solve = solve
        self.diagnostics = self._named(np.zeros(0, dtype=int), np.zeros((0, 2)))

    def read(self, steps: int) -> None:
        iterations, errors = self.iterations.numpy()[:steps], self.errors.numpy()[:steps]
        self.diagnostics = self._named(iterations.astype(int), errors.astype(np.float64))

    def _named(self, iterations: NDArray, errors: NDArray) -> dict[str, NDArray]:
        average, greatest = errors.T
        return {
            "iterations": iterations,
            "density_errors": average,
            "greatest_density_errors": greatest,
            "converged": self._converged(average, greatest),
        }

    def counts(self, step: int) -> Counts:
        return (int(self.diagnostics["iterations"][step]),)

    def _converged(self, average: NDArray, greatest: NDArray) -> NDArray:
        """(steps,) whether the errors came below the tolerances; always, with a fixed number of iterations."""
        solve = self._solve
        if solve is None or solve.minimum_iterations == solve.maximum_iterations:
            return np.ones(len(average), dtype=bool)
        return (average <= solve.tolerance) & (greatest <= solve.greatest_tolerance)
