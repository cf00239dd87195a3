"""Flat faces of solids that move mirror the fluid: against the slow twin, theory, differences and momentum."""

import numpy as np
import pytest

from cortado import Problem, Simulation
from cortado.sensors import SolidLoad, WallForce
from reference_projection import Projection
from scenes import Squares, box, pool, simulated
from test_solid_parameters import check, point_of

S = 0.05
FLAP = box([-0.5, -0.2], [0.0, 0.8], name="flap", motion="path", velocity=[0.3, 0.05], angular_velocity=-0.6)
FALL = {"gravity": [0.0, -9.81]}
STEPS = 5


def flume(flap=FLAP, **tables):
    """Water between a flap that goes through the floor, and the end of a box."""
    own = {"container": box([-0.8, 0.0], [0.6, 1.0]), "fluid": [box([0.02, 0.0], [0.52, 0.5], phase="water")]}
    own |= {"forces": FALL, "solver": {"kind": "projection", "time_step": 0.004}}
    return pool([0.5, 0.5], [0.6, 1.0], S, 1.0, **{"solid": [flap], **own, **tables})


def hanging():
    """A box that moves and turns in water, around whose lower end water flows."""
    tank = {"container": box([0.0, 0.0], [1.2, 1.0]), "fluid": [box([0.0, 0.0], [0.5, 0.6], phase="water")]}
    return flume(
        box([0.5, 0.1], [0.9, 0.9], name="flap", motion="path", velocity=[0.3, 0.05], angular_velocity=-0.6), **tank
    )


def channel():
    """The flume in space: a box that goes through the floor and the sides."""
    moving = {"rotation": [0.02, 0.03, -0.02], "velocity": [0.3, 0.0, 0.05], "angular_velocity": [0.1, 0.2, -0.6]}
    space = {"dimension": 3, "container": box([-0.9, 0.0, 0.0], [0.4, 1.0, 0.2])}
    space |= {
        "fluid": [box([0.05, 0.0, 0.0], [0.35, 0.3, 0.2], phase="water")],
        "forces": {"gravity": [0.0, -9.81, 0.0]},
    }
    return flume(box([-0.6, -0.2, -0.2], [0.0, 0.8, 0.4], name="flap", motion="path", **moving), **space)


SCENES = {"flume": flume, "hanging": hanging, "channel": channel}


def faces_of(scene):
    return len(Simulation(scene).solver.system.faces.solids)


def test_faces_that_mirror(unpacked):
    """Both long sides do, all sides of a box in space, and all of a tank; others stay as walls of particles."""
    assert [faces_of(scene()) for scene in SCENES.values()] == [2, 2, 6]
    tank = box([0.0, 0.0], [0.6, 1.0], name="tank", side="inside", motion="path", velocity=[0.1, 0.0])
    assert faces_of(flume(tank, container={"shape": "none"})) == 4
    space = {"dimension": 3, "container": box([-0.8, 0.0, 0.0], [0.6, 1.0, 0.2])}
    space |= {"fluid": [box([0.02, 0.0, 0.0], [0.52, 0.5, 0.2], phase="water")], "forces": {}}
    wide = box([-0.5, -0.2, 0.0], [0.0, 0.8, 0.2], name="flap", motion="path", velocity=[0.3, 0.0, 0.0])
    ball = {"name": "ball", "shape": "sphere", "centre": [-0.3, 0.5], "radius": 0.2}
    still = {"name": "flap", "shape": "box", "lower": [-0.5, -0.2], "upper": [0.0, 0.8]}
    for other in (
        flume({**FLAP, "slip": "no"}),
        flume({**FLAP, "upper": [0.0, 0.19]}),
        flume({**ball, "motion": "path", "velocity": [0, 0]}),
        flume(still),
        flume({**still, "lower": [-0.5, 0.1], "motion": "free", "density": 500.0}),
        flume(container=box([-0.8, 0.0], [0.6, 1.0], periodic=[True, False])),
        flume(solver={"kind": "pcisph", "time_step": 0.004}),
        flume(wide, **space),
    ):
        assert faces_of(other) == 0


def test_water_beside_a_box_that_hangs_in_it_moves_as_beside_wall_particles():
    """Where its faces mirror what is beyond their ends, it moves 2.3 times as fast."""
    rest = {"solver": {"kind": "projection", "time_step": 0.002}, "discretisation": {"spacing": 0.02}}
    tank = {"container": box([0.0, 0.0], [1.0, 1.0]), "fluid": [box([0.0, 0.0], [1.0, 0.5], phase="water")]}
    boxes = [box([0.4, 0.06], [0.6, 0.8], name="box", motion="path", velocity=[0.0, 0.0]), box([0.4, 0.06], [0.6, 0.8])]
    speeds = []
    for one in boxes:
        scene = flume({"name": "box", **one}, **tank, **rest)
        run = Simulation(scene).run(80, record_every=20)
        speeds.append(np.sqrt((run.velocities[2:] ** 2).mean()))
    assert speeds[0] < speeds[1]


