"""Optimisers, searches and their coordinates, fits, and logs to resume a search."""

from typing import TYPE_CHECKING

from cortado.lazy import getter

if not TYPE_CHECKING:
    __getattr__ = getter(__name__)
