"""Observations of an experiment and their predictions: videos, sensor series, and tracks of tracers."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from scipy.sparse import csr_array
from scipy.spatial import cKDTree

from cortado.arrays import as_numbers, as_one_number, read_only, require_methods
from cortado.calls import fixed
from cortado.device.threads import WARP
from cortado.discretise.shapes import wrapped
from cortado.errors import InputError, shown
from cortado.losses import Snapshot
from cortado.render import Renderer
from cortado.render.cameras import Calibration
from cortado.runs.particle_sums import weights_of
from cortado.runs.sensor import Sensor, checked_sensor, value_of
from cortado.scene.parameter_values import Arrays
from cortado.simulation import Simulation

CLOCK = "start"
"""Name of the parameter that shifts the times of an observation's frames."""
LEAST_FRAMES = 4


@dataclass(frozen=True)
class Direction:
    """A direction for the derivative of an observation's prediction."""

    fields: Arrays
    """Tangents of the state's fields by name, such as positions (n, d) and mass fractions (n, phases)."""
    parameters: Mapping[str, np.ndarray]
    """Components of the direction for the simulation's parameters, by name."""
    own: Mapping[str, np.ndarray]
    """Components of the direction for the observation's parameters, by name."""
    quantities: Callable[[Iterable[str]], Arrays]
    """Function that returns the tangents of particle quantities with the given names."""


class Observation(Protocol):
    """Protocol of an observation: numbers measured at several times (frames), and the prediction of these numbers."""

    times: np.ndarray
    """Increasing times (frames,) [s] after the start of the run."""
    measured: np.ndarray
    """Measured numbers (frames, m). NaN values are ignored."""
    noise: float | None
    """Standard deviation of a measured number, or None to estimate it from the residuals."""
    unit: str
    """Unit of the measured numbers."""

    @property
    def start(self) -> Mapping[str, np.ndarray]:
        """Return the initial values of the observation's parameters, such as the position of a camera. The value of the
        parameter "start" [s] is added to the times of the frames."""

    def value(self, at: Snapshot, own: Mapping[str, np.ndarray]) -> np.ndarray:
        """Return the predicted numbers (m,) for a state. ``own`` has the values of the observation's parameters."""

    def tangents(self, at: Snapshot, own: Mapping[str, np.ndarray], along: Sequence[Direction]) -> np.ndarray:
        """Return the derivatives (m, directions) of `value` along the given directions."""


class Again:
    def __init__(self, observation: Observation, measured: np.ndarray):
        _, values, _ = checked(observation.times, measured, observation.noise)
        if values.shape != observation.measured.shape:
            raise InputError(f"measured has shape {values.shape}, but must be {observation.measured.shape}.")
        self._observation, self.measured = observation, values

    def __getattr__(self, name: str) -> Any:
        if name == "_observation":  # while it is unpickled
            raise AttributeError(name)
        return getattr(self._observation, name)


@dataclass(frozen=True)
class Frames:
    """Frames of an observation, interpolated linearly between states of a run."""

    steps: np.ndarray
    """Number of steps before each frame (frames,)."""
    shares: np.ndarray
    """Weight (frames,) of the later state in the interpolation, from 0 to 1."""

    @classmethod
    def of(cls, times: np.ndarray, time_step: float, steps: int) -> "Frames":
        places = times / time_step
        if places[-1] > steps + 1e-6:
            said = f"times go up to {times[-1]:g} s"
            raise InputError(f"{said}, but the run ends after {steps} steps of {time_step:g} s: give more steps.")
        whole = np.minimum(np.floor(places + 1e-6).astype(int), steps)
        shares = np.clip(places - whole, 0.0, 1.0)
        return cls(whole, np.where(shares < 1e-6, 0.0, shares))

    @property
    def needed(self) -> set[int]:
        return {int(k) for k in self.steps} | {int(k) + 1 for k in self.steps[self.shares > 0.0]}

    @property
    def around(self) -> set[int]:
        return {int(k) + more for k in self.steps for more in (0, 1)}

    def rates(self, read: Mapping[int, np.ndarray], time_step: float) -> np.ndarray:
        """Return time derivatives of readings (frames, ...), per second. ``read`` has readings by step number."""
        return np.array([(read[int(k) + 1] - read[int(k)]) / time_step for k in self.steps])

    def between(self, read: Mapping[int, np.ndarray]) -> np.ndarray:
        """Return readings interpolated to the frames (frames, ...). ``read`` has readings by step number."""
        last = max(read)
        after = [read[min(int(k) + int(share > 0.0), last)] for k, share in zip(self.steps, self.shares, strict=True)]
        before = np.array([read[int(k)] for k in self.steps])
        shares = self.shares.reshape(-1, *[1] * (before.ndim - 1))
        return (1.0 - shares) * before + shares * np.array(after)


