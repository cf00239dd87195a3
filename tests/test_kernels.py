"""Every derivative kernel by itself, in float64 on random data: <J v, w> = <v, J^T w>, and J v against differences.

Kernels are launched directly, their arguments found by name: inputs as given, tangents with ``_dot``, adjoints with
``_bar``. Data are of size 1, so that no term hides behind another.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from types import MappingProxyType
from typing import Any

import numpy as np
import pytest
import warp as wp

from cortado.device.grid import Grid
from cortado.device.launching import Bundles, bound, bundles_of
from cortado.device.precision import FLOAT32, FLOAT64, Precision
from cortado.device.reduction import TreeReduction, add, sum_and_maximum, sum_of
from cortado.discretise.smoothing import CUBIC_SPLINE
from cortado.particles.moving_walls import WallArrays
from cortado.particles.neighbourhood import Discretisation, neighbourhood_type
from cortado.particles.neighbours import NeighbourSearch
from cortado.particles.state import Layout
from cortado.scene.parameter_values import reference_density, reference_density_adjoint, reference_density_tangent
from cortado.solvers.pcisph.pressure import pressure_force_kernels, pressure_kernels
from cortado.solvers.pcisph.steps import begin_adjoint_kernel, density_ratio_kernels, wall_kernels
from cortado.sph.density import density_kernels
from cortado.sph.diffusion import Diffusion, diffusion_kernels
from cortado.sph.free_energy import CONSTANT, DEGENERATE, DOUBLE_WELL, MISCIBLE
from cortado.sph.gravity import gravity_kernels
from cortado.sph.integration import integration_kernels
from cortado.sph.mixture import mixture_kernels
from cortado.sph.stress_kernels import stress_kernels
from cortado.sph.viscosity import viscosity_kernels
from cortado.sph.viscosity_law import newtonian_law
from finite_differences import central_difference, decades, plateau

N, WALLS = 60, 40
SUPPORT = 1.0
CPU = wp.get_device("cpu")
DISCRETISATION = Discretisation(CUBIC_SPLINE, FLOAT64, periodic=True)
"""Of clouds with a period of 0 too, which have no other image."""

Values = dict[str, np.ndarray]


class Kernels:
    """All kernels at once, so that each Warp module is compiled once."""

    density = density_kernels(DISCRETISATION)
    walls = wall_kernels(DISCRETISATION)
    density_ratio = density_ratio_kernels(DISCRETISATION)
    pressure = pressure_kernels(DISCRETISATION)
    force = pressure_force_kernels(DISCRETISATION)
    integration = integration_kernels(FLOAT64, False)
    begin_adjoint = begin_adjoint_kernel(DISCRETISATION)
    gravity = gravity_kernels(FLOAT64, False)
    pairwise_no_slip = viscosity_kernels(DISCRETISATION, True)
    pairwise = viscosity_kernels(DISCRETISATION, False)
    mixture = mixture_kernels(FLOAT64, 3, False)
    diffusion = MappingProxyType(
        {
            variant: diffusion_kernels(Diffusion(DISCRETISATION, *kinds))
            for variant, kinds in {
                "2, double well, degenerate": (2, DOUBLE_WELL, DEGENERATE),
                "2, miscible, constant": (2, MISCIBLE, CONSTANT),
                "3, double well, constant": (3, DOUBLE_WELL, CONSTANT),
                "3, miscible, degenerate": (3, MISCIBLE, DEGENERATE),
                "4, double well, degenerate": (4, DOUBLE_WELL, DEGENERATE),
            }.items()
        }
    )


def array(values: np.ndarray, dtype: Any = wp.vec3d) -> Any:
    return wp.array(values, dtype=dtype, device=CPU)


SINGLE: Values = {"rounds": np.array([1]), "x_before": np.zeros((N, 3)), "v_before": np.zeros((N, 3)), "cell": 0.027}
"""Of a single scene in the first iteration."""


def launch(kernel: Any, threads: int = N, **given: Any) -> Values:
    """Run a kernel on arguments by name and return every array argument after it. An array with an axis for the scenes
    of a batch has none here."""
    given = {"particles": N, "k": 0, **SINGLE, **given}
    types, bundles = {a.label: a.type for a in kernel.adj.args}, bundles_of(kernel)
    for label, fields in bundles.items():
        own = types.pop(label).vars
        types |= {name: own[field].type for field, name in fields.items()}
    values = {}
    for name, kind in types.items():
        value = given[name]
        if isinstance(value, np.ndarray):
            value = array(value[None] if kind.ndim == 2 else value, kind.dtype)
        values[name] = value
    wp.launch(kernel, threads, inputs=bound(kernel, (values,), {}, Bundles()), device=CPU)
    return {
        name: value.numpy()[0] if types[name].ndim == 2 else value.numpy()
        for name, value in values.items()
        if isinstance(value, wp.array)
    }


@dataclass(frozen=True)
class Cloud:
    """Random fluid and wall particles in a small box, with their lists."""

    x: np.ndarray
    neighbourhood: Any
    search: NeighbourSearch
    dimension: int

    def vectors(self, seed: int, n: int = N) -> np.ndarray:
        """(n, 3) of size 1; z is 0 in 2-D."""
        values = np.random.default_rng(seed).standard_normal((n, 3))
        values[:, self.dimension :] = 0.0
        return values


@cache
def cloud(name: str, seed: int = 7) -> Cloud:
    """``"3-D"``, ``"2-D"`` or ``"periodic"`` (along x)."""
    dimension = 2 if name == "2-D" else 3
    side = {2: 3.5, 3: 2.3}[dimension]
    random = np.random.default_rng(seed)
    x, walls = random.uniform(0.0, side, (N, 3)), random.uniform(0.0, side, (WALLS, 3))
    walls[:, 1] = random.uniform(-0.4, 0.0, WALLS)
    x[:, dimension:] = walls[:, dimension:] = 0.0
    period = np.array([side, 0.0, 0.0]) * (name == "periodic")
    grid = Grid.around(np.full(3, -0.4)[:dimension], np.full(3, side)[:dimension], period, 1.03 * SUPPORT, 512)
    weights, layout = random.uniform(0.5, 1.5, WALLS), Layout(N, 1, FLOAT64, CPU)
    feet = np.stack([0.0 * walls[:, 0], -walls[:, 1], 0.0 * walls[:, 2]], axis=1)
    known = WallArrays(walls, weights, weights, feet, 0.0 * feet, *[np.full(WALLS, -1)] * 2)
    search = NeighbourSearch(DISCRETISATION, grid, known, layout, 100)
    s = neighbourhood_type(FLOAT64)()
    s.particles = N
    s.neighbours, s.fluid_count = search.neighbours, search.fluid_count
    s.filling, s.count = search.filling, search.count
    for name, values in search.walls.items():
        setattr(s, name, values)
    s.support, s.per_support, s.reach = SUPPORT, 1.0 / SUPPORT, 1.03 * SUPPORT
    s.normalisation = CUBIC_SPLINE.normalisation(dimension, SUPPORT)
    s.self_weight = float(CUBIC_SPLINE.weight(np.zeros(1), dimension, SUPPORT)[0])
    s.volume, s.response_scale, s.laplacian_correction = 0.11, 30.0**-0.5, 1.3
    s.period = wp.vec3d(*period)
    s.frequency = wp.vec3d(1.0 / side if period.any() else 0.0, 0.0, 0.0)
    search.sort(array(x))
    x = x[search.order.numpy()[:N]]
    search.fill(s, array(x), array(np.array([-1]), wp.int32))
    count, fluid_count = search.count.numpy(), search.fluid_count.numpy()
    assert search.needed < 100
    assert fluid_count.mean() > 8 and (count - fluid_count).mean() > 1
    return Cloud(x, s, search, dimension)


VECTORS = {"x", "v", "acceleration", "acceleration_in", "gravity", "x_star"}
VECTORS |= {"x_free", "v_free", "outlet_in", "nozzle_path"}


class Operation:
    """A differentiable piece of the step on one cloud: values in, values out."""

    inputs: Sequence[str]
    outputs: Sequence[str]

    passed: Sequence[str] = ()
    """Inputs whose adjoint is handed through and not added to."""

    def __init__(self, cloud: Cloud):
        self.cloud = cloud
        random = np.random.default_rng(11)
        self.s = cloud.neighbourhood
        self.start: Values = {
            "x": cloud.x,
            "v": cloud.vectors(1),
            "acceleration": cloud.vectors(2),
            **{name: random.uniform(0.6, 1.6, N) for name in ("n", "m", "rho_0", "mu")},
            "y": random.uniform(0.4, 1.0, N),
            "p_in": random.uniform(0.0, 1.0, N) * (random.uniform(0.0, 1.0, N) < 0.6),
            "time_step": np.array([0.2]),
            "gravity": cloud.vectors(3, n=4),
        }
        if "acceleration_in" in self.inputs:
            self.start["acceleration_in"] = self.start.pop("acceleration")

    def directions(self, seed: int, names: Sequence[str] | None = None) -> Values:
        """A random tangent, 0 but for ``names``."""
        random = np.random.default_rng(seed)
        found = {}
        for name in self.inputs:
            value = random.standard_normal(self.start[name].shape)
            if name in VECTORS:
                value[:, self.cloud.dimension :] = 0.0
            found[name] = value if names is None or name in names else np.zeros_like(value)
        return found

    def weights(self, seed: int) -> Values:
        """Random adjoints of the outputs."""
        random = np.random.default_rng(seed)
        forward = self.forward(self.start)
        return {name: random.standard_normal(forward[name].shape) for name in self.outputs}


def dotted(dots: Values) -> Values:
    return {f"{name}_dot": value for name, value in dots.items()}


def zeros(*names: str) -> Values:
    """Empty adjoints: vectors for x, v and accelerations, reals for the rest."""
    vectors = ("x_bar", "v_bar", "scaled_bar", "acceleration_bar")
    return {name: np.zeros((N, 3) if name in vectors else N) for name in names}


class Family(Operation):
    """Kernels of one quantity: its formula, tangent and adjoint, which take what is ``given`` besides inputs."""

    kernels: Any = None
    own: Sequence[str] = ("x",)
    """Inputs of particles that the adjoint adds to."""
    vectors = True
    """Whether the quantity is one, or a number."""

    def __init__(self, cloud):
        super().__init__(cloud)
        self.given: dict[str, Any] = {"s": self.s}
        (self.name,), self.empty = self.outputs, np.zeros((N, 3) if self.vectors else N)

    def forward(self, values):
        return launch(self.kernels.forward, **{**self.given, **values, self.name: self.empty})

    def recorded(self, values):
        """What the tangent and the adjoint know."""
        return {**self.given, **values}

    def tangent(self, values, dots):
        given = {**self.recorded(values), **dotted(dots), f"{self.name}_dot": self.empty}
        return {self.name: launch(self.kernels.tangent, **given)[f"{self.name}_dot"]}

    def adjoint(self, values, bars, **more):
        """With the adjoints of what is given ``more``, as the kernel leaves them."""
        given = {**self.recorded(values), f"{self.name}_bar": bars[self.name], **more}
        found = launch(self.kernels.adjoint, **given, **zeros(*(f"{name}_bar" for name in self.own)))
        handed = {"acceleration_in": bars["acceleration"]} if "acceleration_in" in self.passed else {}
        return {**{name: found[f"{name}_bar"] for name in self.own}, **handed, **{name: found[name] for name in more}}


class Density(Family):
    inputs, outputs, vectors, kernels = ("x",), ("n",), False, Kernels.density


class WallYield(Family):
    inputs, outputs, vectors, kernels = ("x",), ("y",), False, Kernels.walls

    def recorded(self, values):
        return {**super().recorded(values), "y": self.forward(values)["y"], "slope_bar": np.zeros((N, 3))}


class DensityRatio(Operation):
    """The pressure relaxation of heavy particles among lighter ones."""

    inputs, outputs = ("x", "m", "wall_y"), ("y",)

    def __init__(self, cloud):
        super().__init__(cloud)
        self.start["wall_y"] = self.start.pop("y")

    def forward(self, values):
        return launch(Kernels.density_ratio.forward, s=self.s, **values, t=np.zeros(N), y=np.zeros(N))

    def tangent(self, values, dots):
        given = {**values, **dotted(dots), **{name: self.forward(values)[name] for name in ("t", "y")}}
        return {"y": launch(Kernels.density_ratio.tangent, s=self.s, **given, y_dot=np.zeros(N))["y_dot"]}

    def adjoint(self, values, bars):
        given = {**values, **{name: self.forward(values)[name] for name in ("t", "y")}}
        factor, total = Kernels.density_ratio.adjoint
        bar = launch(factor, s=self.s, **given, y_bar=bars["y"], t_bar=np.zeros(N))
        found = launch(total, s=self.s, **given, t_bar=bar["t_bar"], **zeros("x_bar", "m_bar"))
        return {"x": found["x_bar"], "m": found["m_bar"], "wall_y": bar["y_bar"]}


class Viscosity(Family):
    inputs, outputs = ("x", "v", "n", "m", "mu", "acceleration_in"), ("acceleration",)
    passed, own = ("acceleration_in",), ("x", "v", "n", "m", "mu")

    def __init__(self, cloud):
        super().__init__(cloud)
        self.given["kappa"] = 10.0


class Pairwise(Viscosity):
    kernels = Kernels.pairwise


class PairwiseWithFriction(Viscosity):
    kernels = Kernels.pairwise_no_slip


class WithoutViscosity(Pairwise):
    """Every other particle has none, so that there are pairs without any."""

    inputs = ("x", "v", "n", "m", "acceleration_in")

    def __init__(self, cloud):
        super().__init__(cloud)
        self.start["mu"] = np.where(np.arange(N) % 2, 0.0, self.start["mu"])

    def tangent(self, values, dots):
        return super().tangent(values, {**dots, "mu": np.zeros(N)})


class Stress(Viscosity):
    """Viscosity as a stress: sums over neighbours, and then the force."""

    inputs = ("x", "v", "m", "mu", "acceleration_in")
    sticks = False

    def __init__(self, cloud):
        super().__init__(cloud)
        self.kernels = stress_kernels(DISCRETISATION, cloud.dimension, newtonian_law(), self.sticks)
        none = np.zeros((1, 1))
        self.given = {"s": self.s, "control": 1.3, "least": 0.05, "theta": none, "theta_dot": none}
        self.room = {name: np.zeros((N, 3, 3)) for name in "MAT"} | {name: np.zeros(N) for name in ("R", "eta")}

    def known(self, values):
        """Arguments of all kernels after the first two."""
        known = {**self.given, **values, **self.room}
        known |= launch(self.kernels.moments.forward, **known)
        known["A_u"] = known["A"]
        return known | launch(self.kernels.stress.forward, **known)

    def forward(self, values):
        return launch(self.kernels.force.forward, **self.known(values), acceleration=np.zeros((N, 3)))

    def tangent(self, values, dots):
        known = {**self.known(values), **dotted(dots), **{f"{name}_dot": value for name, value in self.room.items()}}
        known |= launch(self.kernels.moments.tangent, **known)
        known |= launch(self.kernels.stress.tangent, **known, A_u_dot=known["A_dot"])
        found = launch(self.kernels.force.tangent, **known, acceleration_dot=np.zeros((N, 3)))
        return {"acceleration": found["acceleration_dot"]}

    def adjoint(self, values, bars):
        known = {**self.known(values), **{f"{name}_bar": value for name, value in self.room.items()}}
        known |= {"theta_bar": np.zeros((N, 1)), "A_u_bar": np.zeros((N, 3, 3))}
        known["acceleration_bar"] = bars["acceleration"]
        known |= zeros("x_bar", "v_bar", "m_bar", "mu_bar")
        of_stress, of_particles = self.kernels.force.adjoint
        known |= launch(of_stress, **known)
        known |= launch(self.kernels.stress.adjoint, **known)
        known["A_bar"] = known["A_bar"] + known["A_u_bar"]
        for kernel in self.kernels.moments.adjoint, of_particles:
            known |= launch(kernel, **known)
        found = {name: known[f"{name}_bar"] for name in ("x", "v", "m", "mu")}
        return {**found, "acceleration_in": bars["acceleration"]}


class StressWithoutSlip(Stress):
    sticks = True


class GravityTable(Operation):
    inputs, outputs = ("gravity", "acceleration_in"), ("acceleration",)
    step = np.array([2], dtype=np.int32)

    def forward(self, values):
        return launch(Kernels.gravity.forward, **values, step=self.step, acceleration=np.zeros((N, 3)))

    def tangent(self, values, dots):
        return launch(Kernels.gravity.tangent, **dots, step=self.step, acceleration=np.zeros((N, 3)))

    def adjoint(self, values, bars):
        total = sum_of(FLOAT64.vector, N, CPU)(array(bars["acceleration"])).numpy()
        found = launch(Kernels.gravity.adjoint, 1, total=total, step=self.step, gravity_bar=np.zeros((4, 3)))
        return {"gravity": found["gravity_bar"], "acceleration_in": bars["acceleration"]}


class Pressure(Operation):
    """The pressure alone; its adjoint is fused with what comes before and after it, see `Iterations`."""

    inputs = ("x_star", "n", "m", "rho_0", "y", "p_in", "time_step")
    outputs = ("p_out", "c")

    def __init__(self, cloud):
        super().__init__(cloud)
        self.start["x_star"] = self.start.pop("x") + 0.05 * cloud.vectors(4)

    def forward(self, values):
        out = {"p_out": np.zeros(N), "c": np.zeros(N), "error": wp.zeros(N, dtype=wp.vec2d, device=CPU)}
        return launch(Kernels.pressure.forward, s=self.s, stiffness=0.1, **values, **out)

    def tangent(self, values, dots):
        given = {**values, "p_out": self.forward(values)["p_out"], **dotted(dots)}
        out = {"p_out_dot": np.zeros(N), "c_dot": np.zeros(N)}
        found = launch(Kernels.pressure.tangent, s=self.s, stiffness=0.1, **given, **out)
        return {"p_out": found["p_out_dot"], "c": found["c_dot"]}


class PressureForce(Operation):
    """The pressure force and the prediction that follows it, alone."""

    inputs = ("x", "v", "acceleration", "m", "c", "time_step")
    outputs = ("x_star", "v_star")

    def __init__(self, cloud):
        super().__init__(cloud)
        self.start["c"] = self.start["p_in"]

    def forward(self, values):
        return launch(Kernels.force.forward, s=self.s, **values, x_star=np.zeros((N, 3)), v_star=np.zeros((N, 3)))

    def tangent(self, values, dots):
        given = {**values, "v_star": self.forward(values)["v_star"], **dotted(dots)}
        out = {"x_star_dot": np.zeros((N, 3)), "v_star_dot": np.zeros((N, 3))}
        found = launch(Kernels.force.tangent, s=self.s, **given, **out)
        return {"x_star": found["x_star_dot"], "v_star": found["v_star_dot"]}


class Iterations(Operation):
    """A prediction and then so many pressure iterations, in the order of the solver; the new state in scene order."""

    inputs = ("x", "v", "acceleration", "n", "m", "rho_0", "y", "p_in", "time_step")
    outputs = ("x_new", "v_new", "p_new")
    iterations = 1
    stiffness = 0.03

    def __init__(self, cloud):
        super().__init__(cloud)
        self.order = np.random.default_rng(13).permutation(N).astype(np.int32)

    def record(self, values):
        """(x*, v*), p and c of every iteration."""
        out = {"x_star": np.zeros((N, 3)), "v_star": np.zeros((N, 3))}
        first = launch(Kernels.integration.predict, **{**values, **out})
        states, pressures, cs = [first], [values["p_in"]], []
        for _ in range(self.iterations):
            given = {**values, "x_star": states[-1]["x_star"], "p_in": pressures[-1], "stiffness": self.stiffness}
            given |= {"p_out": np.zeros(N), "c": np.zeros(N), "error": wp.zeros(N, dtype=wp.vec2d, device=CPU)}
            found = launch(Kernels.pressure.forward, s=self.s, **given)
            pressures.append(found["p_out"])
            cs.append(found["c"])
            states.append(launch(Kernels.force.forward, s=self.s, **values, c=cs[-1], **out))
        return states, pressures, cs

    def in_scene_order(self, state):
        found = np.zeros((2, N, 3))
        found[0, self.order], found[1, self.order] = state["x_star"], state["v_star"]
        return {"x_new": found[0], "v_new": found[1]}

    def forward(self, values):
        states, pressures, _ = self.record(values)
        return {**self.in_scene_order(states[-1]), "p_new": pressures[-1]}

    def tangent(self, values, dots):
        states, pressures, cs = self.record(values)
        dot, out = dotted(dots), {"x_star_dot": np.zeros((N, 3)), "v_star_dot": np.zeros((N, 3))}
        state = launch(Kernels.integration.predict_tangent, **values, **dot, v_star=states[0]["v_star"], **out)
        p_dot = dots["p_in"]
        for k in range(self.iterations):
            given = {**values, "x_star": states[k]["x_star"], "p_in": pressures[k], "p_out": pressures[k + 1]}
            given_dot = {**dot, "x_star_dot": state["x_star_dot"], "p_in_dot": p_dot}
            reals = {"p_out_dot": np.zeros(N), "c_dot": np.zeros(N)}
            found = launch(Kernels.pressure.tangent, s=self.s, stiffness=self.stiffness, **given, **given_dot, **reals)
            p_dot = found["p_out_dot"]
            given = {**values, "c": cs[k], "v_star": states[k + 1]["v_star"]}
            state = launch(Kernels.force.tangent, s=self.s, **given, **dot, c_dot=found["c_dot"], **out)
        new = {"x_star": state["x_star_dot"], "v_star": state["v_star_dot"]}
        return {**self.in_scene_order(new), "p_new": p_dot}

    def adjoint(self, values, bars):
        states, pressures, cs = self.record(values)
        names = ("time_step", "x", "v", "n", "m", "rho_0", "mu", "scaled", "y", "p")
        given = {**values, "x_scene_bar": bars["x_new"], "v_scene_bar": bars["v_new"], "v_star": states[-1]["v_star"]}
        given |= zeros(*(f"{name}_bar" for name in names))
        bar = launch(Kernels.begin_adjoint, order=self.order, **given)
        bar = {name: value for name, value in bar.items() if name.endswith("_bar")}
        bar["p_bar"] = bars["p_new"]
        for k in reversed(range(self.iterations)):
            given = {**values, "p_in": pressures[k], "p_out": pressures[k + 1], "c": cs[k], "r": np.zeros(N)}
            found = launch(Kernels.force.adjoint, s=self.s, stiffness=self.stiffness, **given, **bar)
            bar |= {name: found[name] for name in bar if name in found}
            given = {**values, **{name: states[k][name] for name in ("x_star", "v_star")}, "r": found["r"]}
            found = launch(Kernels.pressure.adjoint, s=self.s, **given, **bar)
            bar |= {name: found[name] for name in bar if name in found}
        found = launch(Kernels.integration.acceleration_adjoint, **values, **bar, acceleration_bar=np.zeros((N, 3)))
        return {
            **{name: bar[f"{name}_bar"] for name in ("x", "v", "n", "m", "rho_0", "y")},
            "acceleration": found["acceleration_bar"],
            "p_in": bar["p_bar"],
            "time_step": bar["time_step_bar"].sum(keepdims=True),
        }


class Blend(Operation):
    """The materials of 3 phases; with them go the fractions themselves, into the scene's order."""

    inputs, outputs, passed = ("c", "rest_density", "viscosity"), ("rho_0", "mu", "c_new"), ("c",)
    kernels = Kernels.mixture

    def __init__(self, cloud):
        super().__init__(cloud)
        random = np.random.default_rng(17)
        self.order = random.permutation(N).astype(np.int32)
        self.start |= {
            "c": random.dirichlet(np.ones(3), N) + 0.03 * random.standard_normal((N, 3)),
            "rest_density": random.uniform(0.6, 1.6, 3),
            "viscosity": random.uniform(0.1, 2.0, 3),
        }

    def in_scene_order(self, c):
        return launch(self.kernels.order.unsort, order=self.order, a=c, a_scene=np.zeros_like(c))["a_scene"]

    def forward(self, values):
        found = launch(self.kernels.blend.forward, **{**values, "rho_0": np.zeros(N), "mu": np.zeros(N)})
        return {**found, "c_new": self.in_scene_order(values["c"])}

    def materials(self, values):
        return {name: array for name, array in self.forward(values).items() if name in ("rho_0", "mu")}

    def tangent(self, values, dots):
        given = {**values, **dotted(dots), **self.materials(values)}
        found = launch(self.kernels.blend.tangent, **given, rho_0_dot=np.zeros(N), mu_dot=np.zeros(N))
        return {"rho_0": found["rho_0_dot"], "mu": found["mu_dot"], "c_new": self.in_scene_order(dots["c"])}

    def adjoint(self, values, bars):
        given = {**values, **self.materials(values), "order": self.order, "c_scene_bar": bars["c_new"]}
        given |= {f"{name}_bar": bars[name] for name in ("rho_0", "mu")} | {"c_bar": np.zeros((N, 3))}
        empty = zeros("rest_density_bar", "viscosity_bar")
        sums = {name: np.stack([values] * 3, axis=1) for name, values in empty.items()}
        found = launch(self.kernels.blend.adjoint, **given, **sums)
        totals = {name: found[f"{name}_bar"].sum(axis=0) for name in ("rest_density", "viscosity")}
        return {"c": found["c_bar"], **totals}


