"""Several threads for one particle: which simulations get them, and that their kernels compile for a GPU.

What they compute is compared with one thread for each particle in `tests/test_gpu.py`.
"""

import pickle

import pytest
import warp as wp

from cortado import Simulation
from cortado.device.lanes import BY_SIZE, lanes_for, lanes_of
from cortado.device.precision import FLOAT32, FLOAT64
from cortado.device.reduction import SHARED, sum_and_maximum_kernel, sum_kernel
from cortado.discretise.smoothing import CUBIC_SPLINE, WENDLAND_C4
from cortado.errors import InputError
from cortado.gradients.adjoint_filters import adjoint_filter_kernels
from cortado.particles.neighbourhood import Discretisation
from cortado.particles.neighbours import fill_kernel
from cortado.solvers.pcisph.pressure import pressure_force_kernels, pressure_kernels
from cortado.solvers.pcisph.relaxation import density_ratio_kernels, wall_kernels
from cortado.sph.curvature_kernels import curvature_kernels
from cortado.sph.density import density_kernels
from cortado.sph.diffusion import Diffusion, diffusion_kernels
from cortado.sph.free_energy import CONSTANT, DEGENERATE, DOUBLE_WELL, MISCIBLE
from cortado.sph.integration import integration_kernels
from cortado.sph.stress_kernels import stress_kernels
from cortado.sph.surface_stress import surface_tension_kernels
from cortado.sph.surface_tension import normal_kernels
from cortado.sph.viscosity import viscosity_kernels
from cortado.sph.viscosity_law import newtonian_law
from scenes import scene


class Device:
    """As much of a device as counts."""

    def __init__(self, is_cpu):
        self.is_cpu = is_cpu


def test_few_particles_get_many_lanes_and_a_cpu_has_one():
    sizes = [1, *(most for most, _ in BY_SIZE), *(most + 1 for most, _ in BY_SIZE), 10**7]
    found = [lanes_for(size, Device(is_cpu=False)) for size in sorted(sizes)]
    assert found == sorted(found, reverse=True) and found[-1] == 1
    assert all(32 % lanes == 0 for lanes in found)
    assert {lanes_for(size, Device(is_cpu=True)) for size in sizes} == {1}


def test_lanes_that_are_asked_for_are_had_on_a_gpu_alone():
    assert lanes_for(100, Device(is_cpu=False), 2) == 2
    assert lanes_for(100, Device(is_cpu=True), 2) == 1


@pytest.mark.parametrize("lanes", [3, 0, 32, "four", 1.5, True])
def test_a_wrong_number_of_lanes_is_a_sentence(lanes):
    with pytest.raises(InputError, match=r"^lanes is .*, but must be .*[.]$"):
        Simulation(scene(), lanes=lanes)


def test_copies_have_the_same_lanes():
    simulation = Simulation(scene(), lanes=4)
    for copy in (pickle.loads(pickle.dumps(simulation)), simulation.batch_of(3), simulation.in_precision("float64")):
        assert copy._lanes == 4


def kernels_of(discretisation):
    """Every kernel that is made for lanes; mixtures of two and of three phases."""
    curved = curvature_kernels(discretisation, 3)
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
        *stress_kernels(discretisation, 3, newtonian_law(), True),
        density_ratio_kernels(discretisation),
        normal_kernels(discretisation),
        surface_tension_kernels(discretisation),
        *(curved.colour, curved.normal, curved.bend),
        *(kernels for mixture in mixtures for kernels in (mixture.potential, mixture.flux)),
    ]
    kernels = [kernel for family in families for kernel in (family.forward, family.tangent, family.adjoint)]
    alone = [
        fill_kernel(discretisation),
        filters.crowd,
        filters.strength,
        filters.viscosity,
    ]
    return [*alone, *kernels, curved.mean.forward, curved.mean.tangent, curved.mean.adjoint[1]]


def compiles(module, folder):
    try:
        wp.compile_aot_module(module, arch=90, module_dir=str(folder))
    except Exception as error:
        pytest.fail(f"{module.name}: {error}")


NVRTC = pytest.mark.skipif(not wp.get_cuda_supported_archs(), reason="this Warp cannot compile for a GPU")


@NVRTC
@pytest.mark.parametrize("dtype", [wp.float32, wp.vec2d, FLOAT64.fractions(3), wp.types.matrix((4, 3), wp.float64)])
def test_sums_by_blocks_compile_for_a_gpu_that_is_not_there(dtype, tmp_path):
    level = sum_kernel(dtype, is_cpu=False)
    assert level.threads * wp.types.type_size_in_bytes(dtype) <= SHARED
    compiles(level.kernel.module, tmp_path)


@NVRTC
@pytest.mark.parametrize("precision", [FLOAT32, FLOAT64])
def test_error_sums_by_blocks_compile_for_a_gpu_that_is_not_there(precision, tmp_path):
    compiles(sum_and_maximum_kernel(precision, is_cpu=False).kernel.module, tmp_path)


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
