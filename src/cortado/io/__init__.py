"""What is read and written: run folders, trajectories, pictures, videos, reports, progress on a terminal."""

from typing import TYPE_CHECKING

from cortado.lazy import getter

if not TYPE_CHECKING:
    __getattr__ = getter(__name__)
