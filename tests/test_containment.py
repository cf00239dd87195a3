"""Walls hold the fluid, and the fluid keeps its density, at every step of a violent flow; where they fail, the run ends
in a sentence."""

import warnings
from typing import Any

import numpy as np
import pytest
import warp as wp

from benchmarks.bench.scene import dam_break
from cortado import CortadoWarning, DivergedError, InputError, Problem, Scene, Simulation, Trajectory, losses
from cortado.device.launching import KernelLauncher
from cortado.device.precision import precision_named
from cortado.discretise.room import Region
from cortado.discretise.shapes import corners
from cortado.particles.state import POSITIONS, VELOCITIES, Layout, to_device
from cortado.scene.shape_tables import CylinderContainer
from cortado.solvers.containment import Containment
from cortado.solvers.obstacles import Walled
from scenes import bodies, jet, plane, scene

SUPPORTS = {"cubic_spline": 2.0, "wendland_c2": 2.6, "wendland_c4": 3.0}


def box(particles: int = 1000, kernel: str = "cubic_spline") -> Scene:
    return _with_kernel(dam_break(particles).model_dump(mode="json"), kernel)


def cup(kernel: str = "cubic_spline") -> Scene:
    """1,011 particles that fall into a tilted cup with a lid."""
    water = {"shape": "cylinder", "base": [0.0, 0.6, 0.0], "radius": 0.6, "height": 0.9}
    walls = {"shape": "cylinder", "base": [0.0, 0.0, 0.0], "radius": 0.65, "height": 1.6, "lid": True}
    solver = {"kind": "pcisph", "time_step": 0.002, "minimum_iterations": 5, "maximum_iterations": 5}
    made = bodies(3, [water], walls, 0.1, 0.05, forces={"gravity": [3.0, -9.81, 0.0]}, solver=solver)
    return _with_kernel(made.model_dump(mode="json"), kernel)


def _with_kernel(tables: dict[str, Any], kernel: str) -> Scene:
    changed = {**tables["discretisation"], "kernel": kernel, "support": SUPPORTS[kernel]}
    return Scene(**{**tables, "discretisation": changed})


def escaped(scene: Scene, trajectory: Trajectory) -> int:
    everywhere = trajectory.positions.reshape(-1, trajectory.dimension)
    return int(np.count_nonzero(~scene.container.contains(everywhere.astype(np.float64), 0.0)))


def energies(scene: Scene, trajectory: Trajectory) -> np.ndarray:
    """(frames,) mean of v^2 / 2 - g . x over the particles [J/kg], from the lowest place in the container on."""
    gravity = np.array(scene.forces.gravity)
    x, v = trajectory.positions.astype(np.float64), trajectory.velocities.astype(np.float64)
    lowest = (corners(*scene.container.extent()) @ gravity).max()
    return 0.5 * (v**2).sum(axis=2).mean(axis=1) - (x @ gravity).mean(axis=1) + lowest


@pytest.mark.parametrize(
    ("kernel", "steps"), [("cubic_spline", 1000), ("wendland_c2", 300), ("wendland_c4", 300)], ids=SUPPORTS
)
@pytest.mark.parametrize("make", [box, cup])
def test_walls_hold_a_dam_break(make, kernel, steps):
    scene = make(kernel=kernel)
    trajectory = Simulation(scene, precision="float32").run(steps)
    travelled = np.linalg.norm(trajectory.positions[-1] - trajectory.positions[0], axis=1)
    assert travelled.max() > 3.0 * scene.discretisation.spacing  # it did move
    assert escaped(scene, trajectory) == 0
    energy = energies(scene, trajectory)
    assert energy.max() <= 1.001 * energy[0] and energy[-1] < energy[0]  # walls do no work
    assert trajectory.density_errors[10:].max() <= 0.01


@pytest.mark.parametrize("kernel", SUPPORTS)
@pytest.mark.parametrize("round_walls", [False, True])
def test_a_column_that_touches_walls_starts_with_no_more_than_its_energy(round_walls, kernel):
    """In short steps whatever is compressed at first, at an edge or in a corner, would burst."""
    column = {"shape": "box", "lower": [0.0, 0.0, 0.0], "upper": [1.0, 1.0, 1.0]}
    in_a_cup = {"shape": "cylinder", "base": [0.0, 0.0, 0.0], "radius": 1.0}
    fluid = {**in_a_cup, "height": 1.0} if round_walls else column
    walls = {**in_a_cup, "height": 1.5} if round_walls else {**column, "upper": [2.0, 2.0, 1.0]}
    solver = {"kind": "pcisph", "time_step": 0.0005, "maximum_iterations": 100, "density_tolerance": 1e-4}
    made = _with_kernel(bodies(3, [fluid], walls, 1.0 / 6.0, solver=solver).model_dump(mode="json"), kernel)
    energy = energies(made, Simulation(made).run(60))
    assert energy.max() <= 1.001 * energy[0]