class Potential(Operation):
    """The chemical potential, and what mobility makes of it, alone; its adjoint is part of `Substep`'s."""

    inputs, outputs = ("x", "n", "m", "c", "mobility", "interface_width"), ("chi", "w")
    variant = "2, double well, degenerate"

    def __init__(self, cloud):
        super().__init__(cloud)
        self.kernels, phases = Kernels.diffusion[self.variant], int(self.variant[0])
        random = np.random.default_rng(19)
        self.start |= {
            "c": random.dirichlet(np.ones(phases), N) + 0.03 * random.standard_normal((N, phases)),
            "w": random.uniform(0.6, 1.6, N),
            "chi": random.standard_normal((N, phases)),
            "mobility": np.array([0.8]),
            "interface_width": np.array([0.4]),
        }
        self.given = {"s": self.s, "strength": 1.7, "substeps": 3}
        self.empty = np.zeros((N, phases))

    def forward(self, values):
        return launch(self.kernels.potential.forward, **{**self.given, **values, "chi": self.empty, "w": np.zeros(N)})

    def tangent(self, values, dots):
        out = {"chi_dot": self.empty, "w_dot": np.zeros(N)}
        found = launch(self.kernels.potential.tangent, **{**self.given, **values, **dotted(dots), **out})
        return {"chi": found["chi_dot"], "w": found["w_dot"]}


