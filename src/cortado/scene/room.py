"""Where the fluid of a scene may be: in its container, outside of its solids."""

from dataclasses import replace
from functools import lru_cache

from cortado.discretise.room import Room
from cortado.discretise.solid import Solid
from cortado.scene.model import SceneTables
from cortado.scene.solids import SolidTable


def room_of(scene: SceneTables) -> Room:
    """The room of a scene at the start, in which nothing closes a period."""
    lengths = scene.container.periods(scene.dimension)[1]
    region = scene.container.region(scene.dimension).opened(lengths)
    return Room(region, solids_of(scene.solid), lengths)


def resting_room(scene: SceneTables) -> Room:
    """The same without the solids that move."""
    return replace(room_of(scene), solids=solids_of(tuple(solid for solid in scene.solid if not solid.moves)))


@lru_cache(maxsize=8)
def solids_of(tables: tuple[SolidTable, ...]) -> tuple[Solid, ...]:
    """The solids that tables describe, in their order."""
    return tuple(table.solid() for table in tables)
