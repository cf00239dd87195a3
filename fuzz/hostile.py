"""Files that are not what their names say: damaged, lying about their size, or no files at all."""

from collections.abc import Callable, Sequence
from pathlib import Path

from fuzz.damage import DAMAGES, cut
from fuzz.lies import LIES
from fuzz.no_files import PLACES
from fuzz.oddities import Random


def make_hostile(path: Path, good: bytes, others: Sequence[bytes], random: Random) -> str:
    """Put something hostile in the place of a good file; returns what, in words."""
    kind = random.random()
    lies = LIES.get(path.suffix, (cut,))
    if kind < 0.30:
        place = PLACES[random.integers(len(PLACES))]
        place(path, good)
        return _words(place)
    if kind < 0.60:
        lie = lies[random.integers(len(lies))]
        path.write_bytes(lie(good, random))
        return _words(lie)
    if kind < 0.66:
        path.write_bytes(others[random.integers(len(others))])
        return "of another format"
    damage = DAMAGES[random.integers(len(DAMAGES))]
    path.write_bytes(damage(good, random))
    return _words(damage)


def _words(function: Callable[..., object]) -> str:
    return function.__name__.strip("_").replace("_", " ")
