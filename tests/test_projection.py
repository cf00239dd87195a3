"""The projection against its slow twin, its derivatives against one another and differences, and what it promises."""

import warnings
from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp

from cortado import CortadoWarning, InputError, Problem, SceneError, Simulation, losses
from cortado.device.launching import KernelLauncher
from cortado.device.precision import FLOAT32, FLOAT64
from cortado.rollout.run_checks import divergence_sentence
from cortado.solvers.projection.coarse_levels import Levels
from finite_differences import both_modes, central_difference
from reference_projection import Projection
from scenes import C2, box, plane, plane_of_three, scene, thrown

SOLVER = {"kind": "projection", "time_step": 0.002}
PERIODIC = box([0.0, 0.0], [0.4, 0.8], periodic=[True, False])
FOLLOW = {**SOLVER, "velocities_follow": True}
CASES = {
    "plane": lambda: plane(solver=SOLVER),
    "space": lambda: scene(solver=SOLVER),
    "periodic": lambda: plane(solver=SOLVER, container=PERIODIC),
    "three phases": lambda: plane_of_three(solver=SOLVER, mixture={"mobility": 0.0}),
    "velocities follow": lambda: plane(solver=FOLLOW),
    "velocities follow in space": lambda: scene(solver=FOLLOW),
    "hurled": lambda: plane(solver=SOLVER),
    "hurled in space": lambda: scene(solver=SOLVER),
}
HURLED = {"hurled": 24.0, "hurled in space": 16.0}
"""How many times as fast as in other cases fluid is thrown: walls throw it back."""


def begun(case, simulation):
    given = thrown(simulation)
    return {**given, "initial_velocities": HURLED.get(case, 1.0) * given["initial_velocities"]}


def held_and_thrown(simulation):
    solver, dt = simulation.solver, simulation.scene.solver.time_step
    kick, gamma = solver.carried["pressure_kick"].numpy(), solver.density.around["beside"].numpy()
    far = dt * np.linalg.norm(kick, axis=1) > 0.1 * simulation.scene.discretisation.spacing
    return (solver.repaired[0]["held"].numpy() < 1.0).sum(), (far & ((kick * gamma).sum(1) > 0.0)).sum()


@pytest.mark.parametrize("case", HURLED)
def test_fluid_that_is_hurled_at_walls_is_held_back_by_both_bounds(case):
    simulation = Simulation(CASES[case]().replaced("phase[0].viscosity=0"), precision="float64")
    found = [held_and_thrown(simulation) for steps in (1, 2, 3) if simulation.run(steps, begun(case, simulation))]
    assert (np.sum(found, axis=0) > 0).all()


@pytest.mark.parametrize("case", CASES)
def test_a_step_is_that_of_the_twin(case):
    """Three steps without viscosity, the second and third from pressures of the one before."""
    made = CASES[case]()
    made = made.replaced(*(f"phase[{number}].viscosity=0" for number in range(len(made.phase))))
    simulation = Simulation(made, precision="float64")
    given, twin = begun(case, simulation), Projection.of(simulation)
    gravity, dt = np.array(made.forces.gravity), 0.002
    m = simulation.state()["reference_density"]
    run = simulation.run(3, given)
    x, v = given["initial_positions"], given["initial_velocities"]
    ends = np.zeros(len(m)), np.zeros_like(x)
    for step in range(1, 4):
        x, v, ends, divergence = twin.step(x, v + dt * gravity, ends, m, dt)
        k, kick = ends
        assert run.diagnostics["divergence"][step - 1] == pytest.approx(divergence, rel=1e-9, abs=0.0)
        for found, wanted in ((run.positions[step], x), (run.velocities[step], v)):
            np.testing.assert_allclose(found, wanted, rtol=1e-10, atol=1e-11)
        np.testing.assert_allclose(run.others["pressure_impulse"][step], k, rtol=1e-8, atol=1e-9)
        np.testing.assert_allclose(run.others["pressure_kick"][step], kick, rtol=1e-10, atol=1e-11)
    assert (k > 0.0).any() and (k < 0.0).any()


