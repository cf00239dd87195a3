"""Drains: what they take is out of everybody's reach and counted to a particle, and sinks take their flow rate; for
their derivatives, batches and runs that go on see tests/test_features.py."""

import numpy as np
import pytest

from cortado import SceneError, Simulation
from cortado.cli.run_report import Balance
from cortado.pictures.film import is_out, shown_places
from cortado.scene.drain_tables import open_sphere
from cortado.scene.emitter_table import samples, waits
from scenes import box, jet, plane, pool, scene

SPACING = 0.025
HOLE = {"shape": "sink", "name": "hole"}
OVER = {"shape": "box", "name": "over", "lower": [0.3, 0.36]}
SOLVER = {"kind": "projection", "time_step": 0.002}


def emptied(d, made=None, **keys):
    """A block of fluid beside a wall, or another scene, with a sink off the floor and a box above."""
    sink = {**HOLE, "position": [0.22, 0.02, 0.13][:d], "radius": 0.05, "flow_rate": [0.05, 0.01][d - 2]}
    over = {**OVER, "lower": [*OVER["lower"], 0.0][:d]}
    return (made or (plane if d == 2 else scene))(drain=[sink, over], solver=SOLVER, **keys)


def recirculating(**keys):
    """A jet into a pool, and beside it a slot out of which comes again what a box took of the pool."""
    slot = {"name": "slot", "phase": "water", "outlet": [0.15, 0.5], "sides": [0.1], "length": 0.1, "fed_by": ["lid"]}
    slot |= {"times": [0.0, 0.1], "flow_rates": [0.7, 0.6]}
    lid = {"shape": "box", "name": "lid", "lower": [0.4, 0.12]}
    return jet(**{"emitter": [*jet().emitter, slot], "drain": [lid], "solver": SOLVER, **keys})


def tank(depth=0.5, **keys):
    """A tank of one metre in the plane, with water up to a depth."""
    return pool([1.0, depth], [1.0, depth + 0.5], SPACING, **keys)


@pytest.mark.parametrize("precision", ["float32", "float64"])
@pytest.mark.parametrize("kind", ["projection", "pcisph"])
def test_what_a_box_took_is_out_of_reach_and_what_is_left_goes_on_as_if_it_were_not_there(kind, precision):
    """Of two blocks that fall beside one another, far apart, a box takes one, layer after layer. In the length of a
    coarse correction of the projection every particle of a scene has a share, of (1e-6 spacings / dt)^2."""
    solver = {"kind": kind, "time_step": 0.002}
    solver |= {"minimum_iterations": 4, "maximum_iterations": 4} if kind == "pcisph" else {}
    blocks = [box([x, 0.3], [x + 0.2, 0.5], phase="water") for x in (0.0, 0.8)]
    room = box([0.0, 0.0], [1.0, 1.0])
    both = plane(fluid=blocks, container=room, drain=[box([0.6, 0.0], [1.0, 0.2], name="right")], solver=solver)
    alone = plane(fluid=blocks[:1], container=room, solver=solver)
    run, other = (Simulation(one, precision=precision).run(150, record_every=10) for one in (both, alone))
    drained, left = run.others["drained"], len(other.positions[0])
    assert (np.diff((drained > 0).sum(axis=1)) >= 0).all() and (drained[-1, left:] == 1).all()
    assert (drained[:, :left] == 0).all() and 0 < (drained > 0).sum(axis=1)[9] < len(drained[0]) - left
    tolerance = (1e-12 if kind == "pcisph" else 1e-6) if precision == "float64" else 1e-4
    np.testing.assert_allclose(run.positions[:12, :left], other.positions[:12], rtol=0, atol=tolerance)  # it grows
    taken = run.positions[-1, left:]
    assert (run.velocities[-1, left:] == 0.0).all() and (np.abs(taken - 0.5) > 1.0).any(axis=1).all()
    assert np.array_equal(is_out(both, run[-1].others, len(drained[0])), drained[-1] == 0)
    np.testing.assert_allclose(shown_places(both, run)[-1, left:], np.tile([0.8, 0.1], (len(taken), 1)))
    apart = np.linalg.norm(taken[:, None] - taken, axis=-1) + 9.0 * np.eye(len(taken))
    assert apart.min() > 1.5 * both.discretisation.support_radius


