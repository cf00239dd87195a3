"""Every key of a scene, changed alone where it acts, changes what is computed, drawn or said, or is refused."""

import json
import warnings
from functools import cache
from typing import Any

import numpy as np
import pytest

from cortado import CortadoError, CortadoWarning, Scene, Simulation
from cortado.pictures.pace import Pace
from cortado.pictures.painter import colours_of, painter
from cortado.scene.camera_paths import Moment, View
from cortado.scene.tables import Table
from scenes import jet, plane_of_three, scene

ROOM = {"shape": "box", "lower": [0.0, 0.0], "upper": [0.6, 0.8], "slip": "no"}
LAW = {"kind": "bingham", "yield_stress": 3.0, "regularisation": 0.2}
WATER = {"name": "water", "rest_density": 1000.0, "viscosity": 0.5}
SENSORS = [
    {"name": "a", "kind": "pressure_probe", "position": [0.3, 0.1], "radius": 0.12},
    {"name": "b", "kind": "wave_gauge", "position": [0.3, 0.1], "radius": 0.12},
    {"name": "c", "kind": "flow_rate", "position": [0.3, 0.15], "normal": [1.0, 1.0], "reach": 0.1},
    {"name": "d", "kind": "wall_force", "lower": [0.28, -0.3], "upper": [0.4, 0.3], "about": [0.1, 0.1]},
]
PICTURE = {"width": 80, "height": 64, "background": [0.2, 0.3, 0.4], "film_frames": 7, "film_speed": 0.5}
SPACE = {"width": 64, "height": 64, "camera": [0.9, 0.7, 0.9], "look_at": [0.1, 0.1, 0.1], "transparency": 0.5}
BASES = {
    "pcisph": lambda: jet(
        phase=[{**WATER, "rheology": LAW, "colour": [0.1, 0.2, 0.3]}],
        container=ROOM,
        sensor=SENSORS,
        picture=PICTURE,
        schedule={"gravity": {"times": [0.0, 1.0], "values": [[0.1, -9.0], [2.0, -9.0]]}},
    ),
    "projection": lambda: jet(
        container=ROOM,
        solver={"kind": "projection", "time_step": 0.001, "velocities_follow": True},
        solid=[{"name": "ball", "shape": "sphere", "centre": [0.45, 0.4], "radius": 0.08, "slip": "no"}],
    ),
    "mixture": lambda: plane_of_three(
        render={"resolution": [16, 16], "background": [0.5, 0.6, 0.7], "extinction": 5.0},
    ),
    "shapes": lambda: scene(
        forces={"gravity": [0.0, -9.81, 0.0]},
        phase=[{**WATER, "rheology": {"kind": "carreau", "relaxation_time": 0.1, "flow_index": 0.5}}],
        container={"shape": "cylinder", "base": [0.0, 0.0, 0.0], "radius": 0.3, "height": 0.6, "slip": "no"},
        fluid=[
            {"shape": "cylinder", "base": [0.0, 0.05, 0.0], "radius": 0.12, "height": 0.1, "phase": "water"},
            {"shape": "sphere", "centre": [0.0, 0.4, 0.0], "radius": 0.1, "phase": "water"},
        ],
        solid=[
            {"name": "rod", "shape": "capsule", "start": [-0.17, 0.3, 0.0], "end": [-0.17, 0.5, 0.0], "radius": 0.06},
            {"name": "pole", "shape": "cylinder", "base": [0.2, 0.3, 0.0], "radius": 0.06, "height": 0.1, "slip": "no"},
        ],
    ),
    "space": lambda: scene(
        picture={**SPACE, "camera_path": {"kind": "dolly", "distance": 0.5}},
        render={"view": "volume", "resolution": [16, 16], "position": [1.0, 1.0, 1.0], "look_at": [0.1, 0.1, 0.1]},
    ),
}
ASIDE = {
    "name": "titles, and what others call it",
    "phase": "names",
    "material": "pictures of water and glass: tests/test_materials.py",
    "colour": "pictures: tests/test_films.py",
    "transparency": "pictures: tests/test_solid_pictures.py",
    "rotation": "a sphere is the same, turned",
    "density_tolerance": "only where more iterations are taken: tests/test_solver.py",
    "maximum_iterations": "only where the pressure does not converge: tests/test_solver.py",
}
"""Keys that others look at, or that cannot show here."""


