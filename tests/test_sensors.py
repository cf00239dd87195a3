"""Sensors against what is known, and their derivatives."""

import csv

import numpy as np
import pytest

import cortado
from bad_tasks import TINY_SCENE
from cortado.cli import main
from cortado.discretise.packing import Packing
from cortado.discretise.smoothing import KERNELS
from cortado.errors import CortadoWarning, InputError
from cortado.losses import Series
from cortado.runs.quantity_values import QuantityEvaluator
from cortado.runs.sensor import Readings, SensorLog, as_csv, from_csv, value_of
from cortado.scene.shape_tables import NoContainer
from cortado.sensors import FlowRate, PressureProbe, WallForce, WaveGauge
from cortado.watching import Watch
from finite_differences import both_modes, distance
from scenes import box, jet, plane, pool, scene, simulated
from test_wave_gauges import Basin

IN_THE_PLANE = {
    "probe": PressureProbe([0.21, 0.13], 0.12),
    "gauge": WaveGauge([0.19, 0.0], radius=0.15),
    "flow": FlowRate([0.33, 0.0], [1.0, 0.2]),
    "close": WaveGauge([0.19, 0.0], radius=0.07),
    "thin": FlowRate([0.33, 0.0], [1.0, 0.2], 0.06),
    "force": WallForce(upper=[0.35, 2.0], about=[0.1, 0.05]),
}
IN_SPACE = {
    "probe": PressureProbe([0.12, 0.1, 0.11]),
    "gauge": WaveGauge([0.11, 0.0, 0.13]),
    "flow": FlowRate([0.2, 0.0, 0.0], [1.0, 0.1, 0.2]),
    "close": WaveGauge([0.11, 0.0, 0.13], radius=0.08),
    "force": WallForce(about=[0.1, 0.0, 0.2]),
}
CASES = [(make, name, own) for make, each in ((plane, IN_THE_PLANE), (scene, IN_SPACE)) for name, own in each.items()]
NAMED = [f"{make.__name__}-{name}" for make, name, _ in CASES]


def problem_of(make, sensor, precision="float64", steps=8):
    """One whose loss holds a sensor against a series, a point, and a direction there."""
    random = np.random.default_rng(3)
    simulation = simulated(make(), precision)
    d, dt = simulation.dimension, simulation.scene.solver.time_step
    wanted = random.normal(size=(4, len(sensor.columns(d))))
    loss = Series(sensor, np.linspace(0.0, steps * dt, 4), wanted, dt)
    gravity = np.array(simulation.scene.forces.gravity) + random.normal(size=(steps, d))
    velocities = 0.5 * random.normal(size=simulation.velocities.shape)
    point = {"gravity": gravity, "initial_velocities": velocities, "rest_density": np.array(1000.0)}
    along = {"gravity": random.normal(size=gravity.shape), "initial_velocities": random.normal(size=velocities.shape)}
    return cortado.Problem(simulation, steps, loss), point, {**along, "rest_density": np.array(20.0)}


@pytest.mark.parametrize(("make", "name", "sensor"), CASES, ids=NAMED)
def test_the_gradient_of_a_sensor_is_that_of_forward_mode_and_of_differences(make, name, sensor):
    problem, point, along = problem_of(make, sensor)
    _, derivative = both_modes(problem, point, along, 1e-11)
    steps = [1e-4, 3e-5, 1e-5, 3e-6, 1e-6, 3e-7, 1e-7]
    assert distance(problem.value, point, along, derivative, steps, enough=1e-6) < 1e-6


@pytest.mark.parametrize(("name", "sensor"), IN_THE_PLANE.items(), ids=IN_THE_PLANE)
def test_the_certificate_finds_the_gradient_of_a_sensor_right(name, sensor):
    """In float32; in float64 the test before finds it right."""
    problem, point, _ = problem_of(plane, sensor, "float32")
    assert cortado.certify(problem, {"gravity": point["gravity"]}).right


FRICTIONLESS = {"viscosity": "none", "gravity": [1.0, -9.81]}


def still_water(precision="float64", **changes):
    """A column of water, 0.5 m wide and 0.5 m high, in the plane."""
    discretisation = {"spacing": 0.025, "support": 3.0, "kernel": "wendland_c2"}
    solver = {"kind": "pcisph", "time_step": 0.001, "maximum_iterations": 100, "density_tolerance": 0.001}
    tables = {"discretisation": discretisation, "solver": solver, **changes}
    return cortado.Simulation(pool([0.5, 0.5], [0.5, 0.8], viscosity=5.0, **tables), precision=precision)


