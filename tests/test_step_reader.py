"""Sensors that are read on the device beside what they read of the same states on the host."""

from functools import cache, partial

import numpy as np
import pytest

import cortado
from cortado.device.launching import CapturedGraph
from cortado.errors import CortadoWarning
from cortado.runs.quantity_values import QuantityEvaluator
from cortado.sensors import FlowRate, PressureProbe, SolidLoad, WallForce, WaveGauge
from scenes import jet, plane, scene
from test_free_bodies import RAFT
from test_moving_solids import ROTOR
from test_moving_solids import plane as pond
from test_riding_sensors import MADE, on_a_solid
from test_sensors import IN_SPACE, IN_THE_PLANE, ROUND_THE_EDGE, channel
from test_time_steps import CHOSEN, SOLVERS, drop

pytestmark = pytest.mark.usefixtures("unpacked")
LOADED = {"load": SolidLoad("rotor"), "gauge": WaveGauge([0.5, 0.0]), "walls": WallForce()}
LOADED |= {"flow": FlowRate([0.5, 0.0], [1.0, 0.3])}
RIDDEN = {f"on a {on} in {d}-D": (partial(make, d), on_a_solid(d, on)) for make, on in MADE.values() for d in (2, 3)}
CASES = {
    "plane": (plane, IN_THE_PLANE),
    "projection": (lambda: plane(solver={"kind": "projection", "time_step": 0.002}), IN_THE_PLANE),
    "space": (scene, IN_SPACE),
    "period": (lambda: channel(2)[0].scene, ROUND_THE_EDGE[2]),
    "periods": (lambda: channel(3)[0].scene, ROUND_THE_EDGE[3]),
    "rotor": (lambda: pond(ROTOR), LOADED),
    **RIDDEN,
    "raft": (lambda: pond(RAFT), {"load": SolidLoad("raft"), "gauge": WaveGauge([0.5, 0.0])}),
    "chosen": (lambda: drop({**SOLVERS["projection"], **CHOSEN}), dict(list(IN_THE_PLANE.items())[:-1])),
    "nozzle": (jet, {"gauge": WaveGauge([0.2, 0.0]), "flow": FlowRate([0.0, 0.2], [0.0, -1.0])}),
}
STEPS = 11
"""More than the 8 that are taken together."""


@cache
def simulated(name, precision="float64", batch=None):
    return cortado.Simulation(CASES[name][0](), precision=precision, batch=batch)


class Doubled(PressureProbe):
    """A sensor of one's own that reads something else than what it is made from."""

    def value(self, at):
        return 2.0 * super().value(at)


def test_a_sensor_made_from_another_reads_its_own_values():
    probes = {"one": PressureProbe([0.2, 0.1]), "two": Doubled([0.2, 0.1])}
    read = simulated("plane").run(3, sensors=probes).sensors
    np.testing.assert_allclose(read["two"].values, 2.0 * read["one"].values, rtol=1e-13)


class OnHost:
    """A sensor of one's own that reads what another does."""

    def __init__(self, sensor):
        self.columns, self.value, self.adjoint = sensor.columns, sensor.value, sensor.adjoint


def readings(run):
    return {sensor: own.values for sensor, own in run.sensors.items()}


@pytest.mark.parametrize(
    ("name", "precision"),
    [*((name, "float64") for name in CASES), ("projection", "float32")],
)
def test_readings_are_those_of_the_same_states_on_the_host(name, precision):
    simulation, sensors = simulated(name, precision), CASES[name][1]
    found = simulation.run(STEPS, sensors=sensors)
    wanted = simulation.run(STEPS, sensors={name: OnHost(sensor) for name, sensor in sensors.items()})
    assert found.positions.tobytes() == wanted.positions.tobytes()
    for sensor, own in found.sensors.items():
        host = wanted.sensors[sensor].values
        assert own.times.tobytes() == wanted.times.tobytes() and len(own.values) == STEPS + 1
        np.testing.assert_allclose(own.values, host, rtol=0.0, atol=1e-13 * np.abs(host).max(), err_msg=sensor)
        assert np.ptp(own.values[:, 0]) > 0.0, sensor


