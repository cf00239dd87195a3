"""Shaded pictures: what they show, that they show it whatever the order of particles, and that they change nothing."""

import numpy as np
import pytest
import warp as wp

import cortado
from bad_tasks import GOOD_TASK, TINY_SCENE
from cortado.device.launching import BandLauncher, launch
from cortado.discretise.shapes import corners
from cortado.errors import CortadoWarning, InputError, SceneError
from cortado.files.image_encoding import to_srgb
from cortado.losses import FinalPositions
from cortado.pictures import film as shading_film
from cortado.pictures.film import Page, film, lacking
from cortado.pictures.painter import colours_of, labelled, painter, side_by_side
from cortado.pictures.run_pictures import run_pictures
from cortado.pictures.stage import Stage, screen_axes
from cortado.pictures.tracing.solid_surfaces import NODES, FloorShadow
from cortado.pictures.tracing.space import SpacePainter, State, environment_of, particles_of, wetting
from cortado.pictures.tracing.trace import find_contrast
from cortado.runs.frames import Film, Pace, pace_of
from cortado.runs.run_folder import RunFolder
from cortado.scene.appearance import Picture
from scenes import bodies, box

SMALL = {"width": 96, "height": 64}
FILLED = np.array([[0.05, 0.05, 0.05], [0.25, 0.25, 0.25]])
RED, BLUE = (0.8, 0.1, 0.05), (0.05, 0.1, 0.8)


def scene_of(dimension=3, fluids=1, picture=None, **tables):
    """A box with a box of fluid in it, or two of two fluids side by side; 27 particles each in 3-D."""
    phases, fluid, water = [], [], {"rest_density": 1000.0, "viscosity": 0.05}
    for k, (name, colour) in enumerate((("one", BLUE), ("two", RED))[:fluids]):
        phases.append({"name": name, "colour": colour, **water})
        ends = [0.3 * k, 0.0, 0.0][:dimension], [0.3 * (k + 1), 0.3, 0.3][:dimension]
        fluid.append(box(*ends, phase=name))
    container, solver = box([0.0] * dimension, [0.6, 0.5, 0.4][:dimension]), {"kind": "pcisph", "time_step": 0.002}
    given = {"phase": phases, "solver": solver, "picture": {**SMALL, **(picture or {})}, "container": container}
    return bodies(dimension, tables.pop("fluid", fluid), spacing=0.1, **{**given, **tables})


def first_state(scene):
    simulation = cortado.Simulation(scene)
    fractions = simulation.parameters().get("mass_fractions")
    return simulation.positions, colours_of(scene, fractions, simulation.particles)


def drawn(scene, positions=None, colours=None):
    x, c = first_state(scene)
    x, c = x if positions is None else positions, c if colours is None else colours
    return painter(scene, x).image(x, c)


def is_blue(image):
    return image[..., 2] > 1.3 * image[..., 0]


@pytest.mark.parametrize("surface", ["liquid", "spheres"])
@pytest.mark.parametrize("shape", ["box", "cylinder", "none"])
def test_27_particles_are_seen(surface, shape):
    cup = {"shape": "cylinder", "base": [0.15, 0.0, 0.15], "radius": 0.25, "height": 0.5}
    containers = {"box": {}, "none": {"container": {"shape": "none"}}, "cylinder": {"container": cup}}
    scene = scene_of(picture={"surface": surface}, **containers[shape])
    image = drawn(scene)
    assert image.shape == (64, 96, 3) and image.min() >= 0.0 and image.max() <= 1.0
    assert 0.01 < is_blue(image).mean() < 0.65
    if shape == "box":  # the fluid, in the left lower part of it, is there in the picture too
        rows, columns = np.nonzero(is_blue(image))
        assert rows.mean() > 34 and columns.mean() < 46
    if shape == "cylinder":
        image = painter(scene, FILLED).image(np.zeros((0, 3)), np.zeros((0, 3)))
        assert not is_blue(image).any() and 0.02 < image.std() < 0.3


