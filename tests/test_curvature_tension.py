"""Surface tension by curvature: its constants, particles that are too few for a curvature, and what depends on it.

Whole steps: tests/test_step.py. How drops oscillate: tests/test_validation_flows.py."""

import warnings

import numpy as np
import pytest

from cortado import CortadoWarning, Problem, Scene, Simulation, losses
from cortado.discretise.smoothing import KERNELS
from cortado.scene.stability import stability_limits
from cortado.sph.curvature import CurvatureConstants
from cortado.sph.surface_tension import CurvatureTension, SurfaceTension
from finite_differences import central_difference, directional
from oscillating_drops import C2, CUBIC
from reference_terms import Curvature
from scenes import box, plane

PROJECTION = {"kind": "projection", "time_step": 0.002}
PCISPH = {"kind": "pcisph", "time_step": 0.002, "minimum_iterations": 3, "maximum_iterations": 3}


def loose(points, precision="float64", discretisation=C2, pressure=True, tension=0.3, **tables):
    """A simulation of particles a spacing of 0.1 apart, and a point that puts them at ``points`` [spacings]."""
    x = 0.1 * np.asarray(points, dtype=np.float64)
    n, d = x.shape
    own = {
        "discretisation": {"spacing": 0.1, **discretisation},
        "phase": [{"name": "water", "rest_density": 1000.0, "viscosity": 20.0}],
        "fluid": [box([0.0] * d, [0.1 * n] + [0.1] * (d - 1), phase="water")],
        "forces": {"gravity": [0.0] * d, "surface_tension": tension, "pressure": pressure},
    }
    scene = Scene(dimension=d, **{**own, "solver": PROJECTION, **tables})
    simulation = Simulation(scene, precision=precision)
    assert len(simulation.positions) == n
    return simulation, {"initial_positions": x, "surface_tension": np.array(tension)}


def stirred(points, size=0.1, seed=0):
    points = np.asarray(points, dtype=np.float64)
    return points + size * np.random.default_rng(seed).uniform(-1.0, 1.0, points.shape)


def grid(*counts):
    return np.stack(np.meshgrid(*map(np.arange, counts), indexing="ij"), axis=-1).reshape(-1, len(counts)).astype(float)


FEW = {
    "one": [[0.0, 0.0]],
    "a pair": [[0.0, 0.0], [0.9, 0.3]],
    "a pair in space": [[0.0, 0.0, 0.0], [0.9, 0.3, 0.2]],
    "a line": grid(9, 1),
    "a lone layer": grid(5, 5, 1),
    "27": grid(3, 3, 3),
    "a bent line": np.stack([np.arange(9.0), 0.05 * (np.arange(9.0) - 4.0) ** 2], axis=1),
    "a stirred line": stirred(grid(9, 1)),
    "a stirred layer": stirred(grid(5, 5, 1)),
}


def problem_of(points, steps=2, **options):
    simulation, point = loose(points, **options)
    x = point["initial_positions"]
    target = x + 0.05 * np.sin(np.arange(x.size)).reshape(x.shape)
    return Problem(simulation, steps, losses.FinalPositions(target)), point


@pytest.mark.filterwarnings("ignore::cortado.CortadoWarning")
@pytest.mark.parametrize("name", FEW)
def test_few_particles_have_a_force_and_derivatives(name):
    """That are finite, the same in both directions, and those of differences, on one side and on the other."""
    problem, point = problem_of(FEW[name], pressure=False)
    moved = 0.1 * np.random.default_rng(1).standard_normal(point["initial_positions"].shape)
    ways = {"initial_positions": moved, "surface_tension": np.array(0.1)}
    value, gradient = problem.value_and_gradient(point)
    tangent = problem.tangent(point, ways)
    assert np.isfinite(value) and all(np.isfinite(each).all() for each in gradient.values())
    size = sum(np.abs(gradient[key] * ways[key]).sum() for key in ways)
    assert abs(directional(gradient, ways) - tangent) <= 1e-12 * size
    for h in (1e-4, 1e-5, 1e-6):
        for one_side in (h, -h):
            middle = {key: point[key] + one_side * way for key, way in ways.items()}
            slope = central_difference(problem.value, middle, ways, 0.5 * one_side)
            assert abs(slope - tangent) <= (30.0 * h + 1e-9) * size + 1e-9 * abs(value) / h * 1e-6


