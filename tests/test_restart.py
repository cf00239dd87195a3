"""A run that goes on from the last state of another one has the bits of a run that did not stop."""

from dataclasses import replace

import numpy as np
import pytest

from cortado import InputError, Scene, Simulation, Trajectory
from cortado.scene.restart import Clock
from scenes import jet, plane, plane_of_three, pour, two_layers

FIRST, REST = 17, 24
MAKERS = {"plane": plane, "two layers": two_layers, "plane of three": plane_of_three, "jet": jet, "pour": pour}


def controls_of(simulation):
    """Gravity, and a nozzle's path where there is one, that change in every step."""
    steps, d = FIRST + REST, simulation.dimension
    sway = 0.01 * np.sin(0.3 * np.arange(steps))[:, None] * np.eye(d)[0]
    controls = {"gravity": np.array(simulation.scene.forces.gravity) + 100.0 * sway}
    if simulation.scene.emitter is not None:
        controls["nozzle_path"] = np.array(simulation.scene.emitter.outlet) + sway
    return controls


@pytest.mark.parametrize("precision", ["float32", "float64"])
@pytest.mark.parametrize("name", MAKERS)
def test_a_restart_has_the_bits_of_a_run_that_did_not_stop(name, precision, tmp_path):
    simulation = Simulation(MAKERS[name](), precision=precision)
    controls = controls_of(simulation)
    whole = simulation.run(FIRST + REST, controls)
    first = simulation.run(FIRST, {key: table[:FIRST] for key, table in controls.items()}, record_every=5)
    first.save(tmp_path / "first.vtkhdf")
    later = {key: table[FIRST:] for key, table in controls.items()}
    for state in (first.last_state, Trajectory.load(tmp_path / "first.vtkhdf").last_state):
        rest = simulation.run(REST, later, state=state)
        assert rest.steps.tolist() == list(range(FIRST, FIRST + REST + 1))
        assert rest.times.tobytes() == whole.times[FIRST:].tobytes()
        assert rest.others.keys() == whole.others.keys()
        for field, found in rest.others.items():
            assert found.tobytes() == whole.others[field][FIRST:].tobytes(), field
        for field in ("positions", "velocities", "mass_fractions"):
            found, wanted = getattr(rest, field), getattr(whole, field)
            assert (found is None) == (wanted is None)
            assert found is None or found.tobytes() == wanted[FIRST:].tobytes(), field
        assert rest.density_errors.tobytes() == whole.density_errors[FIRST:].tobytes()
        again = simulation.run(FIRST, {key: table[:FIRST] for key, table in controls.items()})
        assert again.positions.tobytes() == whole.positions[: FIRST + 1].tobytes()  # nothing of the restart stays


FRACTIONS = "state mass_fractions of particle 0 are"


def test_states_that_do_not_fit_are_refused():
    simulation = Simulation(pour(), precision="float64")
    state = simulation.run(3).last_state

    def other(**fields):
        return replace(state, fields={**state.fields, **fields})

    emitterless = Simulation(two_layers()).run(1).last_state
    for arguments, what in [
        ({"state": other(positions=state["positions"][:-1])}, "state positions has shape"),
        (
            {"state": other(positions=state["positions"] + [0.0, 0.0, 5.0])},
            "state positions has particle 0 at .* m, outside the container of this scene",
        ),
        (
            {"state": other(reference_density=np.zeros(simulation.particles))},
            "state reference_density must be greater than 0",
        ),
        ({"state": other(mass_fractions=np.full((simulation.particles, 2), [2.0, -1.0]))}, FRACTIONS + " 2, -1"),
        ({"state": other(mass_fractions=np.full((simulation.particles, 2), [0.9, 0.2]))}, FRACTIONS + " 0.9, 0.2"),
        ({"state": other(emitted=np.array([np.nan]))}, "state emitted has a value that is not finite"),
        ({"state": emitterless}, "state has positions, .*, but must have positions, .*, outlet, emitted in this scene"),
        ({"state": simulation.initial}, "must be a RestartState"),
        ({"state": state, "controls": {"initial_velocities": state["velocities"]}}, "must be left out with a state"),
    ]:
        with pytest.raises(InputError, match=what):
            simulation.run(3, **arguments)


