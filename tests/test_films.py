"""Films and pictures of trajectories: cameras that move, colours that stand for numbers, emitters."""

import numpy as np
import pytest
import warp as wp

import cortado
from cortado.device.launching import BandLauncher
from cortado.discretise.shapes import corners
from cortado.errors import InputError, SceneError
from cortado.files.image_encoding import to_srgb
from cortado.pictures import Dolly, Follow, Keyframes, Orbit
from cortado.pictures.film import ShownRun, ages, coloured_by, is_out
from cortado.pictures.painter import MOVING, Scale, painter, plan
from cortado.pictures.run_pictures import _with_scale, run_page
from cortado.pictures.stage import Stage, screen_axes
from cortado.pictures.tracing.near_particles import Particles
from cortado.pictures.tracing.solid_surfaces import FloorShadow
from cortado.scene.appearance import LIGHTS, Moment, Picture, View
from scenes import jet, plane, pool, pour, scene

SMALL = {"width": 160, "height": 90}
HOME = View(np.array([0.0, 1.0, 4.0]), np.array([0.0, 1.0, 0.0]))
KEYS = {"kind": "keyframes", "times": [0, 1], "cameras": [[0] * 3, [1] * 3]}
UP = np.array([0.0, 1.0, 0.0])


def moment(share, time=0.0, **solids):
    return Moment(share, time, UP, solids)


def frames_of(path):
    with pytest.importorskip("av").open(str(path)) as container:
        return [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]


