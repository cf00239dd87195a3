"""Scenes: good ones load and keep what they say; bad ones end in one sentence, and in nothing else."""

import pickle
import tomllib
import warnings
from contextlib import contextmanager
from datetime import date
from math import cos, sin, sqrt

import numpy as np
import pytest

from bad_scenes import BAD_SCENES, EMITTER, GOOD_SCENE, MIXTURE, RENDER, assert_one_sentence, one_sentence, plane
from cortado import Problem, Simulation
from cortado.discretise.smoothing import CUBIC_SPLINE, pairwise_rate, stress_rate
from cortado.errors import CortadoWarning, DivergedError, InputError, MassWarning, SceneError
from cortado.losses import CentreOfMass
from cortado.scene.fluids import BoxFluid
from cortado.scene.model import DiscretisationTable, MixtureTable
from cortado.scene.scene import Scene, load_scene, scene_from_dict
from cortado.scene.stability import stability_limits
from scenes import bodies, box, pool, stability_limit


@contextmanager
def warned():
    said = []
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        yield said
    said += [str(one.message) for one in caught]


@contextmanager
def silent(*ignored):
    """An error where anything but ``ignored`` is warned of."""
    with warnings.catch_warnings():
        warnings.simplefilter("error", CortadoWarning)
        for category in ignored:
            warnings.simplefilter("ignore", category)
        yield


@pytest.fixture
def scene_file(tmp_path):
    path = tmp_path / "scene.toml"
    path.write_text(GOOD_SCENE)
    return path


def good_data() -> dict:
    return tomllib.loads(GOOD_SCENE)


def full_data() -> dict:
    return tomllib.loads(GOOD_SCENE + EMITTER + MIXTURE + RENDER)


def test_a_scene_keeps_what_its_file_says(scene_file):
    scene = load_scene(scene_file)
    assert scene.dimension == 3 and scene.discretisation.support_radius == 0.1
    assert [fluid.shape for fluid in scene.fluid] == ["box", "sphere"]
    assert scene.fluid[1].velocity == (0.0, 0.0, 0.0) and scene.fluid[0].upper == (0.25, 0.25, 0.25)
    assert scene.container.periodic == (True, False, False) and scene.container.slip == "no"
    assert scene.forces.gravity == (0.0, -9.81, 0.0) and scene.forces.pressure is True
    assert (scene.solver.minimum_iterations, scene.solver.maximum_density_tolerance) == (5, None)


def test_a_scene_can_be_built_from_parts():
    fluid = BoxFluid(lower=np.zeros(2), upper=(np.float32(1.0), 0.5), phase="water")
    scene = Scene(**plane(fluid=[fluid], discretisation=DiscretisationTable(spacing=0.1)))
    assert scene == Scene(**plane()) and fluid.velocity == (0.0, 0.0, 0.0)
    with pytest.raises(SceneError, match=r"^spacing is -1, but must be greater than 0 m\.$"):
        DiscretisationTable(spacing=-1)


def test_a_scene_with_other_values_is_another_one():
    scene = scene_from_dict(full_data())
    assert Scene.from_json(scene.to_json()) == scene and Scene(**plane()) == Scene.from_json(Scene(**plane()).to_json())
    tilt = "schedule.tilt.times=[0, 1]", "schedule.tilt.values=[[0, 0], [9, 0]]"
    other = scene.replaced("solver.time_step=0.0005", *tilt)
    with pytest.raises(InputError, match=r"^dimension cannot be set, as a scene does not change; make another one"):
        scene.dimension = 3
    assert scene.replaced() == scene and hash(scene.replaced()) == hash(scene)
    assert other.schedule.tilt.times == (0.0, 1.0) and other.solver.time_step == 0.0005 != scene.solver.time_step
    for wrong in ("solver.timestep=1", "solver.time_step=-1", "x", 3):
        with one_sentence(error=SceneError):
            scene.replaced(wrong)


