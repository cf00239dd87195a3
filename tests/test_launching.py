"""How kernels are launched: arguments bound by their names, several threads for one particle, and sums over all."""

import gc
import pickle

import numpy as np
import pytest
import warp as wp

from cortado import InputError, Problem, Simulation, losses
from cortado.device.launching import bound
from cortado.device.precision import FLOAT32, FLOAT64, lanes_of
from cortado.device.reduction import SHARED, sum_and_maximum, sum_and_maximum_kernel, sum_kernel, sum_of
from cortado.discretise.smoothing import CUBIC_SPLINE, WENDLAND_C4
from cortado.gradients.reverse_mode import adjoint_filter_kernels
from cortado.particles.neighbourhood import Discretisation, neighbourhood_type
from cortado.particles.neighbours import fill_kernel
from cortado.particles.pair_sums import fluid_sum
from cortado.solvers.pcisph.pressure import pressure_force_kernels, pressure_kernels
from cortado.solvers.pcisph.solver import density_ratio_kernels, wall_kernels
from cortado.sph.curvature import curvature_kernels
from cortado.sph.density import density_kernels
from cortado.sph.free_energy import CONSTANT, DEGENERATE, DOUBLE_WELL, MISCIBLE, Diffusion, diffusion_kernels
from cortado.sph.parts import integration_kernels
from cortado.sph.stress_forces import newtonian_law
from cortado.sph.stress_kernels import stress_kernels
from cortado.sph.surface_tension import normal_kernels, surface_tension_kernels
from cortado.sph.viscosity import viscosity_kernels
from scenes import plane, scene, two_layers

CPU = wp.get_device("cpu")
PREDICT = integration_kernels(FLOAT64, False).predict
NAMES = ("particles", "time_step", "x", "v", "acceleration", "x_star", "v_star")


def test_arguments_come_in_the_order_of_the_kernel_and_of_groups_and_a_misspelt_one_is_named():
    given = {name: name.upper() for name in reversed(NAMES)}
    assert bound(PREDICT, (), given) == [name.upper() for name in NAMES]
    first, second = {"x": 1, "v": 2, "other": 0}, {"x": 10, "v": 20, "time_step": 30, "x_star": 40, "v_star": 50}
    found = bound(PREDICT, (first, second), {"v": 3, "acceleration": 4, "particles": 60})
    assert found == [60, 30, 1, 3, 4, 40, 50]
    with pytest.raises(TypeError, match="has no argument 'xstar'; it has particles, time_step, x, v, acc"):
        bound(PREDICT, (), {**dict.fromkeys(NAMES, 0), "xstar": 0})
    groups = dict.fromkeys(("particles", "time_step", "x", "v", "xstar"), 0), {"x": 1, "acceleration": 2}
    told = r"'x_star' of .* is missing; .*; known are v_star, particles, time_step, x, v, xstar, acc"
    with pytest.raises(TypeError, match=told):
        bound(PREDICT, groups, {"v_star": 0})


def test_a_sum_over_neighbours_has_a_thread_for_each_particle():
    solver = Simulation(plane()).solver
    context = solver.context(solver.new_parameters(1))
    with pytest.raises(TypeError, match="sums over neighbours, and has one thread for each particle"):
        context.launch(solver.density.kernels.forward, threads=1)


@wp.kernel(module="unique", enable_backward=False)
def count_neighbours(s: neighbourhood_type(FLOAT64), found: wp.array(dtype=wp.int32)):
    i = wp.tid()
    found[i] = s.count[i]


def test_a_sum_over_neighbours_begins_where_its_range_begins():
    """Else a range of particles would overwrite another, from some thousands of particles on, without a word."""
    solver = Simulation(plane(), precision="float64").solver
    context = solver.context(solver.new_parameters(1))
    found = wp.zeros(solver.layout.particles, dtype=wp.int32, device=CPU)
    with pytest.raises(TypeError, match=r"count_neighbours takes the neighbourhood s, .* i = s\.first \+ wp\.tid\(\)"):
        context.launch(count_neighbours, found=found)


