"""Several fluids: gradients are right in everything they depend on, and what must be kept is kept."""

from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp

from bad_scenes import one_sentence
from cortado import InputError, Problem, Simulation, gradients, losses
from cortado.scene.parameter_values import reference_density
from cortado.sph.free_energy import FreeEnergy
from finite_differences import both_modes, decades, distance
from scenes import MIXING, Weighed, plane_of_three, scene, two_layers

MAKERS = {"two layers": two_layers, "plane of three": plane_of_three}
STEPS = {"two layers": 30, "plane of three": 50}
scenes = pytest.mark.parametrize("name", MAKERS)


@cache
def simulation_of(name, precision="float64"):
    return Simulation(MAKERS[name](), precision=precision)


SIZES = {
    **{"gravity": 1.0, "initial_positions": 0.05, "initial_velocities": 0.1, "mass_fractions": 0.1},
    **{"rest_density": 100.0, "viscosity": 0.05, "time_step": 1e-4, "mobility": 0.01, "interface_width": 0.004},
}
"""Size of a direction of each parameter."""


def point_of(simulation, seed=3):
    """All parameters: the scene's, but for a lattice that is disturbed and phases that are mixed a little."""
    random = np.random.default_rng(seed)
    point = {name: simulation.parameters()[name] for name in SIZES}
    x, c = point["initial_positions"], point["mass_fractions"]
    mixed = 0.8 * c + 0.2 * random.dirichlet(np.ones(c.shape[1]), len(c))
    velocities = 0.3 * random.standard_normal(x.shape)
    disturbed = x + 0.001 * random.standard_normal(x.shape)
    return {**point, "initial_positions": disturbed, "initial_velocities": velocities, "mass_fractions": mixed}


def directions_of(point, seed=5):
    random = np.random.default_rng(seed)
    found = {}
    for name, value in point.items():
        direction = random.standard_normal(value.shape)
        found[name] = SIZES[name] * direction / np.linalg.norm(direction)
    return found


@cache
def case(name):
    """A problem with its point, and the gradient there in all parameters together."""
    simulation = simulation_of(name)
    problem, point = Problem(simulation, STEPS[name], Weighed(simulation)), point_of(simulation)
    return problem, point, problem.value_and_gradient(point)


@scenes
def test_phases_keep_their_mass_and_fractions_add_up_to_1(name):
    simulation = simulation_of(name)
    trajectory = simulation.run(200)
    c, first = trajectory.mass_fractions, simulation.mass_fractions
    weights = reference_density(first, simulation.parameters()["rest_density"])
    kept = np.einsum("i,tik->tk", weights, c)
    assert trajectory.substeps in (2, 3)
    assert np.abs(trajectory.positions[-1] - trajectory.positions[0]).max() > 0.1  # it flowed
    assert np.abs(c[-1] - first).max() > 0.3  # and mixed
    assert np.abs(kept / kept[0] - 1.0).max() < 1e-12
    assert np.abs(c.sum(axis=2) - 1.0).max() < 1e-12


@pytest.mark.parametrize("make", [two_layers, plane_of_three])
def test_momentum_is_kept_in_free_space(make):
    d = make().dimension
    free = Simulation(make(container={"shape": "none"}, forces={"gravity": [0.0] * d}), precision="float64")
    point = point_of(free)
    chosen = {name: point[name] for name in ("initial_positions", "initial_velocities", "mass_fractions")}
    trajectory = free.run(100, chosen)
    m = reference_density(point["mass_fractions"], point["rest_density"])
    assert np.abs(trajectory.velocities[-1] - trajectory.velocities[0]).max() > 0.3
    momentum = np.einsum("i,tid->td", m, trajectory.velocities)
    assert np.abs(momentum - momentum[0]).max() < 1e-10 * (m[:, None] * np.abs(trajectory.velocities[0])).sum()
    x, v = (np.pad(a, ((0, 0), (0, 0), (0, 3 - d))) for a in (trajectory.positions, trajectory.velocities))
    spin = np.einsum("i,tid->td", m, np.cross(x, v))
    assert np.abs(spin - spin[0]).max() < 1e-10 * (m[:, None] * np.abs(np.cross(x[0], v[0]))).sum()


def equal_fluids(phases, **mixture):
    """The two layers, of one fluid: as one phase, or as two that are equal."""
    water = scene().phase[0].model_dump()
    layers = [fluid.model_dump() for fluid in two_layers().fluid]
    if phases == 1:
        return scene(phase=[water], fluid=[{**layer, "phase": "water"} for layer in layers])
    return two_layers(phase=[water, {**water, "name": "oil"}], mixture=mixture)


def test_two_equal_phases_behave_like_one():
    alone, two, mixing = (
        Simulation(equal_fluids(phases, **mixture), precision="float64")
        for phases, mixture in ((1, {}), (2, {}), (2, MIXING))
    )
    wanted, same, near = (simulation.run(60) for simulation in (alone, two, mixing))
    assert np.abs(near.mass_fractions[-1] - near.mass_fractions[0]).max() > 0.1
    assert same.substeps == 0 and (same.mass_fractions == same.mass_fractions[0]).all()
    for name in ("positions", "velocities"):
        assert getattr(same, name).tobytes() == getattr(wanted, name).tobytes()
        np.testing.assert_allclose(getattr(near, name), getattr(wanted, name), rtol=0, atol=1e-12)