@pytest.mark.filterwarnings("ignore::cortado.CortadoWarning")
def test_one_particle_a_pair_and_two_lines_feel_nothing():
    """A pair has a normal and no curvature; a straight line and a layer have the same fluid on both sides."""
    for name in ("one", "a pair", "a pair in space"):
        simulation, point = loose(FEW[name])
        run = simulation.run(3, point)
        assert np.abs(run.velocities[-1]).max() < 1e-12, name


def disc(radius, turned):
    """Particles of a drop in concentric rings, a spacing apart, the last ones half a spacing below its surface."""
    rings = []
    for n, r in enumerate(radius - 0.5 - np.arange(radius)):
        m = int(np.rint(2.0 * np.pi * r))
        a = 2.0 * np.pi * (np.arange(m) / m + 0.618 * n) + turned
        rings.append(r * np.stack([np.cos(a), np.sin(a)], axis=1))
    return np.concatenate(rings)


@pytest.mark.parametrize("name, radius", [("wendland_c2", 12), ("wendland_c4", 24)])
def test_the_pressure_of_a_drop_is_that_of_laplace(name, radius):
    """The force adds up to sigma / R along the radius, but for what its depth takes, and not without the correction of
    the curvature."""
    support = {"wendland_c2": 2.6, "wendland_c4": 3.0}[name]
    kernel = KERNELS[name]
    made = CurvatureConstants.of(kernel, 1.0, support, 2)
    volume = 1.0 / kernel.weight(np.linalg.norm(grid(9, 9) - 4.0, axis=1), 2, support).sum()
    x = disc(radius, 0.3)
    r = np.linalg.norm(x, axis=1)

    def pressure(depth):
        twin = Curvature(kernel, support, volume, 1.0, made.width, depth)
        force = twin.acceleration(x, np.ones(len(x)), 1.0)
        return -((force * x).sum(axis=1) / r**2).sum() / (2.0 * np.pi) * radius

    assert abs(pressure(made.depth) - 1.0 - 0.5 / radius) < 0.03
    assert pressure(0.0) > 1.0 + 1.4 / radius


@pytest.mark.filterwarnings("ignore::cortado.CortadoWarning")
def test_the_solver_says_which_form_a_scene_has_and_its_steps_may_be_longer_by_curvature():
    limits = []
    for solver, wanted in ((PROJECTION, CurvatureTension), (PCISPH, SurfaceTension)):
        for discretisation in (CUBIC, C2):
            forces = {"gravity": [0.0, -9.81], "surface_tension": 3.0}
            made = plane(solver=solver, discretisation={"spacing": 0.05, **discretisation}, forces=forces)
            found = [type(force) for force in Simulation(made).solver.forces]
            assert [kind for kind in found if kind in (SurfaceTension, CurvatureTension)] == [wanted]
        limits.append(stability_limits(made)["surface tension"])
    assert limits[0] == pytest.approx(2.5 * limits[1])


def test_a_fluid_with_hardly_any_viscosity_and_a_narrow_support_are_warned_of():
    for viscosity, warned in ((0.1, True), (2.0, False)):
        water = [{"name": "water", "rest_density": 1000.0, "viscosity": viscosity}]
        with warnings.catch_warnings(record=True) as found:
            warnings.simplefilter("always")
            loose(grid(8, 8), phase=water)
        assert any("viscosity of phase 'water'" in str(one.message) for one in found) == warned
    with pytest.warns(CortadoWarning, match="support is 2, but surface tension needs at least 2.5"):
        loose(grid(8, 8), discretisation=CUBIC)
