"""Where solids are and how large, as parameters: reverse and forward mode of all five, in each solver and with each
force."""

import warnings

import numpy as np
import pytest

from cortado import Problem, Scene, Simulation, certify
from cortado.certificate.horizon import coherent_directions, scales
from cortado.errors import CortadoWarning, InputError
from cortado.losses import CentreOfMass
from cortado.losses.distances import SensorMatch
from cortado.pictures.exported import Exported
from cortado.runs.frames import posed
from cortado.sensors import PressureProbe, WallForce
from finite_differences import decades, directional, distance
from freeze import FLOOR
from scenes import Squares, box, simulated
from test_moving_solids import PADDLE, ROTOR, WATER, plane, space

PASTE = {"name": "paste", "rest_density": 1000.0, "viscosity": 4.0}
PASTE["rheology"] = {"kind": "bingham", "yield_stress": 8.0, "regularisation": 0.5}
OIL = {"name": "oil", "rest_density": 800.0, "viscosity": 3.0}
BALL = {"name": "ball", "shape": "sphere", "centre": [0.45, 0.3], "radius": 0.06}
BALL |= {"motion": "path", "velocity": [-0.3, 0.2], "slip": "free"}
PCISPH, PROJECTION = ({"kind": kind, "time_step": 0.001} for kind in ("pcisph", "projection"))
STEPS = 5


def body(phase, lower=(0.0, 0.0), upper=(0.6, 0.4)):
    return box(list(lower), list(upper), phase=phase)


def pasty(solver, **forces):
    return plane(ROTOR, phase=[PASTE], fluid=[body("paste")], solver=solver, forces={"viscosity": "stress", **forces})


def periodic():
    container = box([0, 0], [0.6, 1], periodic=[True, False], slip="no")
    return plane({**ROTOR, "lower": [0.48, 0.15], "upper": [0.68, 0.25]}, container=container)


BOTH = {"phase": [WATER, OIL], "fluid": [body("water", upper=(0.6, 0.2)), body("oil", lower=(0.0, 0.2))]}
SPOUT = {"phase": "water", "outlet": [0.8, 0.5], "radius": 0.08, "length": 0.2, "flow_rate": 0.2}

SCENES = {
    "projection": lambda: plane(ROTOR),
    "pcisph": lambda: plane(ROTOR, solver=PCISPH),
    "space": space,
    "space, pcisph": lambda: space(solver=PCISPH, forces={"viscosity": "stress"}),
    "paste": lambda: pasty(PROJECTION),
    "paste, implicit": lambda: pasty(PROJECTION, viscous_solve="implicit"),
    "paste, implicit, pcisph": lambda: pasty(PCISPH, viscous_solve="implicit"),
    "pairwise": lambda: plane(ROTOR, solver=PCISPH, forces={"viscosity": "pairwise"}),
    "two phases": lambda: plane(ROTOR, **BOTH),
    "two solids": lambda: plane(ROTOR, BALL),
    "periodic": periodic,
    "mixture": lambda: plane(ROTOR, **BOTH, mixture={"interface_width": 0.06, "mobility": 1e-3}),
    "tension": lambda: plane(ROTOR, forces={"surface_tension": 2.0}),
    "tension, pcisph": lambda: plane(ROTOR, solver=PCISPH, forces={"surface_tension": 2.0}),
    "emitter": lambda: plane(ROTOR, emitter=[SPOUT]),
}


def point_of(scene, steps=STEPS, seed=0):
    """The parameters of all solids of a scene, by name, and a direction there."""
    random, d = np.random.default_rng(seed), scene.dimension
    times = scene.solver.time_step * np.arange(1, steps + 1)
    point, along = {}, {}
    for solid in (table for table in scene.solid if table.moves):
        angles = () if d == 2 else (3,)
        begun = np.array(solid.rotation or (0.2,) * (2 * d - 3)).reshape(angles)
        drift = 0.2 * np.multiply.outer(times, random.normal(size=d))
        turned = np.multiply.outer(times, 3.0 * random.normal(size=angles))
        own = {"position": (solid.middle() + 0.003, 0.1), "rotation": (begun, 1.0)}
        own["displacement"] = drift + 1e-5 * random.normal(size=drift.shape), 1e-3
        own["turn"] = turned + 1e-4 * random.normal(size=turned.shape), 0.01
        own["scale"] = np.array(1.04 + 0.02 * seed), 0.1
        point |= {f"{solid.name}.{name}": value for name, (value, _) in own.items()}
        along |= {f"{solid.name}.{name}": size * random.normal(size=value.shape) for name, (value, size) in own.items()}
    return point, along


