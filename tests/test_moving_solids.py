"""Solids that move as they are told: where they are, what they do to fluid, and derivatives beside them."""

import numpy as np
import pytest

import cortado
from cortado import DivergedError, InputError, Scene, SceneError, Simulation, Trajectory
from cortado.discretise.solid import rotation_matrix
from cortado.scene.discrete_scene import discretise
from cortado.scene.scene_warnings import standing_sentences
from scenes import box, jet, pool

WATER = {"name": "water", "rest_density": 1000.0, "viscosity": 1.0}
ROTOR = box([0.2, 0.15], [0.4, 0.25], name="rotor", motion="path", angular_velocity=6.0, velocity=[0.2, 0.1], slip="no")
PADDLE = {
    **{"name": "paddle", "shape": "capsule", "start": [0.2, 0.25, 0.2], "end": [0.2, 0.45, 0.2], "radius": 0.06},
    **{"rotation": [0.3, 0.0, 0.2], "motion": "path", "times": [0.0, 0.05, 0.2]},
    "positions": [[0.2, 0.35, 0.2], [0.22, 0.35, 0.2], [0.2, 0.35, 0.25]],
    "rotations": [[0.0, 0.0, 0.0], [0.0, 0.3, 0.1], [0.4, 0.3, 0.0]],
}


def plane(*solids, **tables):
    own = {"phase": [WATER], "container": box([0.0, 0.0], [1.0, 1.0], slip="no"), "solid": list(solids)}
    return pool([0.6, 0.4], [1.0, 1.0], **{**own, **tables})


def space(**tables):
    fluid, container = box([0.0, 0.0, 0.0], [0.4, 0.3, 0.4], phase="water"), box([0.0, 0.0, 0.0], [0.5, 0.6, 0.4])
    return plane(**{"dimension": 3, "fluid": [fluid], "container": container, "solid": [PADDLE], **tables})


def walls_of(simulation):
    search = simulation.solver.search
    first = np.count_nonzero(simulation.solver.search.walls["wall_weights"].numpy()) - search.moving._own["count"]
    names = ("wall_positions", "wall_feet", "wall_velocities", "wall_weights")
    return [search.walls[name].numpy()[first:] for name in names]


@pytest.mark.parametrize(("scene", "scale"), [(plane(ROTOR), 1.2), (space(), 0.9)], ids=["plane", "space"])
def test_walls_are_where_the_path_says_and_move_as_it_does(scene, scale):
    """Against NumPy: after the last step, as a set; beneath the surface of a solid that is stretched."""
    simulation, table = Simulation(scene, precision="float64"), scene.solid[0]
    steps, dt, d = 30, 0.001, scene.dimension
    run = simulation.run(steps, controls={f"{table.name}.scale": scale})
    motion = run.solids[table.name]
    assert motion.positions.shape == (steps + 1, d) and len(motion.rotations) == steps + 1 and motion.scale == scale
    walls = discretise(scene).walls
    own = walls.solid == 0
    surface, own_feet = (
        vectors[own] @ table.turn(d) for vectors in (walls.positions + walls.feet - table.middle(), walls.feet)
    )

    def placed(k):
        turn = rotation_matrix(tuple(np.atleast_1d(motion.rotations[k])))
        return motion.positions[k] + (scale * surface - own_feet) @ turn.T

    now, before = placed(steps), placed(steps - 1)
    found, feet, velocities = (array[:, :d] for array in walls_of(simulation)[:3])
    order = np.lexsort(np.round(now, 9).T), np.lexsort(np.round(found, 9).T)
    np.testing.assert_allclose(found[order[1]], now[order[0]], atol=1e-12)
    np.testing.assert_allclose(walls_of(simulation)[3][order[1]], walls.weights[own][order[0]] * scale ** (d - 1))
    turns = [rotation_matrix(tuple(np.atleast_1d(motion.rotations[k]))) for k in (steps, steps - 1)]
    feet_before = feet @ turns[0] @ turns[1].T
    moved = (now - before)[order[0]] + (feet - feet_before)[order[1]]  # of the surface
    np.testing.assert_allclose(velocities[order[1]], moved / dt, atol=1e-9)
    solid = table.stretched(scale).solid()
    turn = rotation_matrix(tuple(np.atleast_1d(motion.rotations[steps]))) @ table.turn(d).T
    back = table.middle() + (found + feet - motion.positions[steps]) @ turn
    np.testing.assert_allclose(solid.distance(back), 0.0, atol=1e-9)  # feet turn with it