def places(value: Any, path: tuple = ()) -> Any:
    """The path of every key in a table, and in those within it."""
    if isinstance(value, Table):
        for name in type(value).model_fields:
            found = getattr(value, name)
            tables = found if isinstance(found, tuple) else (found,)
            if any(isinstance(one, Table) for one in tables):
                yield from places(found, (*path, name))
            elif found is not None and found != ():
                yield (*path, name)
    elif isinstance(value, tuple):
        for k, one in enumerate(value):
            yield from places(one, (*path, k))


def changed(value: Any, schema: dict[str, Any]) -> Any:
    """Another value of the same kind."""
    if isinstance(value, bool):
        return not value
    if isinstance(value, str):
        return next(one for one in reversed(schema.get("enum", ["other", "else"])) if one != value)
    if isinstance(value, int):
        return value + 1
    if isinstance(value, float):
        return 0.9 * value if value else 0.01
    return [changed(value[0], {}), *value[1:]]


def entry(data: Any, path: tuple) -> Any:
    for part in path:
        data = data[part]
    return data


def schema_of(path: tuple, base: Scene) -> dict[str, Any]:
    table: Any = base
    for part in path[:-1]:
        table = table[part] if isinstance(part, int) else getattr(table, part)
    return type(table).model_json_schema()["properties"][path[-1]]


def effects(made: Scene) -> Any:
    """What can be seen of a scene, cheap things first."""
    simulation = Simulation(made, precision="float64")
    yield simulation.positions, simulation.velocities, simulation.walls, simulation.lattice
    picture = made.picture
    if picture is not None:
        colours = colours_of(made, simulation.mass_fractions, simulation.particles)
        yield painter(made, simulation.positions).image(simulation.positions, colours)
        if picture.camera_path is not None:
            home = View(np.ones(3), np.zeros(3))
            yield picture.camera_path.view(home, Moment(0.5, 0.5, np.array([0.0, 1.0, 0.0]), {}))
        yield Pace.of(np.linspace(0.0, 1.0, 30), picture.film_frames, picture.film_speed)
    if made.render is not None:
        yield simulation.renderer().render(simulation.initial)
    trajectory = simulation.run(25)
    yield trajectory.positions[-1], trajectory.diagnostics
    yield {name: read.values for name, read in trajectory.sensors.items()}


def same(one: Any, other: Any) -> bool:
    return json.dumps(one, default=_listed) == json.dumps(other, default=_listed)


def _listed(value: Any) -> Any:
    return (
        value.tolist() if isinstance(value, np.ndarray) else vars(value) if hasattr(value, "__dict__") else str(value)
    )


def told(make: Any) -> tuple[Any, list[str]]:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", CortadoWarning)
        return make(), sorted(str(one.message) for one in caught)


@cache
def known(base: str) -> tuple[Scene, list[str], list[Any]]:
    made, words = told(BASES[base])
    return made, words, list(effects(made))


@pytest.mark.parametrize("base", BASES)
def test_a_scene_in_which_nothing_is_changed_has_the_same_effects(base):
    """Or all keys would act."""
    made, words, wanted = known(base)
    other, others = told(lambda: Scene.from_json(made.to_json()))
    assert others == words and all(map(same, effects(other), wanted))


CASES = [(base, path) for base, make in BASES.items() for path in places(make()) if path[-1] not in ASIDE]


@pytest.mark.parametrize("base, path", CASES, ids=[f"{base}-{'.'.join(map(str, path))}" for base, path in CASES])
def test_a_key_changed_alone_acts_or_is_refused(base, path):
    made, words, wanted = known(base)
    data = {name: value for name, value in json.loads(made.to_json()).items() if value is not None}
    entry(data, path[:-1])[path[-1]] = changed(entry(data, path), schema_of(path, made))
    try:
        other, others = told(lambda: Scene.from_json(json.dumps(data)))
        acts = others != words or not all(map(same, effects(other), wanted))
    except CortadoError:
        return
    assert acts
