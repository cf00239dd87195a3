"""Sheets, walls of no thickness: what they hide, that they hold water and let nothing through, and derivatives."""

import os
from itertools import pairwise

import numpy as np
import pytest
import trimesh
import warp as wp

from baffles import held, two_levels
from cortado import DivergedError, Problem, SceneError, Simulation
from cortado.device.precision import FLOAT32, FLOAT64
from cortado.discretise.shapes import in_space, launch_on_cpu
from cortado.discretise.sheet import Sheet, Thickened
from cortado.discretise.solid import enclosed_moments, rotation_matrix
from cortado.discretise.tree_kernels import faces_on, find_crossing
from cortado.losses import CentreOfMass
from cortado.particles.sheets import Sheets
from cortado.pictures.shown_solids import shown_solids
from cortado.scene.discrete_scene import discretise
from cortado.scene.motions import wall_numbers
from cortado.solvers.projection.sides import NEAREST, Sides
from scenes import box, simulated
from test_moving_solids import WATER, plane, space
from test_solid_parameters import BALL, STEPS, check, check_batch, point_of, problem_of

BLADE = {"name": "blade", "shape": "sheet", "corners": [[0.2, 0.2], [0.35, 0.2], [0.4, 0.3]], "slip": "no"}
BLADE |= {"motion": "path", "angular_velocity": 6.0, "velocity": [0.2, 0.1]}
BAFFLE = {"name": "baffle", "shape": "sheet", "corners": [[0.5, -0.05], [0.5, 0.25]], "slip": "no"}
BENT = {**BAFFLE, "corners": [[0.15, 0.1], [0.3, 0.2], [0.15, 0.25], [0.35, 0.3]]}
WEDGE = {**BLADE, "name": "wedge", "corners": [[0.15, 0.1], [0.3, 0.2], [0.15, 0.25], [0.35, 0.3]]}
FLAP = {"name": "flap", "shape": "sheet", "motion": "path", "velocity": [0.3, 0.1, 0.0], "slip": "no"}
FLAP |= {"angular_velocity": [0.0, 1.0, 3.0]}
FLAP |= {"corners": [[0.2, 0.1, 0.1], [0.2, 0.1, 0.3], [0.2, 0.35, 0.3], [0.2, 0.35, 0.1]]}
SLIPPERY = box([0.0, 0.0], [1.0, 1.0])
SCENES = {
    "plane": lambda: plane(BLADE, BAFFLE, container=SLIPPERY),
    "at rest": lambda: plane(BENT, BALL),
    "wedge": lambda: plane(WEDGE),
    "space": lambda: space(solid=[FLAP]),
}


def placed(table, dimension):
    """The sheet of a table where it begins."""
    return table.own_solid().placed(table.middle(), table.turn(dimension))


def turned(rotation):
    """The matrix of a rotation vector, or of an angle in the plane."""
    return rotation_matrix(tuple(np.atleast_1d(rotation)))


def crossing(starts, ends, sheet, wider=0.0):
    """The same as `Sheet.crossed`, by where each segment meets each edge or triangle, some ``wider`` [m]."""
    found = np.zeros(len(starts), dtype=bool)
    for corners, normal in zip(sheet.pieces, sheet.normals, strict=True):
        above, below = ((points - corners[0]) @ normal for points in (starts, ends))
        meets = (above < 0.0) != (below < 0.0)
        places = starts + (above / np.where(meets, above - below, 1.0))[:, None] * (ends - starts)
        for first, second in zip(corners, np.roll(corners, -1, axis=0), strict=True):
            inwards = second - first if len(corners) == 2 else np.cross(normal, second - first)
            meets &= (places - first) @ inwards >= -wider * np.linalg.norm(inwards)
        found |= meets
    return found