def test_overrides_replace_values(scene_file):
    overrides = ["solver.time_step=0.002", "forces.gravity=[0,-5,0]", "fluid.0.upper=[0.1,0.1,0.1]"]
    overrides += ["fluid[1].radius = 0.08", "name=a drop", "container.periodic[0]=false"]
    scene = load_scene(scene_file, overrides)
    assert (scene.solver.time_step, scene.forces.gravity) == (0.002, (0.0, -5.0, 0.0))
    assert (scene.fluid[0].upper, scene.fluid[1].radius) == ((0.1, 0.1, 0.1), 0.08)
    assert (scene.name, scene.container.periodic[0]) == ("a drop", False)
    for bad in ("solver.time_step", "=3", "", "fluid.2.radius=1", "fluid.x.radius=1", "name.x=1", "a b=1"):
        with one_sentence(error=SceneError):
            load_scene(scene_file, [bad])


@pytest.mark.parametrize("old, new, field", [bad[1:] for bad in BAD_SCENES], ids=[bad[0] for bad in BAD_SCENES])
def test_a_bad_scene_is_a_sentence(scene_file, old, new, field):
    assert old in GOOD_SCENE
    scene_file.write_text(GOOD_SCENE.replace(old, new, 1))
    with pytest.raises(SceneError) as caught:
        load_scene(scene_file)
    text = str(caught.value)
    assert_one_sentence(text)
    assert text.startswith(f"{scene_file}: ") and field in text
    assert caught.value.file == str(scene_file) and (field in caught.value.field or not caught.value.field)
    assert str(pickle.loads(pickle.dumps(caught.value))) == text


@pytest.mark.parametrize("spacing, told", [(10.0, True), (0.01, False)])
def test_fluid_in_millimetres_is_asked_about(spacing, told):
    with warned() as said:
        pool([45 * spacing] * 3, [50 * spacing] * 3, spacing, 1.0, solver={"kind": "pcisph", "time_step": "auto"})
    sentence = "the fluid weighs about 9.1e+10 kg: are its lengths in millimetres? A scene has metres."
    assert (sentence in said) is told


def test_numbers_in_other_units_are_asked_about():
    data = good_data()
    data["phase"][0]["viscosity"] = 50_000.0
    ball = {"name": "ball", "shape": "sphere", "centre": [0.1, 0.9, 0.1], "radius": 0.05}
    data["solid"] = [{**ball, "rotation": [0.0, 0.0, 90.0]}]
    with warned() as said:
        scene_from_dict(data, "scene.toml")
    assert any(one.endswith("50000 Pa s, more than tar has: is it in mPa s?") for one in said)
    assert "solid[0].rotation is 90 rad, more than a whole turn: is it in degrees?" in said


@pytest.mark.parametrize(
    ("table", "key", "advice"),
    [
        (None, "gravity", "gravity is not a key of the scene; did you mean forces.gravity or schedule.gravity?"),
        (None, "obstacle", "obstacle is not a key of the scene; did you mean solid?"),
        ("solver", "dt", "solver.dt is not a key of [solver]; did you mean time_step?"),
        (None, "time_step", "time_step is not a key of the scene; did you mean solver.time_step?"),
        ("picture", "turns", "picture.turns is not a key of [picture]; did you mean picture.camera_path.turns?"),
        ("container", "lid", "container.lid is not a key of [container]; its keys are shape, lower"),  # of a cup
        (None, "colour", "colour is not a key of the scene; its keys are name, dimension"),  # of many tables
    ],
)
def test_a_key_of_another_table_is_told_where_it_stands(table, key, advice):
    data = good_data()
    (data if table is None else data.setdefault(table, {}))[key] = 1.0
    with pytest.raises(SceneError) as caught:
        scene_from_dict(data, "scene.toml")
    assert str(caught.value).startswith(f"scene.toml: {advice}")


