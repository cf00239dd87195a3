"""Scenes of several phases: their order, and how they mix."""

import tomllib

import pytest

from bad_scenes import GOOD_SCENE, MIXTURE, plane
from cortado.errors import SceneError
from cortado.scene.fluid_particles import fluid_particles
from cortado.scene.model import MixtureTable
from cortado.scene.scene import Scene, scene_from_dict

PHASES = [{"name": name, "rest_density": 1000, "viscosity": 0.001} for name in ("water", "oil", "ink")]
FLUIDS = [
    {"shape": "box", "lower": [0, 0.5], "upper": [1, 1], "phase": "ink"},
    {"shape": "box", "lower": [0, 0], "upper": [1, 0.5], "phase": "water"},
    {"shape": "box", "lower": [0, 1], "upper": [1, 1.1], "phase": "oil"},
]


def test_phases_are_counted_in_the_order_of_the_scene():
    scene = Scene(**plane(phase=PHASES, fluid=FLUIDS))
    assert fluid_particles(scene).phase.tolist() == [2] * 50 + [0] * 50 + [1] * 10
    assert Scene.from_json(scene.to_json()) == scene and scene.mixture == MixtureTable()


def test_a_mixture_keeps_what_its_file_says():
    mixture = scene_from_dict(tomllib.loads(GOOD_SCENE + MIXTURE)).mixture
    assert (mixture.free_energy, mixture.strength, mixture.mobility) == ("miscible", 2.0, 1e-5)
    assert (mixture.mobility_form, mixture.interface_width, mixture.width(0.05)) == ("constant", 0.1, 0.1)


def test_an_interface_is_as_wide_as_a_spacing_if_nothing_else_is_said():
    mixture = Scene(**plane(phase=PHASES, mixture={"mobility": 1e-6})).mixture
    assert (mixture.interface_width, mixture.width(0.1)) == (None, 0.1)
    assert (mixture.free_energy, mixture.strength, mixture.mobility_form) == ("double_well", 1.0, "degenerate")


def test_one_phase_has_nothing_to_mix_with():
    wanted = r"^mixture is given, but must be left out, as the scene has only one phase\.$"
    with pytest.raises(SceneError, match=wanted):
        Scene(**plane(mixture=MixtureTable(mobility=1e-6)))
    assert Scene(**plane(mixture=MixtureTable())) == Scene(**plane())