def test_a_run_goes_on_where_fluid_is_where_a_solid_was_at_the_start():
    block = box([0.5, 0.0], [0.7, 0.3], name="block", motion="path", velocity=[0.0, 2.0])
    scene = plane(block, solver={"kind": "pcisph", "time_step": 0.001})
    simulation = Simulation(scene, precision="float64")
    whole = simulation.run(300)
    assert ((np.abs(whole.positions[250] - [0.6, 0.1]) < [0.07, 0.07]).all(axis=1)).any()
    rest = simulation.run(50, state=whole[:251].last_state)
    assert rest.positions[-1].tobytes() == whole.positions[-1].tobytes()


@pytest.mark.parametrize("kind", ["projection", "pcisph"])
def test_a_piston_pushes_water_before_it(kind):
    piston = box([-0.3, 0.0], [0.0, 1.0], name="piston", motion="path", velocity=[0.4, 0.0])
    scene = plane(piston, solver={"kind": kind, "time_step": 0.001})
    run = Simulation(scene, precision="float64").run(500, record_every=50)
    assert run.solids["piston"].positions[-1, 0] == pytest.approx(-0.15 + 0.2)
    assert run.positions[-1][:, 0].min() == pytest.approx(0.2 + 0.5 * 0.05, abs=0.4 * 0.05)
    assert run.positions[-1].shape == run.positions[0].shape


def sliding_plate(across, thickness, dt):
    """Fluid between a floor and a plate that slides, 1 m apart and so many particles, at 1 m/s, with nu = 1 m^2 / s;
    the plate is so many spacings thick."""
    spacing, width = 1.0 / across, 10.0 / across
    upper = [width, 1.0 + thickness * spacing]
    return plane(
        box([0.0, 1.0], upper, name="plate", motion="path", velocity=[1.0, 0.0], slip="no"),
        discretisation={"spacing": spacing},
        phase=[{**WATER, "viscosity": 1000.0}],
        fluid=[box([0.0, 0.0], [width, 1.0], phase="water")],
        container=box([0, 0], [width, 2], periodic=[True, False], slip="no"),
        forces={"gravity": [0.0, 0.0]},
        solver={"kind": "projection", "time_step": dt},
    )


@pytest.mark.parametrize("across", [20, 40])
def test_a_plate_that_starts_to_slide_draws_fluid_along_as_it_should(across):
    """Couette flow from rest (Morris, Fox and Zhu 1997, their series), in units of L^2 / nu."""
    dt = 0.1 / across**2
    scene = sliding_plate(across, 5.0, dt)
    run = Simulation(scene, precision="float64").run(int(0.2 / dt), record_every=int(0.0225 / dt))
    k = np.arange(1, 400)
    for time, x, v in zip(run.times[1:], run.positions[1:], run.velocities[1:], strict=True):
        y = x[:, 1]
        waves = (-1.0) ** k / k * np.sin(np.outer(y, k) * np.pi) * np.exp(-((k * np.pi) ** 2) * time)
        exact = y + 2.0 / np.pi * waves.sum(axis=1)
        assert np.abs(v[:, 0] - exact).max() < {20: 0.03, 40: 0.01}[across]


def test_a_thin_plate_draws_fluid_along():
    """Its far side lies within the support of the fluid, and must not drive it."""
    run = Simulation(sliding_plate(10, 2.0, 0.001)).run(1000)
    assert np.polyfit(run.positions[-1][:, 1], run.velocities[-1][:, 0], 1)[0] == pytest.approx(1.0, abs=0.06)


def test_a_belt_moves_fluid_and_stays():
    belt = box([-0.2, -0.2], [1.2, 0.0], name="belt", slip="no", surface_velocity=[1.0, 0.0])
    scene = plane(belt, container=box([0, 0], [1, 1]))
    run = Simulation(scene).run(200)
    assert np.ptp(run.solids["belt"].positions, axis=0).max() == 0.0
    near = run.positions[-1][:, 1] < 0.05
    far = run.positions[-1][:, 1] > 0.25
    assert run.velocities[-1][near, 0].mean() > 0.4 > run.velocities[-1][far, 0].mean() + 0.2