def lists_of(simulation):
    """Of each particle, in the scene's order, the set of its neighbours in the last step, and that of its wall
    particles; and the places and the solids of all wall particles."""
    search, n = simulation.solver.search, simulation.particles
    order, rows = search.order.numpy()[:n], search.neighbours.numpy()
    ends = [array.numpy() for array in (search.fluid_count, search.filling, search.count)]
    walls = search.walls["wall_positions"].numpy(), search.walls["wall_solids"].numpy()
    fluid, beside = [set() for _ in range(n)], [set() for _ in range(n)]
    for i, (filled, filling, count) in enumerate(zip(*ends, strict=True)):
        fluid[order[i]] = set(order[rows[: filled - filling, i]].tolist())
        beside[order[i]] = set(rows[filled:count, i].tolist())
    return fluid, beside, walls


@pytest.mark.parametrize("make", [SCENES["plane"], SCENES["space"]], ids=["plane", "space"])
def test_what_is_hidden_is_what_segments_through_sheets_say(make):
    """With pairs and solved equations, in the first step; and some of it is hidden, of particles and of walls."""
    scene, d = make().replaced("discretisation.jitter=0.1"), make().dimension
    simulation = simulated(scene)
    run = simulation.run(1)
    fluid, beside, (places, solids) = lists_of(simulation)
    x = simulation.positions
    sheets = {wall_numbers(scene.solid)[table.name]: placed(table, d) for table in scene.solid}
    places = places[:, :d].copy()
    for number, table in enumerate(one for one in scene.solid if one.moves):  # where they were before the step
        own = solids == number
        after = run.solids[table.name].positions[-1], run.solids[table.name].rotations[-1]
        turn = turned(after[1])
        places[own] = table.middle() + (places[own] - after[0]) @ turn
    without = Simulation(scene, precision="float64")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Sheets, "hide", lambda *_, **__: None)
        without.run(1)
        everything = lists_of(without)
    hidden = [0, 0]
    for i in range(simulation.particles):
        others, walls = (sorted(lists[i]) for lists in everything[:2])
        through = {number: crossing(np.tile(x[i], (len(others), 1)), x[others], one) for number, one in sheets.items()}
        seen = ~np.any(list(through.values()), axis=0)
        assert fluid[i] == {j for j, sees in zip(others, seen, strict=True) if sees}
        starts = np.tile(x[i], (len(walls), 1))
        through = {number: crossing(starts, places[walls], one) for number, one in sheets.items()}
        wanted = [all(through[number][k] == (number == solids[b]) for number in sheets) for k, b in enumerate(walls)]
        assert beside[i] == {b for b, sees in zip(walls, wanted, strict=True) if sees}
        hidden[0] += len(others) - len(fluid[i])
        hidden[1] += len(walls) - len(beside[i])
    assert min(hidden) > 50


def test_two_levels_are_held_and_the_sheet_bears_their_difference():
    moved, speed, load, across = held(150)
    assert across == 0 and moved < 0.05 and speed < 0.08 and abs(load - 1.0) < 0.02


def test_water_that_sees_through_is_found_by_that(monkeypatch):
    """The walls of both sides push what is on the other side."""
    monkeypatch.setattr(Sheets, "hide", lambda *_, **__: None)
    with pytest.raises(DivergedError):
        held(100)


def through(steps, speed):
    """How many particles go through a blade that moves by a fifth of a spacing a step, in fluid that is hurled, and how
    near they come to it, in spacings."""
    scene = plane({**BLADE, "corners": [[0.1, 0.2], [0.5, 0.2]], "velocity": [0.0, 0.0], "angular_velocity": 50.0})
    simulation, table = Simulation(scene, precision="float64"), scene.solid[0]
    thrown = speed * np.random.default_rng(1).normal(size=simulation.positions.shape)
    run = simulation.run(steps, {"initial_velocities": thrown})
    motion, found, nearest = run.solids["blade"], 0, np.inf
    sheet, spacing = table.own_solid(), scene.discretisation.spacing
    frames = [
        (x - middle) @ turned(angle)
        for x, middle, angle in zip(run.positions, motion.positions, motion.rotations, strict=True)
    ]
    for before, after in pairwise(frames):
        found += int(sheet.crossed(before, after, spacing).sum())
        nearest = min(nearest, float(sheet.distance(after).min()) / spacing)
    return found, nearest


