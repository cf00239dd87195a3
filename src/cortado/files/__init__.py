"""Files that are read and written whole, locks, films, and what a terminal is told. Knows nothing of fluids."""

from typing import TYPE_CHECKING

from cortado.lazy import getter

if not TYPE_CHECKING:
    __getattr__ = getter(__name__)