def test_a_plane_takes_what_is_beyond_it_and_waiting_particles_are_left_alone():
    """The column of the jet reaches above the plane; what has come out of it and splashes up does not."""
    level = {"shape": "plane", "name": "level", "position": [0.0, 0.4], "direction": [0.0, 1.0]}
    poured = jet(drain=[level], solver=SOLVER)
    simulation = Simulation(poured)
    run = simulation.run(60)
    assert simulation.positions[:, 1].max() > 0.5 and (run.others["drained"] == 0).all()
    low = {**level, "position": [0.0, 0.12]}
    run = Simulation(jet(drain=[low], solver=SOLVER)).run(3)
    before = run.positions[0, : simulation.free_particles, 1]
    assert np.array_equal(run.others["drained"][1][: len(before)] == 1, before > 0.12)


@pytest.mark.parametrize("d", [2, 3])
def test_without_pressure_fluid_flows_to_a_sink_by_its_formula(d):
    """From the velocity that it has, with phi from 0 at r_2 to 1 at r_1; a step of NumPy beside one on the device."""
    forces = {"gravity": [0.0] * d, "viscosity": "none", "pressure": False}
    simulation = Simulation(emptied(d, forces=forces), precision="float64")
    sink, x = simulation.scene.drain[0], simulation.positions
    v = 0.1 * np.sin(9.0 * x)
    run = simulation.run(1, {"initial_velocities": v})
    y = x - sink.position
    r, r_1 = np.linalg.norm(y, axis=1, keepdims=True), 0.05 + 3.0 * 0.05
    t = np.clip((r_1 + 3.0 * 0.05 - r) / (3.0 * 0.05), 0.0, 1.0)
    phi = t**3 * (10.0 - 15.0 * t + 6.0 * t**2)
    sphere = open_sphere(simulation.scene.resting_room, np.array(sink.position), r_1)
    wanted = (1.0 - phi) * v - phi * sink.flow_rate * y / (sphere * r**d)
    left = run.others["drained"][1] == 0
    assert (phi[left] == 1.0).sum() > 5 and ((phi > 0.0) & (phi < 1.0)).sum() > 5 and (~left).any()
    np.testing.assert_allclose(run.velocities[1][left], wanted[left], rtol=0, atol=1e-12)
    np.testing.assert_allclose(run.positions[1][left], (x + 0.002 * wanted)[left], rtol=0, atol=1e-12)


@pytest.mark.parametrize("depth", [0.5, 1.5])
def test_a_sink_takes_its_flow_rate(depth):
    """Within a few particles, also of those that it begins with; pressure does not drive fluid through it."""
    sink = {**HOLE, "position": [0.5, 0.0], "flow_rate": 0.05}
    run = Simulation(tank(depth, drain=[sink])).run(1000, record_every=100)
    out = (run.others["drained"] > 0).sum(axis=1)
    assert np.abs(out - 0.05 * run.times / SPACING**2)[5:].max() < 10.0
    away = np.linalg.norm(run.positions - [0.5, 0.0], axis=-1) > 8.5 * SPACING
    assert np.linalg.norm(run.velocities, axis=-1)[away].max() < 0.5


def test_a_level_stays_where_it_is_with_a_tap_and_a_drain():
    """For ten seconds, in which more comes and goes than the tank holds, within a particle."""
    tap = {"phase": "water", "outlet": [0.2, 0.55], "radius": 0.05, "flow_rate": 0.05}
    sink = {**HOLE, "position": [0.8, 0.0], "flow_rate": 0.05}
    filled = tank(0.4, emitter=[tap], drain=[sink])
    simulation = Simulation(filled.lasting(10.0))
    run = simulation.run(10_000, record_every=500)
    for frame in run:
        balance = Balance.of(simulation.scene, run[0].others, frame.others)
        assert balance.last == balance.first + balance.came - balance.went["hole"]
        assert abs(balance.last - balance.first) * SPACING**2 < 0.5 * SPACING
    assert balance.came == pytest.approx(800, abs=1) and balance.went["hole"] == pytest.approx(800, abs=8)


def test_a_flow_rate_over_time_opens_and_shuts_a_sink():
    course = {"times": [0.0, 0.3, 0.301, 1.0], "flow_rates": [0.1, 0.1, 0.0, 0.0]}
    run = Simulation(tank(drain=[{**HOLE, "position": [0.5, 0.0], **course}])).run(600, record_every=50)
    out = (run.others["drained"] > 0).sum(axis=1)
    assert out[6] - out[1] > 30 and out[-1] - out[7] <= 2
    top = np.sort(run.positions[-1][run.others["drained"][-1] == 0][:, 1])[-40:]
    assert top.mean() == pytest.approx(0.5 - 0.5 * SPACING - out[-1] * SPACING**2, abs=SPACING)