def test_a_step_is_that_of_the_twin():
    """Three steps without viscosity beside a flap that moves, turns and is stretched."""
    simulation = Simulation(flume().replaced("phase[0].viscosity=0"), precision="float64")
    random, m = np.random.default_rng(1), simulation.state()["reference_density"]
    x = simulation.positions + 0.005 * random.uniform(-1.0, 1.0, simulation.positions.shape)
    v, ends, dt = random.normal(scale=0.1, size=x.shape), (np.zeros(len(x)), np.zeros_like(x)), 0.004
    given = {"initial_positions": x, "initial_velocities": v, "flap.scale": 1.03}
    for steps in (1, 2, 3):
        run = simulation.run(steps, given)
        twin = Projection.of(simulation)
        h = simulation.solver.density.around["image"].numpy()
        assert (h > 0.9).sum() > 15 and ((h > 0.1) & (h < 0.9)).any() and np.ptp(x[h > 0.9], axis=0).min() > 0.3
        x, v, ends, _ = twin.step(x, v + dt * np.array(FALL["gravity"]), ends, m, dt)
        np.testing.assert_allclose(run.positions[-1], x, rtol=1e-10, atol=1e-11)
        np.testing.assert_allclose(run.velocities[-1], v, rtol=1e-10, atol=1e-11)


def test_water_at_rest_between_two_faces_stays():
    """After half a second to a second it moves by 0.032 m/s; with wall particles instead by 0.055."""
    sides = (("left", -0.4, 0.0), ("right", 1.0, 1.4))
    solids = [box([a, -0.06], [b, 1.1], name=name, motion="path", velocity=[0.0, 0.0]) for name, a, b in sides]
    own = {"container": box([-1.0, 0.0], [2.2, 1.2]), "fluid": [box([0.0, 0.0], [1.0, 0.6], phase="water")]}
    made = flume(solid=solids, discretisation={"spacing": 0.04, "jitter": 0.05}, **own).replaced("phase[0].viscosity=0")
    late = Simulation(made, precision="float64").run(250, record_every=10).velocities[13:]
    assert np.sqrt((late**2).sum(axis=2).mean()) < 0.04


@pytest.mark.parametrize("name", SCENES)
def test_walls_get_the_momentum_that_the_fluid_loses(name):
    """In every step and to round-off, with images in the face and in the container's sides. Of the flap alone but for
    what the floor takes in the corner."""
    scene = SCENES[name]().replaced('forces.viscosity="none"')
    run = Simulation(scene, precision="float64").run(10, sensors={"walls": WallForce(), "flap": SolidLoad("flap")})
    d = scene.dimension
    push = 1000.0 * S**d * (np.array(scene.forces.gravity) - np.diff(run.velocities, axis=0) / 0.004)
    lost, found = push.sum(axis=1), run.sensors["walls"].values[:-1]
    np.testing.assert_allclose(found[:, :d], lost, atol=1e-10 * np.abs(lost).max())
    if name != "flume":
        return
    touches_the_flap_alone = (run.positions[:-1, :, 0] < 0.5).all(axis=1)
    assert touches_the_flap_alone.any()
    sideways = run.sensors["flap"].values[:-1, 0] - lost[:, 0]
    np.testing.assert_allclose(sideways[touches_the_flap_alone], 0.0, atol=1e-5 * np.abs(lost).max())


SIZES = {"speed": 0.1, "density": 1e3, "pressure": 1e3, "wall_force": 10.0, "flap.load": 1e3}


@pytest.mark.parametrize("quantities", [["speed", "density"], ["pressure", "wall_force", "flap.load"]], ids=" ".join)
@pytest.mark.parametrize("name", SCENES)
def test_derivatives_by_what_the_solid_does(name, quantities):
    """Where it is, how it is turned, how it moves and turns, and how large it is: reverse and forward mode to
    round-off, and differences; of particles, of pressures and of loads."""
    scene = SCENES[name]()
    simulation, random = simulated(scene), np.random.default_rng(1)
    shapes = {one: simulation.quantity(one).shape for one in quantities}
    weights = {one: random.uniform(size=shape) / SIZES[one] ** 2 for one, shape in shapes.items()}
    check(Problem(simulation, STEPS, Squares(weights)), *point_of(scene))