def test_the_camera_goes_where_the_scene_says():
    scene = scene_of(picture={"camera": [0.3, 0.2, 3.0], "look_at": [0.3, 0.2, 0.2]})
    stage = Stage.of(scene, FILLED)
    np.testing.assert_allclose(stage.placed(np.array([[0.3, 0.2, 3.0], [0.3, 0.2, 0.2]])), [stage.eye, stage.look_at])
    assert np.nonzero(is_blue(drawn(scene)))[1].max() < 52  # the fluid is on the left of x = 0.3


def test_two_fluids_have_their_colours():
    image = drawn(scene_of(fluids=2))
    assert (image[..., 2] > 3.0 * image[..., 0]).mean() > 0.02
    assert (image[..., 0] > 3.0 * image[..., 2]).mean() > 0.02


def test_fluid_that_left_a_periodic_plane_is_seen_where_it_comes_back():
    scene = scene_of(2, fluids=2, container=box([0.0, 0.0], [0.6, 0.3], periodic=[True, False]))
    x, colours = first_state(scene)
    moved = drawn(scene, x + [1.5, 0.0])  # by two and a half periods: the fluids have changed places
    np.testing.assert_allclose(moved, drawn(scene, x, colours[::-1]), atol=1e-9)


def test_the_plane_shows_pure_colours_and_mixtures():
    scene = scene_of(2, fluids=2, picture={"width": 300, "height": 200})
    x, colours = first_state(scene)
    seen = {tuple(pixel) for pixel in to_srgb(drawn(scene)).reshape(-1, 3)}
    for colour in (BLUE, RED):
        wanted = to_srgb(np.array(colour).reshape(1, 1, 3))[0, 0]
        assert min(np.abs(np.subtract(pixel, wanted, dtype=int)).max() for pixel in seen) <= 2
    half = 0.5 * np.add(BLUE, RED)
    assert drawn(scene, x, 0.0 * colours + half)[170, 150] == pytest.approx(half, abs=0.02)


def test_a_drop_in_the_plane_is_as_large_as_a_spacing():
    scene = scene_of(2, picture={"width": 300, "height": 200})
    alone = drawn(scene, np.array([[0.3, 0.25]]), np.array([[0.0, 0.0, 0.0]]))
    pixel = painter(scene, np.zeros((1, 2))).stage.pixel
    dark = (alone.max(axis=2) < 0.4).sum() * pixel**2
    assert 0.3 * 0.1**2 < dark < 1.5 * 0.1**2


@pytest.mark.parametrize("dimension", [2, 3])
def test_the_order_of_particles_does_not_matter(dimension):
    scene = scene_of(dimension, fluids=2)
    x, c = first_state(scene)
    x = x + 0.02 * np.random.default_rng(0).standard_normal(x.shape)
    other = np.random.default_rng(1).permutation(len(x))
    artist = painter(scene, x)
    np.testing.assert_allclose(artist.image(x, c), artist.image(x[other], c[other]), atol=0.01)


def test_mixtures_are_blended_by_mass_fractions():
    scene = scene_of(fluids=2)
    fractions = np.array([[1.0, 0.0], [0.25, 0.75]])
    np.testing.assert_allclose(colours_of(scene, fractions, 2), [BLUE, 0.25 * np.array(BLUE) + 0.75 * np.array(RED)])
    np.testing.assert_allclose(colours_of(scene_of(), None, 3), [BLUE] * 3)


GRAVITIES = ([0.0, -9.81, 0.0], [0.0, 0.0, -9.81], [9.81, 0.0, 0.0], [0.0, 0.0, 0.0])


@pytest.mark.parametrize(("gravity", "size"), list(zip(GRAVITIES, 2 * [(1280, 720), (300, 700)], strict=True)))
def test_the_camera_sees_the_whole_container_and_comes_near(gravity, size):
    scene = scene_of(forces={"gravity": gravity}, picture={"width": size[0], "height": size[1]})
    stage = Stage.of(scene, FILLED)
    away = stage.placed(corners(*scene.container.extent())) - stage.eye
    forward = stage.look_at - stage.eye
    forward /= np.linalg.norm(forward)
    right, up = screen_axes(forward)
    depth = np.tan(0.5 * np.radians(stage.picture.field_of_view)) * (away @ forward)
    across, upwards = away @ right / depth, away @ up / depth * size[0] / size[1]
    assert depth.min() > 0.0 and 0.8 < max(np.abs(across).max(), np.abs(upwards).max()) < 1.0


