"""The result of an optimisation: its best parameters, and every evaluation on the way."""

import re
from dataclasses import dataclass, field
from typing import Any

from cortado.on_top import on_top
from cortado.words import counted, sized

Parameters = dict[str, Any]
# by name: a float where the user gave a number, otherwise a float64 array of the shape that the user gave


@dataclass(frozen=True, eq=False)
class Record:
    """One evaluation in the history of an optimisation."""

    iteration: int
    """Index of the evaluation, from 0; with Adam and gradient descent also the number of updates before it."""
    updates: int
    """Made before it; fewer than the evaluations before it where a line search evaluates several times an update."""
    loss: float
    gradient_norm: float
    """Euclidean, over all the parameters."""
    parameters: Parameters
    """At which the loss was evaluated."""
    replayed: bool
    """Whether it was read from the checkpoint."""
    refused: int = 0
    """Evaluations before it of which there is no run, as it diverged or a parameter was out of its range, so that the
    steps to them were refused."""
    left_out: int = 0
    """Runs that averages over ensembles have left out so far, for the same reasons; replayed ones are not known."""

    def __repr__(self) -> str:
        return f"Record(iteration {self.iteration}: loss {self.loss:.6g}, gradient norm {self.gradient_norm:.4g})"


@dataclass(frozen=True, eq=False)
class Result:
    """The best parameters of an optimisation, with its history."""

    parameters: Parameters
    """With the lowest loss seen."""
    loss: float
    """The lowest seen."""
    last_parameters: Parameters
    """The optimiser's last iterate."""
    history: tuple[Record, ...]
    """One per evaluation, in order."""
    updates: int
    """That the optimiser made, with those replayed from the checkpoint."""
    evaluations: int
    """How many there are in the history, with those replayed from the checkpoint."""
    message: str
    """How it ended, a sentence."""
    converged: bool
    """Whether the optimiser's own test was met, and the gradient agreed with what steps did; only L-BFGS has a test."""
    refused: int = 0
    """Evaluations of which there is no run, as it diverged or a parameter was out of its range, so that the steps to
    them were refused; they are not in the history."""
    left_out: int = 0
    """Runs that averages over ensembles left out, for the same reasons; of those that were not replayed."""
    misled: bool = False
    """Whether the gradient disagreed with what steps did, as beyond the horizon of `cortado.certify`, by which the
    search cannot be trusted; `message` says what to try."""
    stays: bool = False
    """Whether the loss stayed at a good part of the first one, as in a wrong valley."""
    problem: Any = field(default=None, repr=False)
    """The `Problem` that was solved, or one in other coordinates, whose runs a notebook shows; None for other problems,
    and in a result that was pickled."""

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "problem": None}

    def __repr__(self) -> str:
        found = f"loss {self.loss:.6g} after {counted(self.evaluations, 'evaluation')}"
        end = re.split("[,:;.]", self.message)[0]
        return f"Result({sized(self.parameters)}: {found}; {end})"

    def _repr_html_(self) -> str:
        """With the ends of runs, first and found, beside the target; the parameters; the losses of all evaluations."""
        losses, start = [record.loss for record in self.history], self.history[0].parameters
        page: str = on_top("result_page")(self, self.message, self.problem, start, self.parameters, losses)
        return page