RESTING = box([0.2, 0.55], [0.4, 0.75], name="block", motion="path", times=[0.0, 0.3, 0.302])
RESTING |= {"positions": [[0.3, 0.65], [0.3, 0.65], [0.5, 0.65]]}
"""At rest, and then at 100 m/s."""


@pytest.mark.parametrize("kind", ["projection", "pcisph"])
def test_the_fast_part_of_a_path_bounds_the_steps_that_it_is_in(kind, tmp_path):
    tables = {"solver": {"kind": kind, "time_step": "auto"}}
    simulation = Simulation(plane(RESTING, **tables), precision="float64")
    run = simulation.run(time=0.4)
    still = {**RESTING, "positions": [[0.3, 0.65]] * 3}
    resting = Simulation(plane(still, **tables), precision="float64").run(time=0.3)
    before = np.count_nonzero(run.times < 0.3)
    np.testing.assert_array_equal(run.times[:before], resting.times[:before])
    ways = np.diff(np.interp(run.times, RESTING["times"], [0.3, 0.3, 0.5]))
    assert ways.max() == pytest.approx(0.2 * 0.05, rel=1e-4) and np.count_nonzero(ways) == pytest.approx(20, abs=1)
    assert run.solids["block"].positions[-1] == pytest.approx([0.5, 0.65]) and run.times[-1] >= 0.4
    half = before + 8
    run[: half + 1].save(tmp_path / "first.vtkhdf")
    rest = simulation.run(10, state=Trajectory.load(tmp_path / "first.vtkhdf").last_state)
    np.testing.assert_array_equal(rest.positions, run.positions[half : half + 11])
    np.testing.assert_array_equal(rest.times, run.times[half : half + 11])


def test_what_turns_and_a_nozzle_bound_the_steps_that_are_chosen():
    turn = {key: RESTING[key] for key in RESTING if key != "positions"} | {"rotations": [0.0, 0.0, 1.0]}
    simulation = Simulation(plane(turn, solver={"kind": "projection", "time_step": "auto"}), precision="float64")
    run = simulation.run(time=0.4)
    angles = np.interp(run.times, RESTING["times"], [0.0, 0.0, 1.0])
    assert np.diff(angles).max() * np.hypot(0.1, 0.1) == pytest.approx(0.2 * 0.05, rel=1e-4)
    course = {"times": [0.05, 0.051], "values": [[0.3, 0.26], [0.4, 0.26]]}
    shooting = jet(solver={"kind": "pcisph", "time_step": "auto"}, path=course)
    run = Simulation(shooting, precision="float64").run(time=0.06)
    ways = np.diff(np.interp(run.times, course["times"], [0.3, 0.4]))
    assert ways.max() == pytest.approx(0.2 * jet().discretisation.spacing, rel=1e-4)
    assert np.count_nonzero(run.times < 0.05) < 30


def test_scenes_of_a_batch_have_the_steps_of_their_own_paths():
    scene = plane(RESTING, solver={"kind": "projection", "time_step": "auto"})
    one, several = (Simulation(scene, precision="float64", batch=size) for size in (None, 2))
    scales = np.array([1.0, 1.4])
    for scale, run in zip(scales, several.run(80, {"block.scale": scales}), strict=True):
        wanted = one.run(80, {"block.scale": scale})
        np.testing.assert_array_equal(run.times, wanted.times)
        np.testing.assert_array_equal(run.positions, wanted.positions)
    still = one.run(80, {"block.displacement": np.zeros(2)})
    assert still.times[-1] > 0.4 > wanted.times[-1]