class Flux(Potential):
    """The change of the fractions under a given potential, alone."""

    inputs, outputs = ("x", "n", "m", "c", "w", "chi", "time_step"), ("c_new",)

    def forward(self, values):
        return launch(self.kernels.flux.forward, **self.given, **values, c_new=self.empty)

    def tangent(self, values, dots):
        found = launch(self.kernels.flux.tangent, **self.given, **values, **dotted(dots), c_new_dot=self.empty)
        return {"c_new": found["c_new_dot"]}


class Substep(Potential):
    """One step of diffusion."""

    inputs, outputs = ("x", "n", "m", "c", "time_step", "mobility", "interface_width"), ("c_new",)
    passed = ("c",)

    def record(self, values):
        found = Potential.forward(self, values)
        return {**values, "chi": found["chi"], "w": found["w"]}

    def forward(self, values):
        return Flux.forward(self, self.record(values))

    def tangent(self, values, dots):
        found = Potential.tangent(self, values, dots)
        return Flux.tangent(self, self.record(values), {**dots, **found})

    def adjoint(self, values, bars):
        given = {**self.given, **self.record(values)}
        scale, flux = self.kernels.flux.adjoint
        given |= launch(scale, **{**given, "c_bar": bars["c_new"], "y": self.empty})
        shares = ("time_step_bar", "mobility_bar", "interface_width_bar")
        bar = {"c_bar": bars["c_new"], **zeros("x_bar", "n_bar", "m_bar", *shares)}
        found = launch(flux, **{**given, **bar, "z": self.empty})
        bar |= {name: found[name] for name in bar if name in found}
        found = bar | launch(self.kernels.potential.adjoint, **{**given, **bar, "z": found["z"]})
        return {
            **{name: found[f"{name}_bar"] for name in ("x", "n", "m", "c")},
            **{name.removesuffix("_bar"): found[name].sum(keepdims=True) for name in shares},
        }