CPU = BandLauncher(wp.get_device("cpu"))


def wet_of(stage, positions):
    particles = particles_of(stage, positions, np.ones_like(positions), CPU)
    return wetting(stage, environment_of(stage), particles, CPU).places.numpy()


def test_fluid_goes_on_beyond_the_walls_that_it_touches():
    stage = Stage.of(scene_of(), FILLED)
    touching, inside = np.array([[0.05, 0.25, 0.2]]), np.array([[0.3, 0.25, 0.2]])
    wet = wet_of(stage, touching)
    np.testing.assert_allclose(wet, stage.placed(np.array([[0.05, 0.25, 0.2], [-0.05, 0.25, 0.2]])), atol=1e-6)
    assert len(wet_of(stage, inside)) == 1
    corner = wet_of(stage, np.array([[0.05, 0.05, 0.35]]))
    assert len(np.unique(corner.round(6), axis=0)) == len(corner) == 8


@pytest.mark.parametrize(("lid", "x", "cut"), [(True, 0.2, True), (False, 0.2, True), (False, 0.5, False)])
def test_fluid_is_cut_at_the_wall_of_a_cup_unless_some_came_over_its_rim(lid, x, cut):
    cup = {"shape": "cylinder", "base": [0.15, 0.0, 0.15], "radius": 0.25, "height": 0.5, "lid": lid}
    assert Stage.of(scene_of(container=cup), np.array([[0.15, 0.1, 0.15], [x, 0.1, 0.15]])).cuts == cut


def test_fluid_casts_a_shadow_on_the_floor():
    stage = Stage.of(scene_of(), FILLED)
    x, c = first_state(scene_of())
    shadow = FloorShadow(stage, CPU)
    shadow.of_fluid(particles_of(stage, x, c, CPU))
    light, corner, cell = shadow.light.numpy(), shadow.corner, shadow.cell
    assert light.shape[2] == 3 and light.max() <= 1.0 and 0.1 < light.min() < 0.7
    i, j = np.rint((stage.placed(x).mean(axis=0) - corner)[[0, 2]] / cell).astype(int)
    assert light[i, j].max() < 0.95 and light[0, 0].min() > 0.999


@pytest.mark.parametrize("where", [(0.7, 0.2, -0.3), (2.0, 0.0, 0.0), (-9.0, 5.0, 9.0)])
def test_a_shadow_is_looked_for_wherever_it_falls(where, monkeypatch):
    """Also at the ends of the floor and beyond, in the same bits as on all of it."""
    stage, (x, c) = Stage.of(scene_of(), FILLED), first_state(scene_of())

    def light():
        shadow = FloorShadow(stage, CPU)
        shadow.of_fluid(particles_of(stage, x + np.array(where) * stage.size, c, CPU))
        return shadow.light.numpy()

    found = light()
    monkeypatch.setattr(FloorShadow, "_reached", lambda *_: ([0, 0], (NODES, NODES)))
    np.testing.assert_array_equal(found, light())


def test_contrast_marks_pixels_among_white_squares_that_differ_and_black_ones_are_filled():
    image = np.random.default_rng(3).random((5, 7, 3)).astype(np.float32)
    image[:2, :4] = 0.5
    found = wp.zeros(35, dtype=wp.int32, device="cpu")
    pixels = wp.array(image.reshape(-1, 3), dtype=wp.vec3, device="cpu")
    launch(find_contrast, 35, wp.get_device("cpu"), first=0, columns=7, image=pixels, contrast=0.8, found=found)
    marks, filled = found.numpy().reshape(5, 7), pixels.numpy().reshape(5, 7, 3)
    for row, column in np.ndindex(5, 7):
        black = (row + column) % 2
        around = ((0, 1), (1, 0), (0, -1), (-1, 0)) if black else ((0, 0), (1, 1), (1, -1), (-1, 1), (-1, -1))
        places = ((row + down, column + across) for down, across in around)
        near = np.array([image[y, x] for y, x in places if 0 <= y < 5 and 0 <= x < 7])
        assert marks[row, column] == (np.ptp(near, axis=0).max() > 0.8)
        wanted = near.mean(axis=0) if black else image[row, column]
        np.testing.assert_allclose(filled[row, column], wanted, rtol=1e-6)
    assert 0 < marks.sum() < 35


