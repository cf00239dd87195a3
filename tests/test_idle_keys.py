"""A key that changes nothing beside what the rest of a scene says is refused, or warned of, in one sentence."""

import warnings

import pytest

from bad_scenes import assert_one_sentence
from cortado import CortadoWarning, SceneError
from cortado.optimisation.datasets import DatasetTable
from cortado.scene.model import Bingham
from cortado.scene.scene import Scene
from scenes import jet, plane, scene, two_layers

BELT = {"name": "belt", "shape": "box", "lower": [0.2, 0.3], "upper": [0.4, 0.4]}
ROOM = {"shape": "box", "lower": [0.0, 0.0], "upper": [0.6, 0.8]}
LAW = {"name": "mud", "rest_density": 1000.0, "viscosity": 0.5}
SHAKEN = {"gravity": {"times": [0.0, 1.0], "values": [[0.0, -9.81], [2.0, -9.81]]}}
MUD = {"fluid": [{"shape": "box", "lower": [0.0, 0.0], "upper": [0.4, 0.2], "phase": "mud"}]}
FRAMES = {"kind": "keyframes", "times": [0.0, 1.0], "cameras": [[1.0, 1.0, 1.0], [2.0, 1.0, 1.0]]}


def path(**keys):
    return plane(solid=[{**BELT, "motion": "path", **keys}], fluid=[], emitter=jet().emitter)


REFUSED = {
    "mixture.strength": lambda: two_layers(mixture={"strength": 2.0}),
    "mixture.interface_width": lambda: two_layers(mixture={"interface_width": 0.1}),
    "mixture.free_energy": lambda: two_layers(mixture={"free_energy": "miscible"}),
    "mixture.mobility_form": lambda: two_layers(mixture={"mobility_form": "constant"}),
    "forces.viscous_solve": lambda: plane(forces={"viscosity": "pairwise", "viscous_solve": "implicit"}),
    "container.slip": lambda: plane(container={**ROOM, "periodic": [True, True], "slip": "no"}),
    "container.colour": lambda: plane(container={**ROOM, "periodic": [True, True], "colour": [0.1, 0.2, 0.3]}),
    "container.material": lambda: plane(container={**ROOM, "material": "steel", "colour": [0.1, 0.2, 0.3]}),
    "phase[0].material": lambda: plane(phase=[{**LAW, "material": "milk", "colour": [0.1, 0.2, 0.3]}], **MUD),
    "forces.gravity": lambda: plane(forces={"gravity": [0.0, -1.62]}, schedule=SHAKEN),
    "picture.light": lambda: plane(picture={"light": "noon", "background": [0.5, 0.5, 0.5]}),
    "picture.floor": lambda: plane(picture={"floor": False}),
    "picture.field_of_view": lambda: plane(picture={"field_of_view": 40.0}),
    "picture.surface": lambda: plane(picture={"surface": "spheres"}),
    "picture.transparency": lambda: scene(picture={"surface": "spheres", "transparency": 0.5}),
    "picture.film_speed": lambda: plane(picture={"film_frames": 0, "film_speed": 0.5}),
    "picture.camera": lambda: scene(picture={"camera": [1.0, 1.0, 1.0], "camera_path": FRAMES}),
    "solid[0].positions": lambda: path(times=[0.0, 1.0]),
    "tangent_frames": lambda: DatasetTable(steps=2, velocity_noise=0.1, tangent_frames="all"),
}
WARNED = {
    "mixture.strength": lambda: two_layers(mixture={"strength": 2.0, "mobility": 0.0}),
    "container.slip": lambda: plane(container={**ROOM, "slip": "no"}, forces={"viscosity": "none"}),
    "solver.iterations": lambda: plane(
        solver={"kind": "projection", "time_step": 1e-3, "iterations": 5}, forces={"pressure": False}
    ),
    "emitter.length": lambda: jet(emitter={**jet().emitter.model_dump(), "length": 1.0, "duration": 0.05}),
    "solid[0].centre": lambda: plane(
        solid=[{"name": "ball", "shape": "sphere", "centre": [0.5, 0.6], "radius": 0.1, "position": [0.5, 0.7]}]
    ),
    "discretisation.jitter": lambda: jet(discretisation={"spacing": 0.05, "jitter": 0.1}, fluid=[]),
    "phase[0].rheology.regularisation": lambda: plane(
        phase=[{**LAW, "rheology": Bingham(yield_stress=0.0, regularisation=0.3)}], **MUD
    ),
}


@pytest.mark.parametrize("key", REFUSED)
def test_a_key_of_a_choice_that_was_not_made_is_refused(key):
    with pytest.raises(SceneError) as caught:
        REFUSED[key]()
    assert str(caught.value).startswith(f"{key} is ")
    assert_one_sentence(str(caught.value))


def test_gravity_that_a_schedule_begins_with_is_said_twice():
    first = {"times": [0.0, 1.0], "values": [[0.0, -1.62], [2.0, -1.62]]}
    assert plane(forces={"gravity": [0.0, -1.62]}, schedule={"gravity": first}).schedule.gravity.times == (0.0, 1.0)


@pytest.mark.parametrize("key", WARNED)
def test_a_key_that_a_zero_turns_off_is_warned_of(key):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", CortadoWarning)
        made = WARNED[key]()
    assert any(str(one.message).startswith(f"{key} changes nothing, as ") for one in caught)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CortadoWarning)
        assert Scene.from_json(made.to_json()) == made
