"""The checks of `tests/test_kernels.py` for kernels of forces and parts that not every scene has: surface tension,
forces of one function, the emitter; and of what is read of states: vorticity and the push of walls."""

import ast
from pathlib import Path

import numpy as np
import pytest
import warp as wp

import cortado
import test_kernels
from cortado import Simulation
from cortado.forces import Body, Pair
from cortado.particles.state import Fields, Layout
from cortado.particles.wall_terms import ALL_WALLS, SolidShares
from cortado.runs.quantity_formulas import circulation_kernels
from cortado.solvers.pcisph.solver import PcisphAdjoint
from cortado.sph.curvature_kernels import curvature_adjoints, curvature_kernels, curvature_tangents, entries
from cortado.sph.emitter import Nozzle, emitter_kernels, nozzle_type
from cortado.sph.gravity import Gravity
from cortado.sph.parts import Adjoints, Shares
from cortado.sph.surface_tension import normal_kernels, surface_tension_kernels
from cortado.sph.walls import wall_slope_term
from scenes import plane_of_three, splash
from test_kernels import (
    CPU,
    DISCRETISATION,
    FLOAT64,
    Family,
    N,
    Operation,
    by_input,
    cloud,
    clouds,
    dotted,
    launch,
    zeros,
)

VECTORS = np.zeros((N, 3))


def shares_of(found, bars):
    """The adjoints of what surface tension depends on."""
    tension = found["surface_tension_bar"].sum(keepdims=True)
    own = {"x": found["x_bar"], "m": found["m_bar"], "surface_tension": tension}
    return {**own, "acceleration_in": bars["acceleration"]}


class SurfaceTension(Operation):
    """Normals and then the force."""

    inputs, outputs = ("x", "m", "surface_tension", "acceleration_in"), ("acceleration",)
    passed = ("acceleration_in",)

    def __init__(self, cloud):
        super().__init__(cloud)
        self.normal, self.force = normal_kernels(DISCRETISATION), surface_tension_kernels(DISCRETISATION)
        self.start["surface_tension"] = np.array([1.4])
        self.given = {"s": self.s, "inverse": 0.4, "scale": 0.7}

    def normals(self, values):
        return launch(self.normal.forward, **self.given, **values, normals=VECTORS)["normals"]

    def forward(self, values):
        return launch(self.force.forward, **self.given, **values, normals=self.normals(values), acceleration=VECTORS)

    def tangent(self, values, dots):
        given = {**self.given, **values, **dotted(dots)}
        change = launch(self.normal.tangent, **given, normals_dot=VECTORS)["normals_dot"]
        given |= {"normals": self.normals(values), "normals_dot": change}
        return {"acceleration": launch(self.force.tangent, **given, acceleration_dot=VECTORS)["acceleration_dot"]}

    def adjoint(self, values, bars):
        given = {**self.given, **values, "normals": self.normals(values), "acceleration_bar": bars["acceleration"]}
        bar = zeros("x_bar", "m_bar", "surface_tension_bar")
        bar |= launch(self.force.adjoint, **given, **bar, normals_bar=VECTORS)
        found = launch(self.normal.adjoint, **{**given, **bar})
        return shares_of({**bar, "x_bar": found["x_bar"]}, bars)


