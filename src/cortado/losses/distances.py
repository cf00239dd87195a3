"""Losses that compare particle positions, the centre of mass, a solid, a picture, or sensor readings with a target."""

from functools import cache
from hashlib import sha256
from typing import Any, Protocol

import numpy as np
import warp as wp

from cortado.arrays import as_numbers, as_one_number, read_only, require_methods, whole_number
from cortado.calls import fixed
from cortado.device.launching import launch
from cortado.device.modules import kernel_module
from cortado.device.precision import Precision, TypesByName
from cortado.device.reduction import TreeReduction, sum_of
from cortado.device.threads import WARP
from cortado.errors import InputError, shown
from cortado.files.image_encoding import LIGHT, check_light
from cortado.image_losses import ImageLoss, SquaredDifference
from cortado.losses.loss import Adjoint, Frames, Snapshot, SnapshotAdjoint, SnapshotBatch
from cortado.particles.state import State, to_device
from cortado.runs.sensor import Sensor, checked_sensor, value_of
from cortado.scene.motions import AXES, Pose, matrix, position_name, solids_in


@cache
def matching_kernels(precision: Precision) -> tuple[Any, Any]:
    real, vector = precision.real, precision.vector
    module = kernel_module(f"matching_{precision.name}")
    typed = TypesByName(real, {vector: "x target bar", wp.float64: "squares"})

    @wp.kernel(module=module, enable_backward=False)
    @typed.arrays
    def squared_distance(x, target, squares):
        i = wp.tid()
        miss = wp.vec3d(x[i] - target[i % target.shape[0]])
        squares[i] = wp.dot(miss, miss)

    @wp.kernel(module=module, enable_backward=False)
    @typed.arrays
    def difference(factor: real, x, target, bar):
        i = wp.tid()
        bar[i] = factor * (x[i] - target[i % target.shape[0]])

    return squared_distance, difference