def page_of(picture, fingerprint=""):
    return Page([lambda frame, around: picture(frame)], fingerprint=fingerprint)


def test_light_has_no_edge_where_reflection_within_water_becomes_total():
    """Seen along a column of the picture through the flat surface of a pool: the refracted ray meets the wall behind at
    the critical angle in the middle, where the eye is 28.8 degrees above the surface."""
    elevation = np.radians(28.8)
    looks = {"look_at": [0.3, 0.5, 0.4], "camera": [0.3, 0.5 + 2.0 * np.sin(elevation), 0.4 + 2.0 * np.cos(elevation)]}
    scene = scene_of(
        picture={"width": 64, "height": 400, "field_of_view": 2.0, **looks},
        phase=[{"name": "water", "rest_density": 1000.0, "viscosity": 0.05, "material": "water"}],
        fluid=[box([0.0] * 3, [0.6, 0.5, 0.8])],
        container=box([0.0] * 3, [0.6, 0.8, 0.8]),
    )
    column = drawn(scene)[:, 32]
    assert np.abs(np.diff(column[180:220], axis=0)).max() < 0.05
    assert np.abs(column[150] - column[220]).max() > 0.1


def test_a_lattice_in_a_round_cup_reaches_its_glass():
    cup = {"shape": "cylinder", "base": [0.0, 0.0, 0.0], "radius": 0.5}
    for radius in (0.5, 0.437, 0.4):
        fluid, container = ({**cup, "radius": radius, "height": height} for height in (0.4, 0.8))
        scene = scene_of(fluid=[{**fluid, "phase": "one"}], container=container)
        positions, colours = first_state(scene)
        _, _, surface, _ = SpacePainter(Stage.of(scene, positions)).scenery(State(positions, colours))
        off = surface.mesh.points.numpy()
        level = off[np.abs(off[:, 1] + 0.2) < 0.1]  # halfway up the fluid
        turn = np.arctan2(level[:, 2], level[:, 0])
        reached = [np.hypot(*level[np.abs(turn - at) < 0.1][:, ::2].T).max() for at in np.linspace(-3.0, 3.0, 31)]
        assert min(reached) > radius


def shown_in(path):
    """How bright the frames of a film are, from 0 to 1, and when each is shown [s]."""
    with pytest.importorskip("av").open(str(path)) as container:
        frames = [(frame.to_ndarray(format="gray").mean() / 255.0, frame.time) for frame in container.decode(video=0)]
    return np.array(frames).T


def test_a_film_that_is_stopped_keeps_its_frames_and_goes_on(tmp_path):
    path, pace, drawn = tmp_path / "film.mp4", Pace.of(0.1 * np.arange(20.0) ** 1.5), []

    def shade(k, last=20):
        if k == last:
            raise KeyboardInterrupt
        drawn.append(k)
        return np.full((32, 32, 3), k / 20.0)

    with pytest.raises(KeyboardInterrupt):
        film(path, page_of(lambda k: shade(k, 7), "a run"), range(20), pace)
    assert len(shown_in(path)[0]) == 7 and drawn == list(range(7))
    assert [file.name for file in tmp_path.iterdir()] == ["film.mp4"]
    film(path, page_of(shade, "a run"), range(20), pace)
    light, times = shown_in(path)
    assert drawn == list(range(20)) and np.all(np.diff(light) > 0.0)
    np.testing.assert_allclose(times, pace.times, atol=1e-4)
    film(path, page_of(shade, "another run"), range(20), pace)  # nor does one that is whole go on
    film(path, page_of(shade, "another run"), range(20), pace)
    assert len(drawn) == 60


@pytest.mark.parametrize(
    ("times", "said"),
    [
        (np.linspace(0.0, 8.0, 5001), "201 frames, 8.0 s, in real time; 4800 of the 5001 that were recorded are left"),
        (0.0015 * np.arange(421), "106 frames, 4.2 s, at 0.15 x; 315 of the 421 that were recorded are left out"),
        (np.linspace(0.0, 0.4, 41), "41 frames, 1.6 s, at 0.25 x, with 25 frames a second, as no more were recorded: "),
        (np.zeros(1), "1 frame, 0.0 s, in real time"),
    ],
)
def test_a_film_has_25_frames_a_second_and_lasts_some_seconds(times, said):
    pace = Pace.of(times)
    assert str(pace).startswith(said)
    assert len(times) == 1 or pace.frames_per_second == pytest.approx(25.0, rel=0.02)