@pytest.mark.parametrize(("deep", "wide"), [(50, [5.0]), (25, [5.0, 5.0])])
def test_a_first_step_has_the_pressure_of_a_narrow_tank(deep, wide):
    """Where the coarse push had wall particles in place of images, the first pressures were 8 and 9 % off."""
    s, size = 1.0 / deep, np.array([wide[0], deep, *wide[1:]]) / deep
    lower, upper, room = np.zeros_like(size).tolist(), size.tolist(), (size + np.eye(len(size))[1]).tolist()
    tables = {"fluid": [box(lower, upper, phase="water")], "container": box(lower, room)}
    solver, make = {**SOLVER, "time_step": 0.1 * s}, plane if len(wide) == 1 else scene
    made = make(discretisation={"spacing": s}, forces={"gravity": [0.0, -9.81, *lower[2:]]}, solver=solver, **tables)
    state = Simulation(made, precision="float64").run(1).last_state.fields
    missed = state["pressure_impulse"] / (0.1 * s) / 9810.0 - (1.0 - state["positions"][:, 1])
    assert np.sqrt((missed**2).mean()) < 0.02


def test_water_that_is_shut_in_stays():
    """Without a coarse grid the pressure has come half way in ten steps; where walls let no tension through, the level
    of the pressure is found late, and 0.17 of the fall is left in four."""
    shut = filled([1.0, 1.0], [1.0, 1.0], 0.05, jitter=0.05, forces={"gravity": [9.81, 0.0]})
    run = Simulation(shut, precision="float64").run(4)
    assert abs(run.velocities[-1][:, 0].mean()) < 0.05 * 9.81 * 4 * 0.002


def test_water_that_is_shaken_pushes_the_floor_as_it_should():
    """With its mass times g (1 + sin(6 pi t) / 2): the amplitude within 3 %, the phase within 3 degrees."""
    dt = 0.004
    shaken = filled([0.5, 1.0], [0.5, 1.5], 0.05, jitter=0.05, solver={"time_step": dt})
    t = dt * (np.arange(int(0.7 / dt)) + 0.5)
    g = 9.81 * (1.0 + 0.5 * np.sin(6.0 * np.pi * t))
    run = Simulation(shaken).run(len(t), {"gravity": np.stack([0.0 * t, -g], axis=1)}, record_every=1)
    force = g + np.diff(run.velocities[:, :, 1].astype(np.float64).mean(axis=1)) / dt
    waves = np.stack([np.sin(6.0 * np.pi * t), np.cos(6.0 * np.pi * t), np.ones(len(t))], axis=1)[t > 1.0 / 3.0]
    along, across, _ = np.linalg.lstsq(waves, force[t > 1.0 / 3.0], rcond=None)[0]
    assert np.hypot(along, across) == pytest.approx(0.5 * 9.81, rel=0.03)
    assert abs(np.degrees(np.arctan2(across, along))) < 3.0


def filled(upper, room, spacing, jitter=None, solver=None, **tables):
    cut = {"spacing": spacing} if jitter is None else {"spacing": spacing, "jitter": jitter}
    given = {"fluid": [box([0.0, 0.0], upper, phase="water")], "container": box([0.0, 0.0], room), **tables}
    return plane(discretisation=cut, solver={**SOLVER, **(solver or {})}, **given)


def resting(**solver):
    return filled([1.0, 1.0], [1.0, 1.5], 0.1, solver=solver)


def test_a_column_behind_a_wall_has_no_image_in_it():
    """A jet comes out of it a spacing from the wall, and would meet the image of what follows, at 0.4 of its speed."""
    nozzle = {"outlet": [0.02, 0.5], "direction": [1.0, 0.0], "radius": 0.08, "length": 0.3, "flow_rate": 0.16}
    tables = {"fluid": [], "emitter": [{"phase": "water", **nozzle}], "forces": {"gravity": [0.0, 0.0]}}
    made = filled([0.0, 0.0], [1.0, 1.0], 0.02, solver={"time_step": 0.001}, **tables)
    run = Simulation(made).run(200, record_every=200)
    out = run.positions[-1][:, 0] > 0.04
    assert out.sum() > 60 and abs(run.velocities[-1][out, 0].mean() - 1.0) < 0.05


