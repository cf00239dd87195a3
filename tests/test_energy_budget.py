"""The budget of pressure in one step: particles keep their momentum, and its work is that of compressing the fluid.

    without walls:  sum_i F_i = 0,      for any displacements u:  sum_i F_i . u_i = -V sum_i q_i dn_i[u]

F_i is the force on particle i [N], which is m_i V times its pressure acceleration, q_i is p_i / n_i^2, and dn_i[u]
comes from the tangent of the density. The second line also holds for the walls' parts of F and dn alone.
"""

from functools import cache

import numpy as np
import pytest
import warp as wp

from cortado import Simulation
from cortado.particles.neighbourhood import neighbourhood_type
from cortado.particles.state import to_device
from scenes import plane, plane_of_three, scene, two_layers

SUPPORTS = {"cubic_spline": 2.0, "wendland_c2": 2.6}
ROUND_OFF = {"float64": 1e-14, "float32": 1e-6}
"""Of a sum, relative to the sum of the magnitudes of its terms; up to 3e-16 and 5e-8 were seen."""


class Step:
    """One step of a fluid that is thrown at walls, under gravity and pressure alone. Arrays of particles are in the
    solver's order if nothing else is said."""

    def __init__(self, make, kernel, precision):
        made = make(
            discretisation={"spacing": 0.05, "support": SUPPORTS[kernel], "kernel": kernel},
            forces={"gravity": make().forces.gravity, "viscosity": "none"},
        )
        self.simulation, random = Simulation(made, precision=precision), np.random.default_rng(0)
        shape = self.simulation.positions.shape
        self.point = {
            "initial_positions": self.simulation.positions + 0.003 * random.standard_normal(shape),
            "initial_velocities": 0.3 * random.standard_normal(shape) - 1.0,
        }
        rollout = self.simulation.rollout(1, self.point)
        self.new_velocities = rollout.forward().numpy(shape[1])["velocities"]
        """(n, d) in the scene's order [m/s]."""
        self.solver = rollout.solver
        self.whole = self.solver.context(rollout.parameters).neighbourhood
        """What particles see: each other and the walls."""
        self.among_particles = neighbourhood_type(self.solver.discretisation.precision)()
        """The same without the walls."""
        self.among_particles.assign(self.whole)
        self.among_particles.count = self.whole.fluid_count
        self.order = self.solver.search.order.numpy()[: shape[0]]
        self.u = random.standard_normal(shape)
        """(n, d) displacements [m]."""
        self.masses = self.solver.lattice.volume * self.solver.fields["m"].numpy().astype(np.float64)
        """(n,) [kg]"""
        self.q = self.solver.iterates.c[0].numpy().astype(np.float64)
        """(n,) of the last iteration [Pa]."""

    def forces_behind(self, new_velocities):
        """(n, d) what made the new velocities, (n, d) in the scene's order, less gravity [N]."""
        gained = (new_velocities - self.point["initial_velocities"])[self.order]
        made = self.simulation.scene
        return self.masses[:, None] * (gained / made.solver.time_step - np.array(made.forces.gravity))

    def forces(self, neighbourhood):
        """(n, d) pressure forces from the solver's kernel [N]: what particles at rest gain in a second."""
        fields, real = self.solver.fields, self.solver.discretisation.precision.real
        time_step = wp.ones(1, dtype=real, device=self.solver.search.device)
        at_rest, x_star, v_star = (wp.zeros_like(fields["x"]) for _ in range(3))
        self.solver.launch(
            self.solver.kernels.force.forward,
            {"k": 0, "rounds": self.solver.pressure_loop.rounds, "x_before": x_star, "v_before": v_star},
            {"x": fields["x"], "m": fields["m"], "v": at_rest, "acceleration": at_rest},
            s=neighbourhood,
            time_step=time_step,
            c=self.solver.iterates.c[0],
            x_star=x_star,
            v_star=v_star,
        )
        return self.masses[:, None] * v_star.numpy()[:, : self.u.shape[1]]

    def compressions(self, neighbourhood):
        """(n,) changes of number densities by the displacements [-], from the solver's kernel."""
        solver, n_dot = self.solver, wp.zeros_like(self.solver.fields["n"])
        x_dot = to_device(self.u, solver.discretisation.precision, solver.search.device)
        solver.launch(solver.density.kernels.tangent, s=neighbourhood, x=solver.fields["x"], x_dot=x_dot, n_dot=n_dot)
        return n_dot.numpy().astype(np.float64)

    def gap(self, forces, compressions):
        """Between the work of forces and that of compressions, relative to the magnitudes of all terms."""
        terms = np.concatenate([(forces * self.u).ravel(), self.solver.lattice.volume * self.q * compressions])
        return abs(terms.sum()) / np.abs(terms).sum()


step_of = cache(Step)
makes = pytest.mark.parametrize("make", [scene, plane, two_layers, plane_of_three])
kernels = pytest.mark.parametrize("kernel", SUPPORTS)
precisions = pytest.mark.parametrize("precision", ROUND_OFF)


@makes
@kernels
@precisions
def test_pressure_keeps_the_momentum_of_particles(make, kernel, precision):
    step = step_of(make, kernel, precision)
    forces = step.forces(step.among_particles)
    assert 0.3 < (step.q > 0.0).mean() < 0.7
    assert np.abs(forces.sum(axis=0)).max() < ROUND_OFF[precision] * np.abs(forces).sum()


@makes
@kernels
@precisions
def test_the_work_of_pressure_is_that_of_compression(make, kernel, precision):
    """In the step as it was taken, among particles, and by the walls alone."""
    step = step_of(make, kernel, precision)
    forces, compressions = step.forces(step.whole), step.compressions(step.whole)
    inner_forces, inner_compressions = step.forces(step.among_particles), step.compressions(step.among_particles)
    assert np.abs(forces - inner_forces).sum() > 0.1 * np.abs(inner_forces).sum()  # walls do push
    assert step.gap(step.forces_behind(step.new_velocities), compressions) < ROUND_OFF[precision]
    assert step.gap(inner_forces, inner_compressions) < ROUND_OFF[precision]
    assert step.gap(forces - inner_forces, compressions - inner_compressions) < ROUND_OFF[precision]


@pytest.mark.parametrize("make", [scene, plane])
@kernels
def test_so_it_is_in_the_reference_engine(make, kernel):
    reference = pytest.importorskip("cortado.reference", exc_type=ImportError)
    """A step of the reference engine against pressures and compressions of the Warp engine."""
    step = step_of(make, kernel, "float64")
    history = reference.Simulation(step.simulation.scene).run(1, step.point)
    forces = step.forces_behind(history.velocities.high[-1])
    assert step.gap(forces, step.compressions(step.whole)) < ROUND_OFF["float64"]
