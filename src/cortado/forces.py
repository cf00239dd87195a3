"""Forces of one's own, each one function: given to ``Simulation(scene, forces=[...])``; see `docs/own_parts.md`."""

from cortado.sph.body import Body
from cortado.sph.own_force import OverTime
from cortado.sph.pair import Pair

__all__ = ["Body", "OverTime", "Pair"]


def __dir__() -> list[str]:
    return __all__
