"""Sensors that ride on solids, beside closed forms, and their derivatives by the motion of these. What they read on a
device, and in batches, is in tests/test_step_reader.py."""

from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import cortado
from bad_scenes import one_sentence
from cortado.errors import InputError
from cortado.losses import Series
from cortado.scene.motions import matrix
from cortado.sensors import BodyMotion, PressureProbe, SolidLoad, WallForce, WaveGauge
from finite_differences import both_modes, decades, distance
from scenes import box, plane, pool
from test_wave_gauges import Basin, turned

pytestmark = pytest.mark.usefixtures("unpacked")
STEPS = decades(4.0, 8.0)
RATE = 1.0
"""How fast tanks are at the start [m/s]."""


# ---- what they make of fields ------------------------------------------------------------------------------------
@cache
def fields(dimension):
    """A class of states of a basin with two solids that move, and one of them, with numbers for all that is read."""
    basin = Basin(dimension, turned(dimension), spacing=0.05 if dimension == 2 else 0.125)
    random, angles = np.random.default_rng(4), 2 * dimension - 3

    class Fields(dict):
        dimension, solids, lattice, container = basin.dimension, basin.solids, basin.lattice, basin.container

    point = {"positions": basin["positions"], "pressure": random.normal(size=len(basin["positions"]))}
    point["wall_force"] = random.normal(size=basin["positions"].shape)
    for table in basin.solids:
        begun = np.array(table.rotation)
        point[f"{table.name}.position"] = table.middle()[None] + 0.01 * random.normal(size=(1, dimension))
        point[f"{table.name}.rotation"] = (begun if dimension == 2 else begun[None]) + 0.1
        point[f"{table.name}.load"] = random.normal(size=dimension + angles)
    point["solid 0.turn"] = np.full(angles, 0.2) if dimension == 2 else np.full((1, 3), 0.2)
    point["solid 0.scale"] = np.array([1.1])
    axes = np.linalg.qr(np.eye(3) + 0.2 * random.normal(size=(3, 3)))[0] if dimension == 3 else np.eye(3)
    axes = axes * np.sign(np.diag(axes))
    point |= {f"solid 1.turn_{x}": (axes - np.eye(3))[:, k][None, :dimension] for k, x in enumerate("xyz")}
    return Fields, point, axes


def riding(dimension, on):
    """One of each sensor on a solid, with the axes of both."""
    at, upper = np.array([0.9, 0.3, 0.97])[:dimension], np.array([1.25, 0.7, 1.3])[:dimension]
    return {
        "probe": PressureProbe(at, 0.2, on=on),
        "gauge": WaveGauge(at, 0.05, 0.25, on=on),
        "gauge in the body": WaveGauge(at, 0.05, 0.25, [0.1, 1.0, 0.05][:dimension], on=on, axes="body"),
        "force": WallForce(at - 0.3, upper, at + 0.1, on=on),
        "force in the body": WallForce(at - 0.3, upper, at + 0.1, on=on, axes="body"),
        "load in the body": SolidLoad(on, axes="body"),
    }


KINDS = [(kind, on) for kind in riding(2, "solid 0") for on in ("solid 0", "solid 1")]
KINDS.append(("gauge that stays", "solid 0"))


