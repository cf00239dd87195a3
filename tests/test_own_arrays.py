"""Arrays as parameters of a user's force: a network, a field on a grid; run, differentiated, batched, refused."""

import numpy as np
import pytest
import warp as wp

import cortado
from cortado import InputError, Simulation
from cortado.device.launching import watched
from cortado.forces import Body, Pair
from scenes import aimed, plane, plane_of_three, splash, two_layers

RANDOM = np.random.default_rng(3)
WEIGHTS = RANDOM.standard_normal((9, 7))
NODES = RANDOM.standard_normal((5, 4, 3))
BIAS = np.array([0.3, -0.2, 0.1, 0.4])


def net(x, v, w: wp.array2d(dtype=float), gain, bias):
    f = wp.vec3(0.0, 0.0, 0.0)
    for k in range(len(w)):
        h = wp.tanh(w[k, 0] * x[0] + w[k, 1] * x[1] + w[k, 2] * v[0] + w[k, 3] * v[1] + w[k, 4])
        f += h * wp.vec3(w[k, -2], w[k, 6], bias[k % 4])
    return gain * f


def wind(x, v, nodes, size):
    """A field on a grid of nodes, linear between them."""
    a = wp.clamp(x[0] / size, 0.0, nodes.shape[0] - 1.001)
    b = wp.clamp(x[1] / size, 0.0, nodes.shape[1] - 1.001)
    i = int(a)
    j = int(b)
    f = wp.vec3(0.0, 0.0, 0.0)
    for p in range(2):
        for q in range(2):
            part = (1.0 - abs(a - i - p)) * (1.0 - abs(b - j - q))
            f += part * wp.vec3(nodes[i + p, j + q, 0], nodes[i + p, j + q, 1], nodes[i + p, j + q, 2])
    return f - v


def problem(force, made=None, steps=6, **options):
    return aimed(Simulation(made or splash(), **{"precision": "float64", **options}, forces=[force]), steps)


def net_force():
    return Body(net, w=WEIGHTS, gain=3.0, bias=BIAS)


def free(**more):
    """Neither pressure nor viscosity, so that one step is exact: v + dt (g + f)."""
    return plane(forces={"gravity": [0.0, -9.81], "viscosity": "none", "pressure": False}, **more)


def test_what_a_run_reads_is_what_numpy_reads():
    simulation = Simulation(free(), precision="float64", forces=[Body(wind, nodes=NODES, size=0.11)])
    x = simulation.positions
    a, b = (np.clip(x[:, k] / 0.11, 0.0, NODES.shape[k] - 1.001) for k in range(2))
    i, j = a.astype(int), b.astype(int)
    near = (np.array((1 - a + i, a - i)), np.array((1 - b + j, b - j)))
    f = sum((near[0][p] * near[1][q])[:, None] * NODES[i + p, j + q, :2] for p in range(2) for q in range(2))
    run = simulation.run(1)
    dt = run.times[1] - run.times[0]
    np.testing.assert_allclose(run.velocities[1], dt * (f + [0.0, -9.81]), rtol=1e-12, atol=1e-15)


def test_other_arrays_compile_and_capture_nothing_and_bits_are_the_same(monkeypatch):
    judged = problem(net_force(), steps=30)
    first = [judged.value_and_gradient({"net.w": WEIGHTS}) for _ in range(3)]
    for again in first[1:]:
        assert again[0] == first[0][0]
        np.testing.assert_array_equal(again[1]["net.w"], first[0][1]["net.w"])

    def refuse(*arguments, **options):
        raise AssertionError("captured or compiled again")

    monkeypatch.setattr(wp, "ScopedCapture", refuse)
    monkeypatch.setattr(wp._src.context.Module, "_compile", refuse)
    other = judged.value_and_gradient({"net.w": 1.1 * WEIGHTS})
    assert other[0] != first[0][0]


def test_other_arrays_are_another_problem():
    assert len({problem(Body(net, w=w, gain=3.0, bias=BIAS)).fingerprint for w in (WEIGHTS, 2.0 * WEIGHTS)}) == 2