class CurvatureTension(Operation):
    """Its four sums, one after the other, and back."""

    inputs, outputs = ("x", "m", "surface_tension", "acceleration_in"), ("acceleration",)
    passed = ("acceleration_in",)

    def __init__(self, cloud):
        super().__init__(cloud)
        d = cloud.dimension
        self.kernels = curvature_kernels(DISCRETISATION, d)
        made = DISCRETISATION, d, f"surface_curvature_{d}d"
        self.tangents, self.adjoints = curvature_tangents(*made), curvature_adjoints(*made)
        self.start["surface_tension"] = np.array([1.4])
        self.given = {"s": self.s, "spacing": 0.3, "depth": 0.4, "per_width": 2.2}
        kinds = {**entries(FLOAT64), "r": wp.vec3d}
        self.empty = {name: np.zeros((N, *getattr(kind, "_shape_", ()))) for name, kind in kinds.items()}

    def through(self, kernels, known):
        """What is known after all of them."""
        for kernel in kernels:
            known = {**known, **launch(kernel, **known)}
        return known

    def known(self, values):
        four = self.kernels.colour, self.kernels.normal, self.kernels.bend, self.kernels.mean
        known = {**self.given, **values, **self.empty, "acceleration": VECTORS}
        return self.through([one.forward for one in four], known)

    def forward(self, values):
        return self.known(values)

    def tangent(self, values, dots):
        change = {f"{name}_dot": value for name, value in self.empty.items()}
        known = {**self.known(values), **change, **dotted(dots), "acceleration_dot": VECTORS}
        return {"acceleration": self.through(self.tangents, known)["acceleration_dot"]}

    def adjoint(self, values, bars):
        change = {f"{name}_bar": value for name, value in self.empty.items()}
        known = {**self.known(values), **change, **zeros("x_bar", "m_bar", "surface_tension_bar")}
        colour, normal, bend, mean = self.adjoints
        found = self.through((*mean, bend, normal, colour), {**known, "acceleration_bar": bars["acceleration"]})
        return shares_of(found, bars)


class Circulation(Family):
    inputs, outputs, own, kernels = ("x", "v"), ("circulation",), ("x", "v"), circulation_kernels(DISCRETISATION)


class WallSlope(Family):
    inputs, outputs, kernels = ("x",), ("total",), wall_slope_term(DISCRETISATION).kernels

    def __init__(self, cloud):
        super().__init__(cloud)
        self.given |= {"solid": ALL_WALLS, "constants": DISCRETISATION.precision.pair(0.0, 0.0)}

    def adjoint(self, values, bars):
        return super().adjoint(values, bars, slope_bar=bars["total"])


def swirl(x, v, t, rate, centre):
    r = x - centre
    return rate * wp.cos(t) * wp.vec3(-r[1], r[0], 0.0) - wp.length(v) * v


def spring(x_ij, v_ij, t, k, rest):
    r = wp.length(x_ij)
    return (k * (r - rest) * wp.cos(t)) * x_ij - v_ij


class OfOneFunction(Family):
    """theta is the time, a number, and one more parameter."""

    inputs, outputs = ("x", "v", "theta", "acceleration_in"), ("acceleration",)
    passed, own = ("acceleration_in",), ("x", "v")
    force = Body(swirl, rate=1.3, centre=[0.2, 0.4, 0.1])
    theta = (0.3, 1.3, 0.2, 0.4, 0.1)

    def __init__(self, cloud):
        super().__init__(cloud)
        self.kernels = self.force.kernels(DISCRETISATION, 3)
        self.start["theta"] = np.array([self.theta])

    def adjoint(self, values, bars):
        found = super().adjoint(values, bars, theta_bar=np.zeros((N, len(self.theta))))
        return {**found, "theta": found["theta_bar"].sum(axis=0, keepdims=True)}


class PairOfOneFunction(OfOneFunction):
    inputs = ("x", "v", "m", "theta", "acceleration_in")
    force, theta, own = Pair(spring, k=2.0, rest=0.3), (0.3, 2.0, 0.3), ("x", "v", "m")