NEIGHBOURHOOD = Discretisation(CUBIC_SPLINE, FLOAT64)


@fluid_sum(NEIGHBOURHOOD)
def times(c_i: wp.float64, c_j: wp.float64) -> wp.float64:
    return c_i * c_j


@wp.func
def twice(i: int, c: wp.array(dtype=wp.float64), s: neighbourhood_type(FLOAT64)) -> wp.float64:
    return wp.float64(2.0) * times(i, c, s)


@wp.kernel(module="unique", enable_backward=False)
def of_one_thread(s: neighbourhood_type(FLOAT64), m: wp.array(dtype=wp.float64), found: wp.array(dtype=wp.float64)):
    i = s.first + wp.tid()
    found[i] = twice(i, m, s)


def test_a_sum_that_lanes_share_is_of_a_kernel_that_is_made_for_them():
    """Else each of several threads would have a part of the sum of another particle, on a GPU, without a word."""
    solver = Simulation(plane(), precision="float64").solver
    with pytest.raises(TypeError, match=r"calls the sum times, which lanes share, .* i = s\.first \+ wp\.tid\(\) // L"):
        solver.context(solver.new_parameters(1)).launch(of_one_thread, found=solver.numbers())


def test_arrays_of_derivatives_that_are_gone_are_let_go():
    simulation = Simulation(two_layers())
    problem = Problem(simulation, 2, losses.FinalPositions(simulation.positions))
    kept = simulation.solver.launch._bundles
    problem.value_and_gradient({"viscosity": [0.1, 0.2]})
    assert kept
    del problem
    gc.collect()
    assert not kept


@pytest.mark.parametrize("lanes", [3, 0, 32, "four"])
def test_a_wrong_number_of_lanes_is_a_sentence(lanes):
    with pytest.raises(InputError, match=r"^lanes is .*, but must be .*[.]$"):
        Simulation(scene(), lanes=lanes)


def test_copies_have_the_same_lanes():
    simulation = Simulation(scene(), lanes=4)
    for copy in (pickle.loads(pickle.dumps(simulation)), simulation.batch_of(3), simulation.in_precision("float64")):
        assert copy._lanes == 4


def kernels_of(discretisation):
    curved, viscous = curvature_kernels(discretisation, 3), stress_kernels(discretisation, 3, newtonian_law(), True)
    mixtures = [
        diffusion_kernels(Diffusion(discretisation, *kinds))
        for kinds in ((2, DOUBLE_WELL, DEGENERATE), (3, MISCIBLE, CONSTANT))
    ]
    filters = adjoint_filter_kernels(discretisation)
    families = [
        density_kernels(discretisation),
        pressure_kernels(discretisation),
        pressure_force_kernels(discretisation),
        wall_kernels(discretisation),
        viscosity_kernels(discretisation, True),
        viscous.moments,
        density_ratio_kernels(discretisation).total,
        normal_kernels(discretisation),
        surface_tension_kernels(discretisation),
        *(curved.colour, curved.normal, curved.bend),
        *(kernels for mixture in mixtures for kernels in (mixture.potential, mixture.flux)),
    ]
    adjoints = [family.adjoint[-1] if isinstance(family.adjoint, tuple) else family.adjoint for family in families]
    kernels = [*adjoints, *(kernel for family in families for kernel in (family.forward, family.tangent))]
    alone = [fill_kernel(discretisation), filters.crowd, filters.strength, filters.viscosity]
    alone += [viscous.force.forward, viscous.force.tangent, *viscous.force.adjoint]
    return [*alone, *kernels, curved.mean.forward, curved.mean.tangent, curved.mean.adjoint[1]]


def compiles(module, folder):
    try:
        wp.compile_aot_module(module, arch=90, module_dir=str(folder))
    except Exception as error:
        pytest.fail(f"{module.name}: {error}")


NVRTC = pytest.mark.skipif(not wp.get_cuda_supported_archs(), reason="this Warp cannot compile for a GPU")