def test_an_emitter_goes_on_with_another_flow():
    """What has left the nozzle is part of the state: particles that are still prescribed do not jump."""
    simulation = Simulation(jet(), precision="float64")
    given = simulation.parameters()
    first = simulation.run(4)
    faster = {"flow_rate": 1.5 * given["flow_rate"], "time_step": 0.5 * given["time_step"]}
    later = simulation.run(1, faster, state=first.last_state)
    waiting = slice(simulation.particles - 3, None)
    moved = later.positions[1, waiting] - first.positions[-1, waiting]
    speed = np.linalg.norm(first.velocities[-1, waiting], axis=1)
    np.testing.assert_allclose(np.linalg.norm(moved, axis=1), 1.5 * 0.5 * given["time_step"] * speed, rtol=1e-9)
    assert later.times[-1] == pytest.approx(4.5 * given["time_step"])


def test_a_run_goes_on_from_a_frame_on_the_way():
    """Also where a nozzle is moved, whose outlets are kept frame by frame."""
    simulation = Simulation(jet())
    path = simulation.parameters()["nozzle_path"] + np.linspace(0.0, 0.02, 6)[:, None]
    whole = simulation.run(6, {"nozzle_path": path})
    again = simulation.run(3, {"nozzle_path": path[3:]}, state=whole[:4].last_state)
    np.testing.assert_array_equal(again.positions, whole[3:].positions)
    with pytest.raises(InputError, match=r"^The trajectory has no frame"):
        _ = whole[7:].last_state


# ---- what a state belongs to -------------------------------------------------------------------------------------


def spread_out(factor):
    """A plane of as many particles, with a spacing so many times as large."""
    scene = plane()
    box = scene.fluid[0].model_copy(update={"upper": tuple(factor * x for x in scene.fluid[0].upper)})
    wall = scene.container.model_copy(update={"upper": tuple(3.0 * x for x in scene.container.upper)})
    cut = {"spacing": factor * scene.discretisation.spacing}
    return Scene(
        **{
            **scene.model_dump(exclude_none=True),
            "fluid": [box.model_dump()],
            "container": wall.model_dump(exclude_none=True),
            "discretisation": {**scene.discretisation.model_dump(), **cut},
        }
    )


def refused(simulation, state, controls=None):
    with pytest.raises(InputError) as caught:
        simulation.run(2, controls, state=state)
    sentence = str(caught.value)
    assert sentence.startswith("state ") and sentence.endswith(".") and "\n" not in sentence
    return sentence


@pytest.mark.filterwarnings("ignore::cortado.CortadoWarning")
@pytest.mark.parametrize("factor", [0.5, 1.6])
@pytest.mark.parametrize("known", [True, False])
def test_a_state_of_another_spacing_is_refused(factor, known):
    """Also where it does not say what it is of."""
    simulation, other = Simulation(plane()), Simulation(spread_out(factor))
    assert simulation.particles == other.particles
    state = other.run(2).last_state
    sentence = refused(simulation, state if known else replace(state, origin=None))
    assert ("spacing of" if known else "another spacing") in sentence


@pytest.mark.parametrize(
    ("override", "words"),
    [
        (
            "phase.0.rest_density=900",
            "a rest density of 900 kg/m3, but must be of one with a rest density of 1000 kg/m3",
        ),
        ('discretisation.kernel="wendland_c2"', "the kernel wendland_c2"),
        ("discretisation.support=2.5", "a support of 2.5 spacings"),
        ("container.periodic=[true,false]", "periods of"),
    ],
)
def test_a_state_of_other_particles_is_refused(override, words, tmp_path):
    scene = plane()
    trajectory = Simulation(scene.replaced(override)).run(2)
    trajectory.save(tmp_path / "other.vtkhdf")
    for state in (trajectory.last_state, Trajectory.load(tmp_path / "other.vtkhdf").last_state):
        assert words in refused(Simulation(scene), state)


@pytest.mark.parametrize("known", [True, False])
@pytest.mark.parametrize("make", [plane, two_layers, plane_of_three, pour])
@pytest.mark.parametrize("factor", [0.5, 0.9, 1.2])
def test_reference_densities_of_other_fluid_are_refused(make, factor, known):
    simulation = Simulation(make())
    state = simulation.run(2).last_state
    wrong = replace(state, fields={**state.fields, "reference_density": factor * state["reference_density"]})
    sentence = refused(simulation, wrong if known else replace(wrong, origin=None))
    assert "reference_density" in sentence


