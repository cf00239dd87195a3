"""The device layer: precisions, launches, compiling, memory, threads, and processes that share work."""

from typing import TYPE_CHECKING

from cortado.lazy import getter

if not TYPE_CHECKING:
    __getattr__ = getter(__name__)