@fixed
class FinalPositions:
    """A loss: the mean squared distance of the particles from their target positions [m2].

    Example: ``loss = cortado.losses.FinalPositions(trajectory[-1].positions)``
    """

    def __init__(self, target: np.ndarray):
        """Set the ``target`` positions (n, d) [m], in the order of the initial particles."""
        self.target = read_only("target", target)
        if self.target.ndim != 2 or not np.isfinite(self.target).all():
            raise InputError(f"target has shape {self.target.shape}, but must be finite and (particles, dimension).")
        self.fingerprint = _checksum(self.target)
        self._on_device: dict[Any, tuple[wp.array, TreeReduction]] = {}

    def __reduce__(self) -> tuple[Any, ...]:
        return FinalPositions, (self.target,)

    def value(self, end: Snapshot) -> float:
        one: Any = end
        return float(self.values(one)[0])

    def value_and_adjoint(self, end: Snapshot) -> tuple[float, State]:
        return self.value(end), self._adjoint(end)

    def values_and_adjoint(self, end: SnapshotBatch) -> tuple[np.ndarray, State]:
        return self.values(end), self._adjoint(end)

    @WARP
    def values(self, end: SnapshotBatch) -> np.ndarray:
        x, (target, total) = end.state.positions, self._made(end)
        squares = wp.empty(len(x), dtype=wp.float64, device=x.device)
        kernel, _ = matching_kernels(end.precision)
        launch(kernel, len(x), x.device, x=x, target=target, squares=squares)
        return total(squares).numpy() / len(target)

    @WARP
    def _adjoint(self, end: Snapshot | SnapshotBatch) -> State:
        x, bar, (target, _) = end.state.positions, end.state.like(), self._made(end)
        _, kernel = matching_kernels(end.precision)
        launch(kernel, len(x), x.device, factor=2.0 / len(target), x=x, target=target, bar=bar.positions)
        return bar

    def _made(self, end: Snapshot | SnapshotBatch) -> tuple[wp.array, TreeReduction]:
        x, members = end.state.positions, end.state.batch or 1
        shape = (len(x) // members, end.dimension)
        if shape != self.target.shape:
            raise InputError(f"target has shape {self.target.shape}, but must be {shape}.")
        key = (str(x.device), end.precision, members)
        if key not in self._on_device:
            total = sum_of(wp.float64, len(self.target), x.device, members)
            self._on_device[key] = to_device(self.target, end.precision, x.device), total
        return self._on_device[key]


@fixed
class CentreOfMass:
    """A loss: the squared distance of the centre of mass from a target [m2].

    Example: ``problem = cortado.Problem(simulation, 100, cortado.losses.CentreOfMass([1.0, 0.2]))``
    """

    def __init__(self, target: Any, masses: np.ndarray | None = None):
        """Set the ``target`` (d,) [m] and the particles' ``masses`` (n,) in any unit. None means equal masses."""
        self.target, self._weights = _finite("target", target), _weights(masses)
        self.fingerprint = _checksum(self.target, self._weights)

    def value(self, end: Snapshot) -> float:
        return self.value_and_adjoint(end)[0]

    def value_and_adjoint(self, end: Snapshot) -> tuple[float, Adjoint]:
        shares = _shares(self._weights, end, "target", self.target)
        miss = shares @ end.positions - self.target
        return float((miss**2).sum()), (2.0 * shares[:, None] * miss, np.zeros_like(end.velocities))


@fixed
class CentreOfMassAlong:
    """A loss: the coordinate of the centre of mass along a direction [m].

    Example: ``problem = cortado.Problem(simulation, 100, cortado.losses.CentreOfMassAlong([1.0, 0.0]))``
    """

    def __init__(self, direction: Any, masses: np.ndarray | None = None):
        """Set the ``direction`` (d,) [-] and the particles' ``masses`` (n,) in any unit. None means equal masses."""
        self.direction, self._weights = _finite("direction", direction), _weights(masses)
        self.fingerprint = _checksum(self.direction, self._weights)

    def value(self, end: Snapshot) -> float:
        return self.value_and_adjoint(end)[0]

    def value_and_adjoint(self, end: Snapshot) -> tuple[float, Adjoint]:
        slopes = _shares(self._weights, end, "direction", self.direction)[:, None] * self.direction
        return float((slopes * end.positions).sum()), (slopes, np.zeros_like(end.velocities))


def _finite(what: str, value: Any) -> np.ndarray:
    array = read_only(what, value)
    if array.ndim != 1 or not np.isfinite(array).all():
        raise InputError(f"{what} has shape {array.shape}, but must be a finite array with 1 axis.")
    return array


def _weights(masses: np.ndarray | None) -> np.ndarray | None:
    if masses is None:
        return None
    array = _finite("masses", masses)
    if not (array >= 0.0).all() or not array.any():
        raise InputError("masses has a number below 0, or only zeros, but must have a sum above 0.")
    return array


def _shares(weights: np.ndarray | None, end: Snapshot, name: str, vector: np.ndarray) -> np.ndarray:
    n = len(end.positions)
    if vector.shape != (end.dimension,):
        raise InputError(f"{name} has shape {vector.shape}, but must be {(end.dimension,)}.")
    if weights is None:
        return np.full(n, 1.0 / n)
    if weights.shape != (n,):
        raise InputError(f"masses has shape {weights.shape}, but must be {(n,)}.")
    return weights / weights.sum()


def _checksum(*parts: Any) -> str:
    return sha256(b" ".join(b"" if one is None else bytes(memoryview(one)) for one in parts)).hexdigest()


@fixed
class SolidPose:
    """A loss of a moving solid: ``|x - x*|^2 + l^2 (3 - tr R*^T R)`` [m2].

    x is the position of the solid's centre, R is its rotation matrix, x* and R* are the targets, and l is a length. For
    small angles the second term is the squared angle between the rotations, times the squared length l.

    Example: ``loss = cortado.losses.SolidPose("raft", position=[0.8, 0.3], rotation=0.0)``
    """

    def __init__(self, name: str, position: Any = None, rotation: Any = None, length: float = 1.0):
        """Set the ``name`` of the solid and at least one target. ``position`` (d,) [m] is the target of the solid's
        centre. ``rotation`` [rad] is the target angle in 2-D and a rotation vector (3,) in 3-D. ``length`` [m] is the
        factor of angles in the loss, greater than 0."""
        if not isinstance(name, str):
            raise InputError(f"name is {shown(name)}, but must be the name of a solid.")
        if position is None and rotation is None:
            raise InputError("position and rotation are left out, but one of them must be given.")
        if not np.isfinite(length) or length <= 0.0:
            raise InputError(f"length is {shown(length)}, but must be greater than 0.")
        self.name, self.length = name, float(length)
        self.position = None if position is None else read_only("position", position)
        self.rotation = None if rotation is None else read_only("rotation", np.atleast_1d(rotation))
        self.fingerprint = _checksum(name.encode(), self.position, self.rotation, np.float64(length))

    def value(self, end: Snapshot) -> float:
        return self.value_and_adjoint(end)[0]

    def value_and_adjoint(self, end: Snapshot) -> tuple[float, Adjoint]:
        name, names = self.name, end.state.names
        if position_name(name) not in names:
            moving = ", ".join(solids_in(names)) or "the scene has none"
            raise InputError(f"name is {name!r}, but must be the name of a moving solid: {moving}.")
        value, bars = 0.0, {}
        if self.position is not None:
            position = end[position_name(name)]
            if self.position.shape != position.shape[1:]:
                raise InputError(f"position has shape {self.position.shape}, but must be {position.shape[1:]}.")
            value += float(((position - self.position) ** 2).sum())
            bars[position_name(name)] = 2.0 * (position - self.position)
        if self.rotation is not None:
            if self.rotation.shape != (2 * end.dimension - 3,):
                raise InputError(f"rotation has shape {self.rotation.shape}, but must be {(2 * end.dimension - 3,)}.")
            pose = Pose.of(name, f"{name}.{AXES[0]}" in names, end)
            R, wanted, weight = pose.rotation, matrix(self.rotation), self.length**2
            value += weight * float(3.0 - np.trace(wanted.T @ R))
            bars |= pose.turning_bars(-weight * np.cross(R, wanted, axis=0).sum(axis=1))
        return value, bars


class Pictures(Protocol):
    def render(self, positions: wp.array, fractions: wp.array, colours: np.ndarray) -> np.ndarray:
        """Return the picture (rows, columns, 3) of particles."""

    def adjoint(self, image_bar: np.ndarray) -> Any:
        """Return the derivatives ``positions``, ``fractions`` and ``colours`` of the picture that was rendered last."""


@fixed
class Image:
    """A loss: the distance between a picture of the state and a target picture.

    Example::

        renderer = simulation.renderer(resolution=(64, 64))
        loss = cortado.losses.Image(renderer, target, cortado.image_losses.Pyramid())
    """

    def __init__(self, renderer: Pictures, target: np.ndarray, distance: ImageLoss | None = None):
        """Set a ``renderer`` from `Simulation.renderer`, and the ``target`` picture (rows, columns, 3) in linear RGB
        from 0 to 1. ``distance`` is `cortado.image_losses.SquaredDifference`, the default, or `Pyramid` for shapes that
        may not overlap their target.

        Raises `InputError` if the target has a wrong shape or byte values up to 255.
        """
        require_methods("renderer", renderer, ("render", "adjoint"), "an object such as Simulation.renderer() gives")
        self.renderer, self.distance = renderer, SquaredDifference() if distance is None else distance
        wanted = "an object such as cortado.image_losses.Pyramid()"
        require_methods("distance", self.distance, ("value", "adjoint"), wanted)
        self.target, shape = read_only("target", target), getattr(renderer, "shape", None)
        if self.target.ndim != 3 or self.target.shape[2] != 3 or not self.target.size:
            raise InputError(f"target has shape {self.target.shape}, but must be a picture (rows, columns, 3).")
        if shape is not None and self.target.shape != shape:
            found = f"target has shape {self.target.shape}"
            raise InputError(f"{found}, but must have the shape of the renderer's pictures, {shape}.")
        if not np.isfinite(self.target).all():
            raise InputError("target has a value that is not finite, but must be made of finite numbers.")
        check_light("target", target)
        if self.target.min() < 0.0:
            raise InputError(f"target has a value of {self.target.min():g}, but must be {LIGHT}; clip noise at 0.")
        parts = (self.distance.fingerprint, _checksum(self.target))
        self.fingerprint = " ".join((*parts, getattr(renderer, "fingerprint", "")))

    def image(self, end: Snapshot) -> np.ndarray:
        """Return the picture (rows, columns, 3) of a state."""
        return self.renderer.render(end.state.positions, end.state.mass_fractions, end.colours)

    @WARP
    def value(self, end: Snapshot) -> float:
        return self.distance.value(self.image(end), self.target)

    @WARP
    def value_and_adjoint(self, end: Snapshot) -> tuple[float, SnapshotAdjoint]:
        image = self.image(end)
        found = self.renderer.adjoint(self.distance.adjoint(image, self.target))
        bar = end.state.like()
        wp.copy(bar.positions, found.positions)
        wp.copy(bar.mass_fractions, found.fractions)
        return self.distance.value(image, self.target), SnapshotAdjoint(bar, found.colours)


@fixed
class SensorMatch:
    """A loss: the weighted sum of squared differences between a sensor's reading and a target, divided by a scale.

    Example::

        gauge = cortado.sensors.WaveGauge([0.5, 0.0])
        loss = cortado.losses.SensorMatch(gauge, [0.31])  # m, at the end
    """

    def __init__(self, sensor: Sensor, target: Any, weight: float = 1.0, scale: Any = 1.0):
        """Set the ``sensor``, the ``weight`` of the sum, and the ``scale`` of the differences, which is a number or
        (k,). ``target`` (k,) has one number for each column of the sensor. Columns with a NaN target are ignored."""
        self.sensor, self.weight = checked_sensor(sensor), as_one_number("weight", weight)
        self.target = np.atleast_1d(read_only("target", target))
        divisors = as_numbers("scale", scale)
        if divisors.shape not in ((), self.target.shape) or not ((divisors > 0.0) & (divisors < np.inf)).all():
            wanted = f"a number greater than 0, or {len(self.target)} such numbers, one for each column"
            raise InputError(f"scale is {shown(scale)}, but must be {wanted}.")
        self.scale = np.broadcast_to(divisors, self.target.shape)
        arrays = self.target.tobytes() + self.scale.tobytes()
        self.fingerprint = sha256(f"{sensor!r} {self.weight!r}".encode() + arrays).hexdigest()

    def value(self, end: Snapshot) -> float:
        return self.weight * float((self._miss(end) ** 2).sum())

    def value_and_adjoint(self, end: Snapshot) -> tuple[float, Adjoint]:
        return self.value(end), self.sensor.adjoint(end, 2.0 * self.weight * self._miss(end) / self.scale)

    def _miss(self, end: Snapshot) -> np.ndarray:
        found = value_of(self.sensor, end)
        if found.shape != self.target.shape:
            columns = ", ".join(self.sensor.columns(end.dimension))
            said = f"values has {len(self.target)} columns"
            raise InputError(f"{said}, but must have {len(found)}, like the sensor: {columns}.")
        return np.where(np.isnan(self.target), 0.0, found - self.target) / self.scale


@fixed
class Series(Frames):
    """A loss: the mean over steps of the squared differences between a sensor's columns and a measured series.

    The series is interpolated linearly to the times of the steps. Steps before the first time or after the last time of
    the series are ignored.

    Example: ``loss = cortado.losses.Series(gauge, times, heights, time_step=0.002)``
    """

    def __init__(self, sensor: Sensor, times: Any, values: Any, time_step: float, every: int = 1, scale: Any = 1.0):
        """Set the ``sensor`` and the measured series. ``times`` (m,) [s] must increase. ``values`` (m,) or (m, k) have
        one number for each column of the sensor. NaN values of the series do not enter the loss.

        ``time_step`` is the time step of the problem [s]. ``every`` is the interval between compared steps. ``scale``
        divides the differences and is a number or (k,).
        """
        moments, series = read_only("times", times), as_numbers("values", values)
        series = series[:, None] if series.ndim == 1 else series
        if moments.ndim != 1 or len(moments) < 2 or not (np.diff(moments) > 0.0).all():
            raise InputError("times must be a list of at least two increasing numbers.")
        if series.ndim != 2 or len(series) != len(moments):
            raise InputError(f"values has shape {series.shape}, but must have {len(moments)} rows, one for each time.")
        if np.isinf(series).any() or np.isnan(series).all():
            raise InputError("values must be finite, or NaN where nothing was measured, and must not all be NaN.")
        columns, sizes = series.shape[1], as_numbers("scale", scale)
        if sizes.shape not in ((), (columns,)):
            said = f"scale has shape {sizes.shape}"
            raise InputError(f"{said}, but must be one number or have shape ({columns},), one for each column.")
        if not (sizes > 0.0).all():
            raise InputError("scale must be greater than 0.")
        step, stride = as_one_number("time_step", time_step), whole_number("every", every, 1)
        if not 0.0 < step < np.inf:
            raise InputError(f"time_step is {step:g}, but must be finite and greater than 0.")
        first, last = int(np.ceil(moments[0] / step - 1e-9)), int(np.floor(moments[-1] / step + 1e-9))
        steps = [k for k in range(max(first, 0), last + 1) if k % stride == 0]
        if not steps:
            raise InputError(f"times go from {moments[0]:g} to {moments[-1]:g} s, but no step ends in this interval.")
        rows = np.stack([np.interp(np.array(steps) * step, moments, column) for column in series.T], axis=1)
        weight = 1.0 / len(steps)
        self.time_step = step
        super().__init__({k: SensorMatch(sensor, row, weight, scale) for k, row in zip(steps, rows, strict=True)})

    def check(self, time_steps: np.ndarray) -> None:
        other = time_steps[np.abs(time_steps - self.time_step) > 1e-6 * time_steps]  # rounded to float32
        if len(other):
            found = f"time_step of the series is {self.time_step:g} s"
            raise InputError(f"{found}, but must be the fixed time step of the run, {other[0]:g} s.")