def problem_of(scene, quantity="speed", precision="float64"):
    simulation = simulated(scene, precision)
    weights = np.random.default_rng(1).uniform(size=simulation.quantity(quantity).shape)
    return Problem(simulation, STEPS, Squares({quantity: weights}))


def check(problem, point, along):
    """One by one reverse and forward mode, to round-off, and all of them together differences. A derivative counts as
    this part of the greatest one at least: some are what is left of sums that cancel."""
    gradient = problem.value_and_gradient(point)[1]
    tangents = {name: problem.tangent(point, {name: direction}) for name, direction in along.items()}
    least = FLOOR * max(map(abs, tangents.values()))
    for name, tangent in tangents.items():
        reverse = directional(gradient, {name: along[name]})
        assert abs(reverse - tangent) <= 1e-10 * max(abs(tangent), least), name
    assert distance(problem.value, point, along, sum(tangents.values()), decades(3.0, 7.5), enough=1e-7) < 1e-6


@pytest.mark.parametrize("name", SCENES)
def test_all_five_have_derivatives(name):
    scene = SCENES[name]()
    check(problem_of(scene), *point_of(scene))


@pytest.mark.parametrize(
    ("kind", "quantity"),
    [("projection", "pressure"), ("projection", "vorticity"), ("pcisph", "density"), ("pcisph", "wall_force")],
)
def test_losses_of_what_is_read_of_a_state_have_them(kind, quantity):
    """As walls where they will be at the end of the next step are in it."""
    scene = plane(ROTOR, solver=PCISPH, forces={"viscosity": "none"}) if kind == "pcisph" else SCENES[kind]()
    check(problem_of(scene, quantity), *point_of(scene))


@pytest.mark.parametrize("sensor", [WallForce(upper=[0.35, 2.0], about=[0.1, 0.05]), PressureProbe([0.45, 0.2], 0.12)])
def test_losses_of_sensors_have_them(sensor):
    scene = plane(ROTOR)
    loss = SensorMatch(sensor, np.zeros(len(sensor.columns(2))))
    check(Problem(simulated(scene), STEPS, loss), *point_of(scene))


def test_the_time_step_has_a_derivative_where_the_path_is_given():
    scene = plane({**ROTOR, "surface_velocity": [0.7, 0.0]}, forces={"viscosity": "stress"})
    point, along = point_of(scene)
    check(problem_of(scene), {**point, "time_step": np.array(0.001)}, {**along, "time_step": np.array(1e-3)})


@pytest.mark.parametrize("kind", ["projection", "pcisph"])
def test_a_solid_that_is_told_where_it_begins_is_that_of_a_scene_that_says_so(kind):
    """To round-off, if the fluid is there: its walls do not depend on where it begins or how it is turned."""
    place, turned, solver = [0.46, 0.21], 0.3, {"kind": kind, "time_step": 0.001}
    at = {"fluid": [body("water", upper=(0.3, 0.4))], "solver": solver}
    told = plane({**ROTOR, "position": [0.6, 0.3]}, **at)
    own = plane({**ROTOR, "position": place, "rotation": turned}, **at)
    there = problem_of(own)
    fluid = {"initial_positions": there.simulation.positions}
    given = {**fluid, "rotor.position": place, "rotor.rotation": turned}
    found = problem_of(told).value(given)
    assert found == pytest.approx(there.value({}), rel=1e-12)
    assert abs(found / problem_of(told).value(fluid) - 1.0) > 1e-6


DISC = {"shape": "sphere", "centre": [0.5, 0.4], "radius": 0.15}


