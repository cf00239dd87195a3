"""The reference engine: the Warp engine's numbers from independent code, and derivatives that agree."""

import json
import subprocess
import sys

import numpy as np
import pytest

import cortado
import cortado_reference
import reference as twins
from benchmarks.bench.run import bench_reference
from cortado import DivergedError, InputError, Problem, Simulation, losses, reference
from cortado.reference import Digits, Terms
from scenes import box, plane, scatter, scene, splash, two_layers

C2, C4 = ({"spacing": 0.05, "support": h, "kernel": f"wendland_{c}"} for c, h in (("c2", 2.6), ("c4", 3.0)))
C4_NARROW = {**C4, "support": 2.6}
NO_SLIP = box([0.0] * 3, [0.4, 0.6, 0.25], slip="no")
FALL = {"gravity": [0.0, -9.81, 0.0]}
PAIRWISE = {"gravity": [0.0, -9.81], "viscosity": "pairwise"}
STRESS = {"gravity": [0.0, -9.81], "viscosity": "stress"}
PERIOD = box([0.0, 0.0], [0.4, 0.8], periodic=[True, False])
SCENES = {
    "splash": splash(),
    "tolerance": splash(minimum_iterations=2, maximum_iterations=40, density_tolerance=0.001),
    "wendland_c2": scene(discretisation=C2),
    "pairwise, no slip": scene(discretisation=C4_NARROW, container=NO_SLIP),
    "stress, no slip": scene(discretisation=C2, forces=FALL | {"viscosity": "stress"}, container=NO_SLIP),
    "stress, free slip": scene(forces=FALL | {"viscosity": "stress"}),
    "stress, plane, no slip": plane(container=box([0.0, 0.0], [0.7, 0.8], slip="no"), forces=STRESS),
    "stress, periodic": plane(container=PERIOD | {"slip": "no"}, forces=STRESS | {"gravity": [1.0, -9.81]}),
    "plane": plane(forces=PAIRWISE),
    "periodic": plane(container=PERIOD, forces=PAIRWISE | {"gravity": [1.0, -9.81]}),
    "free space": scene(container={"shape": "none"}),
    "without pressure": scene(forces=FALL | {"viscosity": "pairwise", "pressure": False}),
    "without viscosity": plane(forces=PAIRWISE | {"viscosity": "none"}),
}
scenes = pytest.mark.parametrize("made", SCENES.values(), ids=SCENES)
TERMS = [Terms(), *(Terms(**{name: False}) for name in ("viscosity", "pressure", "hessian", "density"))]


def point_and_direction(simulation, steps, seed=0, off_lattice=0.001):
    """All parameters at once, so far off the lattice [m], whose symmetry puts many particles near the clamp's kink."""
    random, shape = np.random.default_rng(seed), simulation.positions.shape
    noise, size = random.standard_normal, np.sqrt(shape[0])
    point = {
        "gravity": np.tile(simulation.scene.forces.gravity, (steps, 1)),
        "initial_positions": simulation.positions + off_lattice * noise(shape),
        "initial_velocities": simulation.velocities + 0.01 * noise(shape),
        "viscosity": np.array(0.05),
    }
    directions = {"gravity": noise((steps, shape[1])) / np.sqrt(steps), "initial_positions": 0.05 * noise(shape) / size}
    directions |= {"initial_velocities": 0.1 * noise(shape) / size, "viscosity": np.array(0.05)}
    if simulation.scene.forces.viscosity == "stress":
        scatter(point["initial_positions"], simulation.scene.discretisation.spacing)
    if simulation.scene.forces.viscosity == "none":
        del point["viscosity"], directions["viscosity"]
    return point, directions


def target_of(simulation):
    return 0.2 + 0.1 * np.random.default_rng(5).random(simulation.positions.shape)


def distance(found, wanted):
    """Relative, of vectors; `Digits` are subtracted digit by digit."""
    size = np.linalg.norm(np.asarray(wanted))
    return np.linalg.norm(found - wanted) / (size if size > 0.0 else 1.0)


def gradients_agree(simulation, point, steps, tolerance):
    """The loss and the gradient of the reference engine are those of the Warp engine, whose problem is returned."""
    loss = losses.FinalPositions(target_of(simulation))
    problem = Problem(Simulation(simulation.scene, precision="float64"), steps, loss)
    value, wanted = problem.value_and_gradient(point)
    found = simulation.gradient(point, steps, reference.FinalPositions(loss.target))
    assert found.value == pytest.approx(value, rel=0.01 * tolerance)
    for name, gradient in wanted.items():
        away = np.linalg.norm(found.parameters[name].high - gradient)
        assert away <= tolerance * max(np.linalg.norm(gradient), 1e-6), name
    return problem


