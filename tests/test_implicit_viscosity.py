"""Viscosity at the end of a step: when it is chosen, what it does, and its derivatives."""

import numpy as np
import pytest

from cortado import CortadoWarning, Problem, Simulation, losses
from cortado.scene.stability import is_implicit, stability_limits, viscous_limit
from cortado.sph.viscous_stress import ImplicitViscousStress
from scenes import HONEY, box, plane, scene

STEPS = 6
FLUID = box([0.0, 0.0], [0.3, 0.4], velocity=[0.5, 0.2], phase="honey")
ROOM = box([0.0, 0.0], [0.6, 0.6], slip="no")
SOLVER = {"kind": "pcisph", "time_step": 0.002, "minimum_iterations": 3, "maximum_iterations": 3}


def thick(solve="implicit", time_step=0.002, viscosity=20.0, **changes):
    solver = {**SOLVER, "time_step": time_step}
    forces = {"gravity": [0.3, -9.81], "viscosity": "stress", "viscous_solve": solve}
    phase = {**HONEY, "rest_density": 1000.0, "viscosity": viscosity}
    tables = {"phase": [phase], "fluid": [FLUID], "container": ROOM, "solver": solver, "forces": forces}
    return plane(**{**tables, **changes})


def cube(**changes):
    return scene(
        phase=[{**HONEY, "viscosity": 30.0}],
        fluid=[box([0.0, 0.0, 0.0], [0.2, 0.2, 0.2], phase="honey")],
        container=box([0.0, 0.0, 0.0], [0.4, 0.4, 0.2]),
        forces={"gravity": [0.3, -9.81, 0.1], "viscosity": "stress", "viscous_solve": "implicit"},
        solver=SOLVER,
        **changes,
    )


def syrups():
    """Two phases, one of them a thousand times as thick."""
    phases = [{**HONEY, "viscosity": 50.0}, {**HONEY, "name": "water", "viscosity": 0.05}]
    bodies = [{**FLUID, "upper": [0.3, 0.2]}, {**FLUID, "lower": [0.0, 0.2], "phase": "water"}]
    return thick(phase=phases, fluid=bodies)


def problem(made, **options):
    simulation = Simulation(made, precision="float64", **options)
    target = simulation.positions + 0.02 * np.sin(7.0 * simulation.positions)
    return Problem(simulation, STEPS, losses.FinalPositions(target))


def test_it_is_chosen_where_the_time_step_is_too_long():
    limit = viscous_limit(thick(), {})
    assert not is_implicit(thick("automatic", 0.9 * limit)) and is_implicit(thick("automatic", 1.1 * limit))
    assert is_implicit(thick("implicit", 0.1 * limit)) and not is_implicit(thick("explicit", 0.5 * limit))
    assert stability_limits(thick())["viscosity"] == np.inf
    forces = Simulation(thick("automatic", 1.1 * limit)).solver.forces
    assert isinstance(forces[-1], ImplicitViscousStress)
    assert not any(isinstance(one, ImplicitViscousStress) for one in Simulation(thick("explicit")).solver.forces)


def test_it_comes_to_the_explicit_flow_with_the_first_order_of_the_time_step():
    def end(solve, steps):
        forces = {"gravity": [0.3, -9.81], "viscosity": "stress", "viscous_solve": solve, "pressure": False}
        made = thick(time_step=0.02 / steps, viscosity=5.0, forces=forces)
        return Simulation(made, precision="float64").run(steps, record_every=steps).velocities[-1]

    exact = 2.0 * end("explicit", 400) - end("explicit", 200)
    coarse, fine = (np.abs(end("implicit", steps) - exact).max() for steps in (20, 40))
    assert 1.7 < coarse / fine < 2.3


def test_fluid_at_rest_needs_no_iteration():
    forces = {"gravity": [0.0, 0.0], "viscosity": "stress", "viscous_solve": "implicit", "pressure": False}
    made = thick(fluid=[{**FLUID, "velocity": [0.0, 0.0]}], forces=forces)
    simulation = Simulation(made, precision="float64")
    np.testing.assert_array_equal(simulation.run(2).positions[-1], simulation.positions)
    assert (simulation.solver.forces[-1].iterations == 0).all()


def test_iterations_of_every_step_are_noted_and_too_few_are_told_of(monkeypatch):
    """The same in every member of a batch as alone, and as often as the last solve says."""
    simulation = Simulation(thick(), precision="float64")
    run = simulation.run(4)
    noted = run.diagnostics["viscous_iterations"]
    assert noted.shape == (4,) and (noted > 3).all() and noted[-1] == simulation.solver.forces[-1].iterations[0]
    thinner = {"viscosity": np.array([20.0, 1.0])}
    both = Simulation(thick(), precision="float64", batch=2).run(4, thinner)
    np.testing.assert_array_equal(both[0].diagnostics["viscous_iterations"], noted)
    assert (both[1].diagnostics["viscous_iterations"] != noted).any()
    assert "viscous_iterations" not in Simulation(thick("explicit"), precision="float64").run(1).diagnostics
    monkeypatch.setattr("cortado.sph.viscous_solve.MOST", 3)
    monkeypatch.setattr("cortado.sph.viscous_solve.Solve.most", 3)
    with pytest.warns(
        CortadoWarning, match="the viscosity did not converge in 4 of 4 steps, in which the solve took 3 iter"
    ):
        Simulation(thick(), precision="float64").run(4)