SUBSTEPS = [Substep] + [
    type(name, (Substep,), {"variant": variant})
    for name, variant in {
        "SubstepOfMiscible": "2, miscible, constant",
        "SubstepOfThree": "3, double well, constant",
        "SubstepOfThreeMiscible": "3, miscible, degenerate",
        "SubstepOfFour": "4, double well, degenerate",
    }.items()
]
TwoIterations, FiveIterations = (
    type(name, (Iterations,), {"iterations": count}) for name, count in (("TwoIterations", 2), ("FiveIterations", 5))
)
VISCOUS = [Pairwise, PairwiseWithFriction, Stress, StressWithoutSlip, WithoutViscosity]
STEPS = [Density, WallYield, DensityRatio, GravityTable, Iterations, TwoIterations, FiveIterations, Blend]
ADJOINT = [*STEPS, *VISCOUS, *SUBSTEPS]
TANGENT = [*ADJOINT, Pressure, PressureForce, Potential, Flux]
clouds = pytest.mark.parametrize("where", ["3-D", "2-D", "periodic"])


def by_input(operations: Sequence[type[Operation]]) -> Callable:
    """One test for each input of each operation, so that a wrong term cannot hide, and one for all together."""
    cases = [(operation, name) for operation in operations for name in (*operation.inputs, "all")]
    ids = [f"{operation.__name__}-{name}" for operation, name in cases]
    return pytest.mark.parametrize("operation, name", cases, ids=ids)