@scenes
def test_positions_and_derivatives_are_those_of_the_warp_engine(made):
    steps, simulation = 20, reference.Simulation(made)
    wanted, found = Simulation(made, precision="float64").run(steps), simulation.run(steps)
    assert distance(wanted.positions[-1], found.positions[-1]) < 1e-9
    assert np.array_equal(wanted.iterations, found.iterations)
    np.testing.assert_allclose(wanted.density_errors, found.density_errors, rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(wanted.times, found.times)
    point, directions = point_and_direction(simulation, steps)
    problem = gradients_agree(simulation, point, steps, 1e-8)
    tangent = simulation.tangent(point, directions, steps)
    bar, _ = reference.FinalPositions(problem.loss.target).adjoint(tangent.positions[-1], tangent.velocities[-1])
    forward = (bar * tangent.position_tangents.high[-1]).sum()
    assert forward == pytest.approx(problem.tangent(point, directions), rel=1e-8)


def test_float32_is_as_near_to_float64_as_the_warp_engine_is():
    """In the median of nine starts: now and then a particle is at the clamp's kink to round-off, in either engine."""
    exact, single = reference.Simulation(splash()), reference.Simulation(splash(), "float32")
    loss = reference.FinalPositions(target_of(exact))
    problem = Problem(Simulation(splash(), precision="float32"), 40, losses.FinalPositions(loss.target))
    errors = {name: [] for name in ("positions", "initial_positions", "initial_velocities", "gravity", "viscosity")}
    for seed in range(9):
        point, _ = point_and_direction(exact, 40, seed, off_lattice=0.004)
        wanted, found = (one.gradient(point, 40, loss) for one in (exact, single))
        _, warp = problem.value_and_gradient(point)
        for name, gradient in wanted.parameters.items():
            errors[name].append([distance(g, gradient.high) for g in (found.parameters[name].high, warp[name])])
        ends = found.history.positions.high[-1], problem.end(point).positions
        errors["positions"].append([distance(x, wanted.history.positions.high[-1]) for x in ends])
    for name, pairs in errors.items():
        own, other = np.median(pairs, axis=0)
        assert 0.0 < own < max(5.0 * other, 1e-5), name
        assert own < 1e-4, name


@scenes
@pytest.mark.parametrize("method", ["dual", "complex_step"])
def test_methods_agree_in_float64(made, method):
    simulation = reference.Simulation(made)
    point, directions = point_and_direction(simulation, 50)
    exact = simulation.tangent(point, directions, 50)
    other = simulation.tangent(point, directions, 50, method=method)
    assert distance(other.position_tangents[-1], exact.position_tangents[-1]) < 1e-12
    assert distance(other.velocity_tangents[-1], exact.velocity_tangents[-1]) < 1e-12


@pytest.mark.parametrize("name", ["splash", "stress, plane, no slip"])
def test_the_tangent_is_the_limit_of_differences_in_float128(name):
    if "float128" not in reference.precisions():
        pytest.skip("the compiler has no float128")
    simulation, steps = reference.Simulation(SCENES[name], "float128"), 60
    point, directions = point_and_direction(simulation, steps)
    exact = simulation.tangent(point, directions, steps, record_every=20).position_tangents
    differences = {"method": "finite_difference", "difference": 1e-12, "record_every": 20}
    found = simulation.tangent(point, directions, steps, **differences).position_tangents
    for frame in (1, 2, 3):
        assert distance(found[frame], exact[frame]) < 1e-12


@scenes
@pytest.mark.parametrize("terms", TERMS, ids=str)
def test_the_adjoint_is_the_transpose_of_the_tangent(made, terms):
    simulation = reference.Simulation(made)
    point, directions = point_and_direction(simulation, 30)
    loss = reference.FinalPositions(target_of(simulation))
    back = simulation.gradient(point, 30, loss, terms=terms)
    forth = simulation.tangent(point, directions, 30, terms=terms)
    bar, _ = loss.adjoint(forth.positions[-1], forth.velocities[-1])
    forward = (bar * forth.position_tangents.high[-1]).sum()
    reverse = sum((back.parameters[name].high * directions[name]).sum() for name in point)
    size = np.linalg.norm(bar) * forth.position_norms[-1]
    assert abs(forward - reverse) < 1e-12 * size


def test_terms_make_a_difference():
    simulation = reference.Simulation(splash())
    point, directions = point_and_direction(simulation, 60)
    found = [simulation.tangent(point, directions, 60, terms=terms).position_norms[-1] for terms in TERMS]
    assert len(set(np.round(found, 6))) == len(TERMS)
    neither = Terms(pressure=False, viscosity=False)
    free = simulation.tangent(point, {"gravity": directions["gravity"]}, 60, terms=neither)
    falling = np.array([[60 - n for n in range(60)]]) @ directions["gravity"] * 0.0021**2
    np.testing.assert_allclose(free.position_tangents.high[-1], np.broadcast_to(falling, (125, 3)), rtol=1e-12)


@pytest.mark.parametrize("method", ["as_printed", "as_printed_right_viscosity", "as_printed_predicted_density"])
def test_printed_equations_against_numpy(method):
    """One step with one iteration, compressed, in free space; the twin differentiates factors by complex step."""
    made = plane(
        container={"shape": "none"},
        forces=PAIRWISE,
        solver={"kind": "pcisph", "time_step": 0.002, "minimum_iterations": 1, "maximum_iterations": 1},
    )
    simulation, warp = reference.Simulation(made), Simulation(made, precision="float64")
    lattice, mass, mu, dt = warp.solver.lattice, 1000.0, 0.05, 0.002
    twin = twins.Pcisph(
        warp.smoothing, 2, lattice.support, lattice.volume, lattice.stiffness, np.zeros((0, 2)), np.zeros(0),
        reach=1.03 * lattice.support, response=1.0,
    )  # fmt: skip
    random = np.random.default_rng(2)
    x = 0.97 * simulation.positions + 0.001 * random.standard_normal(simulation.positions.shape)
    v, dx, dv = (0.1 * random.standard_normal(x.shape) for _ in range(3))
    near = twin.near(x)

    def density(x):
        return lattice.volume * twin.density(x, *near)

    def viscous(x, v, mu):
        g = twin.gradient(x, x)
        fields = density(x) / lattice.volume, g, np.zeros((len(x), 0, 2))
        return twin.viscous(x, v, *fields, np.full(len(x), mass * lattice.volume), np.full(len(x), mu))

    def push(x, c):
        return -lattice.volume / mass * ((c[:, None] + c[None, :])[..., None] * twin.gradient(x, x)).sum(1)

    gamma = 2 * (2 + 2 * mu) if method == "as_printed" else 2 * (2 + 2) * mu
    n, dn = density(x), twins.complex_step(density, [x], [dx])
    explicit = gamma / (8 * mu) * twins.complex_step(lambda x, v: viscous(x, v, mu), [x, v], [dx, dv])
    acceleration = np.array(made.forces.gravity) + viscous(x, v, mu)
    predicted = x + dt * (v + dt * acceleration)
    delta = lattice.stiffness / dt**2
    p = np.maximum(delta * (mass * density(predicted) - mass), 0.0)
    assert (p > 0).any() and (p == 0).any()
    if method == "as_printed_predicted_density":
        dn = twins.complex_step(density, [predicted], [dx + dt * (dv + dt * explicit)])
    dc = (delta * mass * n - 2 * p) / n**3 * dn
    dv_new = dv + dt * (explicit + twins.complex_step(lambda x: push(x, p / n**2), [x], [dx]) + push(x, dc))
    found = simulation.tangent(
        {"initial_positions": x, "initial_velocities": v, "viscosity": mu},
        {"initial_positions": dx, "initial_velocities": dv},
        1,
        method=method,
    )
    assert distance(found.velocity_tangents.high[-1], dv_new) < 1e-12
    assert distance(found.position_tangents.high[-1], dx + dt * dv_new) < 1e-12


@pytest.mark.parametrize("precision", ["float32", "float64"])
def test_same_bits_with_any_number_of_threads(precision):
    found = []
    for threads in (1, 2, 5):
        simulation = reference.Simulation(SCENES["pairwise, no slip"], precision, threads)
        point, directions = point_and_direction(simulation, 30)
        tangent = simulation.tangent(point, directions, 30)
        gradient = simulation.gradient(point, 30, reference.FinalPositions(target_of(simulation)))
        arrays = [tangent.positions.high, tangent.velocity_tangents.high, tangent.position_norms]
        arrays += [digits.high for digits in gradient.parameters.values()]
        found.append(b"".join(array.tobytes() for array in arrays))
    assert len(set(found)) == 1


def test_digits_go_in_and_come_out():
    simulation = reference.Simulation(splash(), "float80")
    small = Digits(simulation.positions, np.full(simulation.positions.shape, 2.0**-62))
    moved = simulation.run(1, {"initial_positions": small}).positions
    assert np.array_equal(moved[0] - simulation.positions, small.low)
    assert np.abs(moved.low[1]).max() > 0.0
    constant = {"gravity": Digits.of(simulation.scene.forces.gravity)}
    once = simulation.gradient(constant, 20, reference.FinalPositions(target_of(simulation)))
    over_time = {"gravity": np.tile(simulation.scene.forces.gravity, (20, 1))}
    each = simulation.gradient(over_time, 20, reference.FinalPositions(target_of(simulation)))
    np.testing.assert_allclose(once.parameters["gravity"].high, each.parameters["gravity"].high.sum(axis=0), rtol=1e-14)


def test_a_history_has_every_step():
    simulation = reference.Simulation(plane())
    seen = []
    history = simulation.tangent({}, {"gravity": [0.0, 1.0]}, 25, record_every=10, observe=seen.append)
    assert seen == list(range(26))
    assert history.steps.tolist() == [0, 10, 20, 25] and history.positions.shape == (4, 64, 2)
    assert history.position_norms.shape == history.velocity_norms.shape == (26,)
    norms = np.linalg.norm(history.position_tangents.high, axis=(1, 2))
    np.testing.assert_allclose(history.position_norms[history.steps], norms, rtol=1e-14)
    assert history.iterations.tolist() == [5] * 25
    assert simulation.run(3).position_tangents is None and simulation.run(3).position_norms is None


def test_an_observer_may_stop_a_run():
    with pytest.raises(ZeroDivisionError):
        reference.Simulation(plane()).run(10, observe=lambda step: 1 / (3 - step))


BLOCK = box([0.25, 0.0, 0.05], [0.4, 0.1, 0.2], name="block", motion="path", velocity=[0.1, 0.0, 0.0])


@pytest.mark.parametrize(
    "call, sentence",
    [
        (lambda s: s.run(0), "steps is 0, but must be a whole number of at least 1."),
        (lambda s: s.run(5, {"gravity": [0.0, 1.0]}), r"gravity has shape \(2,\), but must be \(3,\) or \(5, 3\)"),
        (lambda s: s.run(5, {"time_step": 0.1}), "'time_step' is unknown to the reference engine, but must be one of"),
        (lambda s: s.tangent({}, {}, 5, method="magic"), "method is 'magic', but must be one of analytic, dual"),
        (lambda s: s.tangent({}, {}, 5, method="dual", terms=Terms()), "only analytic has them"),
        (lambda s: s.tangent({}, {}, 5, method="finite_difference", difference=0.0), "difference is 0.0, but must be"),
        (lambda s: s.tangent({}, {"viscosity": 1.0}, 5, method="as_printed"), "no such derivative"),
        (lambda s: s.gradient({}, 5, reference.FinalPositions(np.zeros((2, 3)))), r"target has shape \(2, 3\)"),
        (lambda s: reference.Simulation(splash(), "float16"), "precision is 'float16', but must be one of float32"),
        (lambda s: reference.Simulation(two_layers()), "several phases or an emitter"),
        (lambda s: reference.Simulation(scene(solid=[BLOCK])), r"solid\[0\], which moves, but must"),
    ],
)
def test_a_mistake_gives_a_sentence(call, sentence):
    with pytest.raises(InputError, match=sentence):
        call(reference.Simulation(splash()))


def test_a_lost_particle_is_named():
    for velocity, words in [
        ([1e12, 1e12, 1e12], "particle 0 was lost; speed limits the time step to about"),
        ([0.0, -200.0, 0.0], r"diverged in step 1: particle 0 \(and 49 more\) left the container"),
    ]:
        with pytest.raises(DivergedError, match=words):
            reference.Simulation(splash()).run(5, {"initial_velocities": np.tile(velocity, (125, 1))})


def test_where_it_is_not_installed_there_is_one_sentence():
    program = (
        "import sys; sys.modules['cortado_reference'] = None\n"
        "import cortado\n"
        "try: cortado.reference\n"
        "except (cortado.CortadoError, ImportError) as error: print(error)"
    )
    found = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout
    assert "pip install ./reference" in found and found.count("\n") == 1


def test_both_distributions_have_one_version():
    assert cortado_reference.__version__ == cortado.__version__


def test_bench_times_it():
    (rows,) = json.loads(bench_reference([100], 2, 1, "float32", as_json=True))["sizes"]
    assert rows["particles"] == 125 and rows["threads"] >= 1
    assert rows["speed_up"] == rows["forward_ms_per_step_one_thread"] / rows["forward_ms_per_step"] > 0.0
