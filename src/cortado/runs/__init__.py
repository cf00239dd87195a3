"""What a run leaves: trajectories, folders, reports; what can be read of its states: quantities and sensors."""

from typing import TYPE_CHECKING

from cortado.lazy import getter

if not TYPE_CHECKING:
    __getattr__ = getter(__name__)