def test_steps_of_jax_and_torch_take_it():
    jax, torch = pytest.importorskip("jax"), pytest.importorskip("torch")
    judged = problem(net_force())
    exact = judged.value_and_gradient({"net.w": WEIGHTS})[1]["net.w"]
    weights = torch.tensor(WEIGHTS, requires_grad=True)
    cortado.torch.value(judged)({"net.w": weights}).backward()
    np.testing.assert_allclose(weights.grad.numpy(), exact, rtol=1e-12)
    with jax.enable_x64(True):
        state = cortado.jax.state(judged.simulation)

        def moved(w):
            return cortado.jax.step(judged.simulation, state, {"net.w": w}, steps=6)["positions"]

        target = judged.loss.target
        slope = jax.grad(lambda w: ((moved(w) - target) ** 2).sum())(jax.numpy.array(WEIGHTS))
        np.testing.assert_allclose(slope / slope[0, 0], exact / exact[0, 0], rtol=1e-9)


def test_an_index_beyond_the_end_ends_the_run():
    def beyond(x, v, w):
        return w[int(100.0 * x[0])] * v

    with pytest.raises(cortado.DivergedError):
        Simulation(splash(), forces=[Body(beyond, w=np.ones(7))]).run(3)


def made(function, **values):
    return Simulation(splash(), forces=[Body(function, **values)])


def one(x, v, w):
    return w[2] * v


def two(x, v, w):
    return w[0, 1] * v


def far(x, v, w):
    return w[7] * v


def whole(x, v, w: wp.array):
    return w * v


def of_vectors(x, v, w: wp.array(dtype=wp.vec3)):
    return w[0]


def test_what_is_wrong_is_said():
    for function, w, words in [
        (two, np.ones(7), "has w.0, 1., but must have an index for each axis of the shape .7,."),
        (far, np.ones(7), "has w.7. with the index 7, but the index must be from -7 to 6"),
        (whole, np.ones(7), "uses the array w without indices"),
        (one, np.ones((2, 2, 2, 2)), "an array must have one to 3 axes"),
        (of_vectors, np.ones(7), "with an annotation that does not fit"),
        (one, np.array([1.0, np.nan, 1.0, 1.0]), "one.w has a value that is not finite, but must be numbers"),
        (one, np.ones(4) * 1j, "made of complex numbers"),
    ]:
        with pytest.raises(InputError, match=words):
            made(function, w=w)


def test_wrong_values_are_refused():
    simulation = made(one, w=np.ones(4))
    for value, words in (
        (np.ones(5), "parameter one.w has shape .5,., but must be .4,."),
        ([1.0, np.nan, 1.0, 1.0], "not finite"),
        ([1e20, 1.0, 1.0, 1.0], "one.w"),
        ("abc", "must be a number or an array of real numbers"),
    ):
        with pytest.raises(InputError, match=words):
            simulation.run(1, {"one.w": value})


def test_a_pair_force_has_no_arrays():
    def pull(x_ij, v_ij, w):
        return w[0] * x_ij

    with pytest.raises(InputError, match="use Body for arrays"):
        Pair(pull, w=np.ones(7))


def closure(x, v, density, velocity_gradient, shear_rate, w, k):
    """Of all that a particle has."""
    grown = velocity_gradient[0, 1] + 2.0 * velocity_gradient[1, 1] * velocity_gradient[0, 0]
    turned = velocity_gradient * v
    return w[0] * shear_rate * v - w[1] * turned + k * wp.vec3(wp.tanh(0.001 * density), w[2] * grown, w[3] * x[0])


def test_what_a_particle_has_is_what_it_is():
    """Velocities that are linear in x have their own gradient, also at the surface; the density is the quantity."""

    def seen(x, v, t, density, velocity_gradient, shear_rate):
        return wp.vec3(velocity_gradient[0, 1], velocity_gradient[1, 0], 0.0) + wp.vec3(shear_rate, density, 0.0)

    simulation = Simulation(free(), precision="float64", forces=[Body(seen)])
    turn = np.array([[0.4, 1.5], [-0.7, -0.4]])
    values = {"initial_velocities": simulation.positions @ turn.T}
    run = simulation.run(1, values)
    found = (run.velocities[1] - run.velocities[0]) / (run.times[1] - run.times[0]) - [0.0, -9.81]
    rate = np.sqrt(2.0 * 2.0 * (0.4**2 + 0.4**2))
    wanted = np.column_stack([np.full(64, 1.5 + rate), -0.7 + simulation.quantity("density")])
    inner = np.delete(np.arange(64), [0, 7, 56, 63])  # corners have too few neighbours for all of it
    np.testing.assert_allclose(found[inner], wanted[inner], rtol=1e-9)