FAST = {"kind": "pcisph", "time_step": 0.05, "minimum_iterations": 3, "maximum_iterations": 3}


@pytest.mark.filterwarnings("ignore::cortado.CortadoWarning")
@pytest.mark.parametrize("precision", ["float32", "float64"])
@pytest.mark.parametrize("make", [plane, scene])
def test_fluid_that_leaves_the_container_ends_the_run(make, precision):
    made = make(solver=FAST)
    frames = []
    rollout = Simulation(made, precision=precision).rollout(40)
    wanted = r"left the container and was at \(.*\) m; speed limits the time step to about"
    with pytest.raises(DivergedError, match=wanted) as caught:
        rollout.forward(lambda step, state: frames.append(state.numpy(made.dimension)["positions"]), keep=False)
    assert len(frames) == caught.value.step - 1  # those before are good
    tolerance = 0.5 * made.discretisation.spacing
    assert made.container.contains(np.concatenate(frames).astype(np.float64), tolerance).all()
    assert len(rollout.diagnostics["iterations"]) == caught.value.step


def test_without_pressure_walls_hold_nothing():
    Simulation(plane(forces={"gravity": [0.0, -9.81], "pressure": False})).run(200)


CUP = {"base": (0.1, 0.2, 0.3), "radius": 0.5, "height": 1.0}
PLANE = Region.between(np.array([0.0, -1.0]), np.array([1.0, 2.0]))
REGIONS = {
    "plane": PLANE,
    "periodic": PLANE.opened(np.array([1.0, 0.0])),
    "space": Region.everywhere(3),
    "cup": CylinderContainer(**CUP, axis="y").region(3),
    "open cup": CylinderContainer(**CUP, axis="z", lid=False).region(3),
}


@pytest.mark.parametrize("precision", ["float32", "float64"])
@pytest.mark.parametrize("name", REGIONS)
def test_the_device_finds_the_particles_that_numpy_finds(name, precision):
    """Each of 4,000 random ways, a step of its own kind: within, through a wall, over a rim, or outside throughout."""
    region, real, random = REGIONS[name], precision_named(precision), np.random.default_rng(3)
    n, d = 4000, len(region.lower)
    before, after = random.uniform(-1.5, 2.5, (2, n, d))
    spacing = 0.1
    wanted = region.escaped(before, after, 0.5 * spacing)
    after[7, 0], after[9, -1] = np.nan, np.inf
    wanted[[7, 9]] = True
    assert wanted.sum() == 2 if name == "space" else 10 < wanted.sum() < n - 10
    device = wp.get_device("cpu")
    near = Region.between(np.full(d, -2.0), np.full(d, 3.0))
    layout, launch = Layout(n, 1, real, device), KernelLauncher(n, device, record_tape=False)
    containment = Containment(Walled(region, near, spacing, (), (), np.zeros(d)), layout, launch, n, None)
    order = random.permutation(n)
    state = layout.state((POSITIONS, VELOCITIES))
    state.set({"positions": after})
    known = {
        "order": wp.array(np.tile(order, 2), dtype=wp.int32, device=device),
        "x_before": to_device(before[order], real, device),
        "rho_0": wp.array(np.ones(n), dtype=real.real, device=device),
        "x_free": to_device(after[order], real, device),
        "v_free": to_device(np.zeros((n, d)), real, device),
    }
    containment.look(known, state)
    assert int(containment.bad_particle.numpy()[0]) == np.flatnonzero(wanted)[0]
    assert int(containment._count.numpy()[0]) == wanted.sum()


def test_what_goes_over_the_rim_of_an_open_cup_may_fall_on():
    tables = cup().model_dump(mode="json")
    tables["container"] |= {"lid": False, "height": 0.6, "radius": 0.62}
    trajectory = Simulation(Scene(**{**tables, "forces": {"gravity": [9.0, -6.0, 0.0]}}), precision="float64").run(300)
    assert np.linalg.norm(trajectory.positions[-1][:, [0, 2]], axis=1).max() > 0.8  # some is spilled


def test_what_waits_in_a_nozzle_passes_walls_with_it():
    """The column reaches from the opening at 0.26 m to 0.56 m, below a lid at 0.8 m; then the nozzle is drawn up."""
    path = np.column_stack([np.full(30, 0.3), np.linspace(0.26, 0.7, 30)])
    trajectory = Simulation(jet(), precision="float64").run(30, {"nozzle.path": path})
    assert (trajectory.positions[0, :, 1] < 0.8).all() and trajectory.positions[-1, :, 1].max() > 0.83


@pytest.mark.filterwarnings("ignore::cortado.CortadoWarning")
def test_fluid_that_has_gone_round_a_period_may_be_where_it_is():
    round_along_x = {"shape": "box", "lower": [0.0, 0.0], "upper": [0.7, 0.8], "periodic": [True, False]}
    simulation = Simulation(plane(container=round_along_x), precision="float64")
    problem = Problem(simulation, 1, losses.FinalPositions(simulation.positions))
    problem.value({"initial_positions": simulation.positions + [3.0 * 0.7, 0.0]})
    with pytest.raises(InputError, match="outside the container"):
        problem.value({"initial_positions": simulation.positions - [0.0, 1.0]})


