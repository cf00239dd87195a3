"""Every key of a scene, changed alone where it acts, changes what is computed, drawn or said, or is refused."""

import atexit
import shutil
import warnings
from functools import cache
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

import numpy as np
import pytest
import trimesh

from bad_scenes import one_sentence
from cortado import CortadoError, CortadoWarning, Scene, SceneError, Simulation
from cortado.optimisation.datasets import DatasetTable
from cortado.pictures.painter import colours_of, painter
from cortado.runs.frames import Pace
from cortado.scene.appearance import Moment, View
from cortado.scene.model import Bingham, SceneTables
from every_key import given, key_at, keys_of, places, put, same, told
from scenes import box, jet, plane, plane_of_three, scene, two_layers

ROOM = box([0.0, 0.0], [0.6, 0.8], slip="no")
RENDER = {"resolution": [16, 16]}
ROUND = {"shape": "cylinder", "base": [0.0, 0.0, 0.0], "radius": 0.4}
MOVED = {"times": [0.0, 0.01], "values": [[0.3, 0.26], [0.31, 0.26]]}
LAW = {"kind": "bingham", "yield_stress": 3.0, "regularisation": 0.2}
WATER = {"name": "water", "rest_density": 1000.0, "viscosity": 0.5}
OF_WATER = {"phase": "water", "velocity": [0.1, 0.0], "angular_velocity": 3.0}
SENSORS = [
    {"name": "a", "kind": "pressure_probe", "position": [0.3, 0.1], "radius": 0.12},
    {"name": "b", "kind": "wave_gauge", "position": [0.3, 0.1], "radius": 0.12},
    {"name": "c", "kind": "flow_rate", "position": [0.3, 0.15], "normal": [1.0, 1.0], "reach": 0.1},
    {"name": "d", "kind": "wall_force", "lower": [0.28, -0.3], "upper": [0.4, 0.3], "about": [0.1, 0.1]},
]
MOTION = {"name": "j", "kind": "body_motion", "solid": "disc"}
ON_THE_ROD = [
    {"name": "e", "kind": "solid_load", "solid": "rod", "axes": "body"},
    {"name": "f", "kind": "pressure_probe", "position": [0.5, 0.28], "radius": 0.12, "on": "rod"},
    {"name": "g", "kind": "wave_gauge", "position": [0.5, 0.28], "on": "rod", "axes": "body"},
    {"name": "h", "kind": "wall_force", "lower": [0.3, 0.1], "upper": [0.7, 0.5], "on": "rod", "axes": "body"},
]
PICTURE = {"width": 80, "height": 64, "background": [0.2, 0.3, 0.4], "film_frames": 7, "film_speed": 0.5}
SPACE = {"width": 64, "height": 64, "camera": [0.9, 0.7, 0.9], "look_at": [0.1, 0.1, 0.1], "transparency": 0.5}
ABOUT = {"gravity": {"times": [0.0, 1.0], "values": [[0.1, -9.0], [2.0, -9.0]]}}
GLASS = {"material": "glass", "colour": [0.3, 0.2, 0.1]}
TWICE = [[1.0, 1.0, 1.0], [2.0, 1.0, 1.0]]
FRAMES = {"kind": "keyframes", "times": [0.0, 1.0], "cameras": TWICE, "look_at": TWICE[::-1]}
SHEET = {"name": "sheet", "shape": "sheet", "corners": [[0.1, 0.02], [0.12, 0.1]], "scale": 1.1}
SQUARE = [[0.0, 0.0], [0.2, 0.0], [0.2, 0.2], [0.0, 0.2]]
COARSE = {"spacing": 0.1, "support": 2.0, "kernel": "cubic_spline"}
FOLDER = Path(mkdtemp())
atexit.register(shutil.rmtree, FOLDER)
NAMES = ("block.stl", "points.npy", "drops.npy", "around.npy", "path.csv", "sway.csv")
BLOCK, POINTS, DROPS, AROUND, PATH, SWAY = (str(FOLDER / name) for name in NAMES)
Path(PATH).write_text("time [s],x [mm],rotation [deg]\n0,0,0\n0.01,5,2\n0.02,1,1\n0.03,4,1\n")
Path(SWAY).write_text("time [s],x [m/s^2],y [m/s^2]\n0,0,-9.81\n0.01,2,-9\n0.02,1,-9\n0.03,4,-9\n")
trimesh.creation.box((1.0, 1.0, 1.0)).export(BLOCK)
np.save(POINTS, [[0.45, 0.2], [0.5, 0.2]])
BESIDE = [[0.48, 0.3], [0.62, 0.27], [0.81, 0.3], [1.3, 0.12], [1.46, 0.4], [0.95, 0.6]]
"""Where fluid is on its way to solids [m]."""
np.save(DROPS, (np.array(BESIDE)[:, None] + 0.05 * np.array([[0.0, 0.0], [-1.0, 0.0], [-1.0, -1.0]])).reshape(-1, 2))
np.save(AROUND, [[0.35, 0.3, 0.3], [0.6, 0.3, 0.3], [0.85, 0.3, 0.3]])
IN_THE_PLANE = [
    {
        **box([0.1, 0.3], [0.3, 0.5], name="box", rotation=0.3, colour=[0.2, 0.5, 0.3], transparency=0.3),
        **{"motion": "path", "times": [0.0, 0.1], "positions": [[0.2, 0.4], [0.3, 0.4]], "rotations": [0.0, 0.1]},
    },
    {
        **{"name": "disc", "shape": "sphere", "centre": [0.5, 0.42], "radius": 0.1, "slip": "free"},
        **{"motion": "free", "density": 300.0, "velocity": [0.3, 0.1], "angular_velocity": 1.0},
        **{"freedom": ["x", "y", "rotation"], "friction": 0.3, "restitution": 0.5},
    },
    {
        **{"name": "rod", "shape": "capsule", "start": [0.7, 0.3], "end": [0.7, 0.4], "radius": 0.05},
        **{"position": [0.7, 0.36], "motion": "path", "velocity": [0.3, 0.0], "angular_velocity": 2.0},
    },
    {
        **{"name": "cup", "shape": "cup", "base": [1.0, 0.2], "radius": 0.1, "height": 0.3, "thickness": 0.06},
        **{"surface_velocity": [0.0, 0.5], "slip": "no"},
    },
    {"name": "wedge", "shape": "polygon", "corners": [[1.2, 0.0], [1.5, 0.0], [1.5, 0.2]], "slip": "no"},
    {"name": "slope", "shape": "plane", "position": [1.5, 0.4], "normal": [-1.0, 0.3], "slip": "no"},
    {
        **{"name": "stick", "shape": "capsule", "start": [0.7, 0.65], "end": [0.85, 0.65], "radius": 0.05},
        **{"motion": "path", "path": PATH, "interpolation": "spline", "ramp": 0.02},
    },
    {
        **box([1.0, 0.58], [1.15, 0.68], name="keel", motion="free", mass=9.0),
        **{"centre_of_mass": [0.02, -0.02], "gyration_radius": 0.08},
    },
]
PIN = {"name": "pin", "solid": "keel", "position": [1.1, 0.66], "stiffness": 3.0, "damping": 0.5, "rest_angle": 0.1}
PIN |= {"times": [0.0, 0.1], "torques": [1.0, 2.0]}
LINE = {"name": "line", "solid": "disc", "point": [0.5, 0.42], "anchor": [0.5, 0.14], "stiffness": 300.0}
LINE |= {"rest_length": 0.279, "damping": 2.0, "slack": True}
IN_SPACE = [
    {"name": "pole", "shape": "cylinder", "base": [0.2, 0.1, 0.3], "radius": 0.1, "height": 0.3, "slip": "no"},
    {"name": "cup", "shape": "cup", "base": [0.6, 0.1, 0.3], "radius": 0.1, "height": 0.3, "thickness": 0.1},
    {"name": "block", "shape": "mesh", "file": BLOCK, "scale": 0.2, "position": [1.0, 0.3, 0.3], "material": "steel"},
]
SINK = {"shape": "sink", "name": "a", "position": [0.2, 0.0], "radius": 0.06}
DRAINS = [
    {**SINK, "times": [0.0, 1.0], "flow_rates": [0.3, 0.1]},
    {"shape": "box", "name": "b", "lower": [0.3, 0.3], "upper": [0.36, 0.36]},
    {"shape": "plane", "name": "c", "position": [0.0, 0.201], "direction": [-1.0, 1.0]},
]
TOLD = {"volume": 0.5, "path": MOVED, "sides": [0.15], "times": [0.0, 0.02], "flow_rates": [0.3, 0.1]}
BASES = {
    "pcisph": lambda: jet(
        phase=[{**WATER, "rheology": LAW, "colour": [0.1, 0.2, 0.3]}],
        container={**ROOM, "material": "steel"},
        sensor=SENSORS,
        picture=PICTURE,
        schedule=ABOUT,
    ),
    "projection": lambda: jet(
        container=ROOM,
        solid=[SHEET],
        emitter=[{**jet().emitter[0].model_dump(exclude={"flow_rate", "radius"}), **TOLD}],
        solver={"kind": "projection", "tolerance": 3e-5, "time_step": 0.001, "velocities_follow": True},
        schedule={"tilt": {"times": [0.0, 1.0], "values": [[5.0], [20.0]]}},
    ),
    "chosen": lambda: jet(
        phase=[{**WATER, "rheology": {"kind": "power_law", "flow_index": 0.6, "least_shear_rate": 0.1}}],
        solver={"kind": "pcisph", "time_step": "auto", "courant": 0.02},
        forces={"surface_tension": 0.07},
        schedule={"gravity": {"file": SWAY, "interpolation": "spline", "ramp": 0.02}},
    ),
    "mixture": lambda: plane_of_three(render={**RENDER, "background": [0.5, 0.6, 0.7], "extinction": 5.0}),
    "bodies": lambda: plane(
        phase=[{**WATER, "rheology": {**LAW, "kind": "herschel_bulkley", "flow_index": 0.5, "least_shear_rate": 0.1}}],
        fluid=[
            {"shape": "sphere", "centre": [0.5, 0.6], "radius": 0.15, **OF_WATER},
            {"shape": "polygon", "corners": SQUARE, "position": [0.2, 0.2], **OF_WATER},
            {"shape": "points", "file": POINTS, **OF_WATER},
        ],
    ),
    "plane": lambda: plane(
        discretisation={"spacing": 0.05},
        solver={"kind": "projection", "time_step": 0.001},
        fluid=[{"shape": "points", "file": DROPS, "phase": "water", "velocity": [0.6, 0.6]}],
        container={**ROOM, "upper": [1.6, 0.8], "colour": [0.3, 0.2, 0.1]},
        solid=IN_THE_PLANE,
        hinge=[PIN],
        spring=[LINE],
        sensor=[*ON_THE_ROD, {"name": "i", "kind": "spring_force", "spring": "line"}, MOTION],
        picture={"width": 80, "height": 64},
    ),
    "drains": lambda: plane(drain=DRAINS, solver={"kind": "projection", "time_step": 0.001}),
    "solids": lambda: scene(
        discretisation=COARSE,
        fluid=[{"shape": "points", "file": AROUND, "phase": "water", "velocity": [0.0, 0.0, 1.0]}],
        container={"shape": "box", "lower": [0.0, 0.0, 0.0], "upper": [1.2, 0.6, 0.6]},
        solid=IN_SPACE,
        picture={"width": 64, "height": 64, "camera_path": {"kind": "follow", "solid": "cup", "distance": 0.5}},
    ),
    "space": lambda: scene(
        phase=[{**WATER, "material": "milk"}],
        picture={**SPACE, "camera_path": {"kind": "dolly", "distance": 0.5}},
        render={"view": "volume", "resolution": [16, 16], "position": [1.0, 1.0, 1.0], "look_at": [0.1, 0.1, 0.1]},
    ),
    "round": lambda: scene(
        discretisation=COARSE,
        phase=[{**WATER, "rheology": {"kind": "carreau", "relaxation_time": 0.1, "flow_index": 0.5}}],
        forces={},
        container={**ROUND, "height": 0.9, "slip": "no", **GLASS},
        fluid=[
            {**ROUND, "height": 0.2, "rotation": [0.1, 0.0, 0.0], "phase": "water"},
            {"shape": "mesh", "file": BLOCK, "scale": 0.2, "position": [0.0, 0.6, 0.0], "phase": "water"},
        ],
        picture={"width": 64, "height": 64, "surface": "spheres", "camera_path": FRAMES},
    ),
    "alone": lambda: scene(
        container={"shape": "none"},
        solver={"kind": "pcisph", "time_step": "auto", "greatest_time_step": 0.001},
        picture={"width": 64, "height": 64, "camera_path": {"kind": "orbit"}},
    ),
}
MOTORS = "speed", "speeds", "file"
ASIDE = {
    ("BoxDrain", "name"): "what the balance calls it",
    ("EmitterTable", "name"): "what parameters call it",
    ("EmitterTable", "fed_by"): "only where drains take fluid: tests/test_drains.py",
    ("FlowTable", "file"): "in place of flow_rates: tests/test_drains.py",
    ("PlaneDrain", "name"): "what the balance calls it",
    ("SinkDrain", "name"): "what parameters call it",
    ("Picture", "colour"): "what is computed colours: tests/test_films.py",
    ("Picture", "quality"): "in space alone: tests/test_shading.py",
    ("SceneTables", "name"): "titles",
    ("SheetSolid", "file"): "in place of corners: tests/test_sheets.py",
    ("SolidTable", "name"): "what others call it",
    ("HingeTable", "name"): "what messages call it",
    ("HingeTable", "axis"): "in space alone: tests/test_hinges.py",
    ("HingeTable", "torque"): "in place of torques: tests/test_springs.py",
    **{("HingeTable", key): "beside a damping, or in place of torques: tests/test_springs.py" for key in MOTORS},
    ("HingeTable", "to"): "another solid than the world: tests/test_hinges.py",
    ("SolidTable", "friction"): "where bodies touch: tests/test_free_bodies.py",
    ("SolidTable", "restitution"): "where bodies touch: tests/test_free_bodies.py",
    ("SolidTable", "inertia"): "in place of gyration_radius: tests/test_body_masses.py",
    ("SpringTable", "name"): "what sensors and parameters call it",
    ("SpringTable", "preload"): "in place of rest_length: tests/test_springs.py",
    ("SpringTable", "to"): "instead of the world: tests/test_springs.py",
    ("PackageTable", "kind"): "packages: tests/test_packages.py",
    ("PackageSolver", "kind"): "packages: tests/test_packages.py",
    ("PcisphSolver", "density_tolerance"): "only where more iterations are taken: tests/test_solver.py",
    ("PcisphSolver", "maximum_density_tolerance"): "only where more iterations are taken: tests/test_solver.py",
    ("PcisphSolver", "maximum_iterations"): "only where the pressure does not converge: tests/test_solver.py",
    ("ProjectionSolver", "maximum_iterations"): "only where the tolerance is not reached: tests/test_projection.py",
}
"""Keys that others look at, or that cannot show here."""


