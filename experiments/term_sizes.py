"""The size of each term of the pressure force's derivative in one step, along the exact tangent."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from cortado.reference import Simulation, Terms
from cortado.scene.scene import Scene


def term_sizes(scene: Scene, steps: int, precision: str, cases: Mapping[str, Terms]) -> dict[str, NDArray[np.float64]]:
    """For each choice of terms, norms (steps,) over all particles of the derivative of the pressure acceleration.

    The derivative is along the exact tangent with respect to the size of gravity.
    """
    engine = Simulation(scene, precision)
    gravity = np.array(scene.forces.gravity)
    at, along = {"gravity": gravity}, {"gravity": gravity / np.linalg.norm(gravity)}
    exact = engine.tangent(at, along, steps)
    assert exact.position_tangents is not None and exact.velocity_tangents is not None
    found = {name: np.zeros(steps) for name in cases}
    for k in range(steps):
        states = {"initial_positions": exact.positions[k], "initial_velocities": exact.velocities[k]}
        dots = {"initial_positions": exact.position_tangents[k], "initial_velocities": exact.velocity_tangents[k]}

        def velocity(terms: Terms, states: dict = states, dots: dict = dots) -> NDArray[np.float64]:
            history = engine.tangent({**at, **states}, {**along, **dots}, 1, terms=terms)
            assert history.velocity_tangents is not None
            return np.asarray(history.velocity_tangents[-1])

        without = velocity(Terms(pressure=False))
        for name, terms in cases.items():
            found[name][k] = np.linalg.norm(velocity(terms) - without) / scene.solver.time_step
    return found