def test_nothing_goes_through_a_moving_sheet_however_fast_it_comes(monkeypatch):
    found, nearest = through(60, 30.0)
    assert found == 0 and nearest >= NEAREST * (1.0 - 1e-9)
    monkeypatch.setattr(Sides, "keep", lambda self, step, x_now: x_now)
    assert through(20, 30.0)[0] > 0


def hurled(scene, speed, seed=0):
    """The parameters of solids with first velocities, and directions."""
    simulation = simulated(scene)
    point, along = point_of(scene, seed=seed)
    random, shape = np.random.default_rng(5), simulation.positions.shape
    spacing = scene.discretisation.spacing
    point["initial_positions"] = simulation.positions + 0.05 * spacing * random.normal(size=shape)
    point["initial_velocities"] = speed * random.normal(size=shape)
    along |= {"initial_positions": 1e-3 * random.normal(size=shape)}
    along |= {"initial_velocities": 0.1 * random.normal(size=shape)}
    return point, along


def kept_back(scene, point):
    """How many particles steps keep back, and leave where they were."""
    counts, keep, spacing = np.zeros(2, dtype=int), Sides.keep, scene.discretisation.spacing

    def counting(self, step, x_now):
        kept = keep(self, step, x_now)
        moved = np.linalg.norm(kept.numpy() - x_now.numpy(), axis=1)
        counts[:] += (moved > 0.0).sum(), (moved > 0.8 * spacing).sum()
        return kept

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Sides, "keep", counting)
        Simulation(scene, precision="float64").run(STEPS, point)  # one that has not captured its launches
    return counts


@pytest.mark.parametrize(("name", "speed"), [("plane", 30.0), ("at rest", 30.0), ("wedge", 40.0), ("space", 10.0)])
def test_derivatives_are_right_where_particles_are_kept_on_their_side(name, speed):
    """Also with a calm fluid: see the solids of tests/test_solid_parameters.py."""
    scene = SCENES[name]()
    point, along = hurled(scene, speed)
    kept, left = kept_back(scene, point)
    assert kept > 1 and (left > 0 or name in ("plane", "space"))
    check(problem_of(scene), point, along)


def test_a_batch_and_a_run_that_goes_on_have_the_bits_of_single_runs():
    scene = SCENES["plane"]()
    check_batch(scene, [hurled(scene, 10.0, seed)[0] for seed in range(2)])
    one = simulated(scene)
    whole = one.run(6)
    rest = one.run(4, state=one.run(2).last_state)
    np.testing.assert_array_equal(rest.positions[-1], whole.positions[-1])


def test_the_open_mesh_of_a_file_is_the_sheet_between_its_corners(tmp_path):
    """Of two triangles; and the distances from it are those of a thin box, up to its thickness."""
    corners = np.array(FLAP["corners"])
    path = tmp_path / "flap.stl"
    trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False).export(path)
    told = {name: value for name, value in FLAP.items() if name != "corners"}
    one, other = (space(solid=[solid]) for solid in (FLAP, {**told, "file": str(path)}))
    points = np.random.default_rng(0).uniform(0.0, 0.5, (200, 3))
    sheet = placed(one.solid[0], 3)
    np.testing.assert_allclose(sheet.distance(points), placed(other.solid[0], 3).distance(points), atol=1e-7)
    beyond = np.maximum(np.abs(points - [0.2, 0.225, 0.2]) - [0.0, 0.125, 0.1], 0.0)
    np.testing.assert_allclose(sheet.distance(points), np.linalg.norm(beyond, axis=1), atol=1e-12)
    np.testing.assert_allclose(discretise(one).walls.weights.sum(), discretise(other).walls.weights.sum(), rtol=0.02)


