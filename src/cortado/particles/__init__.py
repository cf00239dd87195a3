"""Particles on a device: their states, their neighbours, and sums over pairs with derivatives."""

from typing import TYPE_CHECKING

from cortado.lazy import getter

if not TYPE_CHECKING:
    __getattr__ = getter(__name__)