@pytest.mark.parametrize(("kind", "on"), KINDS)
@pytest.mark.parametrize("dimension", [2, 3])
def test_what_a_sensor_beside_solids_makes_of_its_adjoint_is_its_derivative(dimension, kind, on):
    """With respect to the fields and quantities that it reads and to the poses of solids, taken as free."""
    make, point, axes = fields(dimension)
    stays = WaveGauge([0.93, 0.0, 0.97][:dimension], up=[0.1, 1.0, 0.0][:dimension])
    sensor, random = {**riding(dimension, on), "gauge that stays": stays}[kind], np.random.default_rng(2)
    bar = random.normal(size=len(sensor.value(make(point))))
    bars = sensor.adjoint(make(point), bar)
    assert f"{on}.position" in bars or "load" in kind
    if sensor is stays:
        assert set(bars) == {name for name in point if not name.endswith(("pressure", "wall_force", "load"))}
    spun = 1e-6 * random.normal(size=3) * (1.0 if dimension == 3 else [0.0, 0.0, 1.0])
    along = {name: 1e-6 * random.normal(size=value.shape) for name, value in point.items() if "turn_" not in name}
    along |= {f"solid 1.turn_{x}": np.cross(spun, axes[:, k])[None, :dimension] for k, x in enumerate("xyz")}
    for only in (*{name.split(".turn_")[0] for name in bars}, None):
        way = {name: value * (only is None or name.split(".turn_")[0] == only) for name, value in along.items()}
        derivative = sum((bars[name] * way[name]).sum() for name in bars)

        def value(values):
            return float(bar @ sensor.value(make(values)))

        if abs(derivative) < 1e-20:
            assert value(point) == value({name: point[name] + way[name] for name in point}), only
        else:
            assert distance(value, point, way, derivative, [10.0, 1.0, 1e-1, 1e-2, 1e-3], enough=1e-4) < 1e-4, only


# ---- derivatives through runs ------------------------------------------------------------------------------------
SPACING = 0.1
TANK = {"name": "tank", "side": "inside", "motion": "path", "angular_velocity": 0.5, "velocity": [0.3, 0.2]}
RAFT = {"name": "raft", "motion": "free", "density": 400.0, "velocity": [0.2, -0.3], "angular_velocity": 0.6}


def swaying(dimension, **more):
    """A tank that holds water, and sways and turns along a path."""
    turn = {} if dimension == 2 else {"velocity": [0.3, 0.2, 0.1], "angular_velocity": [0.1, 0.2, 0.5]}
    corner, water, top = [0.0] * dimension, [0.4, 0.2, 0.3][:dimension], [0.4, 0.5, 0.3][:dimension]
    tank = box(corner, top, **{**TANK, **turn, **more})
    return pool(water, top, SPACING, 0.1, container={"shape": "none"}, solid=[tank])


def afloat(dimension):
    """A body that falls into water and turns."""
    turn = {} if dimension == 2 else {"velocity": [0.2, -0.3, 0.1], "angular_velocity": [0.3, 0.2, 0.6]}
    body = box([0.15, 0.25, 0.1][:dimension], [0.4, 0.45, 0.35][:dimension], **{**RAFT, **turn})
    return pool([0.6, 0.3, 0.5][:dimension], [0.6, 0.8, 0.5][:dimension], SPACING, 0.1, solid=[body])


def on_a_solid(dimension, on):
    """One of each sensor that rides, in the water beside the solid."""
    at, end = np.array([0.21, 0.13, 0.17])[:dimension], np.array([9.0, 0.8, 9.0])[:dimension]
    own = {"motion": BodyMotion(on)} if on == "raft" else {}
    return own | {
        "probe": PressureProbe(at, 0.25, on=on),
        "gauge": WaveGauge(at, radius=0.16, on=on),
        "gauge in the body": WaveGauge(at, radius=0.16, on=on, axes="body"),
        "force": WallForce(-end, end, at, on=on),
        "force in the body": WallForce(-end, end, at, on=on, axes="body"),
        "load in the body": SolidLoad(on, axes="body"),
    }


MADE = {"path": (swaying, "tank"), "free": (afloat, "raft")}


@cache
def simulated(kind, dimension, batch=None):
    """A simulation that the tests of this file share."""
    return cortado.Simulation(MADE[kind][0](dimension), precision="float64", batch=batch)