@pytest.mark.parametrize(
    ("shape", "scale"), [(box([0.35, 0.25], [0.65, 0.55]), 4.0 / 3.0), (DISC, 0.9)], ids=["box", "disc"]
)
def test_a_solid_that_is_told_how_large_it_is_has_the_walls_of_one_that_is(shape, scale, tmp_path):
    """Water that is packed about one of that size has nearly the rest density beside it."""
    solid = {**shape, "name": "one", "motion": "path", "velocity": [0.0, 0.0]}
    table = plane(solid).solid[0].stretched(scale)
    larger = {**solid, **{name: getattr(table, name) for name in table.measures}, "position": [0.5, 0.4]}
    there = Simulation(plane(larger, fluid=[body("water", upper=(1.0, 0.8))], solver=PCISPH), precision="float64")
    np.save(tmp_path / "water.npy", there.positions)
    fluid = {"shape": "points", "file": str(tmp_path / "water.npy"), "phase": "water"}
    told = Simulation(plane({**solid, "position": [0.5, 2.0]}, fluid=[fluid], solver=PCISPH), precision="float64")
    near = table.solid().distance(there.positions) < 0.1
    at = {"initial_positions": there.positions, "one.position": [0.5, 0.4]}
    found, bare = (told.quantity("density", controls={**at, "one.scale": one})[near].mean() for one in (scale, 1.0))
    assert found == pytest.approx(there.quantity("density")[near].mean(), rel=8e-3)
    assert bare != pytest.approx(found, rel=5e-2)


def test_a_displacement_and_a_turn_are_from_where_it_begins():
    scene = plane(ROTOR)
    point, _ = point_of(scene)
    run = simulated(scene).run(STEPS, point)
    motion = run.solids["rotor"]
    np.testing.assert_allclose(motion.positions[0], point["rotor.position"], rtol=1e-15)
    np.testing.assert_allclose(motion.positions[1:], point["rotor.position"] + point["rotor.displacement"], rtol=1e-15)
    np.testing.assert_allclose(motion.rotations[1:], point["rotor.rotation"] + point["rotor.turn"], rtol=1e-14)


def check_batch(scene, points):
    """At several points a batch has the bits of single scenes."""
    one, loss = simulated(scene), CentreOfMass([0.5, 0.3])
    several = Problem(Simulation(scene, batch=len(points), precision="float64"), STEPS, loss)
    together = {name: np.stack([point[name] for point in points]) for name in points[0]}
    values, gradients = several.value_and_gradient(together)
    for b, point in enumerate(points):
        value, gradient = Problem(one, STEPS, loss).value_and_gradient(point)
        assert values[b] == value
        for name, array in gradient.items():
            np.testing.assert_array_equal(gradients[name][b], array, err_msg=name)


def test_scenes_of_a_batch_have_the_bits_of_single_ones():
    scene = plane(ROTOR, BALL)
    check_batch(scene, [point_of(scene, seed=seed)[0] for seed in range(2)])


def test_a_run_that_goes_on_has_the_bits_and_the_derivatives_of_a_whole_one():
    """With the same parameters, of those over time the rows that are left."""
    scene = plane(ROTOR)
    simulation, (point, along) = simulated(scene), point_of(scene)

    def some(values, rows):
        return {name: value[rows] if len(value.shape and value) == STEPS else value for name, value in values.items()}

    whole = simulation.run(STEPS, point)
    first = simulation.run(2, some(point, slice(2)))
    point, along = ({n: v for n, v in values.items() if n != "rotor.scale"} for values in (point, along))  # in states
    rest = simulation.run(STEPS - 2, some(point, slice(2, None)), state=first.last_state)
    np.testing.assert_array_equal(rest.positions[-1], whole.positions[-1])
    np.testing.assert_array_equal(rest.solids["rotor"].rotations, whole.solids["rotor"].rotations[2:])
    problem = Problem(simulation, STEPS - 2, CentreOfMass([0.5, 0.3])).beginning_at(first.last_state)
    check(problem, *(some(values, slice(2, None)) for values in (point, along)))


def test_in_single_precision_they_are_right_to_its_digits():
    scene = plane(ROTOR, forces={"viscosity": "stress"})
    point, _ = point_of(scene)
    exact, found = (problem_of(scene, precision=p).value_and_gradient(point)[1] for p in ("float64", "float32"))
    for name, array in exact.items():
        np.testing.assert_allclose(found[name], array, atol=1e-2 * np.abs(array).max(), err_msg=name)


