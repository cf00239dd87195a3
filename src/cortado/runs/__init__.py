"""Results of a run: trajectories and run folders; and what is computed from its states: quantities and sensors."""

from typing import TYPE_CHECKING

from cortado.lazy import getter

if not TYPE_CHECKING:
    __getattr__ = getter(__name__)
