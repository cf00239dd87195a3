"""Algorithms for a step: what a solver is, what all of them are made of, and PCISPH."""

from typing import TYPE_CHECKING

from cortado.lazy import getter

if not TYPE_CHECKING:
    __getattr__ = getter(__name__)