def test_a_flow_rate_may_be_in_a_file(tmp_path):
    file = tmp_path / "valve.csv"
    file.write_text("time [s],flow_rate [m2/s]\n0,0.1\n0.5,0.0\n")
    sink = {**HOLE, "position": [0.5, 0.0]}
    listed = tank(drain=[{**sink, "times": [0.0, 0.5], "flow_rates": [0.1, 0.0]}])
    read = tank(drain=[{**sink, "file": str(file)}])
    assert read.computed_json() == listed.computed_json()
    file.write_text("time [s],flow_rate [l/s]\n0,0.1\n0.5,0.0\n")
    for wrong in ({"file": str(file)}, {"file": str(tmp_path / "gone.csv")}, {"file": str(file), "flow_rate": 0.1}):
        with pytest.raises(SceneError, match="file"):
            tank(drain=[{**sink, **wrong}])


def test_the_balance_is_right_to_a_particle():
    hole = {**HOLE, "position": [0.3, 0.0], "flow_rate": 0.3, "radius": 0.06}
    lid = {"shape": "box", "name": "lid", "lower": [0.0, 0.35]}
    poured = jet(drain=[hole, lid], solver=SOLVER)
    simulation = Simulation(poured.lasting(steps=100))
    run = simulation.run(100)
    balance = Balance.of(simulation.scene, run[0].others, run[-1].others)
    assert balance.first + balance.came - sum(balance.went.values()) == balance.last
    assert balance.first == simulation.free_particles and balance.came > 20 and balance.went["hole"] > 20


def test_what_drains_took_comes_out_again_in_line_behind_the_layers_before():
    """As much as is there; none is lost, and none is in two places."""
    simulation = Simulation(recirculating().lasting(0.12), precision="float64")
    made, count, run = simulation.scene, simulation.particles, simulation.run(60)
    slot, (name, first, sample) = made.emitter[1], samples(made, count)[1]
    flown = [slot.passed(time) / slot.area(made.discretisation.spacing) for time in run.times]
    np.testing.assert_allclose(run.others["slot.emitted"][:, 0], flown, rtol=0.01)
    serials = set()
    for frame in run:
        others, balance = frame.others, Balance.of(made, run[0].others, frame.others)
        taken, waiting = others["drained"] > 0, waits(made, others, count)
        assert balance.last + (taken | waiting).sum() == count
        led = waiting & ~taken & (others["slot.again"] > 0)
        line = sample.in_line(name, first, others, count)[led, None] - others["slot.emitted"]
        numbers = others["slot.again"][led].astype(int)
        place = slot.outlet + sample.offsets[(numbers - 1) % len(sample.offsets)] + line * [0.0, 1.0]
        np.testing.assert_allclose(frame.positions[led], place, rtol=0, atol=1e-12)
        serials |= set(numbers.tolist())
    assert min(serials) == len(sample.upstream) + 1 and len(serials) > 12 and balance.went["lid"] > 12


@pytest.mark.parametrize(
    ("emitters", "key", "words"),
    [
        ([{"fed_by": ["lid"]}, {"name": "b", "fed_by": ["lid"]}], "emitter[1].fed_by", "feed no other emitter"),
        ([{"fed_by": ["ld"]}], "emitter[0].fed_by", "of ['lid']"),
        ([{}, {}], "emitter[1].name", "another name"),
        ([{"radius": None}], "emitter[0].radius", "or sides in its place"),
        ([{"sides": [0.1]}], "emitter[0].radius", "left out, as there are sides"),
        ([{"radius": None, "sides": [0.1, 0.1]}], "emitter[0].sides", "a list of 1"),
        ([{"flow_rates": [0.1, 0.1]}], "emitter[0].times", "missing"),
    ],
)
def test_a_wrong_emitter_is_told_in_a_sentence(emitters, key, words):
    tap = {"phase": "water", "outlet": [0.2, 0.8], "radius": 0.05, "flow_rate": 0.05}
    made = [{**{k: v for k, v in tap.items() if k not in one or one[k] is not None}, **one} for one in emitters]
    lid = {"shape": "box", "name": "lid", "lower": [0.5, 0.6]}
    with pytest.raises(SceneError) as error:
        tank(emitter=[{k: v for k, v in one.items() if v is not None} for one in made], drain=[lid])
    assert str(error.value).startswith(key) and words in str(error.value)