@pytest.mark.parametrize("make", [plane, two_layers])
def test_a_run_with_a_rest_density_goes_on_with_it_and_not_without(make):
    simulation = Simulation(make(), precision="float64")
    controls = {"rest_density": 0.9 * simulation.parameters()["rest_density"]}
    whole = simulation.run(12, controls)
    state = simulation.run(5, controls).last_state
    rest = simulation.run(7, controls, state=state)
    assert rest.positions.tobytes() == whole.positions[5:].tobytes()
    assert "to be given again where it goes on" in refused(simulation, state)
    refused(simulation, replace(state, origin=None))
    refused(simulation, simulation.run(5).last_state, controls)


def test_fractions_of_2_are_no_reference_densities():
    simulation = Simulation(plane())
    state = simulation.run(2).last_state
    state["mass_fractions"][5] = 2.0
    found = refused(simulation, state)
    assert found == "state mass_fractions of particle 5 are 2, but must be from 0 to 1 and add up to 1."


def test_two_particles_of_a_state_at_one_place_are_refused():
    simulation = Simulation(plane())
    state = simulation.run(2).last_state
    state["positions"][7] = state["positions"][3]
    assert "particles 3 and 7 at one place" in refused(simulation, state)


@pytest.mark.parametrize(
    ("clock", "words"),
    [
        (Clock(3, np.nan), "finite time of at least 0 s"),
        (Clock(3, np.inf), "finite time of at least 0 s"),
        (Clock(3, -5.0), "is at -5.0 s"),
        (Clock(-1, 0.0), "has -1 steps"),
        (Clock(2.5, 0.0), "has 2.5 steps"),
        (0.1, "must be a Clock"),
    ],
)
def test_a_clock_that_cannot_be_is_refused(clock, words):
    simulation = Simulation(plane())
    state = replace(simulation.run(2).last_state, clock=clock)
    sentence = refused(simulation, state)
    assert sentence.startswith("state clock") and words in sentence


def test_a_state_is_of_its_own():
    trajectory = Simulation(plane()).run(2)
    state, before = trajectory.last_state, trajectory.positions.copy()
    state["positions"][:] = 0.0
    state["reference_density"][:] = 0.0
    np.testing.assert_array_equal(trajectory.positions, before)
    assert trajectory.constants["reference_density"].all()
    state = trajectory.last_state
    trajectory.positions[:] = 0.0
    np.testing.assert_array_equal(state["positions"], before[-1])


@pytest.mark.filterwarnings("ignore::cortado.CortadoWarning")
def test_a_state_goes_on_with_other_forces_time_steps_and_precisions():
    state = Simulation(plane()).run(4).last_state
    for simulation, controls in [
        (Simulation(plane(), precision="float64"), {}),
        (Simulation(plane().replaced("forces.gravity=[1,-5]", "phase.0.viscosity=0.3")), {}),
        (Simulation(plane().replaced("solver.time_step=0.0005")), {"gravity": [0.0, 2.0]}),
        (Simulation(plane().replaced("container.upper=[3,3]")), {"time_step": 0.0003}),
    ]:
        assert simulation.run(2, controls, state=state).steps.tolist() == [4, 5, 6]


def test_a_file_without_an_origin_can_still_be_read(tmp_path):
    """As earlier versions wrote it: such a state is judged by its densities and distances alone."""
    simulation = Simulation(plane())
    first = simulation.run(4)
    replace(first, origin=None).save(tmp_path / "old.vtkhdf")
    loaded = Trajectory.load(tmp_path / "old.vtkhdf")
    assert loaded.origin is None and loaded.last_state.origin is None
    found = simulation.run(3, state=loaded.last_state)
    assert found.positions.tobytes() == simulation.run(7).positions[4:].tobytes()
    first.save(tmp_path / "new.vtkhdf")
    assert Trajectory.load(tmp_path / "new.vtkhdf").origin == first.origin == first[1:3].origin
    assert first.origin.spacing == plane().discretisation.spacing