@pytest.mark.parametrize(("rate", "shown"), [(29.97, 29.97), (24.0, 24.0), (60.0, 30.0), (250.0, 25.0)])
def test_a_film_in_real_time_has_the_rate_that_was_asked_for(rate, shown):
    """Or a whole part of it; the last state, which no frame asked for, is in no frame."""
    times = np.append(np.arange(np.floor(5.0 * rate) + 1) / rate, 5.001)
    pace = Pace.of(times, speed=1.0, rate=rate)
    assert pace.frames_per_second == pytest.approx(shown, rel=1e-12)
    np.testing.assert_allclose(pace.times, np.arange(len(pace.frames)) / shown, atol=1e-12)


REAL_TIME = "picture.film_speed=1 is real time"


def test_a_film_has_as_many_frames_as_are_asked_for_and_says_what_is_left_out():
    times = np.linspace(0.0, 2.0, 401)
    some = Pace.of(times, 101)
    assert len(some.frames) == 101 and some.frames[:3] == (0, 4, 8) and some.frames[-1] == 400
    assert str(some) == "101 frames, 4.0 s, at 0.5 x; 300 of the 401 that were recorded are left out; " + REAL_TIME
    asked = Pace.of(times, speed=1.0)
    assert len(asked.frames) == 51 and asked.times[-1] == 2.0 and "350 of the 401" in str(asked)
    assert REAL_TIME not in str(asked) and REAL_TIME not in str(Pace.of(times, speed=0.5))
    with pytest.warns(CortadoWarning, match=r"the film has 7 frames instead of the 90 of picture.film_frames"):
        assert len(pace_of(np.arange(7.0), Picture(film_frames=90)).frames) == 7


def test_a_package_that_is_missing_is_named(monkeypatch):
    assert lacking(scene_of()) is None
    monkeypatch.setattr(shading_film, "find_spec", lambda name: None)
    assert "Shaded pictures need PyAV, which is not installed: pip install av." in lacking(scene_of())
    assert lacking(scene_of(picture={"film_frames": 0})) is None


def test_words_and_panels():
    image = np.full((40, 60, 3), 0.8)
    word = labelled(image.copy(), "found")
    changed = np.nonzero((word != image).any(axis=2))
    assert changed[0].size and changed[0].max() < 30 and changed[1].min() > 5
    page = side_by_side([image * k / 3 for k in (1, 2, 3)], 2)
    assert page.shape == (80, 120, 3)
    named = side_by_side([image] * 3, 2, ["found", "b", "c"])
    np.testing.assert_array_equal(named[:39, :59], word[:39, :59])
    np.testing.assert_allclose(page[[20, 20, 60, 60], [30, 90, 30, 90], 0], [0.8 / 3, 1.6 / 3, 0.8, 1.0])


def test_pictures_change_neither_results_nor_whether_a_search_goes_on(tmp_path):
    plain, other = scene_of(), scene_of(picture={"width": 128, "floor": False})
    loss = FinalPositions(np.zeros((27, 3)))
    problems = (cortado.Problem(cortado.Simulation(scene), 2, loss) for scene in (plain, other))
    assert len({problem.fingerprint for problem in problems}) == 1
    folder = RunFolder.create(tmp_path / "run", plain.to_json(), [], kind="optimise")
    folder.require(other.to_json(), "optimise")
    with pytest.raises(InputError, match=r"was begun with solver\.time_step"):
        folder.require(scene_of(solver={"kind": "pcisph", "time_step": 0.001}).to_json(), "optimise")


def test_a_simulation_draws_its_frames():
    simulation = cortado.Simulation(scene_of(2))
    trajectory = simulation.run(steps=2)
    assert simulation.picture(trajectory[-1]).shape == (64, 96, 3)
    assert simulation.picture(trajectory[-1], width=128, height=72).shape == (72, 128, 3)
    for key, (value, words) in {
        "height": (1, "height"),
        "camera": ([0.0, 1.0, 2.0], "picture.camera is .*left out, as the scene has 2 dimensions"),
        "surface": ("foam", 'picture.surface is \'foam\', but must be "liquid" or "spheres"'),
        "widht": (100, "picture.widht is not a key.*did you mean width"),
    }.items():
        with pytest.raises(SceneError, match=words):
            simulation.picture(trajectory[-1], **{key: value})


