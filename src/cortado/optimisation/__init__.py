"""Optimisers, what they work on, in which coordinates, and how a search is resumed."""

from typing import TYPE_CHECKING

from cortado.lazy import getter

if not TYPE_CHECKING:
    __getattr__ = getter(__name__)