def clock_of(calibrate: Sequence[str], start: float, alone: bool = True) -> dict[str, np.ndarray]:
    """Return the parameter "start" if ``calibrate`` contains "start". If ``alone`` is true, other names are refused."""
    for name in calibrate if alone else ():
        if name != CLOCK:
            raise InputError(f'calibrate has {shown(name)}, but must be empty or ["{CLOCK}"].')
    return {CLOCK: np.array(as_one_number("clock", start))} if CLOCK in calibrate else {}


def checked(times: Any, measured: Any, noise: Any, clock: Any = 0.0) -> tuple[np.ndarray, np.ndarray, float | None]:
    """Check and return the times plus ``clock`` [s], the measured values, and the noise of an observation."""
    late = as_one_number("clock", clock)
    if not np.isfinite(late):
        raise InputError(f"clock is {late:g}, but must be a finite number of seconds.")
    moments = read_only("times", as_numbers("times", times) + late)
    values = read_only("measured", measured)
    if moments.ndim != 1 or len(moments) < LEAST_FRAMES:
        found = f"has {len(moments)}" if moments.ndim == 1 else f"has shape {moments.shape}"
        said = f"times {found}, but must be a list of at least {LEAST_FRAMES} rising numbers"
        raise InputError(f"{said}, as error bars are computed from several frames.")
    if (falls := np.flatnonzero(np.diff(moments) <= 0.0)).size:
        before, after = moments[falls[0] : falls[0] + 2]
        raise InputError(f"times has {after:g} s after {before:g} s, but must rise from frame to frame.")
    if not np.isfinite(moments).all() or moments[0] < 0.0:
        raise InputError(f"times begin with {moments[0]:g} s, but must be finite and at least 0.")
    if values.ndim != 2 or len(values) != len(moments):
        raise InputError(f"measured has shape {values.shape}, but must have {len(moments)} rows, one for each time.")
    if np.isinf(values).any() or np.isnan(values).all():
        raise InputError("measured must be finite, or NaN for numbers to ignore, but not all NaN.")
    if noise is not None and not 0.0 < as_one_number("noise", noise) < np.inf:
        raise InputError(f"noise is {shown(noise)}, but must be greater than 0.")
    return moments, values, None if noise is None else float(noise)


