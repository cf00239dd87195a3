"""Files whose words about themselves are not true: sizes, types and counts that they do not have."""

import io
import re
import struct
import zlib
from collections.abc import Mapping, Sequence

import numpy as np

from fuzz.damage import Damage, changed
from fuzz.oddities import Random
from fuzz.text_mutations import mutate_text

HUGE = 100_000_000_000


def _text_changed(good: bytes, random: Random) -> bytes:
    return mutate_text(good, random)[0]


def _a_shape_beyond_the_file(good: bytes, random: Random) -> bytes:
    shapes = (
        f"({HUGE}, 2)",
        f"(2, {HUGE})",
        "(-1, 2)",
        "(2,)",
        "()",
        f"({HUGE}, {HUGE})",
        "(64, 2, 1)",
        "'x'",
        f"({2**63}, 2)",
    )
    return _npy(
        re.sub(rb"'shape': \([^)]*\)", f"'shape': {shapes[random.integers(len(shapes))]}".encode(), _header(good))
    )


def _another_type(good: bytes, random: Random) -> bytes:
    types = ("|O", "<U100000000", "|V16", "<c16", "<i8", "<f2", "<m8[s]", ">f8", "nonsense", "<f8,<f8", "|S0")
    return _npy(_header(good).replace(b"<f8", types[random.integers(len(types))].encode()), good[-1024:])


def _a_header_that_runs(good: bytes, random: Random) -> bytes:
    return _npy(b"__import__('os').system('true')\n", good[-1024:])


def _an_archive(good: bytes, random: Random) -> bytes:
    file = io.BytesIO()
    np.savez(file, points=np.zeros((4, 2)))
    return file.getvalue()


def _pickled(good: bytes, random: Random) -> bytes:
    file = io.BytesIO()
    np.save(file, np.array([[None, 1.0]], dtype=object), allow_pickle=True)
    return file.getvalue()


def _header(good: bytes) -> bytes:
    return good[10 : 10 + struct.unpack("<H", good[8:10])[0]]


def _npy(header: bytes, content: bytes = b"") -> bytes:
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + content


def _more_points_than_there_are(good: bytes, random: Random) -> bytes:
    count = (HUGE, -1, 0, 2**31, 65, 10_000_000)[random.integers(6)]
    pattern = rb'(POINTS |NumberOfPoints=")\d+'
    return re.sub(pattern, lambda found: found.group(1) + str(count).encode(), good)


def _numbers_of_another_type(good: bytes, random: Random) -> bytes:
    name = (b"unsigned_char", b"Int8", b"string", b"nonsense")[random.integers(4)]
    return good.replace(b"double", name).replace(b"Float64", name)


def _a_larger_dataset(good: bytes, random: Random) -> bytes:
    """HDF5 with a dataset that says to be huge, and one that says that there are as many points."""
    import h5py

    file = io.BytesIO(good)
    with h5py.File(file, "r+") as opened:
        group = opened["VTKHDF"]
        count = int((HUGE, 2**40, -1)[random.integers(3)])
        group["NumberOfPoints"][...] = count
        if count > 0 and random.random() < 0.5:
            del group["Points"]
            group.create_dataset("Points", (count, 3), "f8", chunks=(1000, 3))
    return file.getvalue()


def _a_group_missing(good: bytes, random: Random) -> bytes:
    import h5py

    file = io.BytesIO(good)
    with h5py.File(file, "r+") as opened:
        names: list[str] = []
        opened.visit(names.append)
        del opened[names[random.integers(len(names))]]
    return file.getvalue()


def _a_huge_picture(good: bytes, random: Random) -> bytes:
    """A PNG of one colour: a few kilobytes for tens or hundreds of megapixels."""
    width, height = ((8000, 6000), (30_000, 30_000), (2**31 - 1, 2), (1, 100_000))[random.integers(4)]
    rows = zlib.compressobj()
    content = b"".join(rows.compress(bytes(1 + 3 * min(width, 8000))) for _ in range(min(height, 6000))) + rows.flush()
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + _chunk(b"IHDR", header) + _chunk(b"IDAT", content) + _chunk(b"IEND", b"")


def _an_odd_picture_header(good: bytes, random: Random) -> bytes:
    width, height, depth, colour = (int(random.choice([0, 1, 8, 16, 255, 2**31])) for _ in range(4))
    header = struct.pack(">IIBBBBB", width, height, depth % 256, colour % 256, 0, 0, 0)
    return good[:8] + _chunk(b"IHDR", header) + good[33:]


def _another_picture_format(good: bytes, random: Random) -> bytes:
    from PIL import Image

    file = io.BytesIO()
    with Image.open(io.BytesIO(good)) as picture:
        picture.convert("RGB").save(file, str(random.choice(["JPEG", "GIF", "BMP", "TIFF", "PPM", "EPS", "PDF"])))
    return changed(file.getvalue(), int(random.integers(0, 3)), random)


def _chunk(name: bytes, content: bytes) -> bytes:
    return struct.pack(">I", len(content)) + name + content + struct.pack(">I", zlib.crc32(name + content))


def _other_json(good: bytes, random: Random) -> bytes:
    texts = (
        b"null",
        b"[]",
        b"{}",
        b"3",
        b'"text"',
        b"[" * 100_000,
        b"{" * 1000,
        b"NaN",
        b"9" * 5000,
        b'{"cortado": 1}',
    )
    return texts[random.integers(len(texts))] + b"\n" * int(random.integers(2))


def _a_line_of_something_else(good: bytes, random: Random) -> bytes:
    lines = good.split(b"\n")
    lines[random.integers(len(lines))] = _other_json(good, random).strip()
    return b"\n".join(lines)


def _another_first_line(good: bytes, random: Random) -> bytes:
    """The replay log of something else."""
    first, _, rest = good.partition(b"\n")
    return (
        [b"{}", b"", first.replace(b"1", b"2"), first * 1000, first.replace(b"[", b"[[")][random.integers(5)]
        + b"\n"
        + rest
    )


LIES: Mapping[str, Sequence[Damage]] = {
    ".toml": (_text_changed,),
    ".npy": (_a_shape_beyond_the_file, _another_type, _a_header_that_runs, _an_archive, _pickled),
    ".vtk": (_more_points_than_there_are, _numbers_of_another_type),
    ".vtp": (_more_points_than_there_are, _numbers_of_another_type, _text_changed),
    ".vtkhdf": (_a_larger_dataset, _a_group_missing),
    ".png": (_a_huge_picture, _an_odd_picture_header, _another_picture_format),
    ".json": (_other_json,),
    ".jsonl": (_other_json, _a_line_of_something_else),
    ".log": (_another_first_line,),
}