def test_problems_with_different_substeps_share_a_simulation():
    problem, point, (loss, gradient) = case("two layers")
    other = Problem(problem.simulation, 5, problem.loss)
    for mobility in (0.0, 0.5):
        other.value_and_gradient({"mobility": mobility}, gradients.Tape())
    found, bits = problem.value_and_gradient(point)
    assert found == loss and all(bits[key].tobytes() == gradient[key].tobytes() for key in SIZES)


@cache
def quartic_functions(precision, phases):
    real, fractions = precision.real, precision.fractions(phases)

    @wp.func
    def gradient(c: fractions) -> fractions:
        return wp.cw_mul(wp.cw_mul(c, c), c)

    @wp.func
    def hessian_product(c: fractions, u: fractions) -> fractions:
        return real(3.0) * wp.cw_mul(wp.cw_mul(c, c), u)

    return SimpleNamespace(gradient=gradient, hessian_product=hessian_product)


QUARTIC = FreeEnergy("quartic", lambda c: 0.25 * (c**4).sum(1), curvature=3.0, functions=quartic_functions)


def test_a_free_energy_of_ones_own():
    simulation = Simulation(two_layers(), precision="float64", free_energy=QUARTIC)
    problem, point = Problem(simulation, 20, Weighed(simulation)), point_of(simulation)
    assert problem.value(point) != Problem(simulation_of("two layers"), 20, Weighed(simulation)).value(point)
    directions = directions_of(point)
    _, tangent = both_modes(problem, point, directions)
    assert distance(problem.value, point, directions, tangent, decades(3.0, 7.0), enough=1e-6) < 1e-6


def test_free_energies_of_one_name_are_told_from_one_another():
    """Of one curvature too: by the code of their functions."""
    other = replace(QUARTIC, functions=lambda precision, phases: quartic_functions(precision, phases))
    made = [Simulation(two_layers(), precision="float64", free_energy=one) for one in (QUARTIC, QUARTIC, other)]
    found = [Problem(one, 1, losses.FinalPositions(one.positions)).fingerprint for one in made]
    assert found[0] == found[1] != found[2]


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"curvature": -1.0}, "FreeEnergy quartic's curvature is -1.0, but must be at least 0"),
        ({"functions": lambda precision: 3}, r"takes the arguments '\(precision\)', but must take 2: a precision"),
        ({"value": 3}, "FreeEnergy quartic's value is 3, but must be a function"),
        ({"name": 3}, "FreeEnergy has the name 3, but the name must be a text"),
    ],
)
def test_what_is_no_free_energy_is_a_sentence(changes, said):
    with pytest.raises(InputError, match=said):
        replace(QUARTIC, **changes)
    with pytest.raises(InputError, match=r"no value, but must be called as FreeEnergy\(name, value,"):
        FreeEnergy("quartic")


def no_functions(precision, phases):
    raise ValueError("not today")


@pytest.mark.parametrize(
    ("functions", "said"),
    [
        (lambda precision, phases: 3, "quartic's functions must return an object .* but gradient is None"),
        (no_functions, r"FreeEnergy quartic's functions fail: ValueError: not today\.$"),
        (lambda precision, phases: quartic_functions(precision, 3), "quartic's functions cannot be compiled: .* and"),
    ],
)
def test_functions_that_are_none_of_a_free_energy_are_refused(functions, said):
    with pytest.raises(InputError, match=said):
        Simulation(two_layers(), free_energy=replace(QUARTIC, functions=functions))


def wrong_fractions():
    fractions = np.tile([0.5, 0.5], (125, 1))
    fractions[7] = [0.8, 0.3]
    return fractions


MISTAKES = {
    "viscosity has shape (), but must be (2,)": {"viscosity": 1.0},
    "mass_fractions has shape (125,), but must be (125, 2)": {"mass_fractions": np.ones(125)},
    "mass_fractions of particle 7 add up to 1.1, but must add up to 1": {"mass_fractions": wrong_fractions()},
    "mobility is -0.1, but must be at least 0": {"mobility": -0.1},
    "colours has shape (3,), but must be (2, 3)": {"colours": [0.1, 0.2, 0.3]},
}


@pytest.mark.parametrize("words", MISTAKES)
def test_a_mistake_is_a_sentence(words):
    problem = case("two layers")[0]
    with one_sentence() as caught:
        problem.value(MISTAKES[words])
    assert words in str(caught.value) and len(str(caught.value)) < 300


def test_frames_that_do_not_exist_are_a_sentence():
    simulation = simulation_of("plane of three")
    with pytest.raises(InputError, match="frame 5, but must have frames from 0 to 4"):
        Problem(simulation, 4, losses.Frames({5: Weighed(simulation)}))
    with pytest.raises(InputError, match="at least one frame"):
        losses.Frames({})
