"""The pressure of the projection: the momentum that it carries, its work, its mean, and derivatives of that."""

from functools import cache

import numpy as np
import pytest
import warp as wp

from cortado import Problem, Simulation
from cortado.particles.neighbourhood import neighbourhood_type
from cortado.particles.state import to_device
from reference_projection import Projection
from scenes import OIL, Squares, box, plane, plane_of_three, scene, simulated, two_layers
from still_fluids import still_water
from test_faces import flume
from test_moving_solids import ROTOR
from test_quantities import around
from test_solid_parameters import SCENES, STEPS, check, point_of

SUPPORTS = {"cubic_spline": 2.0, "wendland_c2": 2.6}
ROUND_OFF = {"float64": 1e-14, "float32": 1e-6}
"""Of a sum, relative to the sum of the magnitudes of its terms; up to 3e-16 and 5e-8 were seen."""


class Step:
    """One step of a fluid that is thrown at walls, under gravity and pressure alone. Arrays of particles are in the
    solver's order if nothing else is said."""

    def __init__(self, make, kernel, precision):
        cut = {"spacing": 0.05, "support": SUPPORTS[kernel], "kernel": kernel}
        made = make(discretisation=cut, forces={"gravity": make().forces.gravity, "viscosity": "none"})
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


PROJECTION = {"kind": "projection", "time_step": 0.002}
C2 = {"discretisation": {"spacing": 0.05, "kernel": "wendland_c2", "support": 2.6}}
BOTH = [scene().phase[0].model_dump(), OIL]
HALVES = [box([0.0, 0.0], [0.4, 0.2], phase="water"), box([0.0, 0.2], [0.4, 0.4], phase="oil")]
ROOM = {"container": box([0.0, 0.0, 0.0], [0.6, 0.6, 0.6])}
FLOWS = {
    "plane": lambda **own: plane(solver=PROJECTION, **own),
    "plane, Wendland": lambda **own: plane(solver=PROJECTION, **own, **C2),
    "space": lambda **own: scene(solver=PROJECTION, **own, **ROOM),
    "two phases": lambda **own: plane(solver=PROJECTION, **own, phase=BOTH, fluid=HALVES),
    "free": lambda **own: plane(solver=PROJECTION, **own, container={"shape": "none"}, forces={"gravity": [0.0, 0.0]}),
}


@pytest.mark.parametrize("make", FLOWS.values(), ids=FLOWS)
def test_pressures_add_up_to_the_virial_of_their_forces(make):
    """d sum p_i V_i = sum x_i . F_i in d dimensions, with V_i = s^d, to round-off, beside walls through the origin, as
    they push along their normals: forces at their surfaces have no part in it. F_i is what the next state says."""
    simulation = Simulation(make(), precision="float64")
    turning = {"initial_velocities": np.random.default_rng(1).normal(size=simulation.velocities.shape)}
    first, second = (simulation.run(steps, turning).last_state for steps in (6, 7))
    forces = first["reference_density"][:, None] * second["pressure_kick"] / 0.002
    pressures, x = simulation.quantity("pressure", first), first["positions"]
    scale = np.abs(x * forces).sum()
    assert simulation.dimension * pressures.sum() == pytest.approx((x * forces).sum(), abs=1e-12 * scale)
    assert np.abs(pressures).sum() > 0.1 * scale


@pytest.mark.parametrize("name", [*FLOWS, "flap"])
def test_pressures_are_sums_over_all_pairs_and_walls(name):
    """In NumPy, from the pressures' impulses and L of the solver, also beside a box that sticks out into the fluid, and
    with images, of which a flap that moves has its own."""
    made = FLOWS.get(name, flume)
    d, dt = made().dimension, made().solver.time_step
    own = {} if name == "flap" else {"solid": [box([0.1] * d, [0.2] * d, name="box")]}
    simulation = Simulation(made(**own), precision="float64")
    turning = {"initial_velocities": np.random.default_rng(1).normal(size=simulation.velocities.shape)}
    first, second = (simulation.run(steps, turning).last_state for steps in (6, 7))
    found, solver = simulation.quantity("pressure", first), simulation.solver
    x, volume = first["positions"], simulation.lattice.volume
    L = np.empty((len(x), d, d))
    L[solver.search.order.numpy()[: len(x)]] = solver.density.around["L"].numpy()[:, :d, :d]
    T = (second["pressure_impulse"] / dt)[:, None, None] * L
    (_, g), (_, wall_g) = around(simulation, x)
    apart = x[:, None] - x[None]
    pairs = -0.5 * volume * np.einsum("ijk,ijkl,ijl->i", apart, T[:, None] + T[None], g)
    weights, places, feet = (solver.search.walls[f"wall_{of}"].numpy() for of in ("weights", "positions", "feet"))
    places, feet, wall_g = places[:, :d], feet[:, :d], volume * weights[:, None] * wall_g
    units = feet / np.linalg.norm(feet, axis=1, keepdims=True)
    along = (wall_g * units).sum(axis=2, keepdims=True) * units
    normal, whole = along.sum(axis=1), wall_g.sum(axis=1)
    square = (whole**2).sum(axis=1)
    off = (square - (normal**2).sum(axis=1)) / (square + 0.01 * solver.constants.least_diagonal)
    t = np.clip((off - 0.1) / 0.3, 0.0, 1.0)
    edge = (t * t * (3.0 - 2.0 * t))[:, None, None]
    from_surface = x[:, None] - (places + feet)[None]
    twin, k = Projection.of(simulation), second["pressure_impulse"] / dt
    h = twin.share(x)[0]
    counted = along + edge * (wall_g - along) - h[:, None, None] * along * twin.mirroring(x)[:, :, None]
    reach = (counted * from_surface).sum(axis=(1, 2))
    for _, x_ij, _, image_g, _ in twin.images(x):
        pairs -= 0.5 * (((h * k)[:, None] + h * k) * (x_ij * image_g).sum(axis=2)).sum(axis=1)
    wanted = (pairs - k * reach) / d
    np.testing.assert_allclose(found, wanted, atol=1e-10 * np.abs(wanted).max())
    assert (edge > 0.5).any() or name == "flap"


def test_water_at_rest_has_the_pressure_of_its_depth():
    """Within 2 %, where the impulses over dt that they are made of are 4 % off."""
    found = still_water(20, time=0.7)
    assert found.pressure.all < 0.02 < 0.03 < found.multiplier.all
    assert found.pressure.inside < 0.02
    assert found.pressure.near_walls < 0.03


@pytest.mark.parametrize("name", ["projection", "space", "two phases", "two solids", "tension", "periodic"])
def test_pressures_beside_moving_solids_have_derivatives(name):
    """Reverse and forward mode to round-off, and differences, for gravity, viscosity, and what solids do."""
    own = SCENES[name]()
    simulation = simulated(own)
    weights = np.random.default_rng(2).uniform(size=simulation.particles)
    point, along = point_of(own)
    point |= {"gravity": np.array(own.forces.gravity) + 0.5, "time_step": np.array(0.001)}
    along |= {"gravity": np.ones(own.dimension), "time_step": np.array(1e-4)}
    check(Problem(simulation, STEPS, Squares({"pressure": weights})), point, along)


def test_loads_do_without_stresses():
    """Their kernels are not even made: loads are read in every step."""
    made = plane(solver=PROJECTION, solid=[ROTOR], discretisation={"spacing": 0.05})  # whose kernels others have too
    simulation = Simulation(made, precision="float64")
    simulation.quantity("rotor.load")
    assert "mean_stress" not in vars(simulation.solver)
    simulation.quantity("pressure")
    assert "mean_stress" in vars(simulation.solver)
