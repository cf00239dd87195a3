"""Ensembles: runs from slightly different first states, each of which gives one sample of a measurement."""

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cortado.files.terminal import Advance
from cortado.reference import Simulation

CORES = 2
"""How many runs are computed at the same time; the engine releases Python's lock meanwhile."""


def perturbed(simulation: Simulation, seed: int, perturbation: float) -> NDArray[np.float64]:
    """First positions (n, d) [m], each coordinate of the scene's moved at random by at most ``perturbation`` spacings.

    A perturbation also breaks symmetries of the scene, which otherwise only round-off would break.
    """
    offsets = np.random.default_rng(seed).uniform(-1.0, 1.0, simulation.positions.shape)
    return simulation.positions + perturbation * simulation.scene.discretisation.spacing * offsets


def side_by_side(tasks: Iterable[Callable[[], Any]], advance: Advance) -> list[Any]:
    """The results of tasks that are computed at the same time, in the order of the tasks."""
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