def test_cameras_orbit_come_near_go_through_keyframes_and_follow():
    quarter = Orbit().view(HOME, moment(0.25))
    np.testing.assert_allclose(quarter.eye, [4.0, 1.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(quarter.look_at, HOME.look_at)
    np.testing.assert_allclose(Orbit(turns=-0.5).view(HOME, moment(0.5)).eye, [-4.0, 1.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(Orbit(turns=2.0).view(HOME, moment(1.0)).eye, HOME.eye, atol=1e-12)
    distances = [np.linalg.norm(Dolly(distance=0.5).view(HOME, moment(s)).eye - HOME.look_at) for s in (0.0, 0.5, 1.0)]
    np.testing.assert_allclose(distances, [4.0, 4.0 * 0.5**0.5, 2.0])
    path = Keyframes(times=[1.0, 2.0, 4.0], cameras=[[0.0, 0.0, 1.0], [1.0, 0.0, 1.0], [1.0, 2.0, 1.0]])
    for time, place in ((0.0, [0, 0, 1]), (1.0, [0, 0, 1]), (2.0, [1, 0, 1]), (4.0, [1, 2, 1]), (9.0, [1, 2, 1])):
        np.testing.assert_allclose(path.view(HOME, moment(0.0, time)).eye, place, atol=1e-12)
    np.testing.assert_allclose(path.view(HOME, moment(0.0, 1.5)).look_at, HOME.look_at)
    seen = Follow(solid="raft", distance=0.5).view(HOME, moment(0.3, raft=np.array([3.0, 0.0, 1.0])))
    np.testing.assert_allclose(seen.look_at, [3.0, 0.0, 1.0])
    np.testing.assert_allclose(seen.eye, [3.0, 0.0, 3.0])


@pytest.mark.parametrize(
    ("maker", "table", "sentence"),
    [
        (scene, {"camera_path": {"kind": "orbit", "turns": "fast"}}, "picture.camera_path.turns is 'fast'"),
        (scene, {"camera_path": {"kind": "fly"}}, 'camera_path.kind is .fly., but must be "dolly" or "follow"'),
        (scene, {"camera_path": {"kind": "follow", "solid": "raft"}}, "solid is 'raft', but must be left out"),
        (scene, {"camera_path": KEYS | {"cameras": [[0] * 3]}}, "2 places of 3 comp"),
        (plane, {"camera_path": {"kind": "orbit"}}, "camera_path .*left out, as the scene has 2 dimensions"),
        (scene, {"colour": "rho"}, 'picture.colour is \'rho\', but must be "phase" or "density"'),
    ],
)
def test_a_wrong_table_is_a_sentence(maker, table, sentence):
    with pytest.raises(SceneError, match=sentence):
        maker(picture=table)


def test_a_trajectory_makes_films_and_pictures(tmp_path):
    simulation = cortado.Simulation(scene(picture=SMALL))
    trajectory = simulation.run(2)
    made = trajectory.film(tmp_path / "a.mp4", camera=Orbit(turns=0.5), film_speed=0.01, lines=64)
    shown = frames_of(made.path)
    assert [frame.shape for frame in shown] == [(64, 114, 3)] * 3
    assert "3 frames" in repr(made) and "0.01 x" in repr(made) and "data:video/mp4" in made._repr_html_()
    last = to_srgb(trajectory.picture(lines=64)).astype(int)
    assert np.abs(shown[-1] - last).mean() > 3.0  # it is seen from the other side
    picture = trajectory.picture(0, lines=64)
    assert picture.shape == (64, 114, 3) and picture._repr_png_()[:4] == b"\x89PNG" and picture[0]._repr_png_() is None
    trajectory.save(tmp_path / "run.vtkhdf")
    loaded = cortado.Trajectory.load(tmp_path / "run.vtkhdf")
    again = loaded.picture(0, scene=simulation.scene, lines=64)
    np.testing.assert_allclose(again, picture, atol=1e-4)  # the surface adds up in an order of its own
    with pytest.raises(InputError, match=r"from a file, which has no scene.*scene=scene"):
        loaded.picture()


def test_what_cannot_be_drawn_is_a_sentence(tmp_path):
    simulation = cortado.Simulation(plane(picture=SMALL))
    trajectory = simulation.run(1)
    for call, sentence in (
        (lambda: trajectory.picture(5), "k is 5, but must be the number of one of 2 frames"),
        (lambda: trajectory.film("a.avi"), "must end in .mp4"),
        (lambda: trajectory[:0].film("a.mp4"), "has no frames"),
        (lambda: trajectory.film("a.mp4", frames=5), "picture.frames is not a key"),
        (lambda: trajectory.picture(colour="pressure"), "pressure was not recorded.*simulation.film"),
        (lambda: simulation.picture(trajectory[0], colour="age"), "trajectory.picture"),
        (lambda: trajectory.picture(camera=Orbit()), "camera_path .*2 dimensions"),
    ):
        with pytest.raises((InputError, SceneError), match=sentence):
            call()
    made = simulation.film(trajectory, tmp_path / "a.mp4", colour="pressure")
    assert len(frames_of(made.path)) == 2


def test_the_vorticity_is_computed_where_it_was_not_recorded():
    simulation = cortado.Simulation(plane(picture={**SMALL, "colour": "vorticity"}))
    trajectory = simulation.run(3)
    known = simulation.quantity("vorticity", trajectory)
    np.testing.assert_array_equal(coloured_by(simulation.scene, trajectory), known)
    assert np.abs(known).max() > 0.1


def test_flat_colours_are_those_of_the_scale():
    simulation = cortado.Simulation(scene(picture={**SMALL, "colour": "speed", "shaded": False}))
    trajectory = simulation.run(6)
    colours = Scale.of("speed", trajectory.quantity("speed")).colours(trajectory.quantity("speed")[-1])
    image = trajectory.picture()
    middle = image[62:80, 55:75].reshape(-1, 3)
    nearest = np.abs(middle[:, None] - colours[None]).max(axis=2).min(axis=1)
    assert np.median(nearest) < 0.03
    assert np.abs(trajectory.picture(shaded=True) - image).max() > 0.05


def test_a_scale_tells_its_numbers_in_its_unit():
    scale = Scale.of("speed", np.linspace(0.0, 2.0, 1001))
    image = np.full((360, 640, 3), 0.5)
    told, columns = scale.on(image), scale.columns(360)
    assert 10 < columns < 60 and (told[:, -columns:] != image[:, -columns:]).any()
    np.testing.assert_array_equal(told[:, :-columns], image[:, :-columns])
    beside = scale.beside(image)
    assert beside.shape == (360, 640 + columns, 3)
    np.testing.assert_array_equal(beside[:, :640], image)
    np.testing.assert_allclose(beside[:, 640:], told[:, -columns:], atol=1e-12)
    assert scale._ticks() == [0.5, 1.0, 1.5]
    assert Scale.of("age", np.ones(3)).unit == "s" and Scale.of("age", np.ones(3)).on(image).shape == image.shape


@pytest.mark.parametrize("upper, is_beside", [([4.0, 0.4], True), ([0.4, 0.4], False)])
def test_a_scale_covers_nothing_that_is_shown(upper, is_beside):
    own = plane(picture={**SMALL, "colour": "speed"}).replaced(f"container.upper={upper}")
    trajectory = cortado.Simulation(own).run(2)
    values = trajectory.quantity("speed")
    scale, stage = Scale.of("speed", values), ShownRun(own, trajectory).stage
    image = run_page(ShownRun(own, trajectory, values), "cpu").image(1)
    narrow, drawn = _with_scale(stage, scale)
    assert image.shape == (90, 160, 3) and (drawn == scale.beside) == is_beside
    assert narrow.on_screen(corners(*narrow.ends))[:, 0].max() < 160 - scale.columns(90)


def test_what_waits_in_an_emitter_is_not_drawn():
    simulation = cortado.Simulation(jet(picture=SMALL))
    trajectory = simulation.run(30)
    first, last = (is_out(simulation.scene, frame.others, trajectory.particles) for frame in trajectory[::30])
    assert first.sum() == 48 and 48 < last.sum() < trajectory.particles
    old = ages(simulation.scene, trajectory)
    np.testing.assert_allclose(old[-1, :48], trajectory.times[-1])
    assert (old[-1][~last] == 0.0).all() and (np.diff(old[-1, 48:]) <= 1e-12).all() and old[-1, 48] > 0.0
    image = trajectory.picture(0)
    blue = image[..., 2] > 1.5 * image[..., 0]
    assert blue.any() and np.nonzero(blue)[0].min() > 45  # in the lower half alone
    assert np.abs(trajectory.picture(colour="age") - trajectory.picture()).max() > 0.1


def test_who_goes_around_sees_the_whole_container_from_all_sides():
    flat = scene(container={"shape": "box", "lower": [0.0, 0.0, 0.0], "upper": [2.0, 0.6, 0.25]}, picture=SMALL)
    stage = Stage.of(flat, np.array([[0.0, 0.0, 0.0], [0.25, 0.25, 0.25]]))
    box = corners(*flat.container.extent())
    for share in np.linspace(0.0, 1.0, 9):
        seen = stage.at(None, Orbit().view(stage.home_around, moment(share)))
        forward = (seen.look_at - seen.eye) / np.linalg.norm(seen.look_at - seen.eye)
        right, up = screen_axes(forward)
        off = stage.placed(box) - seen.eye
        across, upwards = (np.abs(off @ axis / (off @ forward)).max() for axis in (right, up))
        half = np.tan(0.5 * np.radians(stage.picture.field_of_view))
        assert across < half and upwards < half * 90 / 160
    np.testing.assert_allclose(seen.sun, stage.sun)


def test_a_low_sun_casts_a_longer_shadow_and_a_light_has_its_own_background():
    positions, shaded = np.array([[0.1, 0.2, 0.1]]), {}
    for name in LIGHTS:
        stage = Stage.of(scene(picture={**SMALL, "light": name}), positions)
        shadow = FloorShadow(stage, BandLauncher(wp.get_device("cpu")))
        shadow.of_fluid(Particles.on("cpu", stage.placed(positions), np.ones((1, 3))))
        light, corner, cell = shadow.light.numpy(), shadow.corner, shadow.cell
        dark = np.argwhere(light[..., 0] < 1.0 - 0.5 * (1.0 - light.min()))
        shaded[name] = np.linalg.norm(corner[[0, 2]] + cell * dark.mean(axis=0) - stage.placed(positions)[0, ::2])
    assert shaded["evening"] > 1.5 * shaded["studio"] > 1.5 * shaded["noon"]
    assert Picture(light="evening").sun_and_sky.background == LIGHTS["evening"].background
    assert Picture(light="evening", background=(0.1, 0.2, 0.3)).sun_and_sky.background == (0.1, 0.2, 0.3)
    with pytest.raises(SceneError, match='light is \'dawn\', but must be "studio" or "noon"'):
        Picture(light="dawn")


@pytest.mark.parametrize("make", [jet, pour])
def test_a_plan_shows_where_an_emitter_shoots_and_how_large_a_scene_is(make):
    made = make(picture={"width": 320, "height": 180})
    simulation = cortado.Simulation(made)
    free = simulation.positions[: simulation.free_particles]
    image = plan(made, free, np.tile([0.1, 0.3, 0.8], (len(free), 1)))
    stage = painter(made, simulation.positions).stage
    (emitter,) = made.emitter
    column, row = stage.on_screen(np.array([np.add(emitter.outlet, np.multiply(0.03, emitter.direction))]))[0].round()
    around = image[int(row) - 6 : int(row) + 7, int(column) - 6 : int(column) + 7].reshape(-1, 3)
    assert np.abs(around - MOVING).max(axis=1).min() < 0.2
    low, high = stage.on_screen(np.array([made.container.lower, made.container.upper]))
    assert low[1] > high[1]  # upwards is upwards
    box = image[max(int(low[1]) + 2, 0) :]
    assert (box.max(axis=2) < 0.4).any()  # words below


def test_water_that_a_solver_keeps_at_rest_does_not_flicker_in_a_film():
    """Though its particles go on swimming. A film that was stopped goes on with the same pictures."""
    water = pool([0.3, 0.3, 0.2], [0.3, 0.5, 0.2], solver={"kind": "projection", "time_step": 0.005}, picture=SMALL)
    trajectory = cortado.Simulation(water).run(98, record_every=7)
    page = run_page(ShownRun(water, trajectory), "cpu")
    frames = range(len(trajectory))
    film, alone = list(page.images(frames, begin=8)), [page.image(k) for k in frames[8:]]
    changed, as_drawn = (
        (np.abs(np.diff(np.array(images) ** (1.0 / 2.4), axis=0)).max(axis=3) > 1.0 / 255.0).mean()
        for images in (film, alone)
    )
    assert as_drawn > 5e-3 and changed < 1e-3, (as_drawn, changed)
    (last,) = run_page(ShownRun(water, trajectory), "cpu").images(frames, begin=len(frames) - 1)
    np.testing.assert_array_equal(last, film[-1])
