"""The inputs of a time step as Warp arrays by name: the state before the step, the sorted particles, and the
parameters.

Vectors have three components on a device, and z is 0 in 2-D.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Any, Self

import numpy as np
import warp as wp
from numpy.typing import NDArray

from cortado.arrays import is_same
from cortado.calls import Staying
from cortado.device.precision import Precision
from cortado.device.reduction import TreeReduction, sum_of
from cortado.scene.parameter_values import REGISTRY, Known, argument
from cortado.scene.parameters import Axis, Parameter


class Entry(Enum):
    NUMBER = "a number"
    VECTOR = "a vector"
    FRACTIONS = "a number for each phase"
    DOUBLE = "a number in float64, whatever the precision of the run: a sum over many steps"


@dataclass(frozen=True)
class StateField:
    """An array of the state, declared by a solver or a part. Every value that a step reads from the previous step must
    be a state field, because a run restarts from its state alone."""

    name: str
    unit: str
    """SI unit, or an empty text for a dimensionless field."""
    entry: Entry
    axis: Axis = Axis.PARTICLE
    """PARTICLE for one value per particle, in the order of the scene, or SCALAR for a single value."""
    first: str | None = None
    """Name of the parameter that contains the first value. None for a field that is 0 at the start."""
    is_constant: bool = False

    def shape(self, particles: int, dimension: int, phases: int) -> tuple[int, ...]:
        own = {Entry.VECTOR: (dimension,), Entry.FRACTIONS: (phases,)}.get(self.entry, ())
        return (particles if self.axis is Axis.PARTICLE else 1, *own)


def check_fields(fields: Iterable[StateField], known: Mapping[str, Parameter]) -> None:
    names: set[str] = set()
    for field in fields:
        if field.name in names:
            raise TypeError(f"a state has several fields called {field.name!r}, but each must have a name of its own.")
        names.add(field.name)
        if field.first is None:
            continue
        if field.first not in known:
            raise TypeError(
                f"field {field.name!r} begins as {field.first!r}, but must begin as a parameter, "
                f"{', '.join(known)}, or at 0."
            )
        particles, dimension, phases = 7, 2, 5  # any that differ
        (shape, *_) = known[field.first].shapes(0, phases, (particles, dimension))
        given = shape if field.axis is Axis.PARTICLE else (1, *shape)
        wanted = field.shape(particles, dimension, phases)
        if given != wanted:
            raise TypeError(
                f"field {field.name!r} begins as {field.first!r}, which is not {field.entry.value} "
                f"{'for each particle' if field.axis is Axis.PARTICLE else 'for the scene'}."
            )


def first_values(fields: Iterable[StateField], parameters: Mapping[str, NDArray]) -> dict[str, NDArray]:
    """Return the first values of fields that begin with the value of a parameter, by field name."""
    found = {}
    for field in fields:
        if field.first is not None and field.first in parameters:
            value = parameters[field.first]
            if field.axis is not Axis.PARTICLE:  # (1,) or (1, components), over time the first row
                value = (np.atleast_2d(value) if field.entry is Entry.VECTOR else np.atleast_1d(value))[:1]
            found[field.name] = value
    return found


POSITIONS = StateField("positions", "m", Entry.VECTOR, first="initial_positions")
VELOCITIES = StateField("velocities", "m/s", Entry.VECTOR, first="initial_velocities")


def padded(vectors: np.ndarray) -> np.ndarray:
    return np.hstack([vectors, np.zeros((len(vectors), 3 - vectors.shape[1]))])


def to_device(values: np.ndarray, precision: Precision, device: Any) -> wp.array:
    """Copy vectors (n, 2) or (n, 3) to a device as a Warp array (n,) of vectors with three components."""
    return wp.array(padded(values), dtype=precision.vector, device=device)


def components(array: wp.array, shape: tuple[int, ...]) -> wp.array:
    """Return a view of the array as scalars with the given shape. Elements may be vectors or matrices."""
    real = getattr(array.dtype, "_wp_scalar_type_", array.dtype)
    view = wp.array(ptr=array.ptr, dtype=real, shape=shape, device=array.device)
    view._ref = array
    if array.requires_grad:
        view.grad = components(array.grad, shape)
    return view


class Arrays(Staying):
    def __init__(self, arrays: Mapping[str, wp.array]):
        self._arrays = dict(arrays)
        self._named: dict[str, dict[str, wp.array]] = {}

    def __getitem__(self, name: str) -> wp.array:
        return self._arrays[name]

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(self._arrays)

    def arrays(self) -> list[wp.array]:
        return list(self._arrays.values())

    def named(self, suffix: str = "") -> dict[str, wp.array]:
        """Names are kernel arguments, such as ``drag_k`` for ``drag.k``. A ``suffix`` is "_dot" or "_bar"."""
        if suffix not in self._named:
            self._named[suffix] = {argument(name) + suffix: array for name, array in self._arrays.items()}
        return self._named[suffix]

    def assign(self, other: Self) -> None:
        for own, source in zip(self.arrays(), other.arrays(), strict=True):
            if own is not source:
                wp.copy(own, source)

    def gradients(self) -> Self:
        return type(self)({name: array.grad for name, array in self._arrays.items()})

    def clear(self) -> None:
        clear(self.arrays())


def clear(arrays: Iterable[wp.array]) -> None:
    for array in arrays:
        array.zero_()


def zeros(kinds: Mapping[str, tuple[Any, Any]], device: Any, requires_grad: bool = False) -> dict[str, wp.array]:
    options = {"device": device, "requires_grad": requires_grad}
    return {name: wp.zeros(size, dtype=dtype, **options) for name, (size, dtype) in kinds.items()}


class Fields(Arrays):
    """Values of the sorted particles (n,) within a time step, or their tangents or adjoints.

    ``x`` are positions [m], and ``v`` are velocities [m / s]. ``n`` are number densities [-], which are 1 on the rest
    lattice. ``rho_0`` are rest densities [kg / m3], and ``mu`` are dynamic viscosities [Pa s]. ``m`` are masses divided
    by the particle volume on the rest lattice [kg / m3], so that the density is m n.
    """

    @classmethod
    def zeros(cls, particles: int, precision: Precision, device: Any, requires_grad: bool = False) -> Self:
        types = dict.fromkeys("xv", precision.vector) | dict.fromkeys(("n", "m", "rho_0", "mu"), precision.real)
        return cls(zeros({name: (particles, dtype) for name, dtype in types.items()}, device, requires_grad))


class State(Arrays):
    """The arrays of a state by field name, or their tangents or adjoints.

    Every state has ``positions`` (n,) vectors [m], ``velocities`` (n,) vectors [m / s] and ``mass_fractions`` (n,) with
    one number for each phase [-]. In a state, particles are in the order of the scene. A batch has the particles of one
    scene after the other.
    """

    def __init__(self, fields: tuple[StateField, ...], arrays: Mapping[str, wp.array], batch: int | None = None):
        """``batch`` is the number of scenes, or None for a single scene."""
        super().__init__(arrays)
        self.fields, self.batch = fields, batch
        self._narrow: dict[int, dict[str, Any]] = {}

    @property
    def positions(self) -> wp.array:
        return self["positions"]

    @property
    def velocities(self) -> wp.array:
        return self["velocities"]

    @property
    def mass_fractions(self) -> wp.array:
        return self["mass_fractions"]

    def like(self) -> Self:
        zero = {name: wp.zeros_like(self[name], requires_grad=False) for name in self.names}
        return type(self)(self.fields, zero, self.batch)

    def following(self) -> Self:
        """Make a later state of the run with uninitialised arrays. The states share the arrays of constant fields."""
        new = {f.name: self[f.name] if f.is_constant else wp.empty_like(self[f.name]) for f in self.fields}
        return type(self)(self.fields, new, self.batch)

    def copy(self, earlier: Self | None = None) -> Self:
        """Copy the state to new arrays. Constant fields are shared with an ``earlier`` state of the run."""
        kept = {} if earlier is None else {f.name: earlier[f.name] for f in self.fields if f.is_constant}
        own = {name: kept[name] if name in kept else wp.clone(self[name], requires_grad=False) for name in self.names}
        return type(self)(self.fields, own, self.batch)

    def member(self, number: int) -> Self:
        assert self.batch is not None
        sizes = {name: len(self[name]) // self.batch for name in self.names}
        views = {name: self[name][number * size : (number + 1) * size] for name, size in sizes.items()}
        return type(self)(self.fields, views)

    def numbers(self, name: str) -> wp.array:
        """Vectors are (n, 3) and fractions (n, phases), and a batch adds a first axis (batch, n, ...). Libraries with
        DLPack, such as PyTorch and JAX, use the view without a copy."""
        field = self[name]
        shape = (len(field),) if self.batch is None else (self.batch, len(field) // self.batch)
        return components(field, (*shape, *getattr(field.dtype, "_shape_", ())))

    def narrow(self, dimension: int) -> dict[str, Any]:
        """The views are NumPy arrays on a CPU and Warp arrays on a GPU, in the shapes of `numpy`."""
        if dimension not in self._narrow:
            on_host, vectors = self.positions.device.is_cpu, {f.name for f in self.fields if f.entry is Entry.VECTOR}
            whole = {name: self.numbers(name) for name in self.names}
            views = {name: array.numpy() if on_host else array for name, array in whole.items()}
            cut = {name: (*[slice(None)] * (views[name].ndim - 1), slice(dimension)) for name in vectors}
            self._narrow[dimension] = {n: a[cut[n]] if n in vectors and dimension < 3 else a for n, a in views.items()}
        return self._narrow[dimension]

    def set(self, values: Mapping[str, Any]) -> None:
        """Vectors are (n, d), numbers (n,) and fractions (n, phases). A batch adds a first axis (batch, n, ...)."""
        for field in self.fields:
            if field.name in values:
                given = np.asarray(values[field.name])
                flat = given if self.batch is None else given.reshape(-1, *given.shape[2:])
                self[field.name].assign(padded(flat) if field.entry is Entry.VECTOR else flat)

    def numpy(self, dimension: int, only: Iterable[str] | None = None) -> dict[str, np.ndarray]:
        """Copy every field, or the fields named in ``only``, to new arrays. Shapes are as in `set`."""
        return {name: array.copy() for name, array in self.views(dimension, only).items()}

    def views(self, dimension: int, only: Iterable[str] | None = None) -> dict[str, np.ndarray]:
        """Return fields as `numpy` does. The arrays are views if the state is on the host."""
        names, lead = set(self.names if only is None else only), () if self.batch is None else (self.batch, -1)
        arrays = {f: self[f.name].numpy() for f in self.fields if f.name in names}
        narrow = {f.name: a[:, :dimension] if f.entry is Entry.VECTOR else a for f, a in arrays.items()}
        return {name: a.reshape(*lead, *a.shape[1:]) if lead else a for name, a in narrow.items()}


class StateSeries:
    """States of one run in shared arrays."""

    def __init__(self, like: State, length: int):
        self._like, self._length = like, length
        changed = {field.name: like[field.name] for field in like.fields if not field.is_constant}
        self._whole = {name: wp.empty(length * len(a), dtype=a.dtype, device=a.device) for name, a in changed.items()}

    def state(self, k: int) -> State:
        size = {name: len(array) // self._length for name, array in self._whole.items()}
        own = {name: array[k * size[name] : (k + 1) * size[name]] for name, array in self._whole.items()}
        arrays = {field.name: own.get(field.name, self._like[field.name]) for field in self._like.fields}
        return State(self._like.fields, arrays, self._like.batch)

    def whole(self, name: str) -> wp.array:
        return self._whole.get(name, self._like[name])

    def like(self) -> Self:
        return type(self)(self._like, self._length)

    def assign(self, other: Self) -> None:
        for name, array in self._whole.items():
            wp.copy(array, other._whole[name])


class Parameters(Arrays):
    """The parameters of a run by name, or their tangents or adjoints.

    A parameter over time has the shape (members, steps), a parameter of phases (members, phases), an array (members,
    ...), and any other parameter (members,). A member is a scene of a batch.
    """

    def __init__(self, arrays: Mapping[str, wp.array]):
        super().__init__(arrays)
        self._written: dict[str, np.ndarray | wp.array] = {}
        self._tables: dict[str, np.ndarray] = {}
        self._numbers: dict[str, wp.array] = {}

    @property
    def written(self) -> Mapping[str, np.ndarray | wp.array]:
        """Return the values that `set` has written, by name. `set_row` changes the arrays of the parameters."""
        return dict(self._written)

    def set(self, values: Mapping[str, Any]) -> None:
        """Write parameters by name. A value is equal for all members, or has a first axis for the members. Values may
        be vectors (d,) or (steps, d), numbers, arrays of numbers, or Warp arrays.

        Only `set`, `set_row` and kernels that take `to_write` may write to the arrays of the parameters.
        """
        for name, value in values.items():
            array, last = self[name], self._written.get(name)
            if isinstance(value, wp.array):
                wp.copy(array, value)
                self._written[name] = array
                continue
            given = np.array(value, dtype=np.float64)
            if isinstance(last, np.ndarray) and is_same(last, given):
                continue
            self._written[name] = given
            is_vector = hasattr(array.dtype, "_shape_")
            axis = given.ndim - 1 - is_vector  # of steps, where the parameter has one
            if array.ndim == 2 and axis >= 0 and 1 < given.shape[axis] < array.shape[1]:
                room = array.shape[1] - given.shape[axis]
                given = np.pad(given, [(0, room if k == axis else 0) for k in range(given.ndim)], mode="edge")
            table = self._on_host(name)
            (table[..., : given.shape[-1]] if is_vector else table)[...] = given
            if not array.device.is_cpu:
                array.assign(table)

    def numbers(self, name: str) -> wp.array:
        """Return a view of a parameter over time as numbers (members, steps, components)."""
        if name not in self._numbers:
            array = self[name]
            self._numbers[name] = components(array, (*array.shape, wp.types.type_size(array.dtype)))
        return self._numbers[name]

    def to_write(self, name: str) -> wp.array:
        """Return the view `numbers` of a parameter for a kernel that writes all elements of the view."""
        self._written[name] = self[name]
        return self.numbers(name)

    def _on_host(self, name: str) -> np.ndarray:
        """On a CPU, the array shares memory with the parameter."""
        if name not in self._tables:
            array = self[name]
            shape = (*array.shape, *getattr(array.dtype, "_shape_", ()))
            self._tables[name] = array.numpy() if array.device.is_cpu else np.zeros(shape)
        return self._tables[name]

    def set_row(self, row: int, values: Mapping[str, np.ndarray]) -> None:
        """Values are vectors (members, d) or numbers (members,) for one time step. Call `set` first."""
        for name, value in values.items():
            self._written[name][:, row] = value
            vectors = np.reshape(value, (len(value), -1))
            given = padded(vectors) if hasattr(self[name].dtype, "_shape_") else vectors
            for member, own in enumerate(given):
                self[name][member][row : row + 1].assign(own.reshape(1, -1) if own.size > 1 else own)


@dataclass(frozen=True)
class Layout:
    """The scenes of a batch are concatenated, and a launch has one thread for each particle of all scenes."""

    particles: int
    phases: int
    precision: Precision
    device: Any
    batch: int | None = None
    """Number of scenes in a batch, or None for a single scene."""
    known: Known = REGISTRY

    @property
    def members(self) -> int:
        return self.batch or 1

    @property
    def all_particles(self) -> int:
        return self.members * self.particles

    def sum_of(self, dtype: Any) -> TreeReduction:
        return sum_of(dtype, self.particles, self.device, self.members)

    def arrays(self, suffix: str = "", requires_grad: bool = False, **kinds: Any) -> dict[str, wp.array]:
        """``kinds`` are Warp types by name, and ``suffix`` is added to the names."""
        sizes = {f"{name}{suffix}": (self.all_particles, kind) for name, kind in kinds.items()}
        return zeros(sizes, self.device, requires_grad)

    def state(self, fields: tuple[StateField, ...], requires_grad: bool = False) -> State:
        precision = self.precision
        dtypes = {
            Entry.NUMBER: precision.real,
            Entry.VECTOR: precision.vector,
            Entry.FRACTIONS: precision.fractions(self.phases),
            Entry.DOUBLE: wp.float64,
        }
        sizes = {Axis.PARTICLE: self.all_particles, Axis.SCALAR: self.members}
        kinds = {field.name: (sizes[field.axis], dtypes[field.entry]) for field in fields}
        return State(fields, zeros(kinds, self.device, requires_grad), self.batch)

    def parameters(self, steps: int, requires_grad: bool = False) -> Parameters:
        real, vector, members = self.precision.real, self.precision.vector, self.members
        sizes: dict[Axis, Any] = {Axis.STEP: (members, max(steps, 1)), Axis.PHASE: (members, self.phases)}
        used = [self.known[name] for name in self.known.run]
        kinds = {p.name: (sizes.get(p.axis, (members, *p.shape)), vector if p.rank else real) for p in used}
        return Parameters(zeros(kinds, self.device, requires_grad))