class Emitter(Operation):
    """The last third of the particles wait in a nozzle, and some of them have left it."""

    inputs = ("x_free", "v_free", "outlet_in", "emitted_in", "nozzle_path", "flow_rate", "time_step")
    outputs = ("x", "v", "outlet", "emitted")

    def __init__(self, cloud):
        super().__init__(cloud)
        random, first, self.kernels = np.random.default_rng(23), 2 * N // 3, emitter_kernels(FLOAT64, False)
        direction = np.array([0.6, 0.8, 0.0])
        offsets = cloud.vectors(24, N - first)[:, : cloud.dimension]
        reserve = np.array([3.0, -2.0, 1.0])
        own = direction[: cloud.dimension], 0.3, 0.5, reserve[: cloud.dimension]
        nozzle = Nozzle(first, np.linspace(0.1, 1.0, N - first), offsets, *own)
        made = nozzle_type(FLOAT64)()
        made.first, made.area, made.direction = first, nozzle.area, FLOAT64.vector(*direction)
        made.column, made.reserve = nozzle.column, FLOAT64.vector(*reserve)
        made.upstream = wp.array(nozzle.upstream, dtype=wp.float64, device=CPU)
        made.offsets = test_kernels.array(np.pad(offsets, ((0, 0), (0, 3 - cloud.dimension))))
        self.known = {"nozzle": made, "step": np.array([2], dtype=np.int32)}
        self.layout = Layout(N, 1, FLOAT64, CPU)
        self.start |= {
            "x_free": cloud.vectors(25),
            "v_free": cloud.vectors(26),
            "outlet_in": cloud.vectors(27, 1),
            "emitted_in": np.array([0.4]),
            "nozzle_path": cloud.vectors(28, 4),
            "flow_rate": random.uniform(0.2, 0.4, 1),
        }

    def begun(self, values, kind="forward", suffix=""):
        known = self.known if kind == "forward" else {**self.known, "drift": self.begun(values)["drift"]}
        out = {"outlet": np.zeros((1, 3)), "drift": np.zeros((1, 3)), "emitted": np.zeros(1)}
        out = {f"{name}{suffix}": array for name, array in out.items()}
        found = launch(getattr(self.kernels.begin, kind), 1, **known, **values, **out)
        return {name: found[name] for name in out}

    def forward(self, values):
        given = {name: value for name, value in values.items() if name not in ("x", "v")}
        begun = self.begun(values)
        found = launch(self.kernels.forward, **self.known, **given, **begun, x=VECTORS, v=VECTORS)
        return {**begun, **{name: found[name] for name in "xv"}}

    def tangent(self, values, dots):
        begun = self.begun({**values, **dotted(dots)}, "tangent", "_dot")
        given = {**self.known, **values, **self.begun(values), **dotted(dots), **begun}
        found = launch(self.kernels.tangent, **{**given, "x_dot": dots["x_free"], "v_dot": dots["v_free"]})
        return {
            **{name: begun[f"{name}_dot"] for name in ("outlet", "emitted")},
            **{n: found[f"{n}_dot"] for n in "xv"},
        }

    def adjoint(self, values, bars):
        given = {**self.known, **values, **self.begun(values)}
        moved = {f"{name}_{kind}_bar": VECTORS for name in "xv" for kind in ("free", "prescribed")}
        found = launch(self.kernels.adjoint, **given, x_bar=bars["x"], v_bar=bars["v"], **moved)
        totals = {f"{name}_total": found[f"{name}_prescribed_bar"].sum(axis=0, keepdims=True) for name in "xv"}
        bar = {"outlet_bar": bars["outlet"], "emitted_bar": bars["emitted"], "nozzle_path_bar": np.zeros((4, 3))}
        bar |= {"flow_rate_bar": np.zeros(1), "time_step_bar": np.zeros(1)}
        last = launch(self.kernels.begin.adjoint, 1, **given, **totals, **bar)
        return {
            **{f"{name}_free": found[f"{name}_free_bar"] for name in "xv"},
            **{f"{name}_in": last[f"{name}_bar"] for name in ("outlet", "emitted")},
            **{name: last[f"{name}_bar"] for name in ("nozzle_path", "flow_rate", "time_step")},
        }


OPERATIONS = [SurfaceTension, CurvatureTension, Circulation, WallSlope, OfOneFunction, PairOfOneFunction, Emitter]
check_transpose = test_kernels.test_adjoint_is_the_transpose_of_the_tangent
check_differences = test_kernels.test_tangent_is_the_limit_of_central_differences
check_bits = test_kernels.test_same_bits_twice


@clouds
@by_input(OPERATIONS)
def test_adjoints_are_transposes_and_tangents_limits_of_differences(operation, name, where):
    if (operation, where) == (OfOneFunction, "2-D"):
        pytest.skip("its kernels here are those of space")
    check_transpose(operation, name, where)
    check_differences(operation, name, where)


@clouds
@pytest.mark.parametrize("operation", OPERATIONS)
def test_the_same_bits_twice(operation, where):
    check_bits(operation, where)