def test_a_certificate_moves_a_path_steadily_and_finds_its_derivatives_right():
    """It does not let a solid jump in the first step."""
    scene = plane(ROTOR)
    problem, (point, _) = problem_of(scene), point_of(scene)
    along = coherent_directions(problem, point, scales(problem, point), np.random.default_rng(0))
    for name in ("rotor.displacement", "rotor.turn"):
        rows = along[name].reshape(STEPS, -1)
        np.testing.assert_allclose(rows, np.multiply.outer(np.arange(1, STEPS + 1) / STEPS, rows[-1]), rtol=1e-12)
    assert certify(problem, point).right


@pytest.mark.parametrize(
    ("name", "value", "sentence"),
    [
        ("rotor.position", np.zeros((STEPS, 2)), r"has shape \(5, 2\), but must be \(2,\) in m"),
        ("rotor.rotation", [0.1, 0.2], r"has shape \(2,\), but must be \(\) in rad"),
        ("rotor.displacement", np.zeros((3, 2)), r"has shape \(3, 2\), but must be \(2,\) or \(5, 2\) in m"),
        ("ball.position", [0.1, 0.1], r"is unknown, but must be one of .*, rotor.angular_velocity in this scene"),
        ("rotor.scale", 0.0, r"rotor.scale is 0.0, but must be greater than 0"),
    ],
)
def test_a_bad_place_is_a_sentence(name, value, sentence):
    with pytest.raises(InputError, match=sentence):
        problem_of(plane(ROTOR)).value({name: value})
    fixed = {name: ROTOR[name] for name in ("name", "shape", "lower", "upper")}
    with pytest.raises(InputError, match=r"'rotor.position' is unknown, as the solid 'rotor' is at rest: only those"):
        problem_of(plane(fixed)).value({"rotor.position": [0.3, 0.2]})


def test_a_solid_that_jumps_is_warned_of():
    """Once: a displacement that does not begin near 0, and a state that goes on with another position."""
    simulation = Simulation(plane(ROTOR))
    with pytest.warns(CortadoWarning, match=r"the solid 'rotor' goes 0\.3 m in step 1 of this run, which is further"):
        simulation.run(2, controls={"rotor.displacement": [0.3, 0.0], "rotor.turn": 0.0})
    first = simulation.run(4, controls={"rotor.position": [0.3, 0.3]})
    with pytest.warns(CortadoWarning, match=r"needs rotor\.position of the first run"):
        simulation.run(1, state=first.last_state)
    with warnings.catch_warnings():
        warnings.simplefilter("error", CortadoWarning)
        simulation.run(1, controls={"rotor.position": [0.3, 0.3]}, state=first.last_state)
        Simulation(plane(ROTOR)).run(4)


@pytest.mark.filterwarnings("ignore:.*goes on")
@pytest.mark.parametrize(
    ("given", "sentence"),
    [
        ({"rotor.scale": 1.6}, r"'rotor' is 1\.6 times as large .*, but the scale must be from 0\.6 to 1\.5"),
        ({"ball.scale": 1.4}, r"'ball' is 1\.4 times as large .* and covers 0\.06 m, more than a spacing"),
        ({"floor.scale": 1.1}, r"'floor' is 1\.1 times as large .*, so that the solid no longer fills a period"),
    ],
)
def test_a_size_that_walls_do_not_hold_is_warned_of(given, sentence):
    floor = {"name": "floor", "shape": "box", "lower": [0.0, -0.2], "upper": [0.6, 0.0], "motion": "path"}
    scene = periodic().model_dump(exclude_none=True)
    scene["solid"] += ({**floor, "velocity": [0.1, 0.0]}, {**BALL, "centre": [0.3, 0.7], "radius": 0.15})
    simulation = Simulation(Scene(**scene))
    with pytest.warns(CortadoWarning, match=sentence):
        simulation.quantity("speed", controls=given)