def test_still_water_pushes_walls_and_probes_as_it_must():
    simulation = still_water("float32")
    weight, side = 1000.0 * 9.81 * 0.5 * 0.5, 1000.0 * 9.81 * 0.5**2 / 2.0
    sensors = {
        "left": WallForce(upper=[0.25, 1.0]),
        "right": WallForce(lower=[0.25, -1.0]),
        "floor": WallForce(upper=[1.0, 0.25]),
        "probe": PressureProbe([0.25, 0.2]),
        "gauge": WaveGauge([0.25, 0.0], radius=0.2),
        "flow": FlowRate([0.25, 0.0], [1.0, 0.0]),
    }
    read = simulation.run(700, record_every=700, sensors=sensors).sensors

    def mean(name, column):
        assert len(read[name].times) == 701
        return read[name][column][300:].mean()

    assert mean("floor", "force_y") == pytest.approx(-weight, rel=0.03)
    assert mean("left", "force_x") == pytest.approx(-side, rel=0.03)
    assert mean("right", "force_x") == pytest.approx(side, rel=0.03)
    assert mean("probe", "pressure") == pytest.approx(1000.0 * 9.81 * 0.3, rel=0.03)
    assert mean("gauge", "height") == pytest.approx(0.5, rel=0.02)
    assert abs(mean("flow", "flow_rate")) < 1e-3


class Moving(Basin):
    """Water without an end that goes along x with 2 m/s as a whole, as sensors see it."""

    container, solids = NoContainer(), ()

    def __getitem__(self, name):
        x = super().__getitem__("positions")
        return {"positions": x, "velocities": np.full_like(x, 2.0) * np.eye(self.dimension)[0]}[name]


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("support", [1.2, 3.0])
@pytest.mark.parametrize("kernel", KERNELS)
def test_a_basin_is_as_deep_as_it_is_with_every_kernel(kernel, support, dimension):
    basin, middle = Moving(dimension, kernel=kernel, support=support), [1.013, 0.2, 0.987][:dimension]
    assert value_of(WaveGauge(middle), basin)[0] == pytest.approx(0.5, rel=1e-3)
    across = 1.0 if dimension == 2 else 2.0
    flow = value_of(FlowRate(middle, np.eye(dimension)[0]), basin)[0]
    assert flow == pytest.approx(2.0 * 0.5 * across, rel=1e-3)


@pytest.mark.parametrize("dimension", [2, 3])
def test_a_basin_is_as_deep_as_it_is_with_every_reach(dimension):
    """Down to half a spacing, and through planes that are slanted."""
    basin, across = Moving(dimension), 1.0 if dimension == 2 else 2.0
    for reach in (0.025, 0.04, 0.06, 0.075, 0.1, 0.13, 0.2, 0.25):
        for place in (1.0, 1.013, 1.025):
            middle = [place, 0.2, 0.987][:dimension]
            assert value_of(WaveGauge(middle, radius=reach), basin)[0] == pytest.approx(0.5, rel=1e-3)
            for normal in ([1.0, 0.0, 0.0], [1.0, 0.3, 0.0]):
                flow = FlowRate(middle, normal[:dimension], reach)
                assert value_of(flow, basin)[0] == pytest.approx(across, rel=1e-3)


@pytest.mark.parametrize("in_space", [False, True])
def test_the_force_and_the_torque_on_walls_are_what_the_fluid_lacks_of_its_momentum(in_space):
    """Without friction, to round-off, in every step: F = sum_i m_i (g - (v_i' - v_i) / dt), and as the forces between
    particles are along the lines between them, T = sum_i a_i x m_i (g - (v_i' - v_i) / dt)."""
    made = scene(forces={"viscosity": "none", "gravity": [1.0, -9.81, 0.5]}) if in_space else None
    simulation = cortado.Simulation(made, precision="float64") if made else still_water(forces=FRICTIONLESS)
    d, dt = simulation.dimension, simulation.scene.solver.time_step
    about = np.array([0.1, 0.05, -0.2])[:d]
    trajectory = simulation.run(30, sensors={"walls": WallForce(about=about)})
    masses = trajectory.constants["reference_density"] * simulation.lattice.cell
    arms = np.zeros((30, simulation.particles, 3))
    pushes = np.zeros_like(arms)
    arms[..., :d] = trajectory.positions[:-1] - about
    pushes[..., :d] = simulation.scene.forces.gravity - np.diff(trajectory.velocities, axis=0) / dt
    force, torque = np.split(trajectory.sensors["walls"].values[:-1], [d], axis=1)
    lack, turn = ((masses[:, None] * each).sum(axis=1) for each in (pushes, np.cross(arms, pushes)))
    assert np.abs(torque).max() > 1.0 and np.abs(force).max() > (1.0 if in_space else 1000.0)
    np.testing.assert_allclose(force, lack[:, :d], atol=1e-9 * np.abs(force).max())
    np.testing.assert_allclose(torque, turn if in_space else turn[:, 2:], atol=1e-9 * np.abs(torque).max())