class All:
    """One sensor that reads what several do."""

    def __init__(self, sensors):
        self.sensors = sensors

    def columns(self, d):
        return {f"{name}, {key}": unit for name, one in self.sensors.items() for key, unit in one.columns(d).items()}

    def value(self, at):
        return np.concatenate([one.value(at) for one in self.sensors.values()])

    def adjoint(self, at, bar):
        total, ends = {}, np.cumsum([len(one.columns(at.dimension)) for one in self.sensors.values()])
        for one, part in zip(self.sensors.values(), np.split(bar, ends[:-1]), strict=True):
            for name, array in one.adjoint(at, part).items():
                total[name] = total.get(name, 0.0) + array
        return total


def problem_of(kind, dimension, steps=4):
    """One whose loss holds all sensors against a series, a point, and a direction there."""
    simulation, random, angles = simulated(kind, dimension), np.random.default_rng(3), 2 * dimension - 3
    on, dt = MADE[kind][1], simulation.scene.solver.time_step
    velocities = 0.1 * random.normal(size=simulation.velocities.shape)
    point, along = {"initial_velocities": velocities}, {"initial_velocities": random.normal(size=velocities.shape)}
    ends = {"position": simulation.scene.solid[0].middle(), "rotation": np.full(angles, 0.03)}
    if kind == "path":
        shapes = {"displacement": (steps, dimension), "turn": (steps,) if dimension == 2 else (steps, 3)}
        ends |= {end: 0.002 * random.normal(size=shape) for end, shape in shapes.items()}
    else:
        ends |= {"velocity": np.full(dimension, 0.3), "angular_velocity": np.full(angles, 0.4)}
        ends |= {"density": np.array(450.0)}
    for end, value in ends.items():
        value = np.reshape(value, ()) if np.shape(value) == (1,) else value
        point[f"{on}.{end}"] = value
        along[f"{on}.{end}"] = (100.0 if end == "density" else 0.3) * random.normal(size=np.shape(value))
    sensor = All(on_a_solid(dimension, on))
    sizes = np.abs(simulation.run(steps, point, sensors={"all": sensor}).sensors["all"].values).max(axis=0)
    wanted = sizes * random.normal(size=(3, len(sizes)))
    loss = Series(sensor, np.linspace(0.0, steps * dt, 3), wanted, dt, scale=sizes)
    return cortado.Problem(simulation, steps, loss), point, along


@pytest.mark.parametrize("kind", MADE)
def test_the_gradient_of_riding_sensors_is_that_of_forward_mode_and_of_differences(kind, dimension=2):
    """With respect to the fluid's first velocities and to how the solid begins and moves."""
    problem, point, along = problem_of(kind, dimension)
    gradient, derivative = both_modes(problem, point, along)
    assert all(np.abs(gradient[one]).max() > 0.0 for one in point)
    assert distance(problem.value, point, along, derivative, STEPS, enough=1e-6) < 1e-6


@pytest.mark.parametrize("kind", MADE)
def test_in_space_it_is_too(kind):
    test_the_gradient_of_riding_sensors_is_that_of_forward_mode_and_of_differences(kind, 3)


# ---- closed forms ------------------------------------------------------------------------------------------------
def carried(start, rate, times, full=True, **sensors):
    """Readings in a tank that begins at a rate [m/s] with its water, gets faster by ``start`` [m/s2] all the time, and
    goes by steps of a millisecond; of a tank that is ``full``, or else of one that is open."""
    positions = np.array([0.5, 0.25]) + np.stack([rate * times + 0.5 * start * times**2, 0.0 * times], axis=1)
    path = {"velocity": [0.0, 0.0]} if start == rate == 0.0 else {"times": times, "positions": positions}
    tank = box([0.0, 0.0], [1.0, 0.5], name="tank", side="inside", motion="path", **path)
    water = box([0.0, 0.0], [1.0, 0.5 if full else 0.3], phase="water", velocity=[rate, 0.0])
    made = pool([1.0, 0.5], [1.0, 0.5], 0.05, 0.0, container={"shape": "none"}, solid=[tank], fluid=[water])
    return cortado.Simulation(made, precision="float64").run(len(times) - 1, sensors=sensors).sensors


