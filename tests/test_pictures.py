"""Target pictures: that a heart is a heart and a rosetta a rosetta, and that files keep their light."""

import os
import struct
import zlib
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from PIL import Image

from bad_scenes import one_sentence
from cortado import CortadoWarning, InputError
from cortado.files.image_encoding import from_srgb, to_srgb
from cortado.pictures.image_files import COFFEE, MILK, WHITE, heart, read_picture, rosetta, write_picture

DRAWINGS = [heart, rosetta]


def milk_share(image: np.ndarray) -> np.ndarray:
    return (image[..., 0] - COFFEE[0]) / (MILK[0] - COFFEE[0])


def layers(shares: np.ndarray) -> int:
    return int(np.sum(np.diff((shares > 0.5).astype(int)) == 1))


@pytest.mark.parametrize("draw", DRAWINGS)
def test_drawings_are_symmetric_and_of_two_colours(draw):
    image = draw(128)
    assert image.shape == (128, 128, 3) and image.dtype == np.float64
    assert np.allclose(image, image[:, ::-1], atol=0.03)
    share = milk_share(image)
    assert np.allclose(image, share[..., None] * MILK + (1.0 - share[..., None]) * COFFEE)
    assert share.min() == pytest.approx(0.0) and share.max() == pytest.approx(1.0)
    assert np.mean((share > 0.01) & (share < 0.99)) > 0.005  # the edges are smooth


def test_a_heart_stands_on_its_tip():
    share = milk_share(heart(128))
    widths = share.sum(axis=1)
    rows = np.flatnonzero(widths > 0.5)
    assert rows[0] == pytest.approx(64 - 0.6 * 64, abs=2) and rows[-1] == pytest.approx(64 + 0.6 * 64, abs=2)
    assert widths[rows[-1]] < 5 and np.argmax(widths) < 60
    below = widths[np.argmax(widths) : rows[-1]]
    assert np.all(np.diff(below) <= 0.0)
    assert layers(share[rows[0] + 3]) == 2  # two lobes and a notch between them
    assert all(layers(share[row]) == 1 for row in range(60, rows[-1]))


@pytest.mark.parametrize("draw", DRAWINGS)
def test_a_cup_stands_on_its_background(draw):
    image = draw((100, 60), cup=0.8, background=(0.1, 0.2, 0.3))
    rows, columns = np.mgrid[:60, :100]
    radius = np.hypot(columns + 0.5 - 50, rows + 0.5 - 30) / 30
    assert np.allclose(image[radius > 0.85], (0.1, 0.2, 0.3))
    assert np.allclose(image[(radius > 0.7) & (radius < 0.75) & (abs(columns - 50) > 15)], COFFEE)
    assert milk_share(draw(128, cup=0.8, background=COFFEE)).mean() == pytest.approx(
        0.64 * milk_share(draw(128)).mean(), rel=5e-3
    )
    assert np.allclose(draw(16, cup=0.8)[0, 0], WHITE)


@pytest.mark.parametrize("wrong", [{"cup": 0.0}, {"size": -1.0}, {"size": np.nan}, {"resolution": (0, 8)}])
def test_what_cannot_be_drawn_is_a_sentence(wrong):
    with pytest.raises(InputError, match="must be"):
        heart(**{"resolution": 8, **wrong})


def test_the_curve_of_srgb():
    every = np.arange(256, dtype=np.uint8).reshape(16, 16, 1).repeat(3, axis=2)
    assert np.array_equal(to_srgb(from_srgb(every)), every)
    assert to_srgb(np.full((1, 1, 3), 0.5))[0, 0, 0] == 188
    assert from_srgb(np.array([10, 188], np.uint8)) == pytest.approx([0.0030353, 0.5028865], rel=1e-5)
    light = np.random.default_rng(0).random((40, 50, 3)) ** 3
    curved = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1.0 / 2.4) - 0.055)
    np.testing.assert_array_equal(to_srgb(light), np.rint(255.0 * curved))
    assert to_srgb([[[-1.0, 0.0, 2.0]]]).tolist() == [[[0, 0, 255]]]
    with ThreadPoolExecutor(2) as helpers:
        np.testing.assert_array_equal(to_srgb(light, helpers.map), to_srgb(light))


def test_a_picture_comes_back_as_it_was_written(tmp_path):
    image = heart((24, 16))
    again = read_picture(write_picture(tmp_path / "a.png", image))
    assert again.shape == (16, 24, 3) and again.dtype == np.float64
    assert np.abs(again - image).max() < 0.005
    assert np.array_equal(read_picture(tmp_path / "a.png", (24, 16)), again)


def test_pictures_are_resampled_in_linear_light(tmp_path):
    chequers = np.indices((8, 8)).sum(axis=0) % 2
    path = write_picture(tmp_path / "a.png", chequers[..., None] * np.ones(3))
    assert read_picture(path, 2) == pytest.approx(0.5, abs=0.02)


