"""The device layer: precisions, kernel launches, compilation, memory, threads, and worker processes."""

from typing import TYPE_CHECKING

from cortado.lazy import getter

if not TYPE_CHECKING:
    __getattr__ = getter(__name__)