def test_probes_that_ride_read_the_pressure_of_a_tank_that_gets_faster():
    """rho (g depth + a x) in a full tank, which has gone 0.1 m; one that stays reads rho a times its way more."""
    times, a, rate = 1e-3 * np.arange(61), 20.0, 1.0
    places = {"left": [0.2, 0.25], "right": [0.8, 0.25], "low": [0.5, 0.1], "high": [0.5, 0.4]}
    sensors = {name: PressureProbe(at, on="tank") for name, at in places.items()}
    sensors |= {"still": PressureProbe([0.5, 0.25]), "middle": PressureProbe([0.5, 0.25], on="tank")}
    read = {name: one["pressure"][20:] for name, one in carried(a, rate, times, **sensors).items()}
    assert (read["left"] - read["right"]).mean() == pytest.approx(1000.0 * a * 0.6, rel=0.02)
    assert (read["low"] - read["high"]).mean() == pytest.approx(1000.0 * 9.81 * 0.3, rel=0.05)
    gone = (rate * times + 0.5 * a * times**2)[20:]
    assert (read["still"] - read["middle"]).mean() == pytest.approx(1000.0 * a * gone.mean(), rel=0.15)


def test_sensors_of_a_tank_at_constant_speed_read_what_they_read_at_rest():
    """Within what steps make of walls that are where they are at their ends."""
    times = 1e-3 * np.arange(31)
    sensors = {
        "probe": PressureProbe([0.3, 0.1], on="tank"),
        "gauge": WaveGauge([0.6, 0.0], on="tank"),
        "force": WallForce([-0.2, -0.2], [0.5, 0.7], [0.1, 0.1], on="tank"),
        "load": SolidLoad("tank", axes="body"),
    }
    stays = PressureProbe([0.02, 0.1], 0.03)
    rest, moved = (carried(0.0, rate, times, full=False, **sensors, still=stays) for rate in (0.0, RATE))
    for name in sensors:
        one, other = (run[name].values[-10:].mean(axis=0) for run in (rest, moved))
        np.testing.assert_allclose(other, one, atol=0.01 * np.abs(one).max(), err_msg=name)
    still = moved["still"]["pressure"]
    assert still[0] > 0.0 == still[-1]  # the tank is gone


@pytest.mark.parametrize("on", ["solid 0", "solid 1"], ids=["path", "free"])
@pytest.mark.parametrize("dimension", [2, 3])
def test_sensors_of_the_body_read_the_same_wherever_all_is_carried_and_turned(dimension, on):
    """To round-off, and what has axes of the world is turned with them."""
    make, point, axes = fields(dimension)
    alone = point[f"{on}.position"][0]
    vector = np.array([0.0, 0.0, 0.7]) if dimension == 2 else np.array([0.4, -0.3, 0.5])
    turn = matrix(vector)
    flat = turn[:dimension, :dimension]
    away = dict(point)
    for name in ("positions", *(f"solid {k}.position" for k in range(2))):
        away[name] = alone + (point[name] - alone) @ flat.T + 0.3
    away["wall_force"] = point["wall_force"] @ flat.T
    begun = matrix(point["solid 0.turn"] if dimension == 2 else point["solid 0.turn"][0])
    further = Rotation.from_matrix(turn @ begun).as_rotvec()
    away["solid 0.turn"] = further[2:] if dimension == 2 else further[None]
    for k, x in enumerate("xyz"):
        away[f"solid 1.turn_{x}"] = (turn @ axes - np.eye(3))[:, k][None, :dimension]
    for name in ("solid 0.load", "solid 1.load"):
        force, torque = point[name][:dimension], point[name][dimension:]
        away[name] = np.append(flat @ force, torque if dimension == 2 else turn @ torque)
    for name, sensor in riding(dimension, on).items():
        one, other = (sensor.value(make(state)) for state in (point, away))
        if name == "force":
            one = np.append(flat @ one[:dimension], one[2:] if dimension == 2 else turn @ one[3:])
        if name != "gauge":
            np.testing.assert_allclose(other, one, rtol=1e-9, atol=1e-9 * np.abs(one).max(), err_msg=name)