def test_the_flow_of_an_emitter_is_its_flow_rate():
    """Where the jet goes through a plane in free fall."""
    outlet = {"phase": "water", "outlet": [0.3, 0.9], "radius": 0.075, "length": 0.5, "flow_rate": 0.3}
    room = {"shape": "box", "lower": [0.0, -3.0], "upper": [0.6, 1.6]}
    made = jet(emitter=[outlet], fluid=[], container=room, forces={"gravity": [0.0, 0.0]}, solver={"time_step": 0.001})
    sensors = {"jet": FlowRate([0.0, 0.7], [0.0, -1.0], 0.1)}
    read = cortado.Simulation(made).run(200, record_every=200, sensors=sensors).sensors["jet"]
    assert read["flow_rate"][-20:].mean() == pytest.approx(0.3, rel=0.01)


TABLES = """
[[sensor]]
kind = "pressure_probe"
name = "bottom"
position = [0.1, 0.05]

[[sensor]]
kind = "wall_force"
name = "walls"
"""


def test_the_command_reads_the_sensors_of_a_scene(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scene.toml").write_text(TINY_SCENE + TABLES)
    main(["run", "scene.toml", "--steps", "4", "--record-every", "2", "--no-pictures", "--out", "run"])
    rows = list(csv.reader((tmp_path / "run" / "sensors.csv").open()))
    heads = ["time [s]", "bottom.pressure [Pa]", "walls.force_x [N/m]", "walls.force_y [N/m]", "walls.torque [N]"]
    assert rows[0] == heads and len(rows) == 6
    alone = cortado.Simulation(tmp_path / "scene.toml").run(4)
    np.testing.assert_array_equal([float(row[1]) for row in rows[1:]], alone.sensors["bottom"]["pressure"])
    assert "sensors.png" in "".join(path.name for path in (tmp_path / "run" / "figures").iterdir())
    assert "What the sensors read" in (tmp_path / "run" / "report.html").read_text()
    (tmp_path / "plain.toml").write_text(TINY_SCENE)
    plain = cortado.Simulation(tmp_path / "plain.toml").run(4)
    assert np.array_equal(plain.positions, alone.positions) and not plain.sensors


class Odd:
    """A sensor of one column, which reads what it is told to."""

    def __init__(self, read):
        self.read = read

    def columns(self, dimension):
        return {"read": "m"}

    def value(self, at):
        return self.read

    def adjoint(self, at, bar):
        return {}


PROBE = PressureProbe([0.2, 0.1])


def series_of(sensor, values=(1.0, 2.0), time_step=0.0021, parameters=None, **options):
    loss = Series(sensor, [0.0, 0.0084], values, time_step, **options)
    return cortado.Problem(cortado.Simulation(plane()), 4, loss).value(parameters or {})


MISTAKES = [
    (lambda: read_by(sensors=[PROBE]), "sensors is .* but must be a dictionary"),
    (lambda: read_by(sensors={"o": Odd(3.0)}), r"sensor Odd has shape \(\), but must be \(1,\)"),
    (lambda: read_by(sensors={"o": Odd("deep")}), "sensor Odd is 'deep', but must be"),
    (lambda: PressureProbe([0.0, 0.0], np.inf), "radius is inf, but must be greater than 0 and finite"),
    (lambda: Series(PROBE, [0.0, 1.0], [np.inf, 0.0], 0.1), "values must be finite"),
    (lambda: Series(PROBE, [0.0, 1.0], [1.0, 0.0], 0.1, scale=[1.0, 2.0]), r"scale has shape \(2,\), but must be"),
    (lambda: series_of(PROBE, [[1.0, 2.0], [3.0, 4.0]]), "values has 2 columns, but must have 1"),
    (lambda: series_of(PROBE, time_step=0.002), "time_step of the series is 0.002 s, but must be .* 0.0021 s"),
    (lambda: series_of(Odd(3.0)), r"sensor Odd has shape \(\)"),
    (lambda: FlowRate([0.0, 0.0], [0.0, 0.0]), "normal is .* but must not be 0"),
    (lambda: WallForce([1.0, 0.0], [0.0, 1.0]), "upper is .* but must be greater than lower"),
    (lambda: Series(PROBE, [0.0, 1.0], [1.0], 0.1), "values has shape"),
    (lambda: Series(PROBE, [1.0, 0.0], [1.0, 1.0], 0.1), "times must be"),
    (lambda: read_by(sensors={"p": PressureProbe([0.0] * 3)}), "position has 3 components"),
    (lambda: read_by(batch=2, sensors={"own": Reference()}), "sensor 'own' is a Reference, but a sensor of a batch"),
    (lambda: plane(sensor=2 * [{"kind": "wall_force", "name": "a"}]), "another name"),
    (lambda: plane(sensor=[{"kind": "wall_force", "name": "a", "lower": [0.0]}]), "2 components"),
    (lambda: table(kind="flow_rate", position=[0.1, 0.1], normal=[0.0, 0.0]), r"sensor\[0\].normal is .* not zero"),
    (lambda: table(kind="wall_force", lower=[0.5, 0.0], upper=[0.1, 0.2]), r"sensor\[0\].upper is .* greater than"),
    *(
        (lambda name=name: table(kind="wall_force", name=name), r"sensor\[0\].name is .* one line of text")
        for name in ("=cmd|calc", "@sum", "\uff1d1", "two\nlines")
    ),
]


def read_by(sensors, batch=None):
    return cortado.Simulation(plane(), batch=batch).run(1, sensors=sensors)


def table(**keys):
    return plane(sensor=[{"name": "mine", **keys}])


def test_a_mistake_is_a_sentence():
    for make, words in MISTAKES:
        with pytest.raises((InputError, cortado.SceneError), match=words):
            make()


def test_a_series_in_a_batch_is_that_of_each_scene():
    loss = Series(PROBE, [0.0, 0.0084], [1.0, 200.0], 0.0021)
    viscosities, alone = [0.05, 0.5], cortado.Problem(cortado.Simulation(plane()), 4, loss)
    each = [alone.value({"viscosity": viscosity}) for viscosity in viscosities]
    together = cortado.Problem(cortado.Simulation(plane(), batch=2), 4, loss).value({"viscosity": viscosities})
    assert together.tolist() == each and each[0] != each[1]


@pytest.mark.usefixtures("unrendered")
def test_an_interruption_between_two_sensors_keeps_what_was_read(cortado_command, tmp_path, monkeypatch):
    """And the run goes on with the same bits."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scene.toml").write_text(TINY_SCENE + TABLES)
    run = ("run", "scene.toml", "--steps", "6", "--record-every", "2", "--no-pictures", "--out")
    assert cortado_command(*run, "whole")[0] == 0
    reads, read = [], SensorLog.read

    def interrupted(log, name, *a):
        reads.append(name)
        if len(reads) == 10:  # the second sensor of the state after four steps
            raise KeyboardInterrupt
        read(log, name, *a)

    with monkeypatch.context() as patch:
        patch.setattr(SensorLog, "read", interrupted)
        code, _, err = cortado_command(*run, "stopped")
    assert code == 130 and "Interrupted; " in err and "Traceback" not in err
    assert len(list(csv.reader((tmp_path / "stopped" / "sensors.csv").open()))) == 5
    assert cortado_command(*run, "stopped", "--resume")[0] == 0
    texts = [(tmp_path / name / "sensors.csv").read_text() for name in ("whole", "stopped")]
    assert texts[0] == texts[1]


ROUND_THE_EDGE = {
    2: {
        "gauge": WaveGauge([0.01, 0.0], radius=0.15),
        "tilted": WaveGauge([0.49, 0.0], radius=0.15, up=[0.2, 1.0]),
        "flow": FlowRate([0.5, 0.0], [1.0, 0.0]),
        "slanted": FlowRate([0.5, 0.0], [2.0, 1.0], 0.3),
        "probe": PressureProbe([0.5, 0.1]),
        "wide": PressureProbe([0.3, 0.1], 0.8),
        "floor": WallForce(lower=[0.4, -1.0], upper=[0.6, 0.15], about=[0.5, 0.0]),
        "half": WallForce(lower=[0.25, -1.0]),
        "walls": WallForce(),
    },
    3: {
        "gauge": WaveGauge([0.01, 0.0, 0.3]),
        "flow": FlowRate([0.3, 0.0, 0.0], [1.0, 0.0, 0.0]),
        "slanted": FlowRate([0.0, 0.0, 0.0], [1.0, 0.0, 1.0]),
        "probe": PressureProbe([0.0, 0.1, 0.0]),
        "floor": WallForce(lower=[0.2, -1.0, 0.2], upper=[0.4, 0.15, 0.4]),
    },
}


def channel(dimension):
    """Water 0.2 m deep that fills a period, 0.5 m long in the plane, 0.3 m along both axes in space."""
    long = [0.5, 0.4] if dimension == 2 else [0.3, 0.4, 0.3]
    low, velocity, periodic = [0.0] * dimension, [2.0, 0.0, 0.5][:dimension], [True, False, True][:dimension]
    tables = {
        "container": box(low, long, periodic=periodic),
        "fluid": [box(low, [long[0], 0.2, *long[2:]], velocity=velocity, phase="water")],
        "discretisation": {"spacing": 0.025 if dimension == 2 else 0.05},
    }
    made = plane if dimension == 2 else scene
    return simulated(made(**tables)), long[0]


@pytest.mark.parametrize("dimension", [2, 3])
def test_sensors_see_fluid_that_has_gone_around_a_period(dimension):
    """Wherever its positions are, and also across the edge: the readings are those of the first lap."""
    simulation, length = channel(dimension)
    sensors, axes = ROUND_THE_EDGE[dimension], np.array([1.0, 0.0, 1.0])[:dimension]

    def read(shift):
        moved = {"initial_positions": simulation.positions + shift}
        run = simulation.run(1, moved, sensors=sensors)
        return {name: own.values for name, own in run.sensors.items()}

    first, turns = read(0.0), np.random.default_rng(1).integers(-2, 4, (simulation.particles, 1))
    for turn in (1.0, 3.0, -2.0, turns):
        for name, values in read(turn * length * axes).items():
            np.testing.assert_allclose(values, first[name], atol=1e-7 * np.abs(first[name]).max(), err_msg=name)
    depth = simulation.lattice.volume * simulation.particles / length ** (dimension - 1)
    assert first["gauge"][0, 0] == pytest.approx(depth, rel=0.01)
    across = depth * (1.0 if dimension == 2 else length)
    assert first["flow"][0, 0] == pytest.approx(2.0 * across, rel=0.01)
    slanted = 2.0 * across if dimension == 2 else (2.0 + 0.5) * across
    assert first["slanted"][0, 0] == pytest.approx(slanted, rel=0.02)


@pytest.mark.parametrize(("dimension", "name"), [(2, name) for name in ROUND_THE_EDGE[2]] + [(3, "slanted")])
def test_the_gradient_of_a_sensor_across_a_period_is_that_of_differences(dimension, name):
    simulation, length = channel(dimension)
    sensor, random = ROUND_THE_EDGE[dimension][name], np.random.default_rng(3)
    dt = simulation.scene.solver.time_step
    wanted = random.normal(size=(2, len(sensor.columns(dimension))))
    problem = cortado.Problem(simulation, 4, Series(sensor, [0.0, 4.0 * dt], wanted, dt))
    shift = random.integers(-2, 4, (simulation.particles, 1)) * length * np.eye(dimension)[0]
    velocities = simulation.velocities + 0.5 * random.normal(size=simulation.velocities.shape)
    point = {"initial_positions": simulation.positions + shift, "initial_velocities": velocities}
    along = {"initial_velocities": random.normal(size=velocities.shape)}
    _, derivative = both_modes(problem, point, along)
    assert distance(problem.value, point, along, derivative, [1e-4, 3e-5, 1e-5, 3e-6, 1e-6, 3e-7], enough=1e-6) < 1e-6


BLOCK = {"name": "block", "shape": "box", "lower": [0.5, 0.0], "upper": [0.65, 0.8]}
NOWHERE = {
    "a probe in millimetres": (PressureProbe([300.0, 100.0]), "outside of the container.*positions are in metres"),
    "a probe in a solid": (PressureProbe([0.58, 0.1]), "in the solid 'block', where it begins"),
    "a probe that sees nothing": (PressureProbe([0.2, 0.1], 1e-9), "less than half a spacing"),
    "a gauge outside": (WaveGauge([0.9, 0.0], 0.3), "outside of the container.*its floor, 0.3 m"),
    "a floor in millimetres": (WaveGauge([0.3, 0.0], 50.0), "has its floor at 50 m, above the container"),
    "a plane outside": (FlowRate([0.9, 0.0], [1.0, 0.1]), "has its plane through .* outside of the container"),
    "a floor below the container": (
        WaveGauge([0.3, 0.0], -5.0),
        "floor at -5 m, .* begins at 0 m: the reading is 5 m less",
    ),
    "a radius in millimetres": (WaveGauge([0.3, 0.0], radius=50.0), "radius of 50 m, more than the size"),
    "a region without walls": (WallForce([0.3, 0.35], [0.32, 0.37]), "without walls"),
}


@pytest.mark.parametrize(("sensor", "words"), NOWHERE.values(), ids=NOWHERE)
def test_a_sensor_that_can_never_see_fluid_is_warned_of_before_the_run(sensor, words):
    scene = plane(solid=[{**BLOCK, "motion": "path", "velocity": [0.0, 0.0]}])
    simulation = cortado.Simulation(scene, precision="float64")
    dt, series = simulation.scene.solver.time_step, [[0.0] * len(sensor.columns(2))] * 2
    with pytest.warns(CortadoWarning, match=f"the sensor 'mine' .*{words}"):
        Watch(simulation, simulation.rollout(1), sensors={"mine": sensor})
    with pytest.warns(CortadoWarning, match=words):
        cortado.Problem(simulation, 1, Series(sensor, [0.0, dt], series, dt))
    with pytest.warns(CortadoWarning, match=words):
        times, column = dt * np.arange(4), [*sensor.columns(2)][:1]
        observed = cortado.measured.SensorSeries(sensor, times, np.zeros((4, 1)), 2, column)
        cortado.measured.Experiment(simulation, {"mine": observed})


def test_a_sensor_far_from_all_fluid_is_warned_of_without_a_container():
    for sensor, metres in [(PressureProbe([0.2, -2.0]), "2.025"), (FlowRate([0.0, 5.0], [0.0, 1.0]), "4.625")]:
        simulation = cortado.Simulation(plane(container={"shape": "none"}))
        words = f"the sensor 'mine' is {metres} m from the fluid and the solids, which begin from"
        with pytest.warns(CortadoWarning, match=words):
            Watch(simulation, simulation.rollout(1), sensors={"mine": sensor})


def within_plates(dimension, gap):
    """Beside water four plates around a place, one of which ends a gap [m] below the next."""
    plates = {"left": ([0.2, 0.1], [0.25, 0.4]), "right": ([0.45, 0.1], [0.5, 0.35 - gap])}
    plates |= {"floor": ([0.2, 0.1], [0.5, 0.15]), "roof": ([0.2, 0.35], [0.5, 0.4])}
    deep = [0.2] * (dimension - 2)
    solid = [box([*lower, *(0.0 for _ in deep)], [*upper, *deep], name=name) for name, (lower, upper) in plates.items()]
    return pool([0.2, 0.2, *deep], [0.7, 0.6, *deep], viscosity=0.01, solid=solid)


@pytest.mark.parametrize("dimension", [2, 3])
def test_a_sensor_that_solids_shut_off_is_warned_of_but_for_a_gap(dimension, recwarn, monkeypatch):
    """The fluid beside the plates stays on its lattice: packing it takes seconds."""
    monkeypatch.setattr(Packing, "packed", lambda self, particles, stays: (particles, np.arange(len(particles))))
    probes = {"in": PressureProbe([0.35, 0.25, 0.1][:dimension]), "out": PressureProbe([0.6, 0.5, 0.1][:dimension])}
    for gap in (0.05, 0.0):
        assert not [one for one in recwarn if "the sensor" in str(one.message)]
        simulation = cortado.Simulation(within_plates(dimension, gap), precision="float64")
        Watch(simulation, simulation.rollout(1), sensors=probes)
    (found,) = (str(one.message) for one in recwarn if "the sensor" in str(one.message))
    words = "shut off from all fluid by solids: the reading is 0, or what is within its radius"
    assert "'in' is at" in found and words in found


def test_sensors_among_fluid_are_not_warned_of(recwarn):
    own = {"corner": PressureProbe([0.0, 0.0]), "edge": FlowRate([0.69, 5.0], [1.0, 0.0])}
    own["beside"] = WaveGauge([0.49, 0.0])
    beside = cortado.Simulation(plane(solid=[{**BLOCK, "upper": [0.65, 0.5]}]))
    open_air = cortado.Simulation(plane(container={"shape": "none"}))
    near = {"gauge": WaveGauge([0.5, 0.0]), "below": PressureProbe([0.2, -0.3]), "on": FlowRate([0.2, 9.0], [1.0, 0.0])}
    cases = [(beside, {**IN_THE_PLANE, **own}), (cortado.Simulation(scene()), IN_SPACE), (open_air, near)]
    for simulation, sensors in [*cases, *((channel(d)[0], ROUND_THE_EDGE[d]) for d in (2, 3))]:
        Watch(simulation, simulation.rollout(1), sensors=sensors)
    assert not [one for one in recwarn if "the sensor" in str(one.message)]


def test_other_names_of_sensors_come_back_from_the_table(tmp_path):
    for name in ["a, b", 'a "b"', "a [b.c"]:
        read = Readings(np.array([0.0, 1.0]), np.array([[1.0], [2.0]]), {"height": "m"})
        (tmp_path / "sensors.csv").write_text(as_csv({name: read}))
        (found,) = from_csv(tmp_path / "sensors.csv").items()
        assert found[0] == name and found[1]["height"].tolist() == [1.0, 2.0]


def test_sensors_that_need_a_step_share_it(monkeypatch):
    solve, solved = QuantityEvaluator._solve, []
    monkeypatch.setattr(QuantityEvaluator, "_solve", lambda self, *a: solved.append(a) or solve(self, *a))
    sensors = {"probe": PressureProbe([0.2, 0.1]), "walls": WallForce(), "gauge": WaveGauge([0.2, 0.0])}
    simulation, alone = cortado.Simulation(plane()), {}
    for name, sensor in sensors.items():
        alone |= simulation.run(5, sensors={name: sensor}).sensors
    assert len(solved) == 2  # of the last state alone: of all others the run's own steps tell
    solved.clear()
    told: list[int] = []
    together = simulation.run(5, sensors=sensors, observe=told.append).sensors
    assert told == [1, 2, 3, 4, 5]
    assert len(solved) == 1
    for name, one in alone.items():
        assert one.values.tobytes() == together[name].values.tobytes(), name


def test_frames_and_readings_do_not_depend_on_how_long_states_wait(monkeypatch):
    simulation, sensors = cortado.Simulation(plane()), {"gauge": WaveGauge([0.2, 0.0])}
    wanted = simulation.run(21, record_every=2, sensors=sensors, record=["density"])
    singles = [simulation.run(n) for n in (2, 20)]
    monkeypatch.setattr("cortado.runs.recording.MOST", 1)
    found = simulation.run(21, record_every=2, sensors=sensors, record=["density"])
    assert wanted.steps.tolist() == [*range(0, 21, 2), 21]
    for n, single in zip((1, 10), singles, strict=True):
        assert wanted.positions[n].tobytes() == single.positions[-1].tobytes()
    for name in ("positions", "velocities", "times"):
        assert getattr(found, name).tobytes() == getattr(wanted, name).tobytes()
    assert found.quantities["density"].tobytes() == wanted.quantities["density"].tobytes()
    assert found.sensors["gauge"].values.tobytes() == wanted.sensors["gauge"].values.tobytes()


class Reference:
    """A sensor of the mean of a field that no step changes."""

    def columns(self, dimension):
        return {"density": "kg/m3"}

    def value(self, at):
        return np.array([at["reference_density"].mean()])

    def adjoint(self, at, bar):
        return {}


def test_a_later_run_reads_its_own_constants():
    simulation = cortado.Simulation(plane())
    for density in (1000.0, 800.0):
        read = simulation.run(3, {"rest_density": density}, sensors={"own": Reference()}).sensors["own"]
        assert read.values[:, 0] == pytest.approx(np.full(4, density))
