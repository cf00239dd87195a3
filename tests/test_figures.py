"""The pictures: that each is drawn at a legible size, shows what it was given, and survives odd input."""

import av
import numpy as np
import pytest
from PIL import Image

from cortado import ComputationError, InputError, Trajectory
from cortado.files.image_encoding import to_srgb
from cortado.pictures import plots
from cortado.pictures.image_files import COFFEE, MILK, heart
from cortado.pictures.run_pictures import density_errors
from cortado.pictures.video_files import BITS, moving_picture, write_video, writing
from full_disk import largest_file


def pixels(path) -> np.ndarray:
    picture = Image.open(path)
    assert picture.format == "PNG" and picture.width >= 1200
    return np.asarray(picture.convert("RGB")).astype(int)


def share_of(colour: tuple[int, int, int], image: np.ndarray) -> float:
    return float(np.mean(np.abs(image - colour).max(axis=-1) < 12))


def block(dimension: int) -> np.ndarray:
    return 0.1 * np.stack(np.meshgrid(*[np.arange(6)] * dimension, indexing="ij"), -1).reshape(-1, dimension)


def trajectory_of(steps: int) -> Trajectory:
    frames = np.zeros((1, 4, 2))
    converged = np.arange(steps) % 5 != 3
    errors = 0.01 + 0.001 * np.arange(steps)
    diagnostics = {"iterations": np.full(steps, 5), "density_errors": errors, "converged": converged}
    return Trajectory(np.zeros(1), np.zeros(1, int), frames, frames, diagnostics)


@pytest.mark.parametrize(
    ("losses", "share"),
    [
        *((losses, 1e-5) for losses in ([3.0, 1.0, 0.1], [0.0, 0.0], [1.0, np.nan, np.inf, 2.0])),
        *((losses, 1e-5) for losses in ([5.0], [1.0, 0.0, 1e-9])),
        *((losses, 1e-3) for losses in ([1.0, np.nan, 0.0, 10.0], [-1.0, 0.0, np.inf, np.nan])),
        ([], None),
    ],
)
def test_a_loss_curve_takes_any_losses_and_leaves_those_without_a_place_out(tmp_path, losses, share):
    drawn = share_of((0x3D, 0x6B, 0x8E), pixels(plots.loss_curve(losses, tmp_path / "loss.png")))
    assert drawn <= 1e-5 if share is None else drawn > share


def test_nearer_particles_hide_farther_ones(tmp_path):
    sheet = 0.1 * np.stack(np.meshgrid(np.arange(6), np.arange(6), [0.0], indexing="ij"), -1).reshape(-1, 3)
    red, green = np.tile([0.6, 0.0, 0.0], (36, 1)), np.tile([0.0, 0.6, 0.0], (36, 1))
    near, far = sheet + np.array([0.0, 0.0, 1.0]), sheet
    for first, second in ((near, far), (far, near)):  # in whatever order they come
        colours = np.concatenate([red, green] if first is near else [green, red])
        positions = np.concatenate([first, second])
        image = pixels(plots.particles([positions], ["a"], tmp_path / "a.png", colours=[colours]))
        assert share_of((203, 0, 0), image) > 0.1  # of linear light, in sRGB
        assert share_of((0, 203, 0), image) == 0.0