def effects(made: Scene) -> Any:
    """What can be seen of a scene, cheap things first."""
    simulation = Simulation(made, precision="float64")
    yield simulation.positions, simulation.velocities, simulation.walls, simulation.lattice
    picture = made.picture
    if picture is not None:
        colours = colours_of(made, simulation.mass_fractions, simulation.particles)
        yield painter(made, simulation.positions).image(simulation.positions, colours)
        if picture.camera_path is not None:
            moment = Moment(0.4, 0.4, np.array([0.0, 1.0, 0.0]), {one.name: one.middle() for one in made.solid})
            yield picture.camera_path.view(View(np.ones(3), np.zeros(3)), moment)
        yield Pace.of(np.linspace(0.0, 1.0, 30), picture.film_frames, picture.film_speed)
    if made.render is not None:
        yield simulation.renderer().render(simulation.initial)
    for steps in (3, 25):
        trajectory = simulation.run(steps)
        yield trajectory.times, trajectory.positions[-1], trajectory.diagnostics, trajectory.solids
        yield {name: read.values for name, read in trajectory.sensors.items()}


@cache
def known(base: str) -> tuple[Scene, list[str], list[Any]]:
    made, words = told(BASES[base])
    return made, words, list(effects(made))


MADE = {base: told(make)[0] for base, make in BASES.items()}
PLACES = [(base, made, path) for base, made in MADE.items() for path in places(made)]
FIRST = {key_at(made, path): (base, path) for base, made, path in reversed(PLACES)}
CASES = [place for key, place in FIRST.items() if key not in ASIDE]
"""The first place of each key."""


