"""A sign flipped in any term of any adjoint, one at a time, is found by the certificate (`planting` flips them)."""

import json
import os
import site
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest

import cortado
from cortado.particles.particle_kernels import MADE
from planting import adjoints, plant_all
from scenes import CUBIC, HONEY, MIXING, OIL, box, plane, scene
from test_faces import channel
from test_free_bodies import BRICK, rough
from test_free_bodies import RAFT as FLOATING
from test_free_bodies import plane as afloat
from test_free_bodies import space as afloat_in_space
from test_moving_solids import plane as solids_in_water
from test_sheets import BAFFLE, BLADE

ROOT = Path(cortado.__file__).parent

UNNAMED = {
    "sph.parts": {"integration_kernels.collect_masses"},
    "sph.curvature": {
        *("curvature_sums.colour_back", "curvature_sums.average_back"),
        *("curvature_sums.bend_back", "curvature_sums.mean_back"),
    },
    "sph.viscous_stress": {"implicit_kernels.weigh", "implicit_kernels.unweigh"},
    "solvers.projection.effects": {f"image_sums.{name}_back" for name in ("lift", "mirror_walls", "behind")},
    "solvers.projection.coarse_push": {"coarse_sums.push_back", "coarse_image_sums.push_back"},
    "solvers.projection.sums": {
        *("projection_sums.moments_back", "projection_sums.force_back"),
        *("projection_sums.divergence_back", "projection_sums.velocity_gradient_back", "projection_sums.push_back"),
    },
    "solvers.projection.wall_sums": {
        *("beside_sums.beside_back", "beside_term.beside_work", "face_share_kernel.face_share"),
    },
    "solvers.projection.repair": {"repair_term.repair_work"},
    "solvers.projection.bodies": {"body_kernels.push_back"},
    "solvers.pcisph.pressure": {"pressure_term.pressure_work"},
    "particles.wall_terms": {"solid_kernel.share"},
    "sph.viscosity": {"viscosity_term.made.viscosity_work"},
    "sph.friction_kernels": {f"row_kernels.{name}" for name in ("take", "heed", "answer")},
    "sph.density": {"_density_work.density_work", "_work.wall_slope_work"},
    "sph.formula": {"packing_kernels.add"},
    "sph.stress_kernels": {*("moments_work.moments_work", "moment_sums.moments_back", "moment_sums.wall_moments_back")},
    "sph.stress_forces": {
        *("stress_sums.traction_back", "stress_sums.wall_traction_back"),
        *("stress_sums.force_back", "stress_sums.wall_force_back", "stress_work.stress_work"),
    },
}
"""Functions of adjoints, by module, whose names do not say so."""
SHARED = {
    "particles.neighbourhood": {"pair_functions.factor_gradient", "pair_functions.hessian_product"},
    "discretise.smoothing_functions": {"_cubic_spline.hessian_factor", "smoothing_functions.slope_change"},
    "image_losses": {"adjoint", "reduce_transposed"},
    "losses.distances": {"matching_kernels.difference"},
    "render.absorption": {"brightness_functions.brightness_derivative", "absorption_kernels.gather"},
    "render.rays": {"interpolation_functions.trilinear_weight"},
    "sph.free_energy": {"_double_well.hessian_product", "_miscible.hessian_product", "_degenerate.gradient"},
    "sph.moving_solids": {"rotations.further"},
    "particles.moving_walls": {"turn_functions.turning", "turn_functions.leaning"},
    "sph.surface_tension": {"normal_kernels.change"},
    "sph.viscosity": {"viscosity_kernels.pair_viscosity_derivative"},
    "sph.stress_forces": {"contact_functions.hold_gradient"},
}
"""Derivatives that forward mode uses too, and those of pictures, so that only differences can tell."""
ELSEWHERE = {
    "environments.kernels": "of rewards, which are no losses of these scenes: tests/test_environments.py",
    "runs.quantity_formulas.load_kernels.load_adjoint": "of loads, which no loss sees: tests/test_solid_loads.py",
    "sph.formula.reading.read_adjoint": "of arrays of forces of one's own: tests/test_own_arrays.py",
    "sph.function_meaning.meanings.adjoint_of_remainder": "of own functions: tests/test_function_meaning.py",
    "sph.parts.integration_kernels.begin_adjoint": "for solvers from outside: tests/test_solver.py",
    "solvers.projection.mean_stress": "of quantities that no loss of these scenes sees: tests/test_energy_budget.py",
}
"""Modules with functions of adjoints that no plant is in, and single such functions, and why."""
FEWEST = {"functions": 108, "plants": 577}
"""There have been so many; more are planted as the source has more."""

