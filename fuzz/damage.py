"""Bytes of a good file, damaged by chance."""

import gzip
from collections.abc import Callable

from fuzz.oddities import Random

Damage = Callable[[bytes, Random], bytes]


def cut(good: bytes, random: Random) -> bytes:
    """The first part."""
    return good[: random.integers(len(good))]


def _the_last_bytes_lost(good: bytes, random: Random) -> bytes:
    return good[: -int(random.integers(1, 9))]


def _a_byte_changed(good: bytes, random: Random) -> bytes:
    return changed(good, 1, random)


def _bytes_changed(good: bytes, random: Random) -> bytes:
    return changed(good, int(random.integers(2, 30)), random)


def _first_bytes_changed(good: bytes, random: Random) -> bytes:
    return changed(good[:400], int(random.integers(1, 10)), random) + good[400:]


def _a_part_zero(good: bytes, random: Random) -> bytes:
    first, last = sorted(random.integers(len(good), size=2))
    return good[:first] + bytes(int(last - first)) + good[last:]


def _a_part_missing(good: bytes, random: Random) -> bytes:
    first, last = sorted(random.integers(len(good), size=2))
    return good[:first] + good[last:]


def _empty(good: bytes, random: Random) -> bytes:
    return b""


def _noise(good: bytes, random: Random) -> bytes:
    return random.bytes(int(random.integers(1, 5000)))


def _compressed(good: bytes, random: Random) -> bytes:
    return gzip.compress(good)


def _twice(good: bytes, random: Random) -> bytes:
    return good + good


def changed(good: bytes, count: int, random: Random) -> bytes:
    """The bytes with so many of them changed."""
    found = bytearray(good)
    for at in random.integers(len(good), size=count):
        found[at] ^= int(random.integers(1, 256))
    return bytes(found)


DAMAGES: tuple[Damage, ...] = (
    cut,
    cut,
    _the_last_bytes_lost,
    _a_byte_changed,
    _a_byte_changed,
    _bytes_changed,
    _first_bytes_changed,
    _a_part_zero,
    _a_part_missing,
    _empty,
    _noise,
    _compressed,
    _twice,
)
