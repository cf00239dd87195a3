"""Loads of the fluid on solids: action and reaction, derivatives, and what is refused."""

import numpy as np
import pytest

from cortado import InputError, Problem, Scene, SceneError, Simulation
from cortado.discretise.solid import Mass
from cortado.sensors import SolidLoad, WallForce
from scenes import Squares, simulated
from test_free_bodies import RAFT
from test_moving_solids import ROTOR, plane, space
from test_solid_parameters import PCISPH, PROJECTION, SCENES, STEPS, body, check, pasty, point_of, problem_of

POST = {"name": "post", "shape": "sphere", "centre": [0.5, 0.2], "radius": 0.07, "slip": "no"}
TANK = {"name": "tank", "shape": "box", "lower": [0.0, 0.0], "upper": [0.7, 0.6], "side": "inside", "slip": "no"}
IN_TANK = {"fluid": [body("water", upper=(0.7, 0.4))], "container": {"shape": "none"}}
"""All walls are those of solids."""
KINDS = {
    "projection": {"solver": PROJECTION},
    "projection, implicit": {"solver": PROJECTION, "forces": {"viscous_solve": "implicit"}},
    "projection, frictionless": {"solver": PROJECTION, "forces": {"viscosity": "none"}},
    "pcisph": {"solver": PCISPH},
    "pcisph, pairwise": {"solver": PCISPH, "forces": {"viscosity": "pairwise"}},
}


def loads_of(scene):
    return {solid.name: SolidLoad(solid.name) for solid in scene.solid}


@pytest.mark.filterwarnings("ignore::cortado.CortadoWarning")
@pytest.mark.parametrize("kind", KINDS)
def test_solids_get_the_momentum_that_the_fluid_loses(kind):
    """To round-off, in every step: sum F = M g - M (v' - v) / dt. The torques, with those of forces at the solids'
    positions, are the angular momentum that it loses, where forces between particles keep it; where viscosity is no
    stress, which acts on the surface, they are the torque of forces on particles."""
    scene = plane(ROTOR, POST, TANK, **IN_TANK, **KINDS[kind])
    sensors = {**loads_of(scene), "walls": WallForce()}
    run = Simulation(scene, precision="float64").run(STEPS, sensors=sensors)
    masses = run.constants["reference_density"] * scene.discretisation.spacing**2
    momentum = np.einsum("n,fnd->fd", masses, run.velocities)
    lack = masses.sum() * np.array(scene.forces.gravity) - np.diff(momentum, axis=0) / scene.solver.time_step
    loads = {name: run.sensors[name].values[:-1] for name in loads_of(scene)}
    assert all(np.abs(load).max() > 0.1 for load in loads.values())
    atol = 1e-12 * np.abs(lack).max()
    np.testing.assert_allclose(sum(load[:, :2] for load in loads.values()), lack, atol=atol)
    places = {"rotor": run.solids["rotor"].positions[1:], "post": POST["centre"], "tank": [0.35, 0.3]}
    torque = 0.0
    for name, load in loads.items():
        x, y = np.transpose(places[name])
        torque = torque + load[:, 2] + x * load[:, 1] - y * load[:, 0]
    if kind in ("projection, frictionless", "pcisph, pairwise"):
        np.testing.assert_allclose(torque, run.sensors["walls"]["torque"][:-1], atol=atol)
    if kind == "pcisph":
        pushes = scene.forces.gravity - np.diff(run.velocities, axis=0) / scene.solver.time_step
        (x, y), (push_x, push_y) = (array.transpose(2, 0, 1) for array in (run.positions[:-1], pushes))
        twisted = (x * push_y - y * push_x) @ masses
        np.testing.assert_allclose(torque, twisted, atol=atol)


@pytest.mark.parametrize("slip", ["free", "no"])
def test_what_fluid_does_to_a_free_body_is_what_moves_it(slip):
    """M (V' - V) / dt = M g + F, where it touches nothing, and so its torque."""
    scene = plane({**RAFT, "slip": slip}, container={"shape": "box", "lower": [0.0, 0.0], "upper": [1.0, 1.0]})
    run = Simulation(scene, precision="float64").run(STEPS, sensors=loads_of(scene))
    load, motion, own = run.sensors["raft"].values[:-1, :2], run.solids["raft"], Mass.of(scene.solid[0].own_solid())
    mass = RAFT["density"] * own.volume
    gained = mass * (np.diff(motion.velocities, axis=0) / scene.solver.time_step - scene.forces.gravity)
    np.testing.assert_allclose(load, gained, atol=1e-10 * np.abs(load).max())
    torque, turned = run.sensors["raft"].values[:-1, 2], np.diff(motion.angular_velocities) / scene.solver.time_step
    np.testing.assert_allclose(torque, RAFT["density"] * own.inertia[2, 2] * turned, atol=1e-10 * np.abs(torque).max())


def of_loads(scene):
    """A loss of all loads, with random weights."""
    weights = np.random.default_rng(1).uniform(size=(len(scene.solid), 3 * scene.dimension - 3))
    return Squares({f"{solid.name}.load": own for solid, own in zip(scene.solid, weights, strict=True)})