def test_some_particles_have_left_the_nozzle_and_some_have_not():
    op = Emitter(cloud("3-D"))
    moved = op.forward(op.start)["x"][2 * N // 3 :] != op.start["x_free"][2 * N // 3 :]
    assert 0.1 < moved.all(axis=1).mean() < 0.9


ELSEWHERE = {
    "implicit_kernels": "of what comes before and after a solve: whole steps in tests/test_implicit_viscosity.py",
    "surrounding_kernels": "of the projection: whole steps in tests/test_projection.py",
    "velocity_kernels": "the same",
    "velocity_gradient_kernels": "the same",
    "coarse_push_kernels": "the same",
    "coarse_pressure_kernels": "the same",
    "residual_kernels": "the same",
    "coarse_body_kernels": "of bodies that are free: whole steps in tests/test_free_bodies.py",
    "repair_kernels": "of the projection again: whole steps in tests/test_projection.py",
    "mean_stress_kernels": "of a quantity: tests/test_energy_budget.py",
    "image_load_kernels": "of loads: tests/test_faces.py",
    "environment_kernels": "of rewards: tests/test_environments.py",
    "phase_colour_kernels": "of pictures, by differences: tests/test_render.py",
    "colour_field_kernels": "the same",
    "absorption_kernels": "the same",
}
"""Factories of kernels of adjoints that are checked in other places."""


def test_every_family_with_an_adjoint_is_checked():
    checked = "".join(Path(module).read_text() for module in (__file__, test_kernels.__file__))
    found = set()
    for path in Path(cortado.__file__).parent.rglob("*.py"):
        for factory in ast.parse(path.read_text()).body:
            kernels = [one for one in ast.walk(factory) if isinstance(one, ast.FunctionDef) and of_an_adjoint(one)]
            found |= {factory.name} if isinstance(factory, ast.FunctionDef) and kernels else set()
    used = {name for name in found if f"{name}(" in checked or name in OF_FORCES}
    assert len(found) > 15 and found - used == ELSEWHERE.keys()


def of_an_adjoint(function):
    decorators = [ast.unparse(one) for one in function.decorator_list]
    is_kernel = any("wp.kernel" in one or one.startswith("particle_kernel(") for one in decorators)
    return is_kernel and "adjoint" in function.name.split("_")


OF_FORCES = {"body_kernels", "pair_kernels"}
"""Made by `OfOneFunction.force`; those of this name in the projection are checked in tests/test_free_bodies.py."""


def test_gravity_adds_to_its_adjoint():
    simulation = Simulation(splash(), precision="float64")
    solver, n = simulation.solver, simulation.particles
    bar = solver.new_parameters(2)
    bar["gravity"].assign(np.full((1, 2, 3), 0.5))
    fields = Fields.zeros(n, simulation.precision, simulation.device)
    shares = Shares(["time_step"], solver.layout)
    ones = wp.array(np.ones((n, 3)), dtype=wp.vec3d, device=simulation.device)
    solver.step_number.fill_(1)
    gravity, solids = Gravity(solver.layout, taped=False), SolidShares(None, solver.layout)
    for _ in range(2):
        gravity.adjoint(solver.context(solver.new_parameters(2)), ones, Adjoints(fields, bar, shares, solids))
    np.testing.assert_array_equal(bar["gravity"].numpy(), [[[0.5] * 3, [0.5 + 2 * n] * 3]])


@pytest.mark.parametrize("shares", ["drag", "gravity", "mass_fractions"])
def test_what_cannot_be_shared_is_said(shares):
    with pytest.raises(TypeError, match=f"shares has '{shares}', but must be a tuple of some of rest_density, "):
        Shares([shares], Layout(3, 1, FLOAT64, "cpu"))


def test_what_parts_added_to_parameters_is_kept_to_the_end():
    solver = Simulation(plane_of_three(), precision="float64").solver
    adjoint = PcisphAdjoint(solver, steps=2)
    for array in adjoint.bar.parameters.arrays():
        array.fill_(0.5)
    for array in adjoint.collect().arrays():
        np.testing.assert_array_equal(array.numpy(), 0.5)