CYLINDER = {"shape": "cylinder", "base": [0, 0], "radius": 1.0, "height": 1.0}
STEP, ALONE = {"kind": "projection", "time_step": 0.001}, "but must be left out, as only the solver"


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        *(
            ({"fluid": [fluid]}, r"^fluid\[0\] is .*, but must be a table\.$")
            for fluid in (np.zeros(2), date(2020, 1, 1), 3, MixtureTable())
        ),
        ({"discretisation": {"spacing": -1}}, r"^discretisation\.spacing is -1, but must be greater than 0 m\.$"),
        ({"fluid": [CYLINDER | {"phase": "water"}]}, "fluid.*shape is 'cylinder'.*2-D"),
        ({"container": CYLINDER}, "container.*shape is 'cylinder'.*2-D"),
        ({"solver": STEP | {"minimum_iterations": 4}}, f'iterations is 4, {ALONE} "pcisph" has it'),
        ({"solver": STEP | {"kind": "pcisph", "iterations": 4}}, f'iterations is 4, {ALONE} "projection" has it'),
        ({"forces": {"viscosity": "pairwise"}, "solver": STEP}, '\'pairwise\', but must be "stress" or "none", as the'),
        ({"phase": [{"name": "water", "density": 1.0}]}, r"phase\[0\].density is not a key .* mean rest_density\?$"),
    ],
)
def test_tables_that_do_not_go_together_are_a_sentence(changes, words):
    with pytest.raises(SceneError, match=words):
        Scene(**plane(**changes))


def test_unreadable_files_are_a_sentence(tmp_path):
    (tmp_path / "latin.toml").write_bytes(b'dimension = 3\nname = "caf\xe9"\n')
    (tmp_path / "made.json").write_text("{}")
    for text in ("", "3", "{", '{"dimension": NaN}', 3000 * "["):
        with one_sentence(error=SceneError):
            Scene.from_json(text)
    reasons = {"absent.toml": "No such file", ".": "directory", "latin.toml": "line 2", "made.json": "Scene.from_json"}
    for name, reason in reasons.items():
        with one_sentence(reason, error=SceneError):
            load_scene(tmp_path / name)


def test_a_scene_may_be_given_by_its_path(scene_file):
    assert Simulation(str(scene_file)).scene == Simulation(scene_file).scene == load_scene(scene_file)
    with pytest.raises(SceneError, match=r"^absent\.toml: the scene cannot be read"):
        Simulation("absent.toml")
    with pytest.raises(InputError, match=r"^scene is 3, but must be a cortado\.Scene or the path of a scene file\.$"):
        Simulation(3)


def test_the_stability_limit_is_the_smallest_of_three():
    still, water = {"gravity": [0, 0], "viscosity": "none"}, {"name": "water", "rest_density": 500, "viscosity": 5000}
    fluid, thick = plane()["fluid"], {"phase": [water], "solver": {"kind": "pcisph", "time_step": 1e-5}}
    oil, above = {"name": "oil", "rest_density": 250, "viscosity": 0.0}, box([0, 0.5], [1, 1], phase="oil")
    stress = 0.5 * 2 / stress_rate(CUBIC_SPLINE, 0.1, 0.2, 2) * 500 / 5000
    viscous = 0.65 * 2 / pairwise_rate(CUBIC_SPLINE, 0.1, 0.2, 2) * 500 / 5000
    for tables, wanted in [
        ({"forces": still}, np.inf),
        ({"forces": still, "fluid": [fluid[0] | {"velocity": [3.0, 4.0]}]}, 0.4 * 0.2 / 5.0),
        ({"container": box([0, 0], [1, 2])}, 0.4 * 0.2 / sqrt(2 * 9.81 * 2)),
        ({"fluid": [box([0, 0], [1, 0.1], phase="water")]}, 0.25 * sqrt(0.2 / 9.81)),
        (thick, stress),
        (thick | {"forces": {"gravity": [0, 0], "viscosity": "pairwise"}}, viscous),
        (thick | {"phase": [water, oil], "fluid": [*fluid, above]}, stress / 2),
        (thick | {"phase": [water, oil]}, stress),
    ]:
        assert stability_limit(Scene(**plane(**tables))) == pytest.approx(wanted)


def test_a_large_time_step_is_a_warning():
    with silent():
        limit = stability_limit(Scene(**plane()))
        Scene(**plane(solver={"kind": "pcisph", "time_step": limit}))
    sentence = r"solver\.time_step is .* s, but the limit of stability is .* s, which comes from \w+\."
    with pytest.warns(CortadoWarning, match=sentence):
        Scene(**plane(solver={"kind": "pcisph", "time_step": 1.01 * limit}))