def test_a_field_that_is_not_there_is_said():
    def late(x, v, k, density):
        return density * k * v

    def of_pairs(x_ij, v_ij, density):
        return density * v_ij

    with pytest.raises(InputError, match="time and any of density, mass_fractions, shear_rate, velocity_gradient"):
        Body(late, k=1.0)
    with pytest.raises(InputError, match="given no value of density"):
        Pair(of_pairs)


def test_they_cost_nothing_where_nobody_asks():
    def drag(x, v, k):
        return -k * v

    def thick(x, v, shear_rate, k):
        return -k * shear_rate * v

    def oily(x, v, mass_fractions, k):
        return -k * mass_fractions[1] * v

    counts = []
    for function in (drag, oily, thick):
        launched: list[str] = []
        simulation = Simulation(two_layers(), forces=[Body(function, k=1.0)])
        simulation.run(1)
        with watched(lambda name, threads, arguments, work, seen=launched: (seen.append(name), work())):
            simulation.run(1)
        counts.append(len(launched))
    assert counts[2] == counts[0] + 1 > 10
    assert counts[1] == counts[0]


def buoyant(x, v, mass_fractions, k):
    c = mass_fractions[0]
    return k * wp.vec3(c * c - 2.0 * mass_fractions[-1] * v[1], 0.3 * c * mass_fractions[1], wp.length(mass_fractions))


def oily(x, v, t, density, mass_fractions, w):
    return wp.vec3(w[0] * density * mass_fractions[1], w[3] * wp.sin(w[1] * mass_fractions[0]), t) - w[2] * v


def of_fractions():
    """Forces that know how fluids are mixed."""
    return [Body(buoyant, k=3.0), Body(oily, w=np.array([0.002, 2.0, 0.3, 1.5]))]


def mixed_a_little(made, steps=6, **options):
    """Fluids under two such forces, with a point."""
    judged = aimed(Simulation(made, **{"precision": "float64", **options}, forces=of_fractions()), steps)
    usual = judged.simulation.parameters()
    names = ("mass_fractions", "mobility", "interface_width", "rest_density", "buoyant.k", "oily.w")
    mixed = 0.7 * usual["mass_fractions"] + 0.3 / len(judged.simulation.scene.phase)
    return judged, {**{name: usual[name] for name in names}, "mass_fractions": mixed}


def test_mass_fractions_are_those_after_the_diffusion_of_the_step():
    def seen(x, v, mass_fractions):
        return wp.vec3(mass_fractions[0], mass_fractions[1], 0.0)

    free = {"gravity": [0.0, -9.81], "viscosity": "none", "pressure": False}
    simulation = Simulation(plane_of_three(forces=free), precision="float64", forces=[Body(seen)])
    run = simulation.run(1)
    moved = np.abs(run.mass_fractions[1] - run.mass_fractions[0]).max()
    found = run.velocities[1] / (run.times[1] - run.times[0]) - [0.0, -9.81]
    assert moved > 1e-6
    np.testing.assert_allclose(found, run.mass_fractions[1][:, :2], rtol=1e-10, atol=1e-12)


def test_scenes_of_a_batch_have_their_own_mass_fractions():
    both, point = mixed_a_little(two_layers(), batch=2)
    alone = mixed_a_little(two_layers())[0]
    each = [point["mass_fractions"], alone.simulation.parameters()["mass_fractions"]]
    loss, gradient = both.value_and_gradient({"mass_fractions": np.stack(each), "buoyant.k": [3.0, 3.0]})
    for b, own in enumerate(each):
        value, found = alone.value_and_gradient({"mass_fractions": own, "buoyant.k": 3.0})
        assert value == loss[b]
        for name, bar in found.items():
            np.testing.assert_array_equal(bar, gradient[name][b])


def test_mass_fractions_that_are_not_there_are_said():
    def second(x, v, mass_fractions):
        return mass_fractions[2] * v

    for made, words in (
        (splash(), "takes mass_fractions, but only scenes of several phases have mass fractions"),
        (two_layers(), r"mass_fractions\[2\], but must have an index from -2 to 1, as the scene has 2 phases"),
    ):
        with pytest.raises(InputError, match=words):
            Simulation(made, forces=[Body(second)])
    Simulation(plane_of_three(), forces=[Body(second)]).run(1)
