"""Solvers: their protocol, their common parts, PCISPH and the projection."""

from typing import TYPE_CHECKING

from cortado.lazy import getter

if not TYPE_CHECKING:
    __getattr__ = getter(__name__)
