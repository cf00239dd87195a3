"""What an optimisation leaves: its best parameters, and every evaluation on the way."""

from dataclasses import dataclass
from typing import Any

Parameters = dict[str, Any]
# by name: a float where the user gave a number, otherwise a float64 array of the shape that the user gave


@dataclass(frozen=True, eq=False)
class Record:
    """One evaluation in the history of an optimisation."""

    iteration: int
    # index of the evaluation, from 0; with Adam and gradient descent also the number of updates before it
    loss: float
    gradient_norm: float
    # Euclidean, over all the parameters
    parameters: Parameters
    # at which the loss was evaluated
    replayed: bool
    # whether it was read from the checkpoint


@dataclass(frozen=True, eq=False)
class Result:
    """What an optimisation found."""

    parameters: Parameters
    # with the lowest loss seen
    loss: float
    # the lowest seen
    last_parameters: Parameters
    # the optimiser's last iterate
    history: tuple[Record, ...]
    # one per evaluation, in order
    evaluations: int
    # how many the optimiser asked for, with those replayed from the checkpoint
    message: str
    # how it ended, a sentence
    converged: bool
    # whether the optimiser's own test was met; Adam and gradient descent have none