@fixed
class Video:
    """A video as an observation of a fit. The frames of the video are compared with pictures of the simulation.

    Example: ``video = cortado.measured.Video(simulation.renderer(resolution=(64, 64)), times, frames)``
    """

    unit = "of light"

    def __init__(
        self,
        renderer: Renderer,
        times: Any,
        frames: Any,
        mask: Any = None,
        noise: float | None = None,
        calibrate: tuple[str, ...] | list[str] = (),
        clock: float = 0.0,
    ):
        """Store a video.

        Args:
            renderer: from `Simulation.renderer`, with the camera's measured position.
            times: (frames,) [s] after the start of the run.
            frames: (frames, rows, columns, 3), linear light from 0 to 1; see `cortado.pictures.read_picture`.
            mask: (rows, columns), true for pixels to use.
            noise: standard deviation of the light in a pixel, if known.
            calibrate: additional parameters to fit: "translation", "rotation", "field_of_view" or "width",
                "extinction", and "start" for the clock.
            clock: [s], added to the times.
        """
        require_methods("renderer", renderer, ("render", "tangent", "seen_by"), "a renderer such as of a Simulation")
        pictures = as_numbers("frames", frames)
        if pictures.shape[1:] != renderer.shape:
            raise InputError(f"frames has shape {pictures.shape}, but must be (frames, *{renderer.shape}).")
        rows, columns, _ = renderer.shape
        inside = np.ones((rows, columns), dtype=bool) if mask is None else np.asarray(mask, dtype=bool)
        if inside.shape != (rows, columns) or not inside.any():
            raise InputError(f"mask has shape {inside.shape}, but must have {(rows, columns)} and a true pixel.")
        self.renderer, self.mask = renderer, inside
        seen = pictures[:, inside].reshape(len(pictures), -1)
        self.times, self.measured, self.noise = checked(times, seen, noise, clock)
        self.calibration = Calibration(renderer.view, tuple(name for name in calibrate if name != CLOCK))
        self._clock = clock_of(calibrate, clock, alone=False)
        self._seen: dict[str, tuple[bytes, Renderer]] = {}

    @property
    def start(self) -> Mapping[str, np.ndarray]:
        return {**self.calibration.start, **self._clock}

    @property
    def unseen(self) -> Mapping[str, np.ndarray]:
        """Return a mask for each camera parameter. A mask is true for components that do not affect the picture."""
        return self.calibration.unseen

    def picture(self, at: Snapshot, own: Mapping[str, np.ndarray]) -> np.ndarray:
        """Return the picture of a state (rows, columns, 3). ``own`` has the values of calibrated parameters."""
        return self._renderer(own).render(at.state.positions, at.state.mass_fractions, at.colours)

    def value(self, at: Snapshot, own: Mapping[str, np.ndarray]) -> np.ndarray:
        return self.picture(at, own)[self.mask].ravel()

    @WARP
    def tangents(self, at: Snapshot, own: Mapping[str, np.ndarray], along: Sequence[Direction]) -> np.ndarray:
        self.picture(at, own)
        renderer, found = self._renderer(own), []
        for one in along:
            given = one.fields["positions"], one.fields["mass_fractions"], one.parameters.get("colours")
            found.append(renderer.tangent(*given, self.calibration.tangent(own, one.own))[self.mask].ravel())
        return np.stack(found, axis=1)

    def _renderer(self, own: Mapping[str, np.ndarray]) -> Renderer:
        if not self.calibration.names:
            return self.renderer
        key = b"".join(np.asarray(own[name]).tobytes() for name in self.calibration.names)
        if self._seen.get("last", (b"",))[0] != key:
            self._seen["last"] = key, self.renderer.seen_by(self.calibration.view(own))
        return self._seen["last"][1]