def test_heights_of_a_tank_that_is_lifted_are_those_in_the_world_or_in_the_tank():
    """Turned by a quarter with its water, a gauge in the body reads as before; one of the world reads the level."""
    tank = box([0.0, 0.0], [1.0, 0.6], name="tank", side="inside", motion="path", velocity=[0.0, 0.0])
    made = pool([1.0, 0.6], [1.0, 0.6], 0.05, container={"shape": "none"}, solid=[tank])
    simulation = cortado.Simulation(made, precision="float64")
    x, middle = simulation.positions, made.solid[0].middle()

    class Fields(dict):
        dimension, solids, lattice, container = 2, made.solid, simulation.lattice, made.container

    turn = np.array([[0.0, -1.0], [1.0, 0.0]])
    at = Fields(positions=(x[x[:, 1] < 0.3] - middle) @ turn.T + middle + [0.2, 0.7])
    at |= {"tank.position": (middle + [0.2, 0.7])[None], "tank.rotation": np.zeros(1), "tank.scale": np.ones(1)}
    at["tank.turn"] = np.array([0.5 * np.pi])
    lifted = Fields(at | {"positions": x[x[:, 1] < 0.3] + [0.0, 0.7], "tank.turn": np.zeros(1)})
    lifted["tank.position"] = (middle + [0.0, 0.7])[None]
    begun = Fields(lifted | {"positions": x[x[:, 1] < 0.3], "tank.position": middle[None]})
    level = WaveGauge([0.5, 0.0]).value(begun)[0]
    gauges = {axes: WaveGauge([0.5, 0.0], on="tank", axes=axes) for axes in ("body", "world")}
    for state, height in ((begun, level), (lifted, level + 0.7), (at, None)):
        assert gauges["body"].value(state)[0] == pytest.approx(level, rel=1e-12)
        assert height is None or gauges["world"].value(state)[0] == pytest.approx(height, rel=1e-12)
    assert gauges["world"].value(at)[0] > level + 0.7  # the water stands upright beside the floor of the tank
    assert level == pytest.approx(0.3, rel=0.01)


# ---- scene files and wrong input -----------------------------------------------------------------------------------
TABLES = [
    {"name": "probe", "kind": "pressure_probe", "position": [0.2, 0.1], "radius": 0.25, "on": "tank"},
    {"name": "gauge", "kind": "wave_gauge", "position": [0.2, 0.1], "radius": 0.16, "on": "tank", "axes": "body"},
    {"name": "force", "kind": "wall_force", "upper": [9.0, 9.0], "on": "tank", "axes": "body"},
    {"name": "load", "kind": "solid_load", "solid": "tank", "axes": "body"},
]


def test_tables_of_a_scene_make_sensors_that_ride():
    made = swaying(2, angular_velocity=20.0)
    plain = [{key: value for key, value in one.items() if key not in ("on", "axes")} for one in TABLES]
    scenes = [cortado.Scene(**{**made.model_dump(), "sensor": each}) for each in (TABLES, plain)]
    runs = [cortado.Simulation(one, precision="float64").run(6) for one in scenes]
    for name in ("probe", "gauge", "force", "load"):
        ridden, still = (run.sensors[name].values for run in runs)
        np.testing.assert_allclose(ridden[0], still[0], rtol=1e-5, atol=1e-3, err_msg=name)
        assert np.abs(ridden[-1] - still[-1]).max() > 1e-3 * np.abs(still[-1]).max(), name


