"""How near a search came to what its task asks for."""

import math
from dataclasses import dataclass

import numpy as np

from cortado.cli.commands.found import distance
from cortado.optimisation.inverse.task import Task
from cortado.optimisation.result import Result

MOST_ERROR = 0.3
"""Of a parameter, relative, up to which it counts as found."""


@dataclass(frozen=True)
class Verdict:
    """How near an optimisation came to what the task asks for."""

    first: float
    """Loss of the start."""
    reduction: float
    """Loss of the start / best loss; infinite where the best is 0."""
    errors: dict[str, float]
    """By parameter: distance (L2) of the estimate from the true value, relative to its size unless that is 0."""
    psnr: float | None
    """Of the last image [dB]; None where positions are compared."""
    failures: list[str]
    """Sentences about what was not reached."""


def judge(
    task: Task,
    result: Result,
    estimate: dict[str, np.ndarray] | None = None,
    noise: float | None = None,
    first: float | None = None,
) -> Verdict:
    """Hold a result against the task's [optimise.check].

    ``estimate``: its parameters, where the result has coordinates; ``noise``: the peak signal-to-noise ratio that was
    reached [dB]; ``first``: the loss of the start, where the history begins with another loss.
    """
    check, estimate = task.optimise.check, result.parameters if estimate is None else estimate
    first = result.history[0].loss if first is None else first
    reduction = first / result.loss if result.loss > 0.0 else math.inf
    true = task.true_parameters
    errors = {name: distance(value, true[name]) for name, value in estimate.items() if name in true}
    failures = []
    if reduction < check.loss_reduction:
        failures.append(f"The loss fell {reduction:.3g} times, but the task asks for {check.loss_reduction:g} times.")
    if noise is not None and noise < check.psnr:
        failures.append(f"The image is matched to {noise:.3g} dB, but the task asks for {check.psnr:g} dB.")
    failures += [
        f"The parameter {name} is {100 * error:.3g}% off, but the task asks for {100 * check.parameter_error:.3g}%."
        for name, error in errors.items()
        if error > check.parameter_error
    ]
    return Verdict(first, reduction, errors, noise, failures)


def found_in_words(error: float) -> str:
    """How well a parameter is found, by its distance from the true value relative to it."""
    if error > MOST_ERROR:
        why = "the search is too short, it ended in a wrong valley of the loss, or other values do as well"
        return f"not found, {100 * error:.3g}% off: {why}"
    return f"found with an error of {100 * error:.2g}%"
