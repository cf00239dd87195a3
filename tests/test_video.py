"""Videos: that what is written can be played, with its size, its length and its colours."""

import sys

import av
import numpy as np
import pytest
from PIL import Image

from cortado.errors import ComputationError, InputError
from cortado.files.image_encoding import BITS, moving_picture, to_srgb, write_video, writing
from cortado.pictures.image_files import COFFEE, MILK, heart
from full_disk import largest_file


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


def test_odd_sides_are_made_even(tmp_path):
    with av.open(write_video(tmp_path / "a.mp4", [heart((33, 21))])) as container:
        context = container.streams.video[0].codec_context
        assert (context.width, context.height) == (34, 22)


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


def test_a_missing_package_is_a_sentence(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(InputError, match=r"pip install av"):
        write_video(tmp_path / "a.mp4", [heart(16)])


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
