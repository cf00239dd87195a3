"""Particles on a device: states, neighbours, and sums over pairs of particles with derivatives."""

from typing import TYPE_CHECKING

from cortado.lazy import getter

if not TYPE_CHECKING:
    __getattr__ = getter(__name__)