def test_water_beside_a_sheet_has_the_rest_density_and_begins_off_it():
    """Within 2 %, but for what is beside a floor or a tip; and no particle is nearer than a quarter of a spacing."""
    simulation = Simulation(two_levels(), precision="float64")
    x, spacing = simulation.positions, 0.025
    beside = (np.abs(x[:, 0] - 0.5) < 2.0 * spacing) & (x[:, 1] > 3.0 * spacing)
    densities = simulation.quantity("density")
    np.testing.assert_allclose(densities[beside & (x[:, 1] < 0.15)], 1000.0, rtol=0.02)
    for at in (0.5, 0.5125, 0.52):
        sheet = {"name": "baffle", "shape": "sheet", "corners": [[at, -0.1], [at, 0.75]]}
        cut = discretise(two_levels(fluid=[box([0.0, 0.0], [1.0, 0.25], phase="water")], solid=[sheet]))
        assert np.abs(cut.fluid.positions[:, 0] - at).min() > 0.249 * spacing


def test_pictures_show_a_sheet_as_a_thin_solid():
    for make in (SCENES["plane"], SCENES["space"]):
        shown = shown_solids(make())[0]
        thick = shown.shape.depth
        assert isinstance(shown.shape, Thickened) and 0.0 < thick < 0.25 * make().discretisation.spacing
        faces = shown.shape.faces(1.0)
        away = shown.shape.sheet.distance(faces.vertices) / thick
        assert 0.7 < away.min() <= away.max() < 1.0 + 1e-6
        assert enclosed_moments(faces.vertices[faces.corners], np.ones(len(faces.corners))).volume > 0.0


def crumpled(dimension, random, size):
    """A sheet with sharp joints, of six edges or twelve triangles, about a metre large; and its middle somewhere."""
    shape = (7,) if dimension == 2 else (4, 3)
    numbers = np.arange(np.prod(shape)).reshape(shape)
    places = np.stack([*np.indices(shape), np.zeros(shape)], axis=-1).reshape(numbers.size, -1) / 4.0
    vertices = places + random.uniform(-0.1, 0.1, places.shape) + size * random.uniform(-1.0, 1.0, dimension)
    if dimension == 2:
        return Sheet.along(vertices)
    a, b, c, d = (part.ravel() for part in (numbers[:-1, :-1], numbers[1:, :-1], numbers[1:, 1:], numbers[:-1, 1:]))
    return Sheet(vertices, np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)]))