@pytest.mark.parametrize("name", ["projection", "rotor", "on a tank in 2-D", "on a raft in 2-D"])
def test_each_scene_of_a_batch_has_the_readings_of_its_own_run(name):
    gravities, sensors = np.array([[[0.0, -9.81]], [[3.0, -5.0]]]), CASES[name][1]
    batch = simulated(name, batch=2).run(STEPS, {"gravity": gravities}, sensors=sensors)
    for gravity, together in zip(gravities, batch, strict=True):
        alone = simulated(name).run(STEPS, {"gravity": gravity[0]}, sensors=sensors)
        for sensor, values in readings(alone).items():
            np.testing.assert_array_equal(together.sensors[sensor].values, values, sensor)


def test_a_batch_reads_the_sensors_of_its_scene_and_until_a_particle_is_lost():
    made = plane(sensor=[{"name": "walls", "kind": "wall_force"}])
    wild = [[[0.0, -9.81]], [[3e5, -9e5]]]
    with pytest.warns(CortadoWarning):
        batch = cortado.Simulation(made, batch=2).run(STEPS, {"gravity": wild})
    assert len(batch[0].sensors["walls"].values) == STEPS + 1
    lost = batch[1].sensors["walls"].values
    assert len(lost) == batch.lost[1].step and np.isnan(lost[-1]).all() and np.isfinite(lost[:-1]).all()


def test_readings_change_no_bit_and_need_no_capture_in_later_runs(monkeypatch):
    simulation, sensors = cortado.Simulation(plane()), {"probe": PressureProbe([0.2, 0.1]), "walls": WallForce()}
    bare, first = simulation.run(STEPS), simulation.run(STEPS, sensors=sensors)
    simulation.run(STEPS, sensors=sensors)
    made, init = [], CapturedGraph.__init__
    monkeypatch.setattr(CapturedGraph, "__init__", lambda *a: made.append(a) or init(*a))
    again = simulation.run(STEPS, sensors=sensors)
    assert not made
    for name, values in readings(first).items():
        assert values.tobytes() == readings(again)[name].tobytes()
    assert bare.positions.tobytes() == first.positions.tobytes() == again.positions.tobytes()


def judged(simulation, sensor, steps=STEPS):
    count = len(sensor.columns(simulation.dimension))
    each = {k: cortado.losses.SensorMatch(sensor, np.full(count, 10.0 * k)) for k in range(steps + 1)}
    return cortado.Problem(simulation, steps, cortado.losses.Frames(each))


PROBE = PressureProbe([0.2, 0.1])
OF_LOSSES = {"projection": PROBE, "plane": PROBE, "rotor": SolidLoad("rotor"), "period": WallForce()}


@pytest.mark.parametrize("batch", [None, 2])
@pytest.mark.parametrize("name", OF_LOSSES)
def test_losses_of_sensors_take_no_step_again_and_have_the_same_bits(name, batch, monkeypatch):
    solve, solved = QuantityEvaluator._solve, []
    monkeypatch.setattr(QuantityEvaluator, "_solve", lambda *given: (solved.append(1), solve(*given))[1])
    made, found = simulated(name, batch=batch), []
    for sensor in (OF_LOSSES[name], OnHost(OF_LOSSES[name])):
        problem, point = judged(made, sensor), {"gravity": made.parameters()["gravity"] + 0.1}
        solved.clear()
        found.append(problem.value(point))
        assert len(solved) == (1 if sensor is OF_LOSSES[name] else STEPS + 1)
        value, gradient = problem.value_and_gradient(point)
        np.testing.assert_array_equal(value, found[-1])
        found.append(gradient["gravity"])
        if batch is None and sensor is PROBE:  # nor on the way back but from the last state, behind which there is none
            assert len(solved) == 3
        along = {"gravity": np.ones_like(point["gravity"])}
        found.append(problem.tangent(point, along))
        slope = gradient["gravity"].reshape(batch or 1, -1).sum(axis=1)
        np.testing.assert_allclose(slope, np.atleast_1d(found[-1]), rtol=1e-10)
    for own, host in zip(found[:3], found[3:], strict=True):
        np.testing.assert_array_equal(own, host)