def test_water_rests_between_solids_that_stand_on_the_floor_of_a_box():
    """Where images went on to their feet it moved with 0.15 m/s."""
    ends = [box([-0.2, 0.0], [0.0, 1.1], name="left"), box([1.0, 0.0], [1.2, 1.1], name="right")]
    tables = {"container": box([-1.0, 0.0], [2.2, 1.2]), "solid": ends, "solver": {"time_step": 0.004}}
    run = Simulation(filled([1.0, 0.6], [], 0.04, **tables)).run(250, record_every=10)
    assert np.sqrt((run.velocities[12:] ** 2).sum(axis=2).mean()) < 0.1


def test_more_images_than_have_numbers_are_refused(monkeypatch):
    monkeypatch.setattr("cortado.particles.mirrors.NUMBERS", 99 * 64 + 1)
    with pytest.raises(InputError, match="100 particles are too many for mirroring walls: take at most 99"):
        Simulation(resting())


@pytest.mark.filterwarnings("ignore:solver.time_step is")
def test_a_divergence_that_is_left_is_told():
    """In steps that are nearly twice as long as they may be."""
    with pytest.warns(
        CortadoWarning, match=r"a divergence times time step of 0\.12 in step 9, and more than 0\.015 in 11 of 12"
    ):
        run = Simulation(resting(time_step=0.035), precision="float64").run(12)
    told = divergence_sentence(run.diagnostics, run.scene)
    assert told is not None and run.diagnostics["divergence"].argmax() == 8
    told = divergence_sentence({"divergence": np.array([[0.0, 0.01], [np.nan, 0.03]])}, run.scene)
    assert "0.03 in step 2 of scene 1, and more than 0.015 in 1 of 4 steps" in told
    with warnings.catch_warnings():
        warnings.simplefilter("error", CortadoWarning)
        allowed = Simulation(resting(time_step=0.019), precision="float64").run(12)
    assert allowed.diagnostics["divergence"].max() < 0.05 * run.diagnostics["divergence"].max()


MET = {**SOLVER, "tolerance": 1e-3, "maximum_iterations": 40}


def test_iterations_go_on_to_a_tolerance():
    """In a run that is taken up again too; where there are too few, the run says so."""
    simulation = Simulation(plane(solver=MET), precision="float64")
    given = thrown(simulation)
    run, fixed = simulation.run(8, given), Simulation(plane(solver=SOLVER), precision="float64").run(8, given)
    left, counts = run.diagnostics["divergence"], run.iterations
    assert fixed.diagnostics["divergence"].max() > 1e-3 >= left.max() and run.converged.all()
    assert counts.min() >= 2 and len(set(counts)) > 1
    rest = simulation.run(4, state=run[:5].last_state)
    np.testing.assert_array_equal(rest.iterations, counts[4:])
    np.testing.assert_array_equal(rest.positions[-1], run.positions[-1])
    with pytest.warns(CortadoWarning, match="the pressure did not converge in"):
        few = Simulation(plane(solver={**MET, "maximum_iterations": 3}), precision="float64").run(8, given)
    assert few.iterations.max() == 3 and not few.converged.all()


def test_derivatives_are_those_of_as_many_iterations_as_a_step_took():
    simulation = Simulation(plane(solver=MET), precision="float64")
    given, rng = thrown(simulation), np.random.default_rng(4)
    problem = Problem(simulation, 6, losses.CentreOfMass([0.3, 0.25]))
    ways = {name: rng.normal(size=value.shape) for name, value in given.items()}
    _, tangent = both_modes(problem, given, ways)
    assert len(set(problem.diagnostics["iterations"])) > 1
    assert central_difference(problem.value, given, ways, 1e-8) == pytest.approx(tangent, rel=1e-5)


