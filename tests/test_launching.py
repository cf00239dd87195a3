"""Arguments of kernels are bound by their names, and a mistake is an error where the launch is written."""

import gc

import pytest
import warp as wp

from cortado import Problem, Simulation, losses
from cortado.device.launching import Bundles, KernelLauncher, bound, launch, launch_together, watched
from cortado.device.precision import FLOAT64
from cortado.discretise.smoothing import CUBIC_SPLINE
from cortado.particles.neighbourhood import Discretisation, neighbourhood_type
from cortado.particles.pair_sums import fluid_sum
from cortado.sph.integration import integration_kernels
from scenes import plane, two_layers

CPU = wp.get_device("cpu")
PREDICT = integration_kernels(FLOAT64, False).predict
NAMES = ("particles", "time_step", "x", "v", "acceleration", "x_star", "v_star")


def test_arguments_come_in_the_order_of_the_kernel():
    given = {name: name.upper() for name in reversed(NAMES)}
    assert bound(PREDICT, (), given, Bundles()) == [name.upper() for name in NAMES]


def test_what_is_given_comes_before_groups_and_groups_in_their_order():
    first, second = {"x": 1, "v": 2, "other": 0}, {"x": 10, "v": 20, "time_step": 30, "x_star": 40, "v_star": 50}
    found = bound(PREDICT, (first, second), {"v": 3, "acceleration": 4, "particles": 60}, Bundles())
    assert found == [60, 30, 1, 3, 4, 40, 50]


@pytest.mark.parametrize("missing", NAMES)
def test_a_missing_argument_is_named(missing):
    given = {name: 0 for name in NAMES if name != missing}
    with pytest.raises(
        TypeError, match=f"argument '{missing}' of kernel .*predict.* is missing; it has particles, time"
    ):
        bound(PREDICT, (), given, Bundles())


def test_what_is_known_is_said_where_an_argument_is_missing():
    groups = dict.fromkeys(("particles", "time_step", "x", "v", "xstar"), 0), {"x": 1, "acceleration": 2}
    with pytest.raises(
        TypeError, match=r"'x_star' of .* is missing; .*; known are v_star, particles, time_step, x, v, xstar, acc"
    ):
        bound(PREDICT, groups, {"v_star": 0}, Bundles())


def test_a_misspelt_argument_is_named():
    with pytest.raises(TypeError, match="has no argument 'xstar'; it has particles, time_step, x, v, acc"):
        bound(PREDICT, (), {**dict.fromkeys(NAMES, 0), "xstar": 0}, Bundles())


@pytest.mark.parametrize("by", ["launch", "launcher"])
def test_launches_compute_what_kernels_say(by):
    arrays = {name: wp.full(3, wp.vec3d(2.0, 3.0, 4.0), dtype=wp.vec3d, device=CPU) for name in NAMES[2:]}
    arrays["particles"], arrays["time_step"] = 3, wp.full(1, 0.5, dtype=wp.float64, device=CPU)
    if by == "launch":
        launch(PREDICT, 3, CPU, arrays)
    else:
        KernelLauncher(3, CPU, record_tape=False)(PREDICT, arrays)
    assert arrays["v_star"].numpy().tolist() == [[3.0, 4.5, 6.0]] * 3
    assert arrays["x_star"].numpy().tolist() == [[3.5, 5.25, 7.0]] * 3


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
    context, found = (
        solver.context(solver.new_parameters(1)),
        wp.zeros(solver.layout.particles, dtype=wp.int32, device=CPU),
    )
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
    kept = simulation.solver.launch._bundles._filled
    problem.value_and_gradient({"viscosity": [0.1, 0.2]})
    assert kept
    del problem
    gc.collect()
    assert not kept


def test_launches_together_are_one_to_a_watcher():
    """It may repeat them, but only all of them."""
    seen, done = [], []

    def watch(name, threads, arguments, work):
        seen.append((name, threads))
        work()
        work()

    def work():
        for total in (first, second):
            launch(count, 3, "cpu", total=total)
            done.append(total)

    @wp.kernel(enable_backward=False)
    def count(total: wp.array(dtype=wp.int32)):
        wp.atomic_add(total, 0, 1)

    first, second = (wp.zeros(1, dtype=wp.int32, device="cpu") for _ in range(2))
    with watched(watch):
        launch_together("both", 3, (first, second), work)
        launch(count, 3, "cpu", total=first)
    assert seen == [("both", 3), (count.key, 3)]
    assert done == [first, second] * 2 and first.numpy() == 12 and second.numpy() == 6