def inner(a: Values, b: Values, names: Sequence[str]) -> float:
    return float(sum((a[name] * b[name]).sum() for name in names))


def norm(a: Values, names: Sequence[str]) -> float:
    return inner(a, a, names) ** 0.5


@clouds
@by_input(ADJOINT)
def test_adjoint_is_the_transpose_of_the_tangent(operation, name, where):
    op = operation(cloud(where))
    directions = op.directions(21, None if name == "all" else [name])
    tangent = op.tangent(op.start, directions)
    assert norm(tangent, op.outputs) > 1e-3
    for outputs in (*([output] for output in op.outputs), op.outputs):
        weights = {k: w if k in outputs else np.zeros_like(w) for k, w in op.weights(22).items()}
        adjoint = op.adjoint(op.start, weights)
        forward, backward = inner(tangent, weights, op.outputs), inner(adjoint, directions, op.inputs)
        assert abs(forward - backward) <= 1e-12 * norm(tangent, outputs) * norm(weights, outputs)


@clouds
@by_input(TANGENT)
def test_tangent_is_the_limit_of_central_differences(operation, name, where):
    op = operation(cloud(where))
    directions = op.directions(31, None if name == "all" else [name])
    check_differences(op, directions, op.tangent(op.start, directions))


def check_differences(op: Operation, directions: Values, tangent: Values) -> None:
    for output in op.outputs:
        size = norm(tangent, [output])

        def off(h, output=output):
            found = central_difference(lambda values: op.forward(values)[output], op.start, directions, h)
            return np.linalg.norm(found - tangent[output])

        found = [off(h) for h in decades(3.5, 6.5)]
        assert plateau(found) < 1e-7 * size or max(found) == size == 0.0, f"{output}: {plateau(found) / size:.1e}"


