"""Sequences of steps, forward and backward: states, checkpoints, and the transfer of parameters to a device."""

from typing import TYPE_CHECKING

from cortado.lazy import getter

if not TYPE_CHECKING:
    __getattr__ = getter(__name__)