def test_a_run_that_goes_on_keeps_the_size():
    """And it is drawn and exported so."""
    simulation = Simulation(plane(ROTOR))
    first = simulation.run(2, controls={"rotor.scale": 1.1})
    rest = simulation.run(1, state=first.last_state)
    assert first.solids["rotor"].scale == rest[:1].solids["rotor"].scale == np.float32(1.1)
    drawn, exported = posed(simulation.scene, first.solids, -1).solid[0], Exported(first, simulation.scene).solids[0]
    for faces in (drawn.own_solid().faces(0.1).vertices, exported.mesh.points):
        np.testing.assert_allclose(np.ptp(faces, axis=0)[:2], [0.22, 0.11], rtol=1e-6)
    with pytest.raises(InputError, match=r"rotor\.scale is given, but must be left out, as the given state"):
        simulation.run(1, controls={"rotor.scale": 1.1}, state=first.last_state)
    density = simulation.quantity("density", first, controls={"rotor.scale": 1.1})  # which is that of the run
    np.testing.assert_array_equal(density[-1], simulation.quantity("density", first.last_state))


PROPELLER = {key: PADDLE[key] for key in ("name", "shape", "start", "end", "radius", "rotation", "motion")}
PROPELLER["velocity"] = [0.1, 0.0, 0.2]


@pytest.mark.parametrize(
    "scene",
    [
        *(plane(ROTOR, BALL, solver=solver) for solver in (PROJECTION, PCISPH)),
        *(space(solid=[PROPELLER], solver=solver) for solver in (PROJECTION, PCISPH)),
    ],
    ids=["plane, projection", "plane, pcisph", "space, projection", "space, pcisph"],
)
def test_steady_motion_has_derivatives(scene):
    """With respect to how fast all solids go, and to the time step."""
    random, d = np.random.default_rng(0), scene.dimension
    point, along = {"time_step": np.array(scene.solver.time_step)}, {"time_step": np.array(1e-3)}
    for name in (table.name for table in scene.solid):
        for rate, shape in ((f"{name}.velocity", (d,)), (f"{name}.angular_velocity", () if d == 2 else (3,))):
            point[rate], along[rate] = random.normal(size=shape), random.normal(size=shape)
    check(problem_of(scene), point, along)


def test_a_velocity_is_that_of_a_scene_that_says_so():
    """To the last bit, and also where a run goes on."""
    told = Simulation(plane({**ROTOR, "velocity": [0.3, -0.1], "angular_velocity": 2.0}), precision="float64")
    given = {"rotor.velocity": [0.3, -0.1], "rotor.angular_velocity": 2.0}
    simulation = Simulation(plane(ROTOR), precision="float64")
    whole, first = told.run(STEPS), simulation.run(2, given)
    rest = simulation.run(STEPS - 2, given, state=first.last_state)
    np.testing.assert_array_equal(rest.positions[-1], whole.positions[-1])
    np.testing.assert_array_equal(rest.solids["rotor"].rotations, whole.solids["rotor"].rotations[2:])


def test_a_path_with_times_has_a_derivative_with_respect_to_the_time_step():
    knots = {"times": [0.0, 0.0023, 0.01], "positions": [[0.45, 0.2], [0.4503, 0.2], [0.45, 0.2]]}
    own = {key: value for key, value in ROTOR.items() if key not in ("angular_velocity", "velocity")}
    scene = plane({**own, "position": [0.45, 0.2], **knots})
    check(problem_of(scene), {"time_step": np.array(0.001)}, {"time_step": np.array(1e-3)})


def test_a_velocity_and_a_displacement_are_one_too_many():
    problem = problem_of(plane(ROTOR))
    both = {"rotor.velocity": [0.1, 0.0], "rotor.displacement": [0.0, 0.0]}
    with pytest.raises(InputError, match=r"rotor.displacement is given, but must be left out, as rotor.velocity is"):
        problem.value(both)
    with pytest.raises(InputError, match=r"direction rotor.velocity is given, .* as rotor.displacement is given in"):
        problem.tangent({"rotor.displacement": [0.0, 0.0]}, {"rotor.velocity": [0.1, 0.0]})
    with pytest.raises(InputError, match=r"'paddle.velocity' is unknown"):  # which has times
        problem_of(space()).value({"paddle.velocity": [0.1, 0.0, 0.0]})