def lock_exchange(time_step):
    """Heavy fluid beside light fluid, 40 spacings deep."""
    phases = [
        {"name": name, "rest_density": rho, "viscosity": 0.001} for name, rho in (("salt", 1200), ("fresh", 1000))
    ]
    fluid = [box([0.0, 0.0], [0.2, 0.4], phase="salt"), box([0.2, 0.0], [0.4, 0.4], phase="fresh")]
    return pool(
        [0.4, 0.4], [0.4, 0.4], 0.01, phase=phases, fluid=fluid, solver={"kind": "pcisph", "time_step": time_step}
    )


def test_a_step_too_long_for_deep_fluid_is_warned_of():
    with pytest.warns(CortadoWarning, match=r"limit of stability is about 0\.00144 s, which comes from depth"):
        scene = lock_exchange(0.002)
    with pytest.raises(DivergedError, match=r"depth limits the time step to about 0\.0014 s, but it is 0\.002 s"):
        Simulation(scene).run(60)
    with silent():
        shorter = lock_exchange(0.0014)
    assert Simulation(shorter).run(60).positions[-1].max() < 0.42


def test_the_depth_is_that_of_the_fluid():
    down, slope = {"gravity": [0, -9.81]}, {"gravity": [9.81 * sin(0.3), -9.81 * cos(0.3)]}
    for slabs, forces, wanted in [
        ([(0, 1)], down, 1.0),
        ([(1, 2), (0, 1)], down, 2.0),
        ([(0, 1), (3, 3.5)], down, 1.5),
        ([(0, 1)], slope, cos(0.3) + 0.5 * sin(0.3)),
        ([(0, 1)], {"gravity": [0, 0]}, 0.0),
        ([(0, 1)], down | {"pressure": False}, 0.0),
    ]:
        fluid = [box([0, lower], [1, upper], phase="water") for lower, upper in slabs]
        tables = {"container": box([0, 0], [1, 4]), "solver": {"kind": "pcisph", "time_step": 1e-5}, "forces": forces}
        limit = stability_limits(Scene(**plane(fluid=fluid, **tables)))["depth"]
        assert 1.8 * 0.1**1.5 / sqrt(9.81) / limit == pytest.approx(wanted)


@pytest.mark.parametrize("deep, before, times", [(50, 1.9e-3, 2.0), (100, 0.66e-3, 3.0), (200, 0.23e-3, 4.2)])
def test_steps_are_in_proportion_to_the_spacing(deep, before, times):
    """Of water that covers the floor, of a dam, and of a tank that lies on its side."""
    up = {"gravity": [0.0, -9.81]}

    def depth(width=1.0, forces=up):
        box = {"shape": "box", "lower": [0.0, 0.0], "upper": [1.0, 1.0]}
        given = {"fluid": [{**box, "phase": "water"}], "container": {**box, "upper": [width, 1.2]}, "forces": forces}
        own = {"kind": "projection", "time_step": 1e-5}
        scene = Scene(**plane(**given, solver=own, discretisation={"spacing": 1.0 / deep}))
        return stability_limits(scene)["depth"], stability_limit(scene)

    (resting, least), (running, _) = depth(), depth(3.0)
    assert resting == least == pytest.approx(0.63 / deep / sqrt(9.81)) and least >= times * before
    assert running == pytest.approx(0.4 / deep / sqrt(9.81))
    assert depth(forces={"gravity": [9.81, 0.0]})[0] == pytest.approx(running), "it has room above"
    assert depth(forces={"gravity": [0.0, 0.0]})[0] == np.inf