@pytest.mark.filterwarnings("ignore:.*only its middle")
def test_the_middle_of_a_picture_is_read(tmp_path):
    stripes = np.zeros((8, 24, 3))
    stripes[:, :8, 0] = stripes[:, 8:16, 1] = stripes[:, 16:, 2] = 1.0
    path = write_picture(tmp_path / "a.png", stripes)
    assert np.allclose(read_picture(path, 8), (0.0, 1.0, 0.0))
    assert np.allclose(read_picture(path, (6, 2))[:, [0, -1]], [(1.0, 0.0, 0.0), (0.0, 0.0, 1.0)], atol=0.1)


def test_unreadable_pictures_are_sentences(tmp_path):
    (tmp_path / "text.png").write_text("no picture")
    whole = write_picture(tmp_path / "whole.png", heart(64)).read_bytes()
    (tmp_path / "torn.png").write_bytes(whole[: len(whole) // 2])
    for name in ("absent.png", "text.png", "torn.png", "."):
        with pytest.raises(InputError, match="cannot be read"):
            read_picture(tmp_path / name)
    Image.fromarray(np.zeros((4, 4), np.uint16)).save(tmp_path / "deep.png")
    with pytest.raises(InputError, match="more than 8 bits"):
        read_picture(tmp_path / "deep.png")


def header_only(columns: int, rows: int) -> bytes:
    """A PNG of some dozen bytes that says how large it is, and holds nothing."""
    size = struct.pack(">II5B", columns, rows, 8, 2, 0, 0, 0)
    chunks = [struct.pack(">I", len(data)) + kind + data for kind, data in ((b"IHDR", size), (b"IDAT", b""))]
    sums = [struct.pack(">I", zlib.crc32(chunk[4:])) for chunk in chunks]
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunk + end for chunk, end in zip(chunks, sums, strict=True))


@pytest.mark.parametrize(
    "columns, size, words",
    [
        (10_000, 32, "has 10000 x 10000 pixels, but must have at most 67108864;"),
        (30_000, 32, "has very many pixels, but must have at most 67108864"),
        (4000, 32, "cannot be read: "),
        (5000, None, "must have at most 16777216"),  # one that is kept as it is
    ],
)
@pytest.mark.filterwarnings("error")
def test_a_picture_is_judged_by_its_header(tmp_path, columns, size, words):
    (tmp_path / "bomb.png").write_bytes(header_only(columns, columns))
    with one_sentence(words):
        read_picture(tmp_path / "bomb.png", size)


def test_only_regular_files_of_known_formats_are_read(tmp_path):
    os.mkfifo(tmp_path / "pipe.png")
    (tmp_path / "zero.png").symlink_to("/dev/zero")
    Image.new("RGB", (4, 4)).save(tmp_path / "other.png", format="TIFF")
    for name, words in (("pipe", "a pipe"), ("zero", "a device"), ("other", "none of PNG, JPEG, WEBP, GIF, BMP")):
        with pytest.raises(InputError, match=f"cannot be read: (it|the format) is {words}"):
            read_picture(tmp_path / f"{name}.png")


@pytest.mark.filterwarnings("ignore:.*only its middle")
@pytest.mark.parametrize("mode", ["RGB", "RGBA", "L", "P"])
def test_bands_of_rows_make_the_same_picture(tmp_path, monkeypatch, mode):
    noise = np.random.default_rng(1).integers(0, 256, (37, 53, 4), dtype=np.uint8)
    image = Image.fromarray(noise).convert(mode)
    image.save(tmp_path / "a.png")
    wanted = [read_picture(tmp_path / "a.png", size) for size in (None, 16)]
    over_white = Image.alpha_composite(Image.new("RGBA", image.size, "white"), image.convert("RGBA"))
    np.testing.assert_array_equal(wanted[0], from_srgb(np.asarray(over_white)[..., :3]))
    monkeypatch.setattr("cortado.pictures.image_files.PIXELS_AT_ONCE", 100)
    for size, one in zip((None, 16), wanted, strict=True):
        np.testing.assert_array_equal(read_picture(tmp_path / "a.png", size), one)


@pytest.mark.parametrize(
    ("name", "image", "wanted"),
    [
        ("absent/a.png", heart(8), "cannot be written"),
        ("a.png", np.zeros((4, 4)), "has shape"),
        ("a.foo", np.zeros((2, 2, 3)), "must be the name of a PNG file"),
        ("a.png", [[1, 2], [3]], "must be a number or an array of real numbers"),
        ("a.png", np.full((4, 4, 3), 255.0), "a value of 255, but must be linear light from 0 to 1"),
        ("a.png", np.zeros((2, 2, 3), np.uint8), "made of whole numbers, but must be linear light from 0 to 1"),
    ],
)
def test_what_would_be_written_wrong_is_refused(tmp_path, name, image, wanted):
    with pytest.raises(InputError, match=wanted):
        write_picture(tmp_path / name, image)
    assert not list(tmp_path.iterdir())


def test_a_picture_that_is_cropped_says_so(tmp_path):
    path = write_picture(tmp_path / "wide.png", np.zeros((54, 96, 3)))
    with pytest.warns(CortadoWarning, match="96 x 54 pixels, but 8 x 8 are wanted: only the middle is used, 56%"):
        read_picture(path, 8)