def test_no_key_of_a_scene_is_forgotten():
    missing = keys_of(SceneTables) - set(FIRST) - set(ASIDE)
    assert not missing, f"give {missing} in one of the scenes above"


@pytest.mark.parametrize("base", BASES)
def test_a_scene_in_which_nothing_is_changed_has_the_same_effects(base):
    """Or all keys would act."""
    made, words, wanted = known(base)
    other, others = told(lambda: Scene(**given(made)))
    assert others == words and all(map(same, effects(other), wanted))


@pytest.mark.parametrize("base, path", CASES, ids=[f"{base}-{'.'.join(map(str, path))}" for base, path in CASES])
def test_a_key_changed_alone_acts_or_is_refused(base, path):
    made, words, wanted = known(base)
    data = given(made)
    put(data, path, made)
    try:
        other, others = told(lambda: Scene(**data))
        acts = others != words or not all(map(same, effects(other), wanted))
    except CortadoError:
        return
    assert acts


BELT = box([0.2, 0.3], [0.4, 0.4], name="belt")
TANK = box([0.0, 0.0], [0.6, 0.8])
MUD_PHASE = {"name": "mud", "rest_density": 1000.0, "viscosity": 0.5}
PROJECTION = {"kind": "projection", "time_step": 1e-3}
BALL = {"name": "ball", "shape": "sphere", "centre": [0.5, 0.6], "radius": 0.1}
STIFF = Bingham(yield_stress=0.0, regularisation=0.3)
SHAKEN = {"gravity": {"times": [0.0, 1.0], "values": [[0.0, -9.81], [2.0, -9.81]]}}
MUD = {"fluid": [{"shape": "box", "lower": [0.0, 0.0], "upper": [0.4, 0.2], "phase": "mud"}]}
KEYFRAMES = {"kind": "keyframes", "times": [0.0, 1.0], "cameras": [[1.0, 1.0, 1.0], [2.0, 1.0, 1.0]]}


