"""User-defined forces, made from a function, for ``Simulation(scene, forces=[...])``; see `docs/own_parts.md`."""

from cortado.calls import face
from cortado.sph.own_force import Body, OverTime, Pair, Rheology

__all__ = ["Body", "OverTime", "Pair", "Rheology"]

__dir__ = face(globals())
