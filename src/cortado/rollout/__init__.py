"""Steps one after another, forward and back: states, checkpoints, and the way of parameters to a device."""

from typing import TYPE_CHECKING

from cortado.lazy import getter

if not TYPE_CHECKING:
    __getattr__ = getter(__name__)
