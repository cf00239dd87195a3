"""Where the study's runs start: first states a little apart, of which each gives one sample of a measurement."""

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cortado.io.progress import Advance
from cortado.reference import Simulation

CORES = 2
"""How many runs go on side by side; the engine leaves Python while it computes."""


def perturbed(simulation: Simulation, seed: int, perturbation: float) -> NDArray[np.float64]:
    """First positions (n, d) [m], each coordinate moved by at most so many spacings; the scene's own without any.

    Also for another reason: the scene's own first state may have a symmetry, which only round-off breaks.
    """
    offsets = np.random.default_rng(seed).uniform(-1.0, 1.0, simulation.positions.shape)
    return simulation.positions + perturbation * simulation.scene.discretisation.spacing * offsets


def side_by_side(tasks: Iterable[Callable[[], Any]], advance: Advance) -> list[Any]:
    """The results of tasks, in their order."""
    with ThreadPoolExecutor(CORES) as pool:
        pending = [pool.submit(task) for task in tasks]
        results = []
        try:
            for one in pending:
                results.append(one.result())
                advance()
        finally:
            for one in pending:
                one.cancel()
    return results
