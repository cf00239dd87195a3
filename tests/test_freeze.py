"""Scenes, helps, public names and the schema are as `tests/data/freeze.json` has them: `tests/freeze.py` says how it is
compared bit by bit, and how it is written anew after a change that is meant."""

import json
from importlib.util import find_spec

import numpy as np
import pytest

from freeze import DATA, GROWING, TOLERANCE, differences, digest, digests, rows, texts

FROZEN = json.loads(DATA.read_text(encoding="utf-8"))
STABLE = [" ".join(row) for row in rows() if not GROWING & {row[0], " ".join(row)}]


def test_every_row_is_held():
    assert {*(" ".join(row) for row in rows()), "texts"} == FROZEN.keys()


def test_texts_are_the_same():
    held = FROZEN["texts"]
    if find_spec("torch") is None:
        held = {name: lines for name, lines in held.items() if name != "cortado.torch"}
    assert list(differences(held, texts())) == []


@pytest.mark.parametrize("row", STABLE)
def test_every_stable_scene_has_its_numbers(row):
    name, _, precision = row.rpartition(" ")
    assert list(differences({row: FROZEN[row]}, {row: digests(name, precision)})) == []


def test_what_differs_is_named():
    array = np.random.default_rng(3).standard_normal((40, 2))
    old = {
        "a float64": {"x": digest(array)},
        "b float64": {"x": digest(array)},
        "texts": {"run --help": ["one", "two"]},
    }
    near, far = array * (1.0 + 1e-15), array * (1.0 + 1e-11)
    new = {"a float64": {"x": digest(near), "y": digest(far)}, "b float64": {"x": digest(far)}, "texts": {}}
    new["texts"]["run --help"] = ["one", "three"]
    lines = ["a float64: y: only the new one has it", "b float64: x: other numbers, a relative distance of 1.0e-11"]
    text = "run --help:\n  - two\n  + three"
    assert list(differences(old, old, bits=True)) == [] and list(differences(old, new)) == [*lines, text]
    found = list(differences(old, new, bits=True))
    assert len(found) == 4 and found[1].startswith("a float64: x: other bits, a relative distance of ")
    assert 0.0 < float(found[1].split()[-1]) < TOLERANCE["float64"]
    assert list(differences({}, {"c float32": {}})) == ["c float32: only the new one has it"]