WRONG = [
    ({"on": "cup"}, "sensor[0].on is 'cup', but must be the name of a solid that moves, of ['tank']"),
    ({"axes": "body"}, "sensor[0].axes is 'body', but must be \"world\", as the sensor is on no solid"),
]


@pytest.mark.parametrize(("keys", "words"), WRONG)
def test_what_is_wrong_in_a_table_is_a_sentence(keys, words):
    table = {"name": "gauge", "kind": "wave_gauge", "position": [0.2, 0.1], **keys}
    with one_sentence(error=cortado.SceneError) as error:
        cortado.Scene(**{**swaying(2).model_dump(), "sensor": [table]})
    assert words in str(error.value)


def test_solids_at_rest_carry_nothing_and_views_that_turn_have_no_images():
    sill = box([0.2, 0.0], [0.3, 0.1], name="sill")
    for table in ({"kind": "solid_load", "solid": "sill", "axes": "body"}, {**TABLES[0], "on": "sill"}):
        with pytest.raises(cortado.SceneError, match=r"as the solid is at rest|left out, as no solid moves"):
            plane(solid=[sill], sensor=[{"name": "mine", **table}])
    for sensor in (PressureProbe([0.1, 0.1], on="sill"), SolidLoad("sill", axes="body")):
        with pytest.raises(InputError, match="is on 'sill', but must be on a moving solid; the scene has none"):
            cortado.Simulation(plane(solid=[sill]), precision="float64").run(1, sensors={"mine": sensor})
    for make, words in (
        (lambda: PressureProbe([0.1, 0.1], on=3), "on is 3, but must be the name"),
        (lambda: WallForce(axes="body"), "as no solid carries the sensor"),
        (lambda: SolidLoad("sill", axes=1), 'axes is 1, but must be "world" or "body"'),
    ):
        with pytest.raises(InputError, match=words):
            make()
    drifting = {**sill, "motion": "path", "velocity": [0.1, 0.0]}
    room = box([0.0, 0.0], [0.6, 0.6], periodic=[True, False])
    simulation = cortado.Simulation(plane(solid=[drifting], container=room), precision="float64")
    for sensor in (WaveGauge([0.1, 0.0], on="sill", axes="body"), WallForce(on="sill")):
        with pytest.raises(InputError, match="has no periodic images"):
            simulation.run(1, sensors={"mine": sensor})


@pytest.mark.parametrize("kind", MADE)
def test_readings_of_a_long_run_are_those_of_its_parts(kind):
    """Bit for bit, over several chunks of steps and where a run goes on from a state."""
    on, simulation = MADE[kind][1], simulated(kind, 2)
    sensors = on_a_solid(2, on)
    whole = simulation.run(45, sensors=sensors)
    first = simulation.run(20, sensors=sensors)
    rest = simulation.run(25, state=first.last_state, sensors=sensors)
    for name in sensors:
        parts = np.concatenate([first.sensors[name].values[:-1], rest.sensors[name].values[:-1]])
        assert parts.tobytes() == whole.sensors[name].values[:-1].tobytes(), name


def test_a_loss_of_a_riding_sensor_in_a_batch_is_that_of_each_scene(name="gauge in the body"):
    starts = np.array([[0.2, 0.25], [0.23, 0.27]])
    sensor, dt = on_a_solid(2, "raft")[name], simulated("free", 2).scene.solver.time_step
    wanted = np.ones((2, len(sensor.columns(2))))
    alone, together = (
        cortado.Problem(simulated("free", 2, batch=batch), 4, Series(sensor, [0.0, 4 * dt], wanted, dt))
        for batch in (None, 2)
    )
    each = [alone.value_and_gradient({"raft.position": start}) for start in starts]
    values, gradient = together.value_and_gradient({"raft.position": starts})
    np.testing.assert_allclose(values, [value for value, _ in each], rtol=1e-12)
    np.testing.assert_allclose(gradient["raft.position"], [one["raft.position"] for _, one in each], rtol=1e-10)
