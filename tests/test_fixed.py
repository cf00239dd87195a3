"""What is decided when an object is made stays: attributes are not set, and what was given is not kept by reference."""

import copy
import pickle

import numpy as np
import pytest

from cortado import InputError, Problem, Simulation, gradients, losses, optimisers
from cortado.optimisation.transforms import Affine, Logarithm, Transformed
from cortado.render.cameras import Orthographic
from scenes import plane

STEPS = 3


@pytest.fixture(scope="module")
def simulation():
    return Simulation(plane(), precision="float64")


@pytest.fixture(scope="module")
def made(simulation):
    """An object of every class whose attributes could be set without effect, by its name."""
    loss = losses.CentreOfMass([0.1, 0.2])
    renderer = simulation.renderer(resolution=(10, 8))
    problem = Problem(simulation, STEPS, losses.Frames({1: loss, STEPS: loss}))
    objects = [simulation, problem, loss, problem.loss, renderer, losses.CentreOfMassAlong([0.0, 1.0])]
    objects += [losses.FinalPositions(simulation.positions), losses.Image(renderer, np.zeros(renderer.shape))]
    objects += [losses.Recorded(lambda x, v, loss: None), Affine([0.0], [[1.0]])]
    objects += [Transformed(problem, {"viscosity": Logarithm()})]
    return {type(one).__name__: one for one in objects}


NAMES = ["Affine", "CentreOfMass", "CentreOfMassAlong", "FinalPositions", "Frames", "Image"]
NAMES += ["Problem", "Recorded", "Renderer", "Simulation", "Transformed"]


@pytest.mark.parametrize("name", NAMES)
def test_what_an_object_was_made_with_cannot_be_set_or_deleted(made, name):
    one = made[name]
    attributes = [attribute for attribute in vars(one) if not attribute.startswith("_")]
    assert attributes
    for attribute in attributes:
        before = getattr(one, attribute)
        with pytest.raises(InputError, match=f"^{attribute} cannot be set, as a {name} does not change; make another"):
            setattr(one, attribute, before)
        with pytest.raises(InputError, match=f"^{attribute} cannot be deleted"):
            delattr(one, attribute)
        assert getattr(one, attribute) is before
    with pytest.raises(InputError, match="gravity cannot be set"):
        one.gravity = np.zeros(2)


@pytest.mark.parametrize("again", [copy.copy, copy.deepcopy, lambda one: pickle.loads(pickle.dumps(one))])
def test_an_object_that_is_copied_does_not_change_either(made, again):
    for name in set(NAMES) - {"Recorded"}:
        twin, attribute = again(made[name]), next(a for a in vars(made[name]) if not a.startswith("_"))
        with pytest.raises(InputError, match="cannot be set"):
            setattr(twin, attribute, None)


def test_a_class_of_ones_own_keeps_its_own_attributes():
    class Keeping(losses.CentreOfMass):
        def value(self, end):
            self.last = end
            return super().value(end)

    loss = Keeping([0.0, 0.0])
    Problem(Simulation(plane()), 1, loss).value({})
    assert loss.last is not None
    with pytest.raises(InputError, match="target cannot be set"):
        loss.target = np.ones(2)


def test_first_particles_and_walls_cannot_be_written(simulation):
    for name in ("positions", "velocities", "mass_fractions", "walls"):
        with pytest.raises(ValueError, match="read-only"):
            getattr(simulation, name)[0] = 0.0


@pytest.mark.parametrize(
    ("make", "name"),
    [
        (lambda table: gradients.EnsembleMean(table), "spread"),
        (lambda table: gradients.Guided(spread=table), "spread"),
        (optimisers.Adam, "learning_rate"),
        (lambda table: optimisers.LBFGS(scale=table), "scale"),
    ],
)
def test_a_table_of_settings_is_copied(make, name):
    table = {"gravity": 0.5}
    one = make(table)
    words = repr(one)
    table["gravity"] = -1.0
    kept = getattr(one, name)
    assert kept == {"gravity": 0.5} and repr(one) == words
    ways = lambda: kept.update(gravity=2.0), lambda: kept.__setitem__("gravity", 2.0), lambda: kept.pop("gravity")
    for change in (*ways, kept.clear):
        with pytest.raises(InputError, match="cannot be changed"):
            change()
    for again in (copy.deepcopy(one), pickle.loads(pickle.dumps(one))):
        assert repr(again) == words and getattr(again, name) == kept


def test_tables_and_arrays_of_losses_and_coordinates_cannot_be_changed(made):
    with pytest.raises(InputError, match="cannot be changed"):
        made["Frames"].losses[2] = losses.CentreOfMass([0.0, 0.0])
    with pytest.raises(InputError, match="cannot be changed"):
        del made["Transformed"].coordinates["viscosity"]
    base, matrix = np.zeros(2), np.eye(2)
    affine = Affine(base, matrix)
    base[:], matrix[:] = 7.0, 7.0
    np.testing.assert_array_equal(affine.parameter(np.array([1.0, 2.0])), [1.0, 2.0])
    with pytest.raises(ValueError, match="read-only"):
        affine.base[0] = 1.0


def test_settings_of_a_renderer_are_copied(simulation):
    colours, resolution = np.array([[0.2, 0.4, 0.6]]), [8, 6]
    camera = Orthographic((0.0, 0.0, 1.0), (0.0, 0.0, 0.0), (0.0, 1.0, 0.0), 1.0, resolution=resolution)
    resolution[0] = 4
    assert camera.resolution == (8, 6)
    own = simulation.renderer(resolution=(10, 8))
    renderer = type(own)(own.view, **{**own._settings, "colours": colours}, precision=own._precision)
    frame = simulation.run(1)[-1]
    before = renderer.render(frame)
    colours[:] = 1.0
    for one in (renderer, renderer.in_precision(own._precision), pickle.loads(pickle.dumps(renderer))):
        np.testing.assert_array_equal(one.render(frame), before)