@pytest.mark.parametrize("form", ["stress", "pairwise"])
@pytest.mark.parametrize("kernel, support", [("cubic_spline", 2.0), ("wendland_c4", 3.0)])
def test_the_viscous_limit_is_where_steps_begin_to_fail(kernel, support, form):
    """A drop falls on a floor in the same way at the limit and at half of it; with three times the step it does not."""
    drop = {"shape": "sphere", "centre": [0.16, 0.1], "radius": 0.08, "velocity": [0, -2.0]}
    tables = {"discretisation": {"spacing": 0.02, "kernel": kernel, "support": support}, "forces": {"viscosity": form}}
    room, solver = box([0, 0], [0.32, 0.32], slip="no"), {"kind": "pcisph", "time_step": 1e-5}
    scene = bodies(2, [drop], room, viscosity=30.0, solver=solver, **tables)
    limit = stability_limits(scene)["viscosity"]

    def speed(time_step):
        run = Simulation(scene, precision="float64").run(round(0.15 / time_step), {"time_step": time_step})
        return np.abs(run.velocities[-1]).max()

    with silent(MassWarning):
        assert speed(limit) < max(2.0 * speed(0.5 * limit), 0.2)
    advice = r"viscosity limits the time step to about .* s, but it is .* s: try"
    with pytest.warns(CortadoWarning, match="from viscosity"), pytest.raises(DivergedError, match=advice):
        speed(3.0 * limit)


@pytest.mark.parametrize(
    "kind, periodic, given, jitter",
    [
        ("projection", [True, True], {}, 0.05),
        ("projection", [True, True], {"jitter": 0.0}, 0.0),
        ("projection", [True, False], {}, 0.0),
        ("pcisph", [True, True], {}, 0.0),
    ],
)
def test_fluid_without_walls_or_surface_is_jittered_with_the_projection(kind, periodic, given, jitter):
    tables = {"container": box([0, 0], [1, 1], periodic=periodic), "forces": {"gravity": [0, 0]}}
    solver, cut = {"kind": kind, "time_step": 0.001}, {"spacing": 0.1, **given}
    made = Scene(**plane(solver=solver, discretisation=cut, **tables))
    assert made.discretisation.jitter == jitter and Scene.from_json(made.to_json()) == made


@pytest.mark.parametrize("form, told", [("stress", 0), ("pairwise", 1)])
def test_forms_that_are_not_as_viscous_as_asked_are_told_once(form, told):
    """Where walls hold the fluid back, and where the viscosity is a parameter of a problem."""
    forces = {"gravity": [0, -9.81], "viscosity": form}
    held = {"shape": "box", "lower": [0, 0], "upper": [1, 1], "slip": "no"}

    def sentences(said, words):
        found = [one for one in said if "as viscous as asked for" in one]
        assert all(words in one and "0.6 to 1.4 times" in one and 'viscosity = "stress"' in one for one in found)
        return len(found)

    with warned() as said:
        Scene(**plane(forces=forces, container=held))
    assert sentences(said, 'slip is "no" at walls') == told
    with warned() as said:
        simulation = Simulation(Scene(**plane(forces=forces, solver={"kind": "pcisph", "time_step": 1e-4})))
        problem = Problem(simulation, 2, CentreOfMass([0.0, 0.0]))
        problem.value({"viscosity": 0.2})
        problem.value_and_gradient({"gravity": [0.0, -9.81]})
    assert sentences(said, "") == 0
    with warned() as said:
        for viscosity in 0.2, 0.3:
            problem.value_and_gradient({"viscosity": viscosity})
            problem.tangent({"viscosity": viscosity}, {"viscosity": 1.0})
    assert sentences(said, "the viscosity is a parameter") == told


@pytest.mark.parametrize(
    ("solver", "given", "kernel", "support"),
    [
        ({"kind": "pcisph"}, {}, "cubic_spline", 2.0),
        ({"kind": "projection"}, {}, "wendland_c2", 2.6),
        ({}, {}, "wendland_c2", 2.6),
        ({}, {"kernel": "wendland_c4", "support": 3.0}, "wendland_c4", 3.0),
        ({"kind": "projection"}, {"support": 2.5}, "cubic_spline", 2.5),
        ({"kind": "projection"}, {"kernel": "cubic_spline"}, "cubic_spline", 2.0),
    ],
)
def test_a_scene_that_names_no_kernel_has_that_of_its_solver(solver, given, kernel, support):
    cut = {"spacing": 0.1, **given}
    for discretisation in (cut, DiscretisationTable(**cut)):
        scene = Scene(**plane(discretisation=discretisation, solver={"time_step": 0.001, **solver}))
        assert scene.solver.kind == solver.get("kind", "projection")
        assert (scene.discretisation.kernel, scene.discretisation.support) == (kernel, support)
        assert Scene.from_json(scene.to_json()) == scene