@pytest.mark.parametrize(
    "solver, words",
    [
        ({"maximum_iterations": 9}, "maximum_iterations is 9, but must be left out, as there is no tolerance"),
        ({"tolerance": 1e-3, "iterations": 60}, "maximum_iterations is 50, but must be at least iterations, 60"),
    ],
)
def test_tolerances_that_mean_nothing_are_a_sentence(solver, words):
    with pytest.raises(SceneError, match=words):
        plane(solver={**SOLVER, **solver})
    with pytest.raises(InputError, match=r"batch is 2, .* as solver\.tolerance applies to a single scene"):
        Simulation(plane(solver=MET), batch=2)


def test_what_a_lost_run_left_on_the_coarse_grid_is_not_read():
    simulation = Simulation(plane(solver=SOLVER), precision="float64")
    first = simulation.run(3)
    simulation.solver.corrected[0]["e"].fill_(np.nan)
    assert simulation.run(3).positions.tobytes() == first.positions.tobytes()


@pytest.mark.parametrize("make", [plane, scene])
def test_pressures_keep_both_momenta(make):
    """Of fluid that nothing holds; the shift and repairs move particles whose velocities stay as they are."""
    made = make(solver=SOLVER, container={"shape": "none"}).replaced("phase[0].viscosity=0")
    made = made.replaced(f"forces.gravity={[0.0] * made.dimension}")
    simulation = Simulation(made, precision="float64")
    given = thrown(simulation)
    x, v = given["initial_positions"], given["initial_velocities"]
    impulses = simulation.run(1, given).velocities[-1] - v
    twice = x.T @ impulses
    assert np.abs(impulses.sum(axis=0)).max() < 1e-12 * np.abs(impulses).sum()
    assert np.abs(twice - twice.T).max() < 1e-12 * np.abs(x).max() * np.abs(impulses).sum()
    assert np.abs(impulses).max() > 0.01


def problem_of(make, steps=8, **options):
    simulation = Simulation(make(), **{"precision": "float64", **options})
    x = simulation.positions
    target = losses.FinalPositions(x + 0.05 * np.sin(np.arange(x.size)).reshape(x.shape))
    return Problem(simulation, steps, losses.Frames({5: target, steps: target}))


@pytest.mark.parametrize("precision", ["float32", "float64"])
def test_fluid_that_moves_as_a_whole_resists_a_strain(precision):
    """All its pressures are 0 at first, where formulas have corners that values have not."""
    jittered = {**plane(solver=SOLVER).discretisation.model_dump(), "jitter": 0.1}
    free = plane(solver=SOLVER, discretisation=jittered, container={"shape": "none"}, forces={"gravity": [0.0, 0.0]})
    problem, double = (problem_of(lambda: free, steps=6, precision=name) for name in (precision, "float64"))
    x = problem.simulation.positions
    strain = (x - x.mean(axis=0)) * [1.0, -1.0]
    strain[:, 0] += 0.3 * strain[:, 0]  # and a little that the pressure takes out
    still, strained = {"initial_velocities": np.tile([0.5, 0.25], (len(x), 1))}, {"initial_velocities": strain}
    _, slope = both_modes(problem, still, strained, 1e-4 if precision == "float32" else 1e-11)
    step = 1e-7  # what is faster is corrected before the first iteration too
    assert slope == pytest.approx(central_difference(double.value, still, strained, step), rel=0.002)


def test_a_scene_without_pressure_has_nothing_to_project():
    forces = {"gravity": [0.0, -9.81], "pressure": False}
    solvers = SOLVER, {"kind": "pcisph", "time_step": 0.002}
    one, other = (
        Simulation(plane(solver=solver, forces=forces, discretisation=C2)).run(10).positions[-1] for solver in solvers
    )
    assert one.tobytes() == other.tobytes()


SHAPES = {
    "plane": (2, (10, 8, 1)),
    "one level": (2, (5, 7, 1)),
    "period of three": (2, (3, 12, 1)),
    "space": (3, (6, 5, 4)),
}