def places_on(sheet, random, count):
    """Places (count, d) on a sheet: a third each on its faces, its joints and edges, and its corners; and normals."""
    piece, d = random.integers(len(sheet.pieces), size=count), sheet.vertices.shape[1]
    weights = random.dirichlet(np.ones(d), size=count)
    weights[: 2 * count // 3, 0] = 0.0
    weights[: count // 3] = np.eye(d)[0]
    weights = random.permuted(weights / weights.sum(axis=1, keepdims=True), axis=1)
    return np.einsum("na,nad->nd", weights, sheet.pieces[piece]), sheet.normals[piece]


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("precision", [FLOAT32, FLOAT64], ids=["float32", "float64"])
def test_no_segment_sees_through_a_crumpled_sheet(dimension, precision):
    """Of 50,000, most of which go through joints and corners within round-off. Whoever is on the sheet itself sees one
    side of it at most; only beyond its edges segments are free. With margins of 1e-6 spacings in float32 many saw."""
    random, spacing, n = np.random.default_rng(dimension), 0.05, 10_000
    near = {"float32": 3e-3, "float64": 1e-5}[precision.name] * spacing

    def hidden(sheet, starts, ends):
        faces, _trees = faces_on([(sheet.pieces, sheet.normals)], spacing, precision, wp.get_device("cpu"))
        segments = {"starts": starts, "ends": ends}
        given = {name: wp.array(in_space(x), dtype=precision.vector, device="cpu") for name, x in segments.items()}
        found = np.zeros(len(starts), dtype=bool)
        launch_on_cpu(find_crossing(precision), len(starts), faces=faces, found=found, **given)
        return found

    for size in (0.0, 1.0, 1.0, 5.0, 5.0):
        sheet = crumpled(dimension, random, size)
        at, normals = places_on(sheet, random, n)
        way = random.normal(size=at.shape)
        way *= (random.uniform(0.1, 2.6, n) * spacing / np.linalg.norm(way, axis=1))[:, None]
        part, off = random.uniform(size=(n, 1)), 10.0 ** -random.uniform(5.0, 15.0, (n, 1))
        starts, ends = (at + off * random.normal(size=at.shape) + share * way for share in (-part, 1.0 - part))
        planes = [*zip(sheet.pieces[:, 0], sheet.normals, strict=True)]
        heights = [(points - corner) @ normal for points in (starts, ends) for corner, normal in planes]
        clear, found = np.abs(heights).min(axis=0) > near, hidden(sheet, starts, ends)
        through = crossing(starts, ends, sheet)
        assert (clear & through).sum() > n // 2 and found[clear & through].all()
        assert not found[clear & ~crossing(starts, ends, sheet, near)].any()
        above, below = at + 0.5 * spacing * normals, at - 0.5 * spacing * normals
        assert (hidden(sheet, at, above) | hidden(sheet, at, below)).all() and hidden(sheet, above, below).all()


def test_a_sheet_across_an_emitters_column_is_a_sentence():
    """Not so one that stands two spacings before its opening, or beside it."""
    spout = {"phase": "water", "outlet": [0.5, 0.6], "direction": [0.0, -1.0], "radius": 0.08, "length": 0.2}
    spout |= {"flow_rate": 0.2}

    def made(lower, upper, **more):
        return plane({"name": "lip", "shape": "sheet", "corners": [lower, upper], **more}, emitter=[spout])

    wanted = r"emitter\[0\] is crossed by the sheet 'lip', but must be clear of sheets from the end of its column"
    for height in (0.58, 0.75):
        with pytest.raises(SceneError, match=wanted):
            made([0.55, height], [0.7, height])
    turned_in = {"motion": "path", "rotation": 0.5 * np.pi, "velocity": [0.0, 0.0]}
    with pytest.raises(SceneError, match=wanted):
        made([0.5, 0.5], [0.5, 0.9], **turned_in)
    made([0.4, 0.5], [0.6, 0.5])
    made([0.6, 0.5], [0.6, 0.9])


REST = {"discretisation": {"spacing": 0.05}}


@pytest.mark.parametrize("name", ["sheet", "container"])
def test_water_let_go_at_rest_has_derivatives_that_differences_confirm(name):
    """Beside upright walls the divergence of what falls is round-off. Where a step decided of it, slopes of both sides
    were 0.05 off, and beside the sheet their mean was 0.012 off too."""
    scene = two_levels(**REST) if name == "sheet" else two_levels(**REST, solid=[])
    problem = Problem(simulated(scene), 1, CentreOfMass([0.3, 0.3]))
    random, still = np.random.default_rng(0), np.zeros_like(problem.simulation.positions)
    direction = random.normal(size=still.shape)
    value, gradient = problem.value_and_gradient({"initial_velocities": still})
    slope, h = np.sum(gradient["initial_velocities"] * direction), 1e-6
    ahead, behind = (problem.value({"initial_velocities": sign * h * direction}) for sign in (1.0, -1.0))
    assert (ahead - behind) / (2.0 * h) == pytest.approx(slope, rel=1e-5)
    assert (ahead - value) / h == pytest.approx(slope, rel=0.03)


CORNERS = {"corners": [[0.3, 0.1], [0.3, 0.3]]}


def test_a_sheet_that_cannot_be_is_a_sentence():
    for make, sentence in [
        (lambda: {}, r"solid\[0\]\.corners is missing, but must be a list of corners, or a file in its place"),
        (lambda: {"corners": [[0.3, 0.1]]}, r"solid\[0\]\.corners is .*, but must be a list of at least 2"),
        (lambda: {"corners": [[0.3, 0.1], [0.3, 0.1]]}, r"corners\[1\] is .* different from the corner before"),
        (lambda: {"corners": [[0.3, 0.1, 0.0], [0.3, 0.2, 0.0]]}, r"corners\[0\] is .* a list of 2 coordinates"),
        (lambda: {**CORNERS, "file": "a.stl"}, r"corners is given, but must be a list of corners, or a file"),
        (lambda: {"file": "a.stl"}, r"file is .* left out in 2-D"),
        (
            lambda: {**CORNERS, "side": "inside"},
            r"side is 'inside', but must be left out, as a sheet has fluid",
        ),
        (lambda: {**CORNERS, "motion": "free", "density": 9.0}, r'motion is .* must be "fixed" or "path", as a sheet'),
        (lambda: {**CORNERS, "surface_velocity": [1.0, 0.0]}, r"surface_velocity is .* left out, as a sheet"),
    ]:
        with pytest.raises(SceneError, match=sentence):
            plane({"name": "one", "shape": "sheet", **make()})


def test_what_does_not_know_of_sheets_is_a_sentence():
    for tables, sentence in [
        (
            {"solver": {"kind": "pcisph", "time_step": 0.001}},
            r'solver\.kind is .* "projection", as the solid \'baffle\'',
        ),
        ({"forces": {"pressure": False}}, r"forces\.pressure is False, but must be true"),
        (
            {"container": box([0.0, 0.0], [1.0, 1.0], periodic=[True, False])},
            r"container\.periodic\[0\] is True, but must be false, .* sheets have no periodic images",
        ),
    ]:
        with pytest.raises(SceneError, match=sentence):
            plane(BAFFLE, **tables)


def test_free_bodies_beside_sheets_and_corners_off_a_plane_are_sentences(tmp_path):
    body = box([0.2, 0.5], [0.3, 0.6], name="body", motion="free", density=300.0)
    with pytest.raises(SceneError, match=r"solid\[1\]\.motion is 'free', but must be .* through which bodies go"):
        plane(BAFFLE, body, phase=[WATER])
    with pytest.raises(SceneError, match=r"corners is .* the corners of a flat convex polygon, once around"):
        space(solid=[{**FLAP, "corners": [*FLAP["corners"][:3], [0.25, 0.35, 0.1]]}])
    with pytest.raises(SceneError, match=r"corners is .* the corners of a flat convex polygon, once around"):
        space(solid=[{**FLAP, "corners": [*FLAP["corners"], *FLAP["corners"]]}])
    flat = tmp_path / "flat.obj"
    flat.write_text("v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n")
    with pytest.raises(SceneError, match=r"file cannot be used: .*flat\.obj has no triangle with an area"):
        space(solid=[{**FLAP, "corners": None, "file": str(flat)}])
    with pytest.raises(SceneError, match=r"corners is .* a list of at least 3 corners in 3-D"):
        space(solid=[{**FLAP, "corners": FLAP["corners"][:2]}])
    with pytest.raises(SceneError, match=r"file cannot be used: .*nothing\.stl' cannot be opened"):
        space(solid=[{**FLAP, "corners": None, "file": "nothing.stl"}])


@pytest.mark.parametrize("shape", ["sheet", "mesh"])
def test_a_file_that_was_replaced_is_read_again(tmp_path, shape):
    file = tmp_path / "part.stl"
    for upper in (0.5, 0.6):
        trimesh.creation.box(bounds=[[0.3] * 3, [upper] * 3]).export(file)
        os.utime(file, (upper, upper))
        table = space(solid=[{"name": "part", "shape": shape, "file": str(file)}])
        found = table.room.solids[0] if shape == "mesh" else table.solid[0].solid()
        np.testing.assert_allclose(found.extent()[1], upper, rtol=1e-6)