@clouds
def test_some_pressures_are_active_and_some_are_not(where):
    """Else the clamp would not be tested."""
    op = FiveIterations(cloud(where))
    for p in op.record(op.start)[1]:
        assert 0.1 < (p > 0).mean() < 0.95


@clouds
@pytest.mark.parametrize("operation", [Density, WallYield, PairwiseWithFriction, StressWithoutSlip, Blend, Substep])
def test_adjoints_are_added(operation, where, monkeypatch):
    """What other terms left in the adjoints of particles and of scalars stays."""
    op = operation(cloud(where))
    bars = op.weights(41)
    alone = op.adjoint(op.start, bars)
    monkeypatch.setitem(globals(), "zeros", lambda *names, make=zeros: {k: v + 1.0 for k, v in make(*names).items()})
    added = op.adjoint(op.start, bars)
    for name in set(op.inputs) - set(op.passed):
        one = 1.0 if len(op.start[name]) == N else N
        np.testing.assert_allclose(added[name], alone[name] + one, rtol=1e-12, atol=1e-12)


@clouds
@pytest.mark.parametrize("operation", ADJOINT)
def test_same_bits_twice(operation, where):
    op = operation(cloud(where))
    bars = op.weights(51)
    first, second = (op.adjoint(op.start, bars) for _ in range(2))
    assert all(first[name].tobytes() == second[name].tobytes() for name in op.inputs)