ADJOINTS = {
    module: {name for name in names if f"{module}.{name}" not in ELSEWHERE}
    for module, names in adjoints(ROOT).items()
    if module not in ELSEWHERE
}
PLANTED = {
    module: set().union(*(functions.get(module, ()) for functions in (ADJOINTS, UNNAMED, SHARED)))
    for module in sorted({*ADJOINTS, *UNNAMED, *SHARED})
}

NOZZLE = {"phase": "oil", "outlet": [0.16, 0.24], "radius": 0.05, "length": 0.11, "flow_rate": 0.2}
ROOM, POOL = box([0.0, 0.0], [0.3, 0.6], slip="no"), box([0.0, 0.0], [0.3, 0.2], phase="water")
PHASES = [{"name": "water", "rest_density": 1000.0, "viscosity": 2.0}, {**OIL, "viscosity": 8.0}]
STEADY = {"motion": "path", "slip": "no"}
BALL = {"name": "ball", "shape": "sphere", "centre": [0.15, 0.25], "radius": 0.05, **STEADY}
BALL |= {"velocity": [0.5, -1.0], "angular_velocity": 3.0}
PLATE = box([0.12, 0.02, 0.02], [0.18, 0.12, 0.14], name="plate", rotation=[0.2, -0.3, 0.1], **STEADY)
PLATE |= {"velocity": [-0.5, 0.2, 0.1], "angular_velocity": [2.0, -1.0, 3.0], "surface_velocity": [0.3, -0.2, 0.5]}
RAFT = box([0.2, -0.002], [0.45, 0.18], name="raft", rotation=0.01, motion="free", density=500.0)
RAFT |= {"velocity": [0.1, -0.3], "angular_velocity": 0.5}
BUOY = {"name": "buoy", "shape": "sphere", "centre": [0.52, 0.14], "radius": 0.08, "motion": "free", "density": 300.0}
BUOY |= {"velocity": [-0.3, 0.1], "angular_velocity": -1.0}
ARM = box([0.3, 0.175], [0.36, 0.3], name="arm", motion="path", velocity=[0.0, -0.2])
"""They touch: the raft the floor, the buoy the raft, and the arm, which has a path, the raft."""
IN_SPACE = {
    "raft": {"lower": [0.1, -0.002, 0.05], "upper": [0.25, 0.12, 0.2], "velocity": [0.1, -0.3, 0.1]},
    "buoy": {"centre": [0.18, 0.2, 0.12], "radius": 0.085, "velocity": [0.1, -0.4, 0.1]},
}
TURNS = {"raft": {"rotation": [0.01, 0.02, 0.01], "angular_velocity": [1.0, 2.0, -3.0]}}
TURNS["buoy"] = {"rotation": [0.2, 0.1, -0.3], "angular_velocity": [2.0, -1.0, 1.0]}
LAW = {"kind": "bingham", "yield_stress": 8.0, "regularisation": 0.5}
THICK = {"name": "paste", "rest_density": 1000.0, "viscosity": 8.0, "rheology": LAW}
IMPLICIT = {"gravity": [1.0, -9.81], "viscosity": "stress", "viscous_solve": "implicit"}
PROJECTION = {"kind": "projection", "time_step": 0.002}
SOLVER = {"kind": "pcisph", "time_step": 0.002, "minimum_iterations": 3, "maximum_iterations": 3}


def small(viscosity: str, **changes):
    """24 particles in a pool and a few in a nozzle, in the plane."""
    tables = {"fluid": [POOL], "container": ROOM, "phase": PHASES, "solver": SOLVER, "discretisation": CUBIC}
    tables["forces"] = {"gravity": [1.0, -9.81], "viscosity": viscosity}
    return plane(**{**tables, "emitter": [NOZZLE], **changes})


CAMERA = {"view": "volume", "resolution": [9, 8], "position": [0.7, 0.35, 0.8], "look_at": [0.15, 0.08, 0.15]}
VOLUME = scene(
    phase=PHASES,
    fluid=[box([0.1, 0.0, 0.1], [0.2, 0.05, 0.2], phase="water"), box([0.1, 0.05, 0.1], [0.2, 0.15, 0.2], phase="oil")],
    container=box([0.0] * 3, [0.3] * 3),
    solver=SOLVER,
    render={**CAMERA, "field_of_view": 20.0, "extinction": 12.0},
)
"""12 particles that one can look into: samples of a ray are dense and thin ones."""