@fixed
class SensorSeries:
    """A time series of sensor readings as an observation of a fit.

    Example: ``series = cortado.measured.SensorSeries(gauge, times, heights, dimension=2, noise=0.001)``
    """

    def __init__(
        self,
        sensor: Sensor,
        times: Any,
        values: Any,
        dimension: int,
        columns: Sequence[str] | None = None,
        noise: float | None = None,
        calibrate: Sequence[str] = (),
        clock: float = 0.0,
    ):
        """Store a measured series.

        Args:
            sensor: a sensor of `cortado.sensors`.
            times: (frames,) [s] after the start of the run.
            values: readings (frames,) or (frames, k) in the sensor's units. NaN readings are ignored.
            dimension: dimension of the scene.
            columns: names of the k measured columns, by default all.
            noise: standard deviation of a reading, if known.
            calibrate: ["start"] to fit the clock.
            clock: [s], added to the times.
        """
        self.start, self.sensor = clock_of(calibrate, clock), checked_sensor(sensor)
        known = dict(sensor.columns(dimension))
        names = list(known) if columns is None else list(columns)
        for name in names:
            if name not in known:
                raise InputError(f"a column is {shown(name)}, but must be one of {', '.join(known)}.")
        array = as_numbers("values", values)
        array = array[:, None] if array.ndim == 1 else array
        if array.ndim != 2 or array.shape[1] != len(names):
            raise InputError(f"values has shape {array.shape}, but must have columns for {', '.join(names)}.")
        if len({known[name] for name in names}) > 1:
            raise InputError(f"columns are {', '.join(names)}, but must have one unit: give a series for each unit.")
        self.times, self.measured, self.noise = checked(times, array, noise, clock)
        self.unit, self.columns = known[names[0]], tuple(names)
        self._picked = np.array([list(known).index(name) for name in names])
        self._width = len(known)

    def value(self, at: Snapshot, own: Mapping[str, np.ndarray]) -> np.ndarray:
        return value_of(self.sensor, at)[self._picked]

    def tangents(self, at: Snapshot, own: Mapping[str, np.ndarray], along: Sequence[Direction]) -> np.ndarray:
        """Sensors have no forward mode. Adjoints therefore give the derivatives along directions."""
        rows = [self.sensor.adjoint(at, np.eye(self._width)[k]) for k in self._picked]
        others = [name for name in rows[0] if along and name not in along[0].fields]
        found = np.zeros((len(rows), len(along)))
        for k, one in enumerate(along):
            dots = {**one.fields, **one.quantities(others)}
            found[:, k] = [sum(float((bar * dots[name]).sum()) for name, bar in row.items()) for row in rows]
        return found


@fixed
class Tracks:
    """Tracer positions over time, as an observation of a fit. A tracer moves with the particles around its start:

    X(t) = X(0) + sum_i w_i (x_i(t) - x_i(0)).

    The vector X is the position of the tracer. The vectors x_i are the positions of the particles and of their periodic
    images. The weight w_i is Wendland's function (1995) of the distance at the start, divided by the sum of all
    weights. Positions are not wrapped at periodic boundaries.

    Example: ``tracks = cortado.measured.Tracks(simulation, first, times, positions, noise=0.001)``
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
        """Store the tracks of tracers. Raises `InputError` if a tracer has no fluid around it.

        Args:
            simulation: simulation of the experiment.
            first: (tracers, d) initial positions of the tracers [m].
            times: (frames,) [s] after the start of the run.
            positions: (frames, tracers, d) [m], NaN for unseen tracers.
            noise: standard deviation of a coordinate [m], if known.
            calibrate: ["start"] to fit the clock.
            clock: [s], added to the times.
        """
        self.start = clock_of(calibrate, clock)
        begun, places = as_numbers("first", first), as_numbers("positions", positions)
        tracers, d = begun.shape if begun.ndim == 2 else (0, 0)
        if not tracers or d != simulation.dimension:
            raise InputError(f"first has shape {begun.shape}, but must be (tracers, {simulation.dimension}).")
        if places.shape[1:] != begun.shape:
            raise InputError(f"positions has shape {places.shape}, but must be (frames, {tracers}, {d}).")
        self.times, self.measured, self.noise = checked(times, places.reshape(len(places), -1), noise, clock)
        x, domain = simulation.positions, simulation.lattice.domain
        support, period = simulation.scene.discretisation.support_radius, np.array(domain.lengths)
        lower, size = np.array(domain.lower), period if period.any() else None
        some, others = (cKDTree(wrapped(points - lower, period), boxsize=size) for points in (begun, x))
        near = some.sparse_distance_matrix(others, support, output_type="coo_matrix")
        w = csr_array((weights_of(near.data / support)[0], (near.row, near.col)), shape=(tracers, len(x)))
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
