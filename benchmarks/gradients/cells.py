"""One cell of the leaderboard: what it is, and how it is computed."""

import time
import warnings
from dataclasses import asdict, dataclass, fields
from functools import lru_cache
from typing import Any

import numpy as np

from cortado import CortadoError, CortadoWarning, Problem, Simulation
from cortado.losses import FinalPositions
from cortado.optimisation.transforms import Transformed

from ..counting import Counted, Steps
from .controls import CONTROLS
from .estimators import ESTIMATORS
from .losses import LOSSES
from .scenes import scene
from .truth import directions, smoothed

HORIZONS = (100, 200, 400, 800, 1200, 2000)
"""In steps."""
TRUTH = "truth"
"""What stands for an estimator in the cell of the true gradient, with which the estimators' cells are compared."""
Record = dict[str, Any]


@dataclass(frozen=True)
class Cell:
    """An estimator, or the truth, at one point of one problem."""

    scene: str
    control: str
    loss: str
    horizon: int
    seed: int
    """Of the place and of the hidden run that the loss has for its target."""
    estimator: str

    @property
    def question(self) -> "Cell":
        """The cell of the truth about it."""
        return Cell(**{**asdict(self), "estimator": TRUTH})

    @classmethod
    def of(cls, record: Record) -> "Cell":
        """The cell that a record is of."""
        return cls(**{field.name: record[field.name] for field in fields(cls)})


@dataclass(frozen=True)
class Bench:
    """Computes cells on a device, in this process or in a worker's."""

    device: str
    precision: str

    def fits(self, cell: Cell) -> bool:
        """Whether the scene has what the control moves."""
        return CONTROLS[cell.control].fits(self._simulation(cell))

    def __call__(self, cell: Cell) -> Record:
        """The record of a cell: its derivatives along directions, their cost and time [s], or why there are none."""
        started, steps = time.perf_counter(), Steps()
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", CortadoWarning)  # of gradients that are not finite
                found = self._derivatives(cell, steps)
        except CortadoError as error:
            found = {"failed": str(error)}
        seconds = round(time.perf_counter() - started, 3)
        return {**asdict(cell), **found, "cost": steps.cost, "seconds": seconds}

    def posed(self, cell: Cell) -> tuple[Transformed, np.ndarray]:
        """The problem that a cell is about, of coordinates of its control, and the place where it is differentiated."""
        simulation, control = self._simulation(cell), CONTROLS[cell.control]
        random = np.random.default_rng(cell.seed)
        hidden, u = (control.drawn(simulation, cell.horizon, random) for _ in range(2))
        bijector = control.bijector(simulation, cell.horizon)
        end = simulation_end(simulation, cell.horizon, {control.parameter: bijector.parameter(hidden)})
        problem = Problem(simulation, cell.horizon, LOSSES[cell.loss](simulation, end))
        return Transformed(problem, {control.parameter: bijector}), u

    def spread(self, cell: Cell) -> float:
        """That of the control of a cell, in units of its parameter."""
        return CONTROLS[cell.control].spread(self._simulation(cell))

    def _derivatives(self, cell: Cell, steps: Steps) -> Record:
        problem, u = self.posed(cell)
        name, spread = CONTROLS[cell.control].parameter, self.spread(cell)
        counted = Counted(problem, cell.horizon, steps)
        if cell.estimator == TRUTH:
            truth = smoothed(counted, name, u, spread, seed=2 * cell.seed)
            return {
                "derivatives": finite(truth.derivatives),
                "standard_errors": finite(truth.standard_errors),
                "numbers": u.size,
            }
        estimator = ESTIMATORS[cell.estimator](spread, 2 * cell.seed + 1)
        gradient = estimator.estimate(counted, {name: u}).gradient[name].ravel()
        with np.errstate(all="ignore"):
            return {"derivatives": finite(directions(u.size, 2 * cell.seed) @ gradient)}

    def _simulation(self, cell: Cell) -> Simulation:
        return simulation_of(cell.scene, self.device, self.precision)


@lru_cache(maxsize=4)
def simulation_of(name: str, device: str, precision: str) -> Simulation:
    """The simulation of a scene; the last few are kept, as one cell after the other asks for the same."""
    return Simulation(scene(name), device, precision)


def simulation_end(simulation: Simulation, steps: int, values: dict[str, np.ndarray]) -> Any:
    """The last state of a run under these parameters."""
    return Problem(simulation, steps, FinalPositions(simulation.positions)).end(values)


def finite(numbers: np.ndarray) -> list[float] | None:
    """The numbers for a file, or nothing where one of them is not finite."""
    return [float(one) for one in numbers] if np.isfinite(numbers).all() else None