STRESS = {"gravity": [1.0, -9.81, 0.5], "viscosity": "stress"}


def touching(make, fluid, room, bodies):
    """Bodies in honey that float against each other, in the plane or in space."""
    low, gravity = [0.0] * len(room), [1.0, -9.81, 0.5][: len(room)]
    tables = {"solver": SHORT, "discretisation": CUBIC, "forces": {"gravity": gravity}, "solid": bodies}
    return make(phase=[HONEY], fluid=[box(low, fluid, phase="honey")], container=box(low, room), **tables)


def block(phase, **tables):
    """In a corner of space, whose walls hold it."""
    walls = box([0.0] * 3, [0.3] * 3, slip="no")
    fluid = [box([0.0] * 3, [0.1, 0.15, 0.15], phase=phase["name"])]
    return scene(phase=[phase], fluid=fluid, container=walls, forces=STRESS, solver=SOLVER, **tables)


def one(viscosity, phase, **changes):
    """The small pool of one phase, without a nozzle."""
    return small(viscosity, phase=[phase], fluid=[{**POOL, "phase": phase["name"]}], emitter=[], **changes)


def pleated():
    """Water hurled at two sheets folded so narrowly that some particles cannot be put beside them."""
    folds = [[[0.05 + 0.45 * (k % 2), low + step * k] for k in range(6)] for low, step in ((0.06, 0.03), (0.27, 0.02))]
    sheets = {**BLADE, "corners": folds[0]}, {**BAFFLE, "corners": folds[1]}
    return solids_in_water(*sheets, container={"shape": "none"})


def open_air(**tables):
    """A square of water in free fall."""
    return plane(fluid=[box([0.2, 0.25], [0.55, 0.6], phase="water")], solver=PROJECTION, **tables)


MISCIBLE = {**MIXING, "free_energy": "miscible", "mobility_form": "constant"}
SHORT = {"kind": "projection", "time_step": 0.001}
TURNED = [{**body, **IN_SPACE[body["name"]], **TURNS[body["name"]]} for body in (RAFT, BUOY)]
SCENES = {
    "pairwise, double well": (small("pairwise", mixture=MIXING), "everything"),
    "pairwise, miscible": (small("pairwise", mixture=MISCIBLE), "everything"),
    "stress": (small("stress"), "everything"),
    "projection": (small("stress", solver=PROJECTION), "everything"),
    "velocities that follow": (small("stress", solver={**PROJECTION, "velocities_follow": True}), "positions"),
    "projection in the open": (
        open_air(discretisation={"spacing": 0.05, "support": 2.6}),  # second rows are neither full nor at the surface
        "positions",
    ),
    "a solid that moves": (one("stress", HONEY, solver=PROJECTION, solid=[BALL]), "positions"),
    "a solid that moves in space": (block(HONEY, solid=[PLATE]), "positions"),
    "free bodies that touch": (touching(plane, [0.6, 0.4], [1.0, 1.0], [RAFT, BUOY, ARM]), "positions"),
    "a face that mirrors": (channel(), "positions"),
    "sheets": (pleated(), "positions"),
    "a rubbed body": (rough(afloat(FLOATING)), "positions"),
    "a rubbed body in space": (rough(afloat_in_space(BRICK)), "positions"),
    "free bodies that touch in space": (touching(scene, [0.35, 0.3, 0.25], [0.5, 0.6, 0.25], TURNED), "positions"),
    "implicit": (one("stress", THICK, forces=IMPLICIT), "positions"),
    "a law in space": (block(THICK), "positions"),
    "one phase": (one("pairwise", HONEY), "positions"),
    "surface tension": (small("pairwise", forces={"gravity": [1.0, -9.81], "surface_tension": 30.0}), "everything"),
    "surface tension by curvature": (  # second rows are a part of the surface, not wholly
        open_air(
            discretisation={"spacing": 0.05, "support": 2.0}, forces={"gravity": [0.0, 0.0], "surface_tension": 100.0}
        ),
        "positions",
    ),
    "a picture of the plane": (small("pairwise", render={"view": "plane", "resolution": [8, 12]}), "pyramid"),
    "a picture of a volume": (VOLUME, "squares"),
}