def test_a_run_has_a_quick_film_and_sheet_unless_its_scene_says_how(tmp_path, monkeypatch):
    drawn, simulation = [], cortado.Simulation(scene_of())
    trajectory = simulation.run(steps=1)
    monkeypatch.setattr("cortado.pictures.run_pictures.film", lambda path, page, _, pace: shown(path, page, pace))

    def shown(path, page, pace):
        drawn.append(page.image(0))
        return Film(path, pace)

    for given in ({}, {"quality": "traced"}):
        figures = run_pictures(scene_of(picture=given), trajectory, tmp_path, simulation.device)
    assert [path.name for _, path in figures] == ["film.mp4", "first.png", "last.png", "sheet.png"]
    quick, traced = (simulation.picture(trajectory[0], quality=one) for one in ("quick", "traced"))
    for image, wanted in zip(drawn, (quick, traced), strict=True):
        np.testing.assert_allclose(image, wanted, atol=1e-3)
    assert 0.002 < np.abs(quick - traced).mean() < 0.05
    assert cortado.pictures.read_picture(tmp_path / "sheet.png").shape == (64, 3 * 64, 3)


PICTURE = "\n[picture]\nwidth = 96\nheight = 64\n"


def test_commands_write_pictures_and_films(tmp_path, monkeypatch, cortado_command):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scene.toml").write_text(TINY_SCENE + PICTURE)
    (tmp_path / "task.toml").write_text(GOOD_TASK + PICTURE)

    def well(*words):
        code, out, error = cortado_command(*words)
        assert code == 0, error
        return out

    well("run", "scene.toml", "--steps", "3", "--out", "a")
    written = {path.name for path in (tmp_path / "a" / "figures").iterdir()}
    assert {"first.png", "last.png", "film.mp4"} <= written
    assert (tmp_path / "a" / "report.html").read_text().count("data:video/mp4") == 1
    well("picture", "a", "--frame", "1", "--set", "picture.width=128", "--out", "one.png")
    assert cortado.pictures.read_picture("one.png").shape == (64, 128, 3)
    out = well("picture", "a", "--film", "--lines", "64", "--colour", "speed")
    told = "film.mp4: 4 frames, 0.9 s, at 0.0095 x, with 4.5 frames a second, as no more were recorded: --fps 16667 "
    assert told in out
    well("picture", "a", "--lines", "72")
    well("picture", "a", "--lines", "64")
    report = (tmp_path / "a" / "report.html").read_text()
    assert report.count("data:video/mp4") == 2 and report.count("<!-- picture.png -->") == 1
    assert report.index("Drawn later") < report.index("<!-- film.mp4 -->") < report.index("How to run it again")
    out = well("optimise", "task.toml", "--out", "b")
    assert out.splitlines()[-1].endswith("; open figures/found.mp4, or report.html.")
    written = {path.name for path in (tmp_path / "b" / "figures").iterdir()}
    assert {"found.png", "search.png", "found.mp4", "search.mp4"} <= written
    assert cortado.pictures.read_picture(tmp_path / "b" / "figures" / "found.png").shape == (64, 3 * 48, 3)
    well("run", "scene.toml", "--steps", "1", "--out", "c", "--no-pictures")
    assert not (tmp_path / "c" / "figures" / "film.mp4").exists()
    for arguments, sentence in {
        "--frame 9": "--frame is 9, but the run has 4 frames",
        "--camera fly": "picture.camera_path.kind is 'fly'",
        "--camera follow:raft": "camera_path is a table, but must be left out, as the scene has 2 dimensions",
        "--colour heat": "picture.colour is 'heat'",
        "--set solver.time_step=1": "must begin with picture.",
        "--film --set picture.film_frames=0": "--film is given, but picture.film_frames is 0",
    }.items():
        code, _, error = cortado_command("picture", "a", *arguments.split())
        assert code == 2 and sentence in error