@pytest.mark.filterwarnings("ignore::cortado.CortadoWarning")
def test_parameters_that_cannot_be_are_refused():
    simulation = Simulation(plane(), precision="float64")
    problem = Problem(simulation, 20, losses.CentreOfMass([0.0, 0.0]))
    with pytest.raises(InputError, match=r"initial_positions has particle 0 at \(5.025, 0.025\) m, outside"):
        problem.value({"initial_positions": simulation.positions + [5.0, 0.0]})
    middle = simulation.positions.mean(axis=0)
    with pytest.raises(InputError, match=r"initial_positions has all particles within 0\.002\d* m2, but the fluid"):
        problem.value({"initial_positions": middle + 0.001 * (simulation.positions - middle)})
    with pytest.raises(InputError, match="rest_density has a value of size 1e"):
        problem.value_and_gradient({"rest_density": 1e300})
    for values in ({"gravity": [0.0, -1e4]}, {"time_step": 1.0}):
        with pytest.raises(DivergedError):
            problem.value_and_gradient(values)


def test_a_time_step_beyond_the_limit_of_stability_is_warned_of_once():
    simulation = Simulation(plane(), precision="float64")
    problem = Problem(simulation, 2, losses.CentreOfMass([0.0, 0.0]))
    problem.value({"gravity": [0.0, -9.81], "time_step": 0.0021})
    with pytest.warns(CortadoWarning, match="time_step is 0.012 s, but the limit of stability with these"):
        problem.value({"time_step": 0.012})
    with pytest.warns(CortadoWarning, match="limit of stability"):
        simulation.run(2, controls={"gravity": [[0.0, -9.81], [0.0, -400.0]]})


def test_scenes_that_a_precision_does_not_resolve_are_refused():
    def moved(spacings):
        x = spacings * 0.05
        block = {"shape": "box", "lower": [x, 0.0], "upper": [x + 0.4, 0.4], "phase": "water"}
        return plane(fluid=[block], container={"shape": "none"}, forces={"gravity": [0.0, 0.0]})

    Simulation(moved(9e3))
    Simulation(moved(9e8), precision="float64")
    with pytest.raises(InputError, match=r"reaches 1.1e\+04 spacings of 0.05 m from the origin"):
        Simulation(moved(1.1e4))


@pytest.mark.filterwarnings("ignore::cortado.CortadoWarning")
def test_particles_that_go_further_than_a_precision_resolves_are_lost():
    block = {"shape": "box", "lower": [0.0, 0.0], "upper": [0.4, 0.4], "velocity": [490.0, 0.0], "phase": "water"}
    solver = {"kind": "pcisph", "time_step": 0.1, "minimum_iterations": 3, "maximum_iterations": 3}
    with pytest.warns(CortadoWarning, match="limit of stability"):
        fast = plane(fluid=[block], container={"shape": "none"}, forces={"gravity": [0.0, 0.0]}, solver=solver)
    assert Simulation(fast, precision="float64").run(12).positions[-1].max() > 500.0
    with pytest.raises(DivergedError, match=r"in step 11: .* than positions are precise in float32.* or float64"):
        Simulation(fast).run(12)
    kicked = {"initial_velocities": np.full((64, 2), 1e6)}
    with pytest.raises(DivergedError, match=r"m, further than 1e\+06 spacings from the scene; .* within the limit.$"):
        Simulation(fast, precision="float64").run(12, kicked)


def points(tmp_path, apart):
    lattice = np.stack(np.meshgrid(*[apart * (np.arange(12) + 0.5)] * 2), axis=-1).reshape(-1, 2)
    np.save(tmp_path / "points.npy", lattice)
    return plane(
        fluid=[{"shape": "points", "file": str(tmp_path / "points.npy"), "phase": "water"}],
        container={"shape": "box", "lower": [0.0, 0.0], "upper": [1.5, 1.5]},
    )


def test_points_fit_the_spacing_or_are_warned_of_or_refused(tmp_path):
    wanted = r"have 1.56 times the rest density .*spacing is 0.05 m, and these points would fit one of 0.04 m"
    with pytest.raises(InputError, match=wanted):
        Simulation(points(tmp_path, 0.04))
    for apart, words in ((0.0485, "fly apart: .* fit one of 0.0485"), (0.1, "hardly touch each")):
        with pytest.warns(CortadoWarning, match=words):
            Simulation(points(tmp_path, apart))
    with warnings.catch_warnings():
        warnings.simplefilter("error", CortadoWarning)
        Simulation(points(tmp_path, 0.05))
        Simulation(points(tmp_path, 0.051))