def assembled(dimension, shape, parts):
    """The dense matrix of what cells (pairs of corners, cells) have of it, on a grid that wraps around."""
    n = np.array(shape)
    corners = np.array([[c & 1, (c >> 1) & 1, c >> 2] for c in range(2**dimension)])
    dense, (first, second) = np.zeros((n.prod(), n.prod())), np.triu_indices(len(corners))
    for number, own in enumerate(parts.T):
        cell = np.array(np.unravel_index(number, shape[::-1]))[::-1]
        nodes = [np.ravel_multi_index(tuple(((cell + corner) % n)[::-1]), shape[::-1]) for corner in corners]
        part = np.zeros((len(corners), len(corners)))
        part[first, second] = part[second, first] = own
        np.add.at(dense, np.ix_(nodes, nodes), part)
    return dense


def system(dimension, shape, rng):
    """What cells have of A for each two corners, q q^T in seven of ten; dense A, and the nodes that have one."""
    pairs, count = np.triu_indices(2**dimension), np.prod(shape)
    q = rng.normal(size=(4, 2**dimension, count))
    q[0] = 0.1
    parts = np.einsum("qan,qbn->abn", q, q)[pairs] * (rng.random(count) > 0.3)
    dense = assembled(dimension, shape, parts)
    return parts, dense, np.diag(dense) > 0.0


def prolongation(n, factor):
    """(n, n / factor) along an axis that wraps around: nodes between two coarser ones have the mean of both."""
    coarser = np.eye(n // factor)
    return coarser if factor == 1 else np.stack([coarser, 0.5 * (coarser + np.roll(coarser, 1, 1))], 1).reshape(n, -1)


def levels_of(precision, dimension, shape, members=1, rows=0):
    layout = SimpleNamespace(precision=precision, members=members, device=wp.get_device("cpu"))
    return Levels(layout, dimension, shape, rows)


@pytest.mark.parametrize("case", ["plane", "period of three", "space"])
def test_coarser_matrices_are_those_of_galerkin(case):
    dimension, shape = SHAPES[case]
    levels = levels_of(FLOAT64, dimension, shape)
    parts, dense, _ = system(dimension, shape, np.random.default_rng(4))
    levels.cells.assign(parts)
    levels.begin(SimpleNamespace(launch=KernelLauncher(1, levels.r.device, False)))
    coarse = levels.levels[1]
    x, y, z = (prolongation(n, factor) for n, factor in zip(shape, coarse.factor, strict=True))
    P = np.kron(z, np.kron(y, x))
    found = assembled(dimension, tuple(coarse.shape), coarse.cells.numpy())
    np.testing.assert_allclose(found, P.T @ dense @ P, atol=1e-12 * np.abs(dense).max())


@pytest.mark.parametrize("case", SHAPES)
@pytest.mark.parametrize("precision, tolerance, most", [(FLOAT64, 1e-14, 1e-11), (FLOAT32, 3e-7, 1e-3)])
def test_a_solve_is_the_dense_one_for_each_scene(case, precision, tolerance, most):
    """With two rows of B, which are a large part of the matrix."""
    (dimension, shape), rng = SHAPES[case], np.random.default_rng(3)
    made = [system(dimension, shape, rng) for _ in range(2)]
    levels = levels_of(precision, dimension, shape, 2, rows=2)
    rows = [rng.normal(size=(2, np.prod(shape))) * full for _, _, full in made]
    levels.B.assign(np.concatenate(rows, axis=1))
    r = rng.normal(size=(2, np.prod(shape))) * [full for _, _, full in made]
    levels.cells.assign(np.concatenate([parts for parts, _, _ in made], axis=1))
    levels.begin(SimpleNamespace(launch=KernelLauncher(1, levels.r.device, False)))
    levels.r.assign(r.ravel())
    e = wp.zeros_like(levels.r)
    levels.solve(e, tolerance, 1_000)
    found = e.numpy().reshape(2, -1)
    for (_, dense, full), B, one, wanted in zip(made, rows, found, r, strict=True):
        exact = np.linalg.solve((dense + B.T @ B)[np.ix_(full, full)], wanted[full])
        np.testing.assert_allclose(one[full], exact, atol=most * np.abs(exact).max())
        assert not one[~full].any()
    assert (levels.count.numpy() < 60).all()
    levels.r.fill_(np.nan)
    levels.solve(e, tolerance, 1_000)
    assert not e.numpy().any()
