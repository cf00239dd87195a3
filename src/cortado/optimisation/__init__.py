"""Optimisers, the problems and coordinates that they search in, fits, and replay logs to resume a search from."""

from typing import TYPE_CHECKING

from cortado.lazy import getter

if not TYPE_CHECKING:
    __getattr__ = getter(__name__)