SEEN = {
    "projection": lambda: plane(ROTOR, POST),
    "pcisph": lambda: plane(ROTOR, POST, solver=PCISPH),
    "pairwise": SCENES["pairwise"],
    "periodic": SCENES["periodic"],
    "space": space,
    "paste": lambda: pasty(PROJECTION),
    "paste, implicit": lambda: pasty(PROJECTION, viscous_solve="implicit"),
    "raft": lambda: plane(RAFT),
    "raft without slip": lambda: plane({**RAFT, "slip": "no"}),
}


@pytest.mark.parametrize("name", SEEN)
def test_loads_have_derivatives(name):
    """Reverse and forward mode to round-off, and differences, for gravity, viscosity, density, and what solids do."""
    scene = SEEN[name]()
    problem = Problem(simulated(scene), STEPS, of_loads(scene))
    point, along = ({}, {}) if "raft" in name else point_of(scene)
    point |= {name: np.array(getattr(scene.phase[0], name)) for name in ("viscosity", "rest_density")}
    along |= {name: 0.3 * point[name] for name in ("viscosity", "rest_density")}
    point["gravity"], along["gravity"] = np.array(scene.forces.gravity) + 0.5, np.ones(scene.dimension)
    if "raft" in name:
        point |= {"raft.density": np.array(500.0), "raft.velocity": np.array([0.1, -0.2])}
        along |= {"raft.density": np.array(50.0), "raft.velocity": np.array([0.2, 0.3])}
    if name == "projection":
        point["time_step"], along["time_step"] = np.array(0.001), np.array(1e-4)
    check(problem, point, along)


def test_loads_of_a_batch_are_those_of_single_scenes_and_twice_the_same():
    scene = plane(ROTOR, POST)
    viscosities, loss = [1.0, 3.0], of_loads(scene)
    alone = Problem(Simulation(scene), STEPS, loss)
    single = [alone.value_and_gradient({"viscosity": one}) for one in (*viscosities, viscosities[0])]
    values, gradients = Problem(Simulation(scene, batch=2), STEPS, loss).value_and_gradient({"viscosity": viscosities})
    assert single[0] == single[2] and [value for value, _ in single[:2]] == values.tolist()
    assert [gradient["viscosity"] for _, gradient in single[:2]] == gradients["viscosity"].tolist()
    exact = Problem(Simulation(scene, precision="float64"), STEPS, loss).value_and_gradient({"viscosity": 1.0})
    assert single[0][0] == pytest.approx(exact[0], rel=2e-3)  # pressures in float32 are off by 5e-4 of the greatest
    assert single[0][1]["viscosity"] == pytest.approx(exact[1]["viscosity"], rel=1e-2)


def test_a_load_is_a_quantity_and_a_sensor_of_the_scene():
    scene = plane(ROTOR, POST, sensor=[{"kind": "solid_load", "name": "torque", "solid": "post"}])
    simulation = Simulation(scene, precision="float64")
    read = simulation.run(3).sensors["torque"]
    assert list(read.units) == ["force_x", "force_y", "torque"]
    np.testing.assert_array_equal(simulation.quantity("post.load"), read.values[0])
    far = plane({**POST, "centre": [0.8, 0.8]})
    assert not np.any(Simulation(far).quantity("post.load"))


def test_after_the_last_step_a_solid_goes_on():
    """What is read of the last state is what a longer run reads there."""
    simulation, sensors = simulated(plane(ROTOR)), {"rotor": SolidLoad("rotor")}
    short, long = (simulation.run(steps, sensors=sensors).sensors["rotor"].values for steps in (4, 6))
    np.testing.assert_allclose(short, long[:5], rtol=1e-9)


MISTAKES = [
    (lambda: SolidLoad(3), "solid is 3, but must be the name of a solid"),
    (lambda: Simulation(plane(ROTOR)).run(1, sensors={"a": SolidLoad("cup")}), "on 'cup', but the scene has rotor"),
    (lambda: Simulation(plane(ROTOR)).run(1, record=["rotor.load"]), "record is 'rotor.load', but must be one of"),
    (lambda: plane(ROTOR, sensor=[{"kind": "solid_load", "name": "a", "solid": "cup"}]), "solid.*the name of a solid"),
    (lambda: plane(sensor=[{"kind": "solid_load", "name": "a", "solid": "cup"}]), "of a scene with solids"),
    (lambda: Simulation(plane(ROTOR, forces={"pressure": False})).quantity("rotor.load"), "computes no pressure"),
]


@pytest.mark.parametrize(("make", "words"), MISTAKES)
def test_a_mistake_is_a_sentence(make, words):
    with pytest.raises((InputError, SceneError), match=words):
        make()


def test_the_force_on_walls_has_derivatives_with_the_normals_of_the_projection():
    """Walls that lean: the projection pushes along their normals."""
    leaning = {**TANK, "rotation": 0.3, "motion": "path", "angular_velocity": 2.0}
    scene = Scene.model_validate({**plane(leaning, **IN_TANK).model_dump(exclude_none=True)})
    check(problem_of(scene, "wall_force"), *point_of(scene))