@NVRTC
def test_sums_by_blocks_compile_for_a_gpu_that_is_not_there(tmp_path):
    """Of the smallest type, and of the greatest, which has the fewest threads."""
    levels = {dtype: sum_kernel(dtype, is_cpu=False) for dtype in (wp.float32, wp.types.matrix((4, 3), wp.float64))}
    assert all(level.threads * wp.types.type_size_in_bytes(dtype) <= SHARED for dtype, level in levels.items())
    for level in (*levels.values(), sum_and_maximum_kernel(FLOAT64, is_cpu=False)):
        compiles(level.kernel.module, tmp_path)


COMBINATIONS = [(CUBIC_SPLINE, FLOAT32, 8), (WENDLAND_C4, FLOAT64, 16)]


@NVRTC
@pytest.mark.parametrize("k", range(len(COMBINATIONS)))
def test_kernels_for_lanes_compile_for_a_gpu_that_is_not_there(k, tmp_path):
    """Each module in one of the combinations, in turn, as forward, tangent and adjoint follow each other: what differs
    between precisions and numbers of lanes, arithmetic and sums over lanes, is in all of them."""
    smoothing, precision, lanes = COMBINATIONS[k]
    kernels = kernels_of(Discretisation(smoothing, precision, lanes))
    assert {lanes_of(kernel) for kernel in kernels} == {lanes}
    assert lanes_of(integration_kernels(precision, False).sort) == 1
    modules = list({kernel.module.name: kernel.module for kernel in kernels}.values())
    for module in modules[k :: len(COMBINATIONS)]:
        compiles(module, tmp_path)


SIZES = [1, 64, 65, 4097, 5000]
precisions = pytest.mark.parametrize("precision", [FLOAT32, FLOAT64], ids=lambda precision: precision.name)


def summed(tree, values, dtype):
    return tree(wp.array(values, dtype=dtype, device="cpu")).numpy()


TYPES = {
    "numbers": lambda precision: precision.real,
    "vectors": lambda precision: precision.vector,
    "four fractions": lambda precision: precision.fractions(4),
    "matrices": lambda precision: precision.matrix,
}
types = pytest.mark.parametrize("type_of", TYPES.values(), ids=TYPES)


@precisions
@types
@pytest.mark.parametrize("size", SIZES)
def test_sum_of(size, type_of, precision):
    dtype = type_of(precision)
    one = getattr(dtype, "_shape_", ())
    values = np.random.default_rng(size).standard_normal((size, *one)).astype(precision.numpy)
    tree = sum_of(dtype, size, wp.get_device("cpu"))
    first, second = (summed(tree, values, dtype).copy() for _ in range(2))
    again = summed(sum_of(dtype, size, wp.get_device("cpu")), values, dtype)
    assert first.shape == (1, *one)
    assert first.tobytes() == second.tobytes() == again.tobytes()
    error = 20 * np.finfo(precision.numpy).eps * np.abs(values).sum()
    np.testing.assert_allclose(first[0], values.astype(np.float64).sum(axis=0), rtol=0, atol=error)
    whole = np.arange(values.size).reshape(values.shape) % 7  # every partial sum is exact
    np.testing.assert_array_equal(summed(tree, whole.astype(precision.numpy), dtype)[0], whole.sum(axis=0))


@precisions
@pytest.mark.parametrize("size", SIZES)
def test_sum_and_maximum(size, precision):
    values = np.random.default_rng(size).uniform(-2.0, -1.0, (size, 2)).astype(precision.numpy)
    tree, error = sum_and_maximum(size, precision, wp.get_device("cpu")), 20 * float(np.finfo(precision.numpy).eps)
    for place in {0, size // 2, size - 1}:
        values[place, 1] = -0.5
        (found,) = summed(tree, values, precision.pair)
        assert found[0] == pytest.approx(values[:, 0].astype(np.float64).sum(), rel=error)
        assert found[1] == -0.5
        values[place, 1] = -1.5