@pytest.mark.parametrize("dimension", [2, 3])
def test_particles_side_by_side_share_their_scale(tmp_path, dimension):
    points = block(dimension)
    corners = (np.full(dimension, -0.1), np.full(dimension, 0.8))
    options = {"container": corners}
    path = plots.particles([points, points + 0.1], ["before", "after"], tmp_path / "a.png", **options)
    ink = pixels(path).sum(axis=-1) < 450
    left, right = ink[:, : ink.shape[1] // 2], ink[:, ink.shape[1] // 2 :]
    assert 0.8 < left.sum() / right.sum() < 1.25
    assert np.nonzero(left)[0].mean() > np.nonzero(right)[0].mean() + 20  # the second set is drawn higher up


def test_steps_that_did_not_converge_are_marked(tmp_path):
    mark = (0xA8, 0x50, 0x4F)
    image = pixels(density_errors(trajectory_of(50), tmp_path / "a.png", tolerance=0.01))
    assert share_of(mark, image) > 1e-4
    assert share_of(mark, pixels(density_errors(trajectory_of(3), tmp_path / "b.png"))) == 0.0
    pixels(density_errors(trajectory_of(0), tmp_path / "c.png"))


@pytest.mark.parametrize("count", [1, 3, 6])
def test_images_are_shown_in_srgb(tmp_path, count):
    shades = [(0.05 + 0.15 * k) * np.ones((16, 24, 3)) for k in range(count)]
    image = pixels(plots.images(shades, [f"step {k}" for k in range(count)], tmp_path / "a.png"))
    places = []
    for shade in shades:
        level = int(to_srgb(shade)[0, 0, 0])
        there = np.all(image == level, axis=-1)
        assert there.mean() > 0.6 / count * 0.5
        places.append(np.argwhere(there).mean(axis=0))
    rows, columns = np.array(places).T
    across = min(count, 3)
    assert np.all(np.diff(columns[:across]) > 100) and np.ptp(rows[:across]) < 5
    assert np.all(rows[across:] > rows[0] + 100)


def test_images_without_titles_and_unwritable_pictures_are_sentences(tmp_path):
    for shown, titles in (([], []), ([np.zeros((2, 2, 3))], [])):
        with pytest.raises(InputError, match="titles"):
            plots.images(shown, titles, tmp_path / "a.png")
    with pytest.raises(InputError, match="cannot be written"):
        plots.loss_curve([1.0], tmp_path / "absent" / "loss.png")


def levels_of(frame: av.VideoFrame) -> np.ndarray:
    """(3,) mean red, green and blue in 0..255, as ITU-R BT.709 has them of luma and chroma."""
    planes = frame.to_ndarray()
    count = frame.height * frame.width
    y, cb, cr = (part.mean() for part in np.split(planes.ravel(), [count, count * 5 // 4]))
    y, cb, cr = (y - 16) * 255 / 219, (cb - 128) * 255 / 224, (cr - 128) * 255 / 224
    return np.array([y + 1.5748 * cr, y - 0.1873 * cb - 0.4681 * cr, y + 1.8556 * cb])


def test_a_video_can_be_played(tmp_path):
    images = [np.ones((32, 48, 3)) * MILK, np.ones((32, 48, 3)) * COFFEE, *[heart((48, 32))] * 5]
    path = write_video(tmp_path / "a.mp4", iter(images), frames_per_second=12.5)
    assert [file.name for file in tmp_path.iterdir()] == ["a.mp4"]
    with av.open(path) as container:
        stream = container.streams.video[0]
        context = stream.codec_context
        assert (context.name, context.pix_fmt, context.width, context.height) == ("h264", "yuv420p", 48, 32)
        assert (context.color_primaries, context.colorspace, context.color_trc, context.color_range) == (1, 1, 13, 1)
        assert stream.average_rate == 12.5
        frames = list(container.decode(stream))
    assert len(frames) == len(images)
    for frame, image in zip(frames, images, strict=True):
        assert levels_of(frame) == pytest.approx(to_srgb(image).mean(axis=(0, 1)), abs=4)


@pytest.mark.parametrize(
    "name, frames, rate, words",
    [
        ("a.mp4", [], 25, "no frames"),
        ("a.mp4", [heart(16), heart(18)], 25, "Frame 1 of the video has shape"),
        ("a.mp4", [heart(16), np.full((70, 16, 3), np.nan)], 25, "not finite"),
        ("a.mp4", [heart(16)], 0, "positive"),
        ("a.avi", [heart(16)], 25, "must end in .mp4"),
        ("absent/a.mp4", [heart(16)], 25, "cannot be written"),
    ],
)
def test_what_cannot_be_filmed_is_a_sentence(tmp_path, name, frames, rate, words):
    with pytest.raises(InputError, match=words):
        write_video(tmp_path / name, frames, rate)
    assert not list(tmp_path.iterdir())


def test_a_full_disk_is_a_sentence_and_keeps_the_film_of_before(tmp_path):
    path, noise = write_video(tmp_path / "a.mp4", [heart(16)]), np.random.default_rng(0)
    before = path.read_bytes()
    with largest_file(20_000), pytest.raises(ComputationError, match=r"a\.mp4 cannot be written: .*free some space"):
        write_video(path, (noise.random((180, 320, 3)) for _ in range(100)))
    assert [file.name for file in tmp_path.iterdir()] == ["a.mp4"] and path.read_bytes() == before


def test_what_follows_no_film_that_is_there_begins_anew(tmp_path):
    path = tmp_path / "a.mp4"
    for content in (b"", b"no film"):
        path.write_bytes(content)
        with writing(path, 25.0, "note", 2) as video:
            assert video.frames == 0
            video.add(heart(16), 0.0)
    assert path.stat().st_size > 500


def test_noise_takes_no_more_than_10_mb_a_minute(tmp_path):
    """At 1080 lines: the limit goes with the pixels. Besides it there are four seconds' worth of it in store."""
    noise, pixels = np.random.default_rng(0), 320 * 180 / (1920 * 1080)
    path = write_video(tmp_path / "a.mp4", (noise.random((180, 320, 3)) for _ in range(75)), 25)
    most = BITS * pixels**0.75 / 8  # bytes a second
    assert 1.0 * most < path.stat().st_size < 1.1 * (3.0 + 4.0) * most
    assert BITS / 8 * (60 + 4) < 10e6


def test_an_animation_has_its_frames_at_their_times(tmp_path):
    grey = [np.full((18, 32, 3), light) for light in (0.1, 0.5, 0.9)]
    with moving_picture(tmp_path / "a.webp", 25.0) as animation:
        for image, time in zip(grey, (0.0, 0.04, 0.24), strict=True):
            animation.add(image, time)
    with Image.open(tmp_path / "a.webp") as found:
        assert (found.format, found.n_frames, found.size, found.info["loop"]) == ("WEBP", 3, (32, 18), 0)
        durations = []
        for k, image in enumerate(grey):
            found.seek(k)
            np.testing.assert_allclose(np.asarray(found.convert("RGB")), to_srgb(image), atol=3)
            durations.append(found.info["duration"])
    assert durations == [40, 200, 1500]


def test_an_animation_that_is_stopped_keeps_its_frames(tmp_path):
    with pytest.raises(KeyboardInterrupt), moving_picture(tmp_path / "a.webp", 25.0) as animation:
        animation.add(np.zeros((18, 32, 3)), 0.0)
        raise KeyboardInterrupt
    assert Image.open(tmp_path / "a.webp").size == (32, 18)
    with pytest.raises(InputError, match="has no frames"), moving_picture(tmp_path / "b.webp", 25.0):
        pass
    assert not (tmp_path / "b.webp").exists()