@pytest.mark.parametrize("length", [1e-6, 1e-15])
def test_a_path_that_jumps_is_one_step_and_said(length):
    times = [0.0, 0.1, 0.1 + length]
    scene = plane({**RESTING, "times": times}, solver={"kind": "projection", "time_step": "auto"})
    simulation = Simulation(scene, precision="float64")
    with pytest.warns(cortado.CortadoWarning, match=r"'block' goes 0\.2 m in .* at 0\.1 s, which is further than"):
        run = simulation.run(time=0.2)
    assert len(run.times) < 300 and run.times[-1] >= 0.2
    with pytest.warns(cortado.CortadoWarning, match=r"'block' goes 0\.3 m in step 2 of this run, which is further"):
        simulation.run(3, {"block.displacement": [[0.0, 0.0], [0.3, 0.0], [0.3, 0.0]]})


def test_what_a_solid_runs_into_is_lost_and_said(monkeypatch):
    """With walls that weigh nothing; a larger one comes to it sooner, by what it reaches further down."""
    from cortado.discretise import walls

    monkeypatch.setattr(walls, "uneven_changes", lambda sums, wanted: np.full(sums.shape[1], -1.0))
    falling = box([0.2, 0.45], [0.4, 0.65], name="block", motion="path", velocity=[0.0, -1.0])
    simulation, steps = Simulation(plane(falling, fluid=[box([0.0, 0.0], [1.0, 0.4], phase="water")])), []
    for scale in (1.0, 1.4):
        with pytest.raises(DivergedError, match="entered the solid 'block' and was at") as found:
            simulation.run(400, controls={"block.scale": scale})
        steps.append(found.value.step)
    assert steps[0] - steps[1] == pytest.approx(40, abs=4)


NO_SPEEDS = {"velocity": None, "angular_velocity": None}


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"motion": "fixed"}, 'left out, as motion is "fixed"'),
        (NO_SPEEDS, "given, or times with positions"),
        ({"angular_velocity": [0.0, 0.0, 1.0]}, "one number in 2-D"),
        ({**NO_SPEEDS, "times": [0.1, 1.0]}, "given, or rotations, as there are times"),
        ({**NO_SPEEDS, "times": [0.1, 1.0], "rotations": [0.0, 0.5]}, "from 0 on"),
        ({**NO_SPEEDS, "times": [0.0, 1.0], "positions": [[0.0, 0.0], [1.0, 0.0]]}, "where its middle is at the start"),
        ({**NO_SPEEDS, "times": [0.0, 1.0], "rotations": [0.0]}, "a list of 2, as are times"),
    ],
)
def test_a_bad_path_is_a_sentence(changes, sentence):
    with pytest.raises(SceneError) as error:
        plane({name: value for name, value in {**ROTOR, **changes}.items() if value is not None})
    assert sentence in str(error.value) and "solid[0]" in str(error.value)


def test_a_path_is_written_and_read_and_a_solid_that_no_run_moved_is_a_sentence():
    assert Scene.from_json(space().to_json()) == space()
    run = Simulation(plane(ROTOR)).run(1)
    with pytest.raises(InputError, match="solids has no 'paddle', as the run has the moving solids rotor"):
        run.solids["paddle"]
    assert run[-1:].solids["rotor"].positions.shape == (1, 2)
    assert "paddle" not in run.solids


@pytest.mark.parametrize(
    ("lower", "motion", "told"),
    [
        (-0.02, {"velocity": [0.1, 0.0]}, ["y = 0 m"]),
        (-0.06, {"velocity": [0.1, 0.0]}, []),
        (0.0, {"velocity": [0.0, 0.1]}, []),
        (0.0, {"times": [0.0, 1.0], "positions": [[0.3, 0.25], [0.5, 0.25]]}, ["y = 0 m"]),
        (0.0, {"velocity": [0.1, 0.0], "angular_velocity": 0.1}, []),
    ],
    ids=["too little", "through the floor", "gate", "on a path", "turns"],
)
def test_a_solid_that_moves_along_a_wall_and_ends_on_it_is_told(lower, motion, told):
    piston = box([0.2, lower], [0.4, 0.5 - lower], name="piston", motion="path", **motion)
    beside, solver = box([0.4, 0.0], [1.0, 0.4], phase="water"), {"kind": "projection", "time_step": 0.002}
    scene = pool([1.0, 0.4], [1.0, 1.0], fluid=[beside], solid=[piston], solver=solver)
    found = list(standing_sentences(scene))
    assert len(found) == len(told) and all(place in sentence for place, sentence in zip(told, found, strict=True))