def test_sort_and_unsort_are_inverses():
    there = cloud("3-D")
    random = np.random.default_rng(61)
    order = random.permutation(N).astype(np.int32)
    x, v, m, c = there.vectors(62), there.vectors(63), random.random(N), random.random((N, 3))
    given = {"order": order, "x_scene": x, "v_scene": v, "m_scene": m}
    found = launch(Kernels.integration.sort, **given, x=np.zeros((N, 3)), v=np.zeros((N, 3)), m=np.zeros(N))
    for name, values in (("x", x), ("v", v), ("m", m)):
        np.testing.assert_array_equal(found[name], values[order])
    given = {"order": order, "x": found["x"], "v": found["v"]}
    back = launch(Kernels.integration.unsort, **given, x_scene=np.zeros((N, 3)), v_scene=np.zeros((N, 3)))
    np.testing.assert_array_equal(back["x_scene"], x)
    np.testing.assert_array_equal(back["v_scene"], v)
    back = launch(Kernels.integration.collect_masses, order=order, m_bar=found["m"], m_scene_bar=m)
    np.testing.assert_array_equal(back["m_scene_bar"], 2.0 * m)
    found = launch(Kernels.mixture.order.sort, order=order, a_scene=c, a=np.zeros((N, 3)))
    np.testing.assert_array_equal(found["a"], c[order])
    back = launch(Kernels.mixture.order.unsort, order=order, a=found["a"], a_scene=np.zeros((N, 3)))
    np.testing.assert_array_equal(back["a_scene"], c)