IN_EVERY_RUN = ("sph.density", "sph.viscosity", "solvers.pcisph.pressure")
"""Modules of adjoints whose plants are looked for in the scene "one phase" alone, but for those of solids' work."""


@cache
def planted(folder: Path) -> list[tuple[str, str, str]]:
    return plant_all(ROOT, folder, PLANTED)


@pytest.fixture(scope="module")
def copy(tmp_path_factory):
    return tmp_path_factory.mktemp("planted")


def test_every_adjoint_is_planted(copy):
    """By at least one term each, and what stands in the lists above is there."""
    plants = planted(copy)
    found = {(module, function) for module, function, _ in plants}
    assert found == {(module, name) for module, names in PLANTED.items() for name in names}
    assert len(found) >= FEWEST["functions"] and len(plants) >= FEWEST["plants"]
    known = adjoints(ROOT)
    assert ELSEWHERE.keys() <= known.keys() | {f"{module}.{name}" for module in known for name in known[module]}


EVERY = {"float64": 1, "float32": 5}
"""One of so many plants, by the precision of the problems that are certified."""


@pytest.fixture(scope="module")
def answers(copy):
    """Of all scenes and plants."""
    plants = planted(copy)
    return answers_of(copy, SCENES, {precision: range(0, len(plants), every) for precision, every in EVERY.items()})


def answers_of(copy, names, chosen):
    """Of a process of its own, which imports the copy: for every plant the scene that gives it away, the scenes whose
    certificate is wrong without a plant, both by precision, and the kernels that scenes launch."""
    request, answer = copy / "request.json", copy / "answer.json"
    scenes = {
        name: {"scene": made.model_dump(mode="json"), "loss": loss}
        for name, (made, loss) in SCENES.items()
        if name in names
    }
    plants = {precision: list(numbers) for precision, numbers in chosen.items()}
    request.write_text(json.dumps({"plants": plants, "scenes": scenes}))
    # Without -S an editable installation would be found before the copy.
    program = [sys.executable, "-S", str(Path(__file__).with_name("planting.py")), str(request), str(answer)]
    path = os.pathsep.join([str(copy), *site.getsitepackages()])
    environment = {"PYTHONPATH": path, "PATH": "", "HOME": str(Path.home())}
    subprocess.run(program, env=environment, check=True, timeout=1200)
    return json.loads(answer.read_text())


def test_plants_of_one_scene_are_found(tmp_path):
    """In the terms of every run: a minute less than all plants of all scenes, which `make test-all` looks for."""
    functions = {module: {name for name in PLANTED[module] if not name.endswith("_work")} for module in IN_EVERY_RUN}
    plants = plant_all(ROOT, tmp_path, functions)
    answers = answers_of(tmp_path, ["one phase"], {"float64": range(len(plants))})
    hidden = [" | ".join(plants[int(number)]) for number, scene in answers["found"]["float64"].items() if scene is None]
    assert len(plants) > 20 and not hidden, "\n".join(hidden)
    assert not answers["alarms"]["float64"]


@pytest.mark.parametrize("precision", EVERY)
def test_every_plant_is_found(copy, answers, precision):
    """In problems in float32, whose certificate is made in float64, a fifth of them."""
    plants, found = planted(copy), answers["found"][precision]
    hidden = [" | ".join(plants[int(number)]) for number, scene in found.items() if scene is None]
    assert len(found) >= len(plants) / EVERY[precision] and not hidden, "\n".join(hidden)


@pytest.mark.parametrize("precision", EVERY)
def test_the_copy_without_a_plant_is_right(answers, precision):
    assert not answers["alarms"][precision]


def test_every_kernel_on_the_way_back_is_planted(answers):
    ours = [*ADJOINTS.values(), *UNNAMED.values()]
    names = {name.split(".")[-1] for functions in ours for name in functions}
    seen = {way: set(keys) for way, keys in answers["launched"].items()}
    by_hand = {key for key in seen["backward"] - seen["forward"] if not key.startswith(MADE)}
    alone = {key.split("__locals__")[-1] for key in by_hand}
    made = {key: key.removesuffix("_share").removesuffix("_whole") for key in alone}  # several times from one text
    alone = {key if key in names else name for key, name in made.items()}
    alone -= {"lift"}  # of the coarse pressure: the way back lifts its multipliers too
    assert alone <= names and len(alone) > 15, alone - names
