"""A run that goes on from the last state of another one has the bits of a run that did not stop."""

from dataclasses import replace

import numpy as np
import pytest

from cortado import InputError, Simulation, Trajectory
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
        ({"state": other(emitted=np.array([np.nan]))}, "state emitted has a value that is not finite"),
        ({"state": emitterless}, "state has positions, .*, but must have positions, .*, outlet, emitted in this scene"),
        ({"state": simulation.state}, "must be a RestartState"),
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
