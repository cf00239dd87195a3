"""Paths of tracers that swim with the fluid."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from scipy.sparse import csr_array
from scipy.spatial import cKDTree

from cortado.arrays import as_numbers
from cortado.discretise.pairs import wrapped
from cortado.errors import InputError
from cortado.fixed import fixed
from cortado.losses import Snapshot
from cortado.optimisation.fitting.observation import Direction, Measurement, clock_of, only_a_clock
from cortado.runs.sensors.sensor import Weights
from cortado.simulation import Simulation


@fixed
class Tracks:
    """Where tracers are over time. A tracer moves as the particles around its first place do:

    X(t) = X(0) + sum_i w_i (x_i(t) - x_i(0)),

    with the weights of Wendland (1995) at the start, which add up to 1 within the support radius. Along a periodic axis
    images of particles count like themselves at the start, and paths go on beyond the end of the period: a tracer that
    has gone around once is a period further.
    """

    unit = "m"

    def __init__(
        self,
        simulation: Simulation,
        first: Any,
        times: Any,
        positions: Any,
        noise: float | None = None,
        calibrate: Sequence[str] = (),
        clock: float = 0.0,
    ):
        """``first`` (tracers, d) places at the start of the run [m]; ``times`` (frames,) [s] after it; ``positions``
        (frames, tracers, d) [m], NaN where a tracer was not seen; ``noise``, standard deviation of a coordinate [m], if
        it is known; ``clock`` [s], what is added to the times, which ``calibrate=["start"]`` searches. Raises
        `InputError` for a tracer that has no fluid around it."""
        only_a_clock(calibrate)
        begun, places = as_numbers("first", first), as_numbers("positions", positions)
        tracers, d = begun.shape if begun.ndim == 2 else (0, 0)
        if not tracers or d != simulation.dimension:
            raise InputError(f"first has shape {begun.shape}, but must be (tracers, {simulation.dimension}).")
        if places.shape[1:] != begun.shape:
            raise InputError(f"positions has shape {places.shape}, but must be (frames, {tracers}, {d}).")
        self.start = clock_of(calibrate, clock)
        own = Measurement.of(times, places.reshape(len(places), -1), noise, clock)
        self.times, self.measured, self.noise = own.times, own.measured, own.noise
        x, domain = simulation.positions, simulation.lattice.domain
        support, period = simulation.scene.discretisation.support_radius, np.array(domain.lengths)
        some, others = (
            cKDTree(wrapped(points - np.array(domain.lower), period), boxsize=period if period.any() else None)
            for points in (begun, x)
        )
        near = some.sparse_distance_matrix(others, support, output_type="coo_matrix")
        w = csr_array((Weights.of(near.data / support).values, (near.row, near.col)), shape=(tracers, len(x)))
        sums = np.asarray(w.sum(axis=1)).ravel()
        if not (sums > 0.0).all():
            lost = int(np.argmin(sums > 0.0))
            raise InputError(f"first[{lost}] is {begun[lost].tolist()}, but must be within {support:g} m of fluid.")
        self._weights = csr_array(w / sums[:, None])
        self._offset = begun - self._weights @ x

    def value(self, at: Snapshot, own: Mapping[str, np.ndarray]) -> np.ndarray:
        return (self._offset + self._weights @ at.positions).ravel()

    def tangents(self, at: Snapshot, own: Mapping[str, np.ndarray], along: Sequence[Direction]) -> np.ndarray:
        return np.stack([(self._weights @ one.fields["positions"]).ravel() for one in along], axis=1)
