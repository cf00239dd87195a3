"""Whether first positions that are given as a parameter can be those of a fluid, as points of a file are judged."""

import numpy as np
from numpy.typing import NDArray

from cortado.discretise.pairs import check_apart, check_crowding, nearest
from cortado.rollout.scene_parameters import Simulated
from cortado.scene.checks import NEAREST
from cortado.scene.parameter_values import Arrays

MOVED = 0.05
"""In spacings: positions that have moved by less along every axis since they were judged are not judged again. A
search, an ensemble or a check by differences moves them so little from one run to the next that it costs nothing."""


class FirstPositions:
    """Judges the first positions of the scenes of a batch, run after run."""

    def __init__(self, simulation: Simulated):
        self._simulation, self._warned = simulation, False
        self._judged: dict[int, NDArray] = {}
        """(n, d) [m], those of each scene that were judged last; at first they are the scene's own."""

    def check(self, values: Arrays, member: int) -> str | None:
        """What to warn of, once, where the positions among the values of a scene are crowded, None if there is nothing.
        Raises `InputError` where two particles are at one place, or where they would burst."""
        simulation = self._simulation
        positions = values.get("initial_positions", simulation.positions)
        spacing = simulation.scene.discretisation.spacing
        former = self._judged.get(member, simulation.positions)
        if np.abs(positions - former).max(initial=0.0) < MOVED * spacing:
            return None
        found = self._found(positions, spacing)
        self._judged[member] = positions.copy()
        if found is None or self._warned:
            return None
        self._warned = True
        return found

    def _found(self, positions: NDArray, spacing: float) -> str | None:
        simulation, lattice = self._simulation, self._simulation.lattice
        period = simulation.scene.container.periods(simulation.dimension)
        check_apart("parameter initial_positions", positions, spacing, period)
        free = positions[: simulation.free_particles]
        if len(free) < 2 or not simulation.scene.forces.pressure:
            return None
        of_lattice = simulation.smoothing, lattice.support, lattice.volume, spacing
        found = check_crowding("particles at initial_positions", free, *of_lattice, period)
        least = nearest(free).min() / spacing
        if found is None and least < NEAREST:
            wanted = f"at least {NEAREST:g} of them"
            found = f"particles at initial_positions are only {least:.2g} spacings apart, which should be {wanted}."
        return found