def path(**keys):
    return plane(solid=[{**BELT, "motion": "path", **keys}], fluid=[], emitter=list(jet().emitter))


REFUSED = {
    "mixture.strength": lambda: two_layers(mixture={"strength": 2.0}),
    "mixture.free_energy": lambda: two_layers(mixture={"free_energy": "miscible"}),
    "forces.viscous_solve": lambda: plane(forces={"viscosity": "pairwise", "viscous_solve": "implicit"}),
    "container.slip": lambda: plane(container={**TANK, "periodic": [True, True], "slip": "no"}),
    "container.colour": lambda: plane(container={**TANK, "periodic": [True, True], "colour": [0.1, 0.2, 0.3]}),
    "container.material": lambda: plane(container={**TANK, "material": "steel", "colour": [0.1, 0.2, 0.3]}),
    "phase[0].material": lambda: plane(phase=[{**MUD_PHASE, "material": "milk", "colour": [0.1, 0.2, 0.3]}], **MUD),
    "forces.gravity": lambda: plane(forces={"gravity": [0.0, -1.62]}, schedule=SHAKEN),
    "picture.light": lambda: plane(picture={"light": "noon", "background": [0.5, 0.5, 0.5]}),
    "picture.transparency": lambda: scene(picture={"surface": "spheres", "transparency": 0.5}),
    "picture.film_speed": lambda: plane(picture={"film_frames": 0, "film_speed": 0.5}),
    "picture.camera": lambda: scene(picture={"camera": [1.0, 1.0, 1.0], "camera_path": KEYFRAMES}),
    "solid[0].positions": lambda: path(times=[0.0, 1.0]),
    "tangent_frames": lambda: DatasetTable(steps=2, velocity_noise=0.1, tangent_frames="all"),
}
WARNED = {
    "mixture.strength": lambda: two_layers(mixture={"strength": 2.0, "mobility": 0.0}),
    "container.slip": lambda: plane(container={**TANK, "slip": "no"}, forces={"viscosity": "none"}),
    "solver.iterations": lambda: plane(solver={**PROJECTION, "iterations": 5}, forces={"pressure": False}),
    "emitter[0].length": lambda: jet(emitter=[{**jet().emitter[0].model_dump(), "length": 1.0, "volume": 0.015}]),
    "solid[0].centre": lambda: plane(solid=[{**BALL, "position": [0.5, 0.7]}]),
    "discretisation.jitter": lambda: jet(discretisation={"spacing": 0.05, "jitter": 0.1}, fluid=[]),
    "phase[0].rheology.regularisation": lambda: plane(phase=[{**MUD_PHASE, "rheology": STIFF}], **MUD),
}


@pytest.mark.parametrize("key", REFUSED)
def test_a_key_of_a_choice_that_was_not_made_is_refused(key):
    with one_sentence(error=SceneError) as caught:
        REFUSED[key]()
    assert str(caught.value).startswith(f"{key} is ")


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