def test_a_jet_out_of_a_slot_contracts():
    """By 0.611 = pi / (pi + 2), with the speed of a fall to where it is narrowest, half the slot's width below it. The
    slot is in the floor, beside a wall in place of its plane of symmetry."""
    spacing, half, across, depth = 0.01, 0.06, 0.5, 0.6
    tables = {
        "solid": [box([half, -0.05], [across + 0.05, 0.0], name="floor")],
        "solver": {**SOLVER, "time_step": 6.5e-4},
    }
    tables["drain"] = [{"shape": "box", "name": "below", "upper": [across, -0.2]}]
    tables["container"] = box([0.0, -0.4], [across, depth + 0.2])
    full = pool([across, depth], [across, depth + 0.2], spacing, **tables)
    run = Simulation(full).run(900, record_every=150)
    above = ((run.others["drained"] == 0) & (run.positions[..., 1] > 0.0)).sum(axis=1) * spacing**2
    flow = (above[2] - above[-1]) / (run.times[-1] - run.times[2])
    level = 0.5 * (above[2] + above[-1]) / across
    assert flow / (half * np.sqrt(2.0 * 9.81 * (level + half))) == pytest.approx(np.pi / (np.pi + 2.0), rel=0.05)


def test_walls_around_a_sink_are_taken_out_of_its_sphere():
    room = tank().resting_room
    for place, part in (([0.5, 0.25], 1.0), ([0.5, 0.0], 0.5), ([0.0, 0.0], 0.25)):
        assert open_sphere(room, np.array(place), 0.1) == pytest.approx(2.0 * np.pi * part, rel=3e-3)
    space = scene().resting_room
    assert open_sphere(space, np.zeros(3), 0.1) == pytest.approx(0.5 * np.pi, rel=1e-2)
    above = plane(solid=[box([-1.0, -0.06], [1.0, 0.0], name="floor")], container={"shape": "none"}).resting_room
    assert open_sphere(above, np.array([0.5, 0.0]), 0.1) == pytest.approx(np.pi, rel=3e-2), "not what is below a floor"


WRONG = [
    ([{**HOLE, "position": [2.0, 0.0], "flow_rate": 0.1}], "drain[0].position", "in the container"),
    ([{**HOLE, "position": [0.5, 0.0]}], "drain[0].flow_rate", "missing"),
    ([{**HOLE, "position": [0.5, 0.0], "times": [0.0, 1.0]}], "drain[0].flow_rates", "missing"),
    ([{**HOLE, "position": [0.5, 0.0], "times": [0.5, 1.0], "flow_rates": [0.1, 0.1]}], "drain[0].times", "from 0 on"),
    ([{**HOLE, "position": [0.5, 0.0], "flow_rate": 0.1, "radius": 0.001}], "drain[0].radius", "one spacing"),
    ([{"shape": "box", "name": "a", "lower": [0.0, 0.0, 0.0], "upper": [1.0, 1.0]}], "drain[0].lower", "2 components"),
    ([{"shape": "box", "name": "a"}, {"shape": "box", "name": "a"}], "drain[1].name", "another name"),
    ([{"shape": "plane", "name": "a", "position": [0.0, 2.0], "direction": [0.0, 1.0]}], "drain[0].position", "part"),
]


def test_a_drain_or_a_column_in_a_solid_is_told_in_a_sentence():
    block, room = box([0.3, 0.5], [0.7, 0.9], name="block"), box([0.4, 0.6], [0.6, 0.8], name="over")
    tank(solid=[block], drain=[{**room, "upper": [0.6, 0.95]}])
    with pytest.raises(SceneError, match=r"drain\[0\] is all of it in solids, but must be where a part of it is out"):
        tank(solid=[block], drain=[room])
    tap = {"phase": "water", "outlet": [0.2, 0.7], "radius": 0.05, "flow_rate": 0.05, "direction": [-1.0, 0.0]}
    tank(solid=[block], emitter=[{**tap, "length": 0.05}])
    with pytest.raises(SceneError, match="projection"):
        tank(drain=[{**HOLE, "position": [0.5, 0.0], "flow_rate": 0.1}], solver={"kind": "pcisph", "time_step": 1e-3})
    with pytest.raises(SceneError, match=r"emitter\[0\] is partly in a solid, for example at"):
        tank(solid=[block], emitter=[tap])


@pytest.mark.parametrize(("drains", "key", "words"), WRONG)
def test_a_wrong_drain_is_told_in_a_sentence(drains, key, words):
    with pytest.raises(SceneError) as error:
        tank(drain=drains)
    assert str(error.value).startswith(key) and words in str(error.value)
