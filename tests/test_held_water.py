"""Solids that move, and meshes, hold water: small ones of what ``python validation/solids.py`` runs with 8,000."""

import pytest

from held_water import cup_turned, meshes, stirred


def test_a_paddle_stirs_and_nothing_enters_it():
    found = stirred(36, 800, thickness=0.14)
    assert found["turns"] > 0.6
    assert found["deepest"] < 0.5 and found["outside"] < 0.5


def test_a_cup_is_turned_upside_down_and_back_and_loses_what_it_pours_alone():
    found = cup_turned(30, 900)
    assert found["through its wall"] == 0 and found["deepest"] < 0.5
    assert found["poured"] > 600 and found["poured"] + found["still in it"] == found["particles"]


@pytest.mark.parametrize("name", ["torus", "cup with a handle", "bodies that overlap"])
def test_a_mesh_holds_water(name):
    found = meshes(60, name)
    assert found["energy"] < 1.005 and found["deepest"] < 0.5 and found["lowest"] > 0.0


def test_a_cup_without_a_bottom_holds_none():
    found = meshes(100, "cup with a handle", bottom=False)
    assert found["lowest"] < 0.0
