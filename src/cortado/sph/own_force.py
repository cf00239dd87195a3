"""User-defined forces and viscosity laws, each given as one Python function.

`Body` is an acceleration of each particle. `Pair` is a force between neighbours, which is multiplied by the smoothing
kernel and therefore ends smoothly at the support radius. `Rheology` is the viscosity of a generalised Newtonian fluid.
Warp computes exact tangents and adjoints from the function.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cache, cached_property
from hashlib import sha256
from typing import Any, ClassVar

import numpy as np
import warp as wp

from cortado.arrays import as_numbers, read_only
from cortado.calls import fixed
from cortado.device.modules import Kernels
from cortado.device.precision import Precision
from cortado.errors import InputError, shown
from cortado.particles.made_derivatives import made_adjoint, made_tangent
from cortado.particles.neighbourhood import Discretisation, pair_functions
from cortado.particles.pair_sums import fluid_sum
from cortado.particles.particle_kernels import pointwise_kernels, sum_kernels
from cortado.particles.state import padded
from cortado.scene.courses import Knots
from cortado.scene.parameter_values import TIME, Arrays
from cortado.scene.parameters import Axis, Parameter
from cortado.scene.scene import Scene
from cortado.sph.formula import READ_AS, Formula, OwnParameters, applied, compiled, formula, theta_of
from cortado.sph.function_text import SENT, plain_function, source_of
from cortado.sph.parts import Adjoints, Force, Setting, StepContext, Tangents
from cortado.sph.stress_forces import check_law
from cortado.sph.stress_kernels import VelocityGradients, gradient_functions
from cortado.sph.viscous_stress import ViscousStress, stress_of


class OverTime:
    """A parameter of a force that changes in time: linear between the given times, and constant before and after them.

    A time step uses the value at the middle of the step. A search may use one value of the parameter for each step.

    Example: ``k = cortado.forces.OverTime([0.0, 0.5], [2.0, 8.0])``
    """

    def __init__(self, times: Any, values: Any):
        """Take increasing ``times`` (k,) [s] and ``values`` (k,) or (k, d)."""
        self.times, self.values = read_only("OverTime times", times), read_only("OverTime values", values)
        if self.times.ndim != 1 or not self.times.size or not np.isfinite(self.times).all():
            raise InputError(f"OverTime times are {shown(times)}, but must be a list of finite times [s].")
        if (np.diff(self.times) <= 0.0).any():
            raise InputError(f"OverTime times are {shown(times)}, but each time must be greater than the time before.")
        if self.values.ndim not in (1, 2) or len(self.values) != len(self.times):
            wanted = f"({len(self.times)},) or ({len(self.times)}, d), with a row for each time"
            raise InputError(f"OverTime values have shape {self.values.shape}, but must be {wanted}.")
        if not np.isfinite(self.values).all():
            raise InputError("A value of OverTime is not finite, but all values must be finite numbers.")
        self._course = Knots(self.times, self.values)

    def __repr__(self) -> str:
        return f"OverTime({self.times.tolist()}, {self.values.tolist()})"

    def at(self, times: np.ndarray) -> np.ndarray:
        """Return the interpolated values at ``times`` (n,) [s]."""
        return self._course.at(self._moments(times))

    def rates(self, times: np.ndarray) -> np.ndarray:
        """Return the time derivatives at ``times`` (n,) [s]."""
        return self._course.rates(self._moments(times))

    def _moments(self, times: Any) -> np.ndarray:
        found = as_numbers("times", times)
        if found.ndim > 1 or not np.isfinite(found).all():
            raise InputError(f"times are {shown(times)}, but must be a list of finite times [s].")
        return found


@fixed
class OwnFunction(ABC):
    """Base class of user-defined forces that are given as one Python function; see `cortado.forces`."""

    kind: ClassVar[str]

    def __init__(self, function: Callable[..., Any], /, name: str | None = None, **parameters: Any):
        """Take a ``function`` defined by ``def``, and values for the ``parameters`` of the function.

        A value is a number, a vector (d,) or an `OverTime`; for `Body` also an array. The function's argument ``k``
        becomes the parameter ``name.k``. The default ``name`` is the name of the function. Raises `InputError` for an
        invalid function or value.
        """
        self._function = plain_function(self.kind, function)
        self._source = source_of(f"{self.kind} function {self._function.__name__}", self._function)
        self._formula, values = formula(self.kind, self._function, self._source, parameters)
        self.name = self._formula.name if name is None else name
        if not isinstance(self.name, str) or not self.name.isidentifier():
            found = f"{self.kind} has the name {shown(name)}"
            raise InputError(f"{found}, but must have a valid name of a Python variable.")
        self._values = {
            argument: value if isinstance(value, OverTime) else read_only(f"parameter {self.name}.{argument}", value)
            for argument, value in values.items()
        }
        own = tuple(self._parameter(argument, value) for argument, value in self._values.items())
        self.parameters = ((TIME,) if len(self._formula.inputs) == 3 else ()) + own
        ranks = tuple(one.rank for one in self.parameters if one.axis is not Axis.ARRAY)
        self._formula, self._what = replace(self._formula, ranks=ranks), f"{self.kind} function {self._formula.name}"

    def __reduce__(self) -> tuple[Any, ...]:
        return _made_again, (type(self), self._function, self._source, self.name, self._values, self.fingerprint)

    def __repr__(self) -> str:
        values = "".join(f", {argument}={shown(value)}" for argument, value in self._values.items())
        return f"{type(self).__name__}({self.name}{values})"

    @property
    def fingerprint(self) -> str:
        """Return a hash of the source code of the function and of the functions that it calls."""
        courses = [repr(value) for value in self._values.values() if isinstance(value, OverTime)]
        words = (self.kind, self.name, self._formula.text, self._formula.outside, *courses)
        return sha256("\n".join(words).encode()).hexdigest()

    def _parameter(self, argument: str, value: Any) -> Parameter:
        name, meaning = f"{self.name}.{argument}", f"{argument} of the force {self.name}"
        own: dict[str, Any] = {}
        if argument in self._formula.arrays:
            own |= {"shape": value.shape, "change": lambda source, value: float(np.sqrt(np.mean(value**2))) or 1.0}
            return Parameter(name, "", meaning, Axis.ARRAY, lambda source: value, **own)
        course = value if isinstance(value, OverTime) else None
        first = value if course is None else course.values[0]
        own |= {"course": course, "change": lambda source, value: np.where(value == 0.0, 1.0, np.abs(value))}
        if first.ndim:
            own["components"] = lambda dimension, phases: dimension
            own["change"] = lambda source, value: float(np.linalg.norm(np.atleast_2d(value), axis=-1).max()) or 1.0
        return Parameter(name, "", meaning, Axis.STEP if course else Axis.SCALAR, lambda source: first, **own)

    @abstractmethod
    def force(self, setting: Setting) -> Force:
        """Make the force in a solver. Raise `InputError` for a function that Warp cannot compile."""


class OwnForce(OwnFunction):
    _made_by: ClassVar[Callable[[Discretisation, Formula, int], Kernels]]

    def kernels(self, discretisation: Discretisation, dimension: int, phases: int = 1) -> Kernels:
        return type(self)._made_by(discretisation, self._formula.of_phases(self._what, phases), dimension)

    def force(self, setting: Setting) -> "FunctionForce":
        kernels = self.kernels(setting.discretisation, setting.scene.dimension, setting.layout.phases)
        compiled(self._what, kernels.forward.module, setting.layout.device)
        return FunctionForce(self._what, kernels, self.parameters, self._formula.fields, setting)


class FunctionForce:
    shares: tuple[str, ...] = ()
    batches = True

    def __init__(
        self, what: str, kernels: Kernels, parameters: tuple[Parameter, ...], fields: tuple[str, ...], setting: Setting
    ):
        self._what, self._kernels, self._device = what, kernels, setting.layout.device
        self._own = OwnParameters(parameters, setting.layout, setting.discretisation.taped)
        takes_gradients = not {"shear_rate", "velocity_gradient"}.isdisjoint(fields)
        self._gradients = VelocityGradients(setting) if takes_gradients else None

    @cached_property
    def _tangent(self) -> Any:
        compiled(self._what, self._kernels.tangent.module, self._device)
        return self._kernels.tangent

    @cached_property
    def _adjoint(self) -> Any:
        compiled(self._what, self._kernels.adjoint.module, self._device)
        return self._kernels.adjoint

    def accelerate(self, step: StepContext, before: wp.array, after: wp.array) -> None:
        sums = self._gradients.measure(step) if self._gradients else {}
        step.launch(self._kernels.forward, self._own.now(step), sums, acceleration_in=before, acceleration=after)

    def tangent(self, step: StepContext, dot: Tangents, before: wp.array, after: wp.array) -> None:
        now = {"acceleration_in_dot": before, "acceleration_dot": after}
        sums = self._gradients.tangent(step, dot) if self._gradients else {}
        step.launch(self._tangent, self._own.along(step, dot.parameters), sums, *dot.named, **now)

    def adjoint(self, step: StepContext, acceleration_bar: wp.array, bar: Adjoints) -> None:
        known = self._own.back(step), self._gradients.known() if self._gradients else {}, *bar.named
        step.launch(self._adjoint, *known, acceleration_bar=acceleration_bar, threads=self._own.threads)
        self._own.collect(step, bar)
        if self._gradients:
            self._gradients.adjoint(step, bar)


def topic(kind: str, text: Formula, dimension: int) -> str:
    words = "\n".join((text.text, text.outside, str(text.ranks), str(dimension), str(text.phases)))
    return f"{kind}_{text.name}_{sha256(words.encode()).hexdigest()[:12]}"


def _made_again(
    made: type[OwnFunction], function: Any, source: str, name: str, values: Mapping[str, Any], fingerprint: str
) -> OwnFunction:
    SENT[function] = source
    found = made(function, name, **values)
    if found.fingerprint != fingerprint:
        said = f"a value or function that the {made.kind} function {name} uses has changed since the force was made"
        raise InputError(f"{said}, but must be the same in every process: make the force anew.")
    return found


@cache
def body_kernels(discretisation: Discretisation, text: Formula, dimension: int) -> Kernels:
    precision, modules = discretisation.precision, discretisation.modules(topic("body", text, dimension))
    gradient, rate = gradient_functions(precision, dimension)
    types: dict[str, Any] = dict.fromkeys(("x_i", "v_i"), precision.vector) | {"theta": theta_of(precision, text.ranks)}
    kinds = {"M_i": precision.matrix, "A_i": precision.matrix, "fractions_i": precision.fractions(max(text.phases, 1))}
    given = [*types]
    for name in text.fields:
        value, entries = FIELDS[name]
        types |= {entry: kinds.get(entry, precision.real) for entry in entries}
        given.append(value)
    reads = dict(zip(("e", "table", "member", "row"), text.reads(precision).values(), strict=False))
    types |= reads

    def make(module: Any) -> Callable[..., Any]:
        force = applied(text, precision, dimension, module)
        scope: dict[str, Any] = {"force": force, "gradient": gradient, "rate": rate}
        source = f"def body({', '.join(types)}):\n    return force({', '.join([*given, *reads])})\n"
        exec(source, scope)
        body: Any = scope["body"]
        body.__annotations__, body.source = {**types, "return": precision.vector}, source
        return body

    summed = {"M", "A"} if "M_i" in types else set()
    options: dict[str, Any] = {"numbers": ["table"], "read": READ_AS} if reads else {}
    results = ["acceleration:acceleration_in"]
    return pointwise_kernels(precision, modules, make, results, written={"theta", *summed}, **options)


FIELDS = {
    "density": ("m_i * n_i", ("m_i", "n_i")),
    "mass_fractions": ("fractions_i", ("fractions_i",)),
    "velocity_gradient": ("gradient(M_i, A_i)", ("M_i", "A_i")),
    "shear_rate": ("rate(M_i, A_i)", ("M_i", "A_i")),
}
"""Particle quantities that a function may take as arguments, with their source code in kernels."""


class Body(OwnForce):
    """A force on each particle. ``function(x, v, t, ...)`` returns the acceleration [m/s2] of a particle from its
    position [m], its velocity [m/s] and the time [s].

    The argument ``t`` may be left out. Arguments with the following names are quantities of the particle: ``density``
    [kg/m3], ``mass_fractions`` [-], ``shear_rate`` [1/s], ``velocity_gradient`` [1/s]. Arguments with other names are
    parameters of the function.

    Example::

        def drag(x, v, k):
            return -k * v

        simulation = cortado.Simulation("dam.toml", forces=[cortado.forces.Body(drag, k=2.0)])
    """

    kind, _made_by = "Body", staticmethod(body_kernels)


def term(discretisation: Discretisation, text: Formula, dimension: int, module: Any) -> Callable[..., Any]:
    precision, (real, vector, neighbourhood) = discretisation.precision, discretisation.types
    theta_type, weight = theta_of(precision, text.ranks), pair_functions(discretisation).weight
    force = applied(text, precision, dimension, module)

    def pair(x_ij: vector, v_ij: vector, m_i: real, theta: theta_type, i: int, j: int, s: neighbourhood) -> vector:
        acceleration = vector()
        if i != j:
            acceleration = (weight(x_ij, s) / (s.self_weight * m_i)) * force(x_ij, v_ij, theta)
        return acceleration

    return pair


@cache
def pair_kernels(discretisation: Discretisation, text: Formula, dimension: int) -> Kernels:
    modules = discretisation.modules(topic("pair", text, dimension))
    accelerations = fluid_sum(discretisation, module=modules[0])(term(discretisation, text, dimension, modules[0]))
    tangents = made_tangent(discretisation, lambda taped: term(taped, text, dimension, modules[1]), modules[1])
    adjoints = made_adjoint(discretisation, lambda taped: term(taped, text, dimension, modules[2]), modules[2])
    sums, named = (accelerations, tangents, adjoints), {"before": "acceleration_in", "per": "cell"}
    return sum_kernels("pair_force", modules, sums, "acceleration", **named, numbers=["cell"], written=["theta"])


class Pair(OwnForce):
    """A force between neighbours. ``function(x_ij, v_ij, t, ...)`` returns the force [N], in 2-D per metre of depth, of
    a neighbour on a particle.

    ``x_ij`` [m] and ``v_ij`` [m/s] are the particle's position and velocity relative to the neighbour. The function may
    leave out the time ``t``. The force is multiplied by a weight that falls from 1 at distance 0 to 0 at the support
    radius. A force f conserves momentum if f(-x, -v) = -f(x, v). Walls exert no user-defined pair force.

    Example::

        def pull(x, v, k):
            return -k * x

        simulation = cortado.Simulation("dam.toml", forces=[cortado.forces.Pair(pull, k=1e-3)])
    """

    kind, _made_by = "Pair", staticmethod(pair_kernels)


class Rheology(OwnFunction):
    """A law of viscosity. ``function(shear_rate, viscosity, ...)`` returns the viscosity [Pa s] at a shear rate [1/s].
    The shear rate is sqrt(2 D : D), where D is the symmetric part of the velocity gradient.

    The argument ``viscosity`` [Pa s] is the viscosity of the phase. The law replaces the viscous force of the scene,
    which must have the form "stress".

    Example::

        def cross(shear_rate, viscosity, time):
            return viscosity / (1.0 + time * shear_rate)

        simulation = cortado.Simulation("dam.toml", forces=[cortado.forces.Rheology(cross, time=0.4)])
    """

    kind = "Rheology"
    replaces = "cortado.sph.viscosity"
    """Module of the scene's force that the viscosity law replaces."""

    def force(self, setting: Setting) -> ViscousStress:
        """Raise `InputError` if the function cannot be compiled, or returns a negative or infinite viscosity."""
        if setting.scene.forces.viscosity != "stress":
            found = f"forces.viscosity is {setting.scene.forces.viscosity!r}"
            raise InputError(f"{found}, but must be 'stress' for a viscosity that depends on the shear rate.")
        made = stress_of(setting.scene)(setting, self._law(setting.scene), self.parameters)
        made.compile(self._what)
        self._try({}, setting.scene, setting.layout.precision, setting.layout.device)
        return made

    def check(self, values: Arrays, simulation: Any) -> None:
        """Raise `InputError` if the law returns an invalid viscosity for the parameter ``values``."""
        if "viscosity" in values or any(one.name in values for one in self.parameters):
            self._try(values, simulation.scene, simulation.precision, simulation.device)

    def _law(self, scene: Scene) -> Formula:
        return replace(self._formula, topic=f"{topic('rheology', self._formula, scene.dimension)}_")

    def _try(self, values: Arrays, scene: Scene, precision: Precision, device: Any) -> None:
        each = np.broadcast_to(values.get("viscosity", [phase.viscosity for phase in scene.phase]), len(scene.phase))
        viscosities = {phase.name: float(value) for phase, value in zip(scene.phase, each, strict=True)}
        size = values.get("time_step", scene.solver.time_step)
        known = {one.name: one for one in self.parameters}
        own = {name: values.get(f"{self.name}.{name}", value) for name, value in self._values.items()}
        steps = max((len(v) for n, v in values.items() if n in known and v.ndim > known[n].rank), default=0)
        changes = [t for v in own.values() if isinstance(v, OverTime) for t in v.times]
        time_step = 0.0 if isinstance(size, str) else float(size)
        times = time_step * np.arange(steps) if steps else np.unique([0.0, *changes])
        columns = [times] if len(self._formula.inputs) == 3 else []
        for name, value in own.items():
            found = value.at(times) if isinstance(value, OverTime) else value
            is_vector = known[f"{self.name}.{name}"].rank
            rows = np.broadcast_to(found, (len(times), *found.shape[-1:] * is_vector))
            columns += [padded(rows) if is_vector else rows]
        thetas = np.column_stack([np.zeros((len(times), 0)), *columns])
        check_law(self._what, self._law(scene), viscosities, thetas, precision, device)