@pytest.mark.parametrize("phases", [1, 2, 3])
def test_derivatives_of_masses(phases):
    random = np.random.default_rng(71)
    c, density = random.dirichlet(np.ones(phases), N), random.uniform(800.0, 2000.0, phases)
    c_dot, density_dot, bar = random.standard_normal((N, phases)), random.standard_normal(phases), random.random(N)
    tangent = reference_density_tangent(c, density, c_dot, density_dot)
    step = 1e-30j
    np.testing.assert_allclose(
        tangent, np.imag(reference_density(c + step * c_dot, density + step * density_dot)) / 1e-30, 1e-13
    )
    c_bar, density_bar = reference_density_adjoint(c, density, bar)
    backward = (c_bar * c_dot).sum() + (density_bar * density_dot).sum()
    assert backward == pytest.approx(bar @ tangent, rel=1e-13)
    assert reference_density(np.eye(phases), density) == pytest.approx(density, rel=1e-15)


SIZES = [1, 2, 63, 64, 65, 128, 4096, 4097, 5000]
precisions = pytest.mark.parametrize("precision", [FLOAT32, FLOAT64], ids=lambda precision: precision.name)


def summed(tree: TreeReduction, values: np.ndarray, dtype: Any) -> np.ndarray:
    return tree(wp.array(values, dtype=dtype, device=CPU)).numpy()


TYPES: dict[str, Callable[[Precision], Any]] = {
    "numbers": lambda precision: precision.real,
    "vectors": lambda precision: precision.vector,
    "four fractions": lambda precision: precision.fractions(4),
    "matrices": lambda precision: wp.types.matrix(shape=(3, 3), dtype=precision.real),
}
types = pytest.mark.parametrize("type_of", TYPES.values(), ids=TYPES)


@precisions
@types
@pytest.mark.parametrize("size", SIZES)
def test_sum_of(size, type_of, precision: Precision):
    dtype = type_of(precision)
    one = getattr(dtype, "_shape_", ())
    values = np.random.default_rng(size).standard_normal((size, *one)).astype(precision.numpy)
    tree = sum_of(dtype, size, CPU)
    first, second = (summed(tree, values, dtype).copy() for _ in range(2))
    again = summed(sum_of(dtype, size, CPU), values, dtype)
    assert first.shape == (1, *one)
    assert first.tobytes() == second.tobytes() == again.tobytes()
    error = 20 * np.finfo(precision.numpy).eps * np.abs(values).sum()
    np.testing.assert_allclose(first[0], values.astype(np.float64).sum(axis=0), rtol=0, atol=error)
    whole = np.arange(values.size).reshape(values.shape) % 7  # every partial sum is exact
    np.testing.assert_array_equal(summed(tree, whole.astype(precision.numpy), dtype)[0], whole.sum(axis=0))


@precisions
@types
def test_add(type_of, precision: Precision):
    dtype = type_of(precision)
    shape = (N, *getattr(dtype, "_shape_", ()))
    values, total = np.random.default_rng(81).standard_normal((2, *shape)).astype(precision.numpy)
    target = array(total, dtype)
    add(array(values, dtype), target)
    np.testing.assert_array_equal(target.numpy(), total + values)


@precisions
@pytest.mark.parametrize("size", SIZES)
def test_sum_and_maximum(size, precision: Precision):
    values = np.random.default_rng(size).uniform(-2.0, -1.0, (size, 2)).astype(precision.numpy)
    tree, error = sum_and_maximum(size, precision, CPU), 20 * float(np.finfo(precision.numpy).eps)
    for place in {0, size // 2, size - 1}:
        values[place, 1] = -0.5
        (found,) = summed(tree, values, precision.pair)
        assert found[0] == pytest.approx(values[:, 0].astype(np.float64).sum(), rel=error)
        assert found[1] == -0.5
        values[place, 1] = -1.5
